"""What is watched, told to other programs: metrics for Prometheus."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ambid.errors import needs
from ambid.ledger.alarm import KINDS
from ambid.ledger.history import History
from ambid.ledger.monitor import Watched
from ambid.settings.caller import setting


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
