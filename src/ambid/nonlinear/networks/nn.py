"""State-space network from records (thesis eqs 5.1-5.2, fig. 5.9): its weights are A and B, beside a network G(x, u).

Delay -> subspace start -> the thesis's training beside Gauss-Newton (for the learning curves) -> multiple shooting
(option) -> Levenberg-Marquardt on simulation errors -> hidden layer (option) -> predictor gain, where errors are not
white -> global search, where all that failed, and training again -> covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, part_of, silent
from ambid.nonlinear.failed import failed_fit
from ambid.nonlinear.fit import NonlinearFit, Settings
from ambid.nonlinear.networks.delay import LARGEST, found_delay, guessed_delay, late
from ambid.nonlinear.networks.global_start import FAR, global_start, misfit
from ambid.nonlinear.networks.magnitude import nn_of_magnitude
from ambid.nonlinear.networks.nn_result import finished
from ambid.nonlinear.networks.nn_stages import Work, identify, trained_start
from ambid.nonlinear.networks.nn_train import Interrupted, State, added_gain
from ambid.nonlinear.networks.start import SHORT, Start, start_free, start_one_axis
from ambid.nonlinear.records import Scaled, scaled_records
from ambid.nonlinear.settings import checked

_RANGES: Mapping[str, tuple[float, float]] = {
    "states": (1, 20),
    "delay": (0, 1000),
    "neurons": (0, 40),
    "starts": (1, 20),
    "prior": (0.01, 1e6),
    "shooting": (0, 1_000_000),
    "descent": (0, 10_000),
    "iterations": (1, 2000),
    "evaluations": (0, 1_000_000),
}
_CHOICES: Mapping[str, tuple[str, ...]] = {
    "form": ("auto", "one-axis", "free"),
    "connections": ("thesis", "damped", "all"),
    "residual": ("anchored", "orthogonal"),
    "noise": ("auto", "output", "innovations"),
    "output": ("signed", "magnitude"),
    "uncertainty": ("auto", "laplace", "sandwich", "bootstrap", "none"),
}
_DEFAULTS: Mapping[str, object] = {
    "form": "auto",
    "output": "signed",
    "connections": "thesis",
    "neurons": 0,
    "residual": "anchored",
    "prior": 3.0,
    "starts": 3,
    "noise": "auto",
    "shooting": 0,
    "descent": 10,
    "iterations": 50,
    "evaluations": 2000,
    "uncertainty": "auto",
}
_UNITS = {"m": 0, "m/s": 1, "A": 2}
_LONG = (20, 30)  # samples of past for the first model of plants that a short one does not show
_NO_START = "no first network stays finite on these records: check the columns for their size and for jumps"
_BETTER = 1e-2  # of the errors' log determinant, by which a network from the global search must be better
_MORE = 2  # states beyond the outputs, for the delay
_DELAY, _TRAINING, _RESCUE, _AGAIN, _SPREAD = (  # shares of the time: rescues are rare
    (0.0, 0.15), (0.15, 0.8), (0.8, 0.9), (0.9, 0.95), (0.95, 1.0),
)  # fmt: skip


def nn(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Train a state-space network whose weights are A and B (thesis eqs 5.1-5.2, fig. 5.9; with G(x, u): eq. 4.9).

    In the form ``one-axis`` (position, current and perhaps velocity from a voltage) the weights are entries of thesis
    eq. 4.8. Consistent under feedback as far as the predictor gain holds the noise.

    Where all starts of that form fail, there is a global search. The form ``free`` has none: its states have no fixed
    meaning, so that every change of coordinates gives another vector of equal cost, with nothing to bound the entries
    between, and the number of entries grows with the square of the states. Its starts come from subspace models of
    several horizons, which need no search; several random starts serve the hidden layer.

    `records`: of one bench; `settings`: described in the register of structures; `seed`: of the hidden layer's starts,
    the global search and the bootstrap; `tick`: called with the stage and the share of the whole; may raise
    KeyboardInterrupt.
    """
    told = checked("nn", settings, _RANGES, _CHOICES, auto=("states", "delay", "neurons"))
    if told.get("output") == "magnitude":
        return nn_of_magnitude(records, told, seed, tick)
    s = {**_DEFAULTS, **checked("nn", settings, _RANGES, _CHOICES, auto=("states", "delay"))}
    whole = scaled_records("nn", records, lag=40 + int(s.get("delay", 0)))  # type: ignore[call-overload]
    s["form"] = _form(str(s["form"]), records[0])
    work, reason = Work(), ""
    try:
        reason = _started(s, whole, records[0], work, tick)
        if not reason:
            identify(s, work.data, work, seed, part_of(tick, *_TRAINING))
        reason = _rescued(s, whole, records[0], work, seed, tick, reason)
    except KeyboardInterrupt as stop:
        if isinstance(stop, Interrupted):
            work.state = stop.state
        work.status = "stalled"
        work.warnings.insert(0, "interrupted: the best model so far")
        reason = reason or "interrupted before there was a network"
    except np.linalg.LinAlgError as error:
        reason = f"the training broke down: {error}"
        work.state = None
    s["delay"] = work.delay
    if work.state is None:
        return failed_fit("nn", records, {"states": 0, **s}, seed, reason, work.timing_s)
    return finished(
        records, {**s, "states": work.state.layout.n}, work.data, work, seed=seed, tick=part_of(tick, *_SPREAD)
    )


def _form(asked: str, first: IOData) -> str:
    """``one-axis`` where the units are those of thesis eq. 4.8, or it was asked for."""
    units = [first.units.get(x) for x in first.outputs]
    fits = (
        [first.units.get(x) for x in first.inputs] == ["V"]
        and {"m", "A"} <= set(units) <= set(_UNITS)
        and len(set(units)) == len(units)
    )
    if asked == "one-axis" and not fits:
        raise EstimationError(
            "nn: form one-axis wants one input in V and outputs in m and A (and m/s); here "
            f"{', '.join(f'{x} [{first.units.get(x)}]' for x in (*first.inputs, *first.outputs))}. Choose form free"
        )
    return "one-axis" if fits and asked != "free" else "free"


def _heads(record: IOData) -> tuple[int, ...]:
    return tuple(_UNITS[record.units[x]] for x in record.outputs)


def _started(s: Mapping[str, Any], whole: Scaled, record: IOData, work: Work, tick: Tick | None) -> str:
    """Find the delay, and put a first network into `work`; return the reason where there is none."""
    began = perf_counter()
    work.delay = int(s["delay"]) if "delay" in s else guessed_delay(whole)
    work.data = late(whole, work.delay)
    reason = _first(s, work.data, record, work)
    work.timing_s["start"] = perf_counter() - began
    if "delay" in s or work.state is None:
        return reason
    began = perf_counter()
    begun: State | None = work.state
    if s["form"] == "free" and "states" not in s:  # more than are needed: fewer would pass for a delay
        found = start_free(work.data, record.dt, work.data.y_level.size + _MORE)
        begun = trained_start(found, work.data) if isinstance(found, Start) else None
    if begun is None:
        return reason
    before = work.delay
    _delayed(s, begun, whole, work, part_of(tick, *_DELAY))
    if work.delay != before:
        work.state = None
        reason = _first(s, work.data, record, work)
    work.timing_s["delay"] = perf_counter() - began
    return reason


def _delayed(s: Mapping[str, Any], state: State, whole: Scaled, work: Work, tick: Tick | None) -> None:
    """Find the delay by short trainings from a first network."""
    rather_late = s["form"] == "free" and "states" not in s
    work.delay, errors = found_delay(state, whole, work.delay, tick, rather_late=rather_late)
    work.data = late(whole, work.delay)
    work.details["tried_delays"] = [{"delay": k, "log_det_errors": v} for k, v in errors.items()]
    if work.delay == LARGEST:
        work.warnings.append(
            f"the delay that fits best is the largest looked for, {LARGEST} samples: give delay if inputs act later"
        )


def _subspace(s: Mapping[str, Any], data: Scaled, record: IOData, past: int) -> Start | str:
    if s["form"] == "one-axis":
        return start_one_axis(data, record.dt, _heads(record), s["connections"], past)
    return start_free(data, record.dt, s.get("states") or data.y_level.size, past)


def _first(s: Mapping[str, Any], data: Scaled, record: IOData, work: Work) -> str:
    """Put a first network into `work`; return the reason where there is none."""
    reason = ""
    for past in (SHORT, *_LONG):
        found = _subspace(s, data, record, past)
        state = trained_start(found, data) if isinstance(found, Start) else None
        if state is not None and (work.state is None or state.score < work.state.score):
            work.state = state
        if state is not None and state.without_gain().simulates(data):
            break
        reason = reason or (found if isinstance(found, str) else _NO_START)
    return "" if work.state is not None else reason


def _rescued(
    s: Mapping[str, Any], whole: Scaled, record: IOData, work: Work, seed: int, tick: Tick | None, reason: str
) -> str:
    """Search globally where ordinary starts failed, and train what was found; return what is left of the reason."""
    before, why = work.state, reason
    if before is not None:
        unexplained = misfit(before, work.data)
        if unexplained > FAR:
            why = f"a linear regression on the past explains {100 * unexplained:.0f} % of the errors' variance"
    if not why or s["form"] != "one-axis" or not s["evaluations"]:
        return reason
    began, second = perf_counter(), Work(data=work.data, delay=work.delay)
    try:
        second.state, found = global_start(
            work.data, record.dt, _heads(record), s["connections"], seed=seed, evaluations=int(s["evaluations"]),
            tick=part_of(tick, *_RESCUE) or silent,
        )  # fmt: skip
        if second.state is not None:
            if "delay" not in s:
                _delayed(s, second.state, whole, second, None)
                if second.delay != work.delay:
                    second.state = _carried(second.state, second.data)
            identify({**s, "descent": 0}, second.data, second, seed, part_of(tick, *_AGAIN))
    except KeyboardInterrupt as stop:
        after = stop.state if isinstance(stop, Interrupted) else second.state
        work.state = after if _better(after, before) else before
        raise KeyboardInterrupt from stop
    work.timing_s["global search"] = perf_counter() - began
    after = second.state
    better = _better(after, before)
    work.details["global_search"] = {
        "why": why, "failed_starts": 1 + len(_LONG), "evaluations": found.evaluations, "seconds": found.seconds,
        "log_det_errors_before": None if before is None else before.score,
        "log_det_errors_after": None if after is None else after.score, "taken": better,
    }  # fmt: skip
    said = f"{1 + len(_LONG)} ordinary starts failed ({why}): differential evolution, {found.evaluations} evaluations, "
    if not better or after is None:
        work.warnings.append(said + "found nothing better. Check channels, their signs and units, and the delay")
        return reason
    if before is None:
        work.warnings.append(said + f"found a network whose errors have {_size(after)} of the outputs' deviations")
    else:
        work.warnings.append(
            said + f"improved the errors from {_size(before)} to {_size(after)} of the outputs' deviations"
        )
    work.state, work.base, work.status = after, second.base, second.status
    work.data, work.delay, work.rivals = second.data, second.delay, second.rivals
    work.curves += second.curves
    return ""


def _carried(state: State, data: Scaled) -> State:
    """The same network on other data."""
    bare = State.of(state.layout, state.theta, data)
    return added_gain(bare, data, state.K) or state


def _better(after: State | None, before: State | None) -> bool:
    return after is not None and (before is None or after.score < before.score - _BETTER)


def _size(state: State) -> str:
    """Errors in deviations of the outputs, the geometric mean over outputs."""
    return f"{np.exp(state.score / state.layout.p / 2.0):.3g}"
