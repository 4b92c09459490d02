"""Measured records: linear models beside peers, judged on data that were not used to estimate them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambid.blackbox.model import Offsets, StateSpaceModel
from peers import Answer, Array, Bench, Way, bench, ways
from table import Table
from timing import quantity

DATA = Path(os.environ.get("AMBID_RECORDS") or Path(__file__).resolve().parents[2] / "shared" / "data") / "benchmarks"
LIMIT_S = 20.0
AHEAD = (1, 10)  # samples, where a plant cannot be simulated

Part = tuple[int, int]
Fits = tuple[tuple[str, Mapping[str, int]], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One record, which part is fitted and which parts judge, and the models to fit.

    The initial state of a test is fitted to its first `start` samples, and the score begins after them; with
    `own_level`, the mean error is no error. Where a simulation says nothing, predictions are judged.
    """

    group: str
    file: str
    fitted: Part
    judged: Mapping[str, Part]
    fits: Fits
    start: int
    before: str
    unit: float = 1.0
    simulated: bool = True
    own_level: bool = True
    feedback: bool = False


_SECOND: Fits = (
    ("oe", {"nb": 3, "nf": 2, "nk": 0}),
    ("bj", {"nb": 3, "nc": 2, "nd": 2, "nf": 2, "nk": 0}),
    ("armax", {"na": 2, "nb": 3, "nc": 2, "nk": 0}),
    ("n4sid", {"n": 2, "horizon": 15, "feedthrough": 1}),
)
_SCORE = (
    "NRMSE = |y - ŷ| / |y - mean y| on data not used in estimation; the initial state is fitted to the first {start}"
    " samples, which do not count. "
)
_LEVEL = "The mean of the error does not count either: the level of these records wanders."
CASES = (
    Case(
        group="Silverbox: linear models of order 2",
        file="silverbox.csv",
        fitted=(40_650, 105_712),
        judged={"multisine": (105_712, 127_400), "arrow": (100, 40_575), "arrow within range": (100, 32_100)},
        fits=_SECOND,
        start=50,
        unit=1e3,
        own_level=False,
        before="The division of the public benchmark: 65 062 samples of multisine to estimate; tests on 21 688 samples"
        " of multisine, on the whole arrow (its end is larger than anything in the estimation data) and on its first"
        " 32 000 samples. Published linear models of order 2: about 13 % on the multisine. "
        + "Simulation from the input alone. "
        + _SCORE.format(start=50)
        + "RMSE in mV.",
    ),
    Case(
        group="Hair dryer",
        file="dryer.csv",
        fitted=(0, 500),
        judged={"second half": (500, 1000)},
        fits=(
            ("arx", {"na": 2, "nb": 2, "nk": 3}),
            ("oe", {"nb": 2, "nf": 2, "nk": 3}),
            ("armax", {"na": 2, "nb": 2, "nc": 2, "nk": 3}),
            ("bj", {"nb": 2, "nc": 1, "nd": 1, "nf": 2, "nk": 3}),
            ("n4sid", {"n": 4, "horizon": 15}),
        ),
        start=20,
        before="DaISy, 1000 samples of 0.08 s; the first half is fitted. Simulation from the input alone. "
        + _SCORE.format(start=20)
        + _LEVEL,
    ),
    *(
        Case(
            group=f"Coupled electric drives, record {k}",
            file=f"coupled_drives_{k}.csv",
            fitted=(0, 300),
            judged={"last 200 samples": (300, 500)},
            fits=(
                ("arx", {"na": 3, "nb": 3, "nk": 1}),
                ("armax", {"na": 3, "nb": 3, "nc": 3, "nk": 1}),
                ("bj", {"nb": 3, "nc": 2, "nd": 2, "nf": 3, "nk": 1}),
                ("n4sid", {"n": 3, "horizon": 12}),
            ),
            start=20,
            simulated=False,
            before=f"500 samples at 50 Hz, PRBS of {level} V; the first 300 are fitted. The sensor shows the absolute"
            " value of the speed and the input is symmetric, so that every linear simulation is off by about 100 %:"
            f" predictions {AHEAD[0]} and {AHEAD[1]} samples ahead are compared, the later input known. "
            + _SCORE.format(start=20)
            + _LEVEL,
        )
        for k, level in ((1, 1.0), (2, 1.5), (3, 0.5))
    ),
    Case(
        group="Ball and beam: unstable, under feedback",
        file="ball_and_beam.csv",
        fitted=(0, 500),
        judged={"second half": (500, 1000)},
        fits=(
            ("arx", {"na": 2, "nb": 2, "nk": 1}),
            ("armax", {"na": 2, "nb": 2, "nc": 2, "nk": 1}),
            ("n4sid", {"n": 2, "horizon": 10}),
            ("pbsid", {"n": 2, "horizon": 10}),
        ),
        start=20,
        simulated=False,
        feedback=True,
        before="DaISy, 1000 samples of 0.1 s; the first half is fitted. The plant is a double integrator, so that a"
        f" simulation runs away, and so does the predictor of OE and BJ: predictions {AHEAD[0]} and {AHEAD[1]} samples"
        " ahead by the others are compared, the later input known. " + _SCORE.format(start=20) + _LEVEL,
    ),
)


def record_tables() -> Iterator[Table]:
    """One table for each record; none where the data are not there."""
    if not DATA.is_dir():
        print("the measured records are not beside this checkout: no tables of them", flush=True)
        return
    with bench() as children:
        for case in CASES:
            print(case.group, flush=True)
            yield _table(case, children)


def _table(case: Case, children: Bench) -> Table:
    values = np.loadtxt(DATA / case.file, delimiter=",", skiprows=1)
    u, y = values[:, 1], values[:, 2]
    first, last = case.fitted
    rows: list[tuple[str, ...]] = []
    data: dict[str, object] = {}
    for structure, orders in case.fits:
        for way in ways(structure):
            found = _fitted(children, way, structure, orders, u[first:last], y[first:last], not case.feedback)
            scores = {name: _score(case, found, u[a:b], y[a:b]) for name, (a, b) in case.judged.items()}
            rows.append((_order(structure, orders), way.label, *_cells(case, found, scores)))
            data[f"{structure}; {way.label}"] = {
                "seconds": found.seconds, "problem": found.problem, "scores": {k: list(v) for k, v in scores.items()}
            }  # fmt: skip
    columns = [c for name in case.judged for c in _columns(case, name)]
    return Table(
        group=case.group,
        columns=("model", "program", *columns, "time"),
        rows=tuple(rows),
        before=case.before,
        data=data,
    )


def _columns(case: Case, name: str) -> Iterator[str]:
    if not case.simulated:
        yield from (f"{name}, {k} ahead" for k in AHEAD)
        return
    if case.unit != 1.0:
        yield f"{name}, RMSE"
    yield f"{name}, NRMSE"


def _cells(case: Case, found: Answer, scores: Mapping[str, tuple[float, ...]]) -> Iterator[str]:
    for score in scores.values():
        for k, value in enumerate(score):
            rmse = case.simulated and k == 0
            if rmse and case.unit == 1.0:
                continue
            shown = f"{value * case.unit:.2f}" if rmse else f"{value:.1%}".replace("%", " %")
            yield shown if np.isfinite(value) else "–"
    yield quantity(found.seconds, "s") if found.model is not None else found.problem.split(":")[0]


def _fitted(
    children: Bench, way: Way, structure: str, orders: Mapping[str, int], u: Array, y: Array, open_loop: bool
) -> Answer:
    """Fit; the peers get the record with the means taken off, which then are their offsets."""
    if way.program == "ambid":
        orders = {k: v for k, v in orders.items() if k != "horizon"}  # it finds its own
        children.answer(way, structure, orders, u, y, open_loop=open_loop)  # whatever is compiled is not measured
        return children.answer(way, structure, orders, u, y, open_loop=open_loop)
    means = Offsets(u=np.array([np.mean(u)]), y=np.array([np.mean(y)]))
    found = children.answer(way, structure, orders, u - means.u, y - means.y, limit_s=LIMIT_S)
    return Answer(seconds=found.seconds, model=found.model, offsets=means, problem=found.problem)


def _score(case: Case, found: Answer, u: Array, y: Array) -> tuple[float, ...]:
    """RMSE and NRMSE of the simulation, or NRMSE of the predictions."""
    if found.model is None or found.offsets is None:
        return (np.nan,) * (2 if case.simulated else len(AHEAD))
    g = found.model.state_space()
    u, y = u - found.offsets.u, y - found.offsets.y
    spread = float(np.std(y[case.start :]))
    if case.simulated:
        error = _counted(case, y - simulated(g, u, y, case.start))
        rmse = float(np.sqrt(np.mean(error**2)))
        return (rmse, rmse / spread) if rmse < 1e3 * spread else (np.nan, np.nan)
    errors = [_counted(case, y - predicted(g, u, y, k, case.start)) for k in AHEAD]
    ratios = [float(np.sqrt(np.mean(e**2))) / spread for e in errors]
    return tuple(r if r < 1e3 else np.nan for r in ratios)


def _counted(case: Case, error: Array) -> Array:
    error = error[case.start :]
    return error - np.mean(error) if case.own_level and np.all(np.isfinite(error)) else error


def simulated(g: StateSpaceModel, u: Array, y: Array, start: int) -> Array:
    """Simulate, the initial state by least squares over the first `start` samples."""
    driven = _run(g.A, g.B, g.C, g.D, u[:, None], np.zeros(g.order), u.size)
    free = np.stack([_run(g.A, g.B, g.C, g.D, None, x, start) for x in np.eye(g.order)], axis=1)
    x0 = np.linalg.lstsq(free, y[:start] - driven[:start], rcond=1e-8)[0]
    return _run(g.A, g.B, g.C, g.D, u[:, None], x0, u.size)


def predicted(g: StateSpaceModel, u: Array, y: Array, ahead: int, start: int) -> Array:
    """Predict `ahead` samples ahead by the innovations form, the later inputs known; the initial state as above."""
    F, z = g.A - g.K @ g.C, np.stack([u, y], axis=1)
    G, D = np.hstack([g.B - g.K @ g.D, g.K]), np.hstack([g.D, np.zeros((1, 1))])
    if np.max(np.abs(np.linalg.eigvals(F)), initial=0.0) >= 1.0:
        return np.full(y.size, np.inf)
    driven = _run(F, G, g.C, D, z, np.zeros(g.order), start)
    free = np.stack([_run(F, G, g.C, D, None, x, start) for x in np.eye(g.order)], axis=1)
    x = np.linalg.lstsq(free, y[:start] - driven, rcond=1e-8)[0]
    states = np.empty((y.size + 1, g.order))
    for t in range(y.size):
        states[t] = x
        x = F @ x + G @ z[t]
    out = np.full(y.size, np.nan)
    for t in range(y.size - ahead + 1):  # from the state that knows y up to t - 1 to the output of t + ahead - 1
        x = states[t]
        for k in range(ahead - 1):
            x = g.A @ x + g.B[:, 0] * u[t + k]
        out[t + ahead - 1] = g.C[0] @ x + g.D[0, 0] * u[t + ahead - 1]
    out[: ahead - 1] = y[: ahead - 1]
    return out


def _run(A: Array, B: Array, C: Array, D: Array, u: Array | None, x: Array, n: int) -> Array:
    """Output of a state space; stops where it runs away."""
    out = np.full(n, np.inf)
    for t in range(n):
        out[t] = C[0] @ x + (0.0 if u is None else D[0] @ u[t])
        x = A @ x + (0.0 if u is None else B @ u[t])
        if abs(out[t]) > 1e12:
            break
    return out


def _order(structure: str, orders: Mapping[str, int]) -> str:
    if "n" in orders:
        return f"{structure.upper()}, n = {orders['n']}"
    return f"{structure.upper()}({', '.join(f'{k} {v}' for k, v in orders.items())})"
