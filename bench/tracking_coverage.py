"""The track of docs/online.md: how often its 95 % bands hold the truth, parameter by parameter, over many records.

The lines of one record share their data and their start: within a record a band holds the truth nearly always or
nearly never. Only the mean over records tells whether the standard deviations are right, and its spread how surely.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field

import numpy as np

from ambid.job.tracking import track
from ambid.physics.presets import preset
from ambid.simulation import simulate_scenario, truth_columns
from table import Table
from tracking_benches import PHYSICAL, START_S, Array

SEEDS, BAR_SEEDS, DRIFTS = 100, 40, 20
AT_S, LENGTH_S = 2.0, 4.0
SOON_S = 0.3  # after a change: what is published comes from few samples
DRIFT_S, SLOPE = 10.0, 0.2 / 60.0  # of R, per second: a fifth in a minute
GROUP = "Tracking: coverage of the bands"
COLUMNS = ("scenario", "lines", *PHYSICAL)
_Z = 1.959964


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A scenario of the unstable bearing, and the stretches of time over which lines are counted apart."""

    name: str
    scenario: str
    seeds: int
    seconds: float = LENGTH_S
    memory: str = "auto"
    words: dict[str, float] = field(default_factory=dict)
    stretches: tuple[tuple[float, float], ...] = ()


CASES = (
    Case(
        name="change",
        scenario="change",
        seeds=SEEDS,
        words={"at_s": AT_S},
        stretches=((START_S, AT_S), (AT_S, AT_S + SOON_S), (AT_S + SOON_S, LENGTH_S)),
    ),
    Case(name="change, memory all", scenario="change", seeds=SEEDS, memory="all", words={"at_s": AT_S}),
    Case(
        name="drift of R",
        scenario="drift",
        seeds=DRIFTS,
        seconds=START_S + DRIFT_S,
        words={"at_s": START_S, "size": 0.2},
        stretches=((START_S, START_S + 5.0), (START_S + 5.0, START_S + DRIFT_S)),
    ),
)


def scores(case: Case, seed: int) -> tuple[Array, Array]:
    """Track one record; return the times of its lines and errors in published sd, NaN in stale lines.

    Returns `times`: (n_lines,), s; `scores`: (n_lines, n_parameters).
    """
    done = simulate_scenario(
        case.scenario, preset("unstable-bearing"), duration_s=case.seconds, seed=seed, **case.words
    )
    followed = track(done.record, start=START_S, memory=case.memory)  # type: ignore[arg-type]
    t = np.array([line.t for line in followed.lines])
    columns = truth_columns(done.record)
    found = np.empty((t.size, len(PHYSICAL)))
    for j, name in enumerate(PHYSICAL):
        known = [line.parameters[name] for line in followed.lines]
        true = np.interp(t, done.record.time_s, columns[name].values) if name in columns else done.truth[name]
        error = np.array([p.value for p in known]) - true
        found[:, j] = np.where([p.stale for p in known], np.nan, error / np.array([p.sd for p in known]))
    return t, found


def coverage_tables() -> Iterator[Table]:
    """One table over all cases."""
    rows: list[tuple[str, ...]] = []
    remarks: list[str] = []
    data: dict[str, object] = {}
    for case in CASES:
        every = [scores(case, seed) for seed in range(1, case.seeds + 1)]
        t, z = every[0][0], np.array([found for _, found in every])
        for first, last in case.stretches or ((START_S, case.seconds),):
            within = (t > first) & (t <= last + 1e-9)
            rows.append((case.name, f"{first:g} to {last:g} s", *_shares(z[:, within])))
        if case.stretches:
            rows.append((case.name, "all", *_shares(z)))
        if case.name == "change":
            rows.append((case.name, f"all, seeds 1 to {BAR_SEEDS}", *_shares(z[:BAR_SEEDS])))
            of_each = np.nanmean(_inside(z), axis=1)
            spread = ", ".join(f"{name} {s:.0%}" for name, s in zip(PHYSICAL, of_each.std(axis=0), strict=True))
            remarks.append(f"Spread (sd) of the share between records of `change`: {spread}.")
        data[case.name] = {**asdict(case), "inside": np.nanmean(_inside(z), axis=1).tolist()}
        for row in rows[-4:]:
            print("; ".join(row), flush=True)
    before = (
        f"The unstable bearing at 20 kHz, start from its first {START_S:g} s, a line each 10 ms. `change` is the record"
        f" of [this page](online.md): k_i falls by 15 % at {AT_S:g} s. Share of the lines that are not stale whose"
        f" band contains the true value, mean over {SEEDS} records ({DRIFTS} of the drift) ± its standard error. In"
        " `change`, k_i is outside from the change to its detection, some 10 ms, and stale until its new value is"
        f" accepted. In the last, R rises by {SLOPE:.2%} a second from {START_S:g} s on."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, remarks=tuple(remarks), data=data)


def _inside(z: Array) -> Array:
    return np.where(np.isnan(z), np.nan, np.abs(z) < _Z)


def _shares(z: Array) -> list[str]:
    """Mean over records of the share inside, and its standard error; `z`: (n_records, n_lines, n_parameters)."""
    share = np.nanmean(_inside(z), axis=1)
    sd = share.std(axis=0, ddof=1) / np.sqrt(share.shape[0])
    return [f"{m:.1%} ± {100 * s:.1f}" for m, s in zip(share.mean(axis=0), sd, strict=True)]
