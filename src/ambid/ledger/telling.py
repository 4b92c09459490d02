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
from ambid.estimation.estimate import plain_json
from ambid.ledger.alarm import KINDS
from ambid.ledger.history import History
from ambid.ledger.monitor import Now, Watched
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
    since = gauge("parameter_timestamp_seconds", "When the record of the latest usable value was taken", "parameter")
    age = gauge("parameter_age_seconds", "Age of the latest usable value when this was written", "parameter")
    taken = gauge("record_timestamp_seconds", "When the record of the latest estimate was taken, usable or not")
    success = gauge("success_timestamp_seconds", "When the record of the latest usable estimate was taken")
    overdue = gauge("overdue_timestamp_seconds", "From when the next estimate is overdue")
    verdict = gauge("verdict", "1 for the verdict of the latest estimate", "verdict")
    failures = gauge("failures", "Records without an estimate")
    alarm = gauge("alarm", "1 where the alarm stands and nobody has taken note", "parameter", "rule")
    noted = gauge("alarm_noted", "1 where it stands and was acknowledged or silenced", "parameter", "rule")
    Gauge("ambid_watched_timestamp_seconds", "When this was written", registry=registry).set(watched.at)
    for s in watched.states:
        failures.labels(s.bearing).set(s.failures)
        for word in ("usable", "caution", "unusable"):
            verdict.labels(s.bearing, word).set(word == s.verdict)
        if s.latest is not None:
            taken.labels(s.bearing).set(s.latest)
        if s.heard is not None:
            overdue.labels(s.bearing).set(s.heard + s.overdue_s)
        if s.success is not None:
            success.labels(s.bearing).set(s.success)
        for kind in KINDS if watched.records else ():
            for each in (alarm, noted):
                each.labels(s.bearing, "", kind).set(0)
    for h in watched.used or ():
        for name, x in _latest(h).items():
            value.labels(h.bearing, name, x["unit"]).set(x["value"])
            sd.labels(h.bearing, name, x["unit"]).set(x["sd"])
            since.labels(h.bearing, name).set(x["taken_at"])
            age.labels(h.bearing, name).set(watched.at - x["taken_at"])
            for rule in (str(r) for r in watched.rules if r.of(name)):
                for each in (alarm, noted):
                    each.labels(h.bearing, name, rule).set(0)
    for a in watched.standing:
        (alarm if a.open else noted).labels(a.bearing, a.parameter, a.rule).set(1)
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
            client.publish(f"{topic.strip('/')}/{_plain(s.bearing)}", message(watched, s), qos=1, retain=True)
            for s in watched.states
        ]
        for one in sent:
            one.wait_for_publish(PATIENCE_S)
        lost = sum(not one.is_published() for one in sent)
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


def message(watched: Watched, s: Now) -> str:
    """Return what is published of a bearing, as JSON."""
    values = {name: x for h in watched.used or () if h.bearing == s.bearing for name, x in _latest(h).items()}
    for x in values.values():
        x["age_s"] = watched.at - x["taken_at"]
    return json.dumps(plain_json(
        {
            "schema": "ambid.message/1", "bearing": s.bearing, "at": watched.at, "taken_at": s.latest,
            "verdict": s.verdict, "success_at": s.success, "overdue_s": s.overdue_s, "failures": s.failures,
            "values": values, "alarms": [asdict(a) for a in watched.standing if a.bearing == s.bearing],
        }
    ))  # fmt: skip
