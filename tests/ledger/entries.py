"""Entries made by hand: no identification."""

from ambid.estimation.estimate import EstimatedParameter
from ambid.ledger.entry import Entry

DAY = 86400.0
BEGIN = 1767225600.0  # 2026-01-01, UTC


def parameter(name, value, sd, *, unit="N/A", seen=True, role="free"):
    ends = (value - 1.96 * sd, value + 1.96 * sd)
    return EstimatedParameter(name=name, unit=unit, value=value, sd=sd, ci95=ends, role=role, identifiable=seen)


def entry(k=0, bearing="A", *, parameters=None, verdict="usable", failed=(), rig="one", day=None, **more):
    given = (parameter("k_i", 80.0 - 0.1 * k, 0.5), parameter("R", 4.2, 0.02, unit="ohm"))
    said = {
        "taken_at": BEGIN + DAY * (k if day is None else day), "sha": f"{bearing}{k}", "rig_sha": rig, "settings": "{}",
        "version": "0.1.0", "job": "identify", "record": f"day{k}.h5", "status": "converged", "verdict": verdict,
        "model": "one-axis", "failed": failed, "parameters": given if parameters is None else parameters,
        "rig_name": f"bench {bearing}", "rig": f'name = "{rig}"\n',
    }  # fmt: skip
    return Entry(bearing=bearing, **{**said, **more})
