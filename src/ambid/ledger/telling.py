"""What is watched, told to other programs: metrics for Prometheus, messages over MQTT."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import numpy as np

from ambid.errors import AmbidError, counted, needs
from ambid.ledger.history import History
from ambid.ledger.monitor import Watched
from ambid.settings.caller import setting

PATIENCE_S = 10.0  # for which a broker may stay silent


def write_metrics(watched: Watched, path: str | Path) -> None:
    """Write gauges as a text file that Prometheus' node exporter collects; needs the extra ``ambid[metrics]``.

    Parameters
    ----------
    watched : Watched
        From `watch`.
    path : str or Path
        ``.prom``; replaced at once.

    Raises
    ------
    AmbidError
        If prometheus-client is not installed.
    """
    with needs("prometheus-client", setting("publish"), "metrics"):
        from prometheus_client import CollectorRegistry, Gauge, generate_latest
    registry = CollectorRegistry()

    def gauge(name: str, says: str, *labels: str) -> Any:
        return Gauge(f"ambid_{name}", says, ("bearing", *labels), registry=registry)

    value = gauge("parameter", "Latest usable value, SI", "parameter", "unit")
    sd = gauge("parameter_sd", "Its standard deviation, SI", "parameter", "unit")
    taken = gauge("record_timestamp_seconds", "When the latest record was taken")
    alarm = gauge("alarm", "1 where the alarm stands", "parameter", "rule")
    for h in watched.used or ():
        taken.labels(h.bearing).set(h.estimates[-1].taken_at)
        for name, x in _latest(h).items():
            value.labels(h.bearing, name, x["unit"]).set(x["value"])
            sd.labels(h.bearing, name, x["unit"]).set(x["sd"])
            for rule in watched.rules:
                if rule.of(name):
                    alarm.labels(h.bearing, name, str(rule)).set(0)
    for a in watched.standing:
        alarm.labels(a.bearing, a.parameter, a.rule).set(1)
    Path(path).write_bytes(generate_latest(registry))


def publish(watched: Watched, where: str) -> int:
    """Send a retained message for each bearing to a broker of MQTT; needs the extra ``ambid[mqtt]``.

    User and password are taken from ``AMBID_MQTT_USER`` and ``AMBID_MQTT_PASSWORD``: no list of processes shows them.

    Parameters
    ----------
    watched : Watched
        From `watch`.
    where : str
        ``[mqtts://]HOST[:PORT]/TOPIC``; with ``mqtts://`` over TLS. The topic of a bearing is ``TOPIC/its name``.

    Returns
    -------
    int
        Messages that the broker has confirmed.

    Raises
    ------
    AmbidError
        If paho-mqtt is not installed, the address is none, or the broker does not take the messages.
    """
    with needs("paho-mqtt", setting("publish"), "mqtt"):
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion
    if "@" in where:
        raise AmbidError(
            f"{setting('publish')} takes no user or password: give AMBID_MQTT_USER and AMBID_MQTT_PASSWORD instead"
        )
    plain = where.removeprefix("mqtts://")
    address, _, topic = plain.removeprefix("mqtt://").partition("/")
    host, _, port = address.partition(":")
    secure = plain != where
    if not host or not topic.strip("/") or set(topic) & set("+#") or not (not port or port.isdigit()):
        raise AmbidError(
            f"{setting('publish')} is {where!r}; it must be HOST[:PORT]/TOPIC, such as localhost/works. Correct it"
        )
    replies = Queue[str]()
    client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5)
    client.on_connect = lambda *given: replies.put("" if not given[3].is_failure else str(given[3]))
    if secure:
        client.tls_set()
    if "AMBID_MQTT_USER" in os.environ:
        client.username_pw_set(os.environ["AMBID_MQTT_USER"], os.environ.get("AMBID_MQTT_PASSWORD", ""))
    try:
        client.connect(host, int(port) if port else 8883 if secure else 1883)
        client.loop_start()
        refused = replies.get(timeout=PATIENCE_S)
        if refused:
            raise AmbidError(f"{setting('publish', where)}: {refused}. Check user and password")
        sent = [
            client.publish(f"{topic.strip('/')}/{_plain(h.bearing)}", _message(watched, h), qos=1, retain=True)
            for h in watched.used or ()
        ]
        for message in sent:
            message.wait_for_publish(PATIENCE_S)
        lost = sum(not message.is_published() for message in sent)
        if lost:
            raise AmbidError(
                f"{setting('publish', where)}: the broker did not confirm {counted(lost, 'message')}. Check it"
            )
    except Empty:
        raise AmbidError(
            f"{setting('publish', where)}: the broker was silent for {PATIENCE_S:.0f} s. Check it"
        ) from None
    except (OSError, ValueError, RuntimeError) as failure:
        raise AmbidError(f"{setting('publish', where)}: {failure}. Check broker, user and network") from None
    finally:
        client.disconnect()
        client.loop_stop()
    return len(sent)


def _plain(name: str) -> str:
    """A bearing's name as one level of a topic."""
    return "".join("_" if c in "+#/\0" else c for c in name)


def _latest(h: History) -> dict[str, dict[str, Any]]:
    """Return the latest known number of each parameter."""
    latest = {}
    for s in h.measured.values():
        known = np.flatnonzero(np.isfinite(s.value))
        if known.size:
            k = known[-1]
            latest[s.name] = {
                "value": float(s.value[k]), "sd": float(s.sd[k]), "unit": s.unit, "taken_at": float(s.taken_at[k]),
            }  # fmt: skip
    return latest


def _message(watched: Watched, h: History) -> str:
    return json.dumps(
        {
            "schema": "ambid.message/1", "bearing": h.bearing, "taken_at": h.estimates[-1].taken_at,
            "verdict": h.estimates[-1].verdict, "values": _latest(h),
            "alarms": [asdict(a) for a in watched.standing if a.bearing == h.bearing],
        }
    )  # fmt: skip
