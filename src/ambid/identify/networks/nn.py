"""State-space network from records (thesis eqs 5.1-5.2, fig. 5.9): its weights are A and B, beside a network G(x, u).

Subspace start -> the thesis's training beside Gauss-Newton (for the learning curves) -> multiple shooting (option) ->
Levenberg-Marquardt on simulation errors -> hidden layer (option) -> predictor gain, where the errors are not white ->
covariance. Errors of all outputs are weighted by their covariance, found on the way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify.blackbox.data import IOData
from ambid.identify.networks.failed import failed_fit
from ambid.identify.networks.nn_result import finished
from ambid.identify.networks.nn_train import (
    Interrupted,
    State,
    added_gain,
    added_network,
    descended,
    trained,
    white,
)
from ambid.identify.networks.records import Scaled, scaled_records
from ambid.identify.networks.search import Tick
from ambid.identify.networks.settings import checked
from ambid.identify.networks.shooting import shooting
from ambid.identify.networks.start import SHORT, Start, start_free, start_one_axis
from ambid.identify.nonlinear.fit import LearningCurve, NonlinearFit, Settings

Array = NDArray[np.float64]

_RANGES: Mapping[str, tuple[float, float]] = {
    "states": (1, 20),
    "delay": (0, 1000),
    "neurons": (0, 40),
    "starts": (1, 20),
    "prior": (0.01, 1e6),
    "shooting": (0, 1_000_000),
    "descent": (0, 10_000),
    "iterations": (1, 2000),
}
_CHOICES: Mapping[str, tuple[str, ...]] = {
    "form": ("auto", "one-axis", "free"),
    "connections": ("thesis", "damped", "all"),
    "residual": ("anchored", "orthogonal"),
    "noise": ("auto", "output", "innovations"),
}
_DEFAULTS: Mapping[str, object] = {
    "form": "auto",
    "connections": "thesis",
    "delay": 0,
    "neurons": 0,
    "residual": "anchored",
    "prior": 3.0,
    "starts": 3,
    "noise": "auto",
    "shooting": 0,
    "descent": 10,
    "iterations": 50,
}
_UNITS = {"m": 0, "m/s": 1, "A": 2}
_LONG = (20, 30)  # samples of past for the first model of plants that a short one does not show
_NO_START = "no first network stays finite on these records: check the columns for their size and for jumps"
_LARGEST = 5  # states beyond the outputs that are tried


@dataclass(slots=True)
class Work:
    """What a fit has come to, so that an interruption loses nothing.

    Attributes
    ----------
    state : State or None
        The best network so far; None before the first.
    status : {"converged", "stalled"}
    curves : list of LearningCurve
    warnings : list of str
    timing_s : dict of str to float
    details : dict
    """

    state: State | None = None
    status: Literal["converged", "stalled"] = "converged"
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)


def nn(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Train a state-space network whose weights are A and B (thesis eqs 5.1-5.2, fig. 5.9; with G(x, u): eq. 4.9).

    In the form ``one-axis`` (position, current and perhaps velocity from a voltage) the weights are entries of thesis
    eq. 4.8. Consistent under feedback as far as the predictor gain holds the noise.

    Parameters
    ----------
    records : sequence of IOData
        Of one bench.
    settings : Mapping
        Described in the register of structures.
    seed : int, optional
        Of the hidden layer's starts.
    tick : callable, optional
        Called with the stage; may raise KeyboardInterrupt.

    Returns
    -------
    NonlinearFit

    Raises
    ------
    EstimationError
        If a setting is not known, records do not belong together, are too short, or a channel does not move.
    """
    s = {**_DEFAULTS, **checked("nn", settings, _RANGES, _CHOICES)}
    data = _late(scaled_records("nn", records, lag=40 + int(s["delay"])), int(s["delay"]))  # type: ignore[call-overload]
    work = Work()
    s["form"] = _form(str(s["form"]), records[0])
    try:
        reason = _first(s, data, records[0], work)
        if not reason:
            _identify(s, data, work, seed, tick)
    except KeyboardInterrupt as stop:
        if isinstance(stop, Interrupted):
            work.state = stop.state
        work.status = "stalled"
        work.warnings.insert(0, "interrupted: the best model so far")
    except np.linalg.LinAlgError as error:
        reason = f"the training broke down: {error}"
        work.state = None
    if work.state is None:
        used = {"states": 0, **s}
        return failed_fit("nn", records, used, seed, reason, work.timing_s)
    return finished(records, {**s, "states": work.state.layout.n}, data, work, seed=seed)


def _late(data: Scaled, delay: int) -> Scaled:
    """Put each output beside the input that acts at its time."""
    if not delay:
        return data
    return replace(data, parts=tuple((y[delay:], u[:-delay]) for y, u in data.parts))


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


def _first(s: Mapping[str, Any], data: Scaled, record: IOData, work: Work) -> str:
    """Put a first network into `work`; return the reason where there is none."""
    began = perf_counter()
    found: Start | str
    reason = ""
    for past in (SHORT, *_LONG):
        if s["form"] == "one-axis":
            heads = tuple(_UNITS[record.units[x]] for x in record.outputs)
            found = start_one_axis(data, record.dt, heads, s["connections"], past)
        else:
            found = start_free(data, record.dt, s.get("states") or data.y_level.size, past)
        state = trained_start(found, data) if isinstance(found, Start) else None
        if state is not None and (work.state is None or state.score < work.state.score):
            work.state = state
        if state is not None and state.without_gain().simulates(data):
            break
        reason = reason or (found if isinstance(found, str) else _NO_START)
    work.timing_s["start"] = perf_counter() - began
    return "" if work.state is not None else reason


def trained_start(start: Start, data: Scaled) -> State | None:
    """Return the start with its gain, if it runs; else None.

    Parameters
    ----------
    start : Start
    data : Scaled

    Returns
    -------
    State or None
    """
    return added_gain(State.of(start.layout, start.theta, data), data, start.K)


def _identify(s: dict[str, Any], data: Scaled, work: Work, seed: int, tick: Tick | None) -> None:
    if tick is not None:
        tick("start")
    began = perf_counter()
    if s["form"] == "free" and "states" not in s:
        _choose_states(data, work, tick)
    assert work.state is not None
    first = work.state
    if s["descent"]:
        curves, work.details["one_step_training"] = descended(first, data, int(s["descent"]))
        work.curves.extend(curves)
        work.timing_s["one-step training"] = perf_counter() - began
        began = perf_counter()
    options: dict[str, Any] = {"iterations": int(s["iterations"]), "tick": tick}
    if s["shooting"]:
        _take(work, shooting(first, data, int(s["shooting"]), **options), worse_ok=True)
    elif s["noise"] == "output" or (s["noise"] == "auto" and first.stable):
        _take(work, trained(first.without_gain(), data, stage="simulation errors", **options), worse_ok=True)
    if s["neurons"]:
        anchored, base = s["residual"] == "anchored", work.state
        for k in range(int(s["starts"])):
            _take(
                work,
                added_network(base, data, int(s["neurons"]), float(s["prior"]), anchored, seed=[seed, k], **options),
            )
    _gain(s, data, work, first, options)
    work.timing_s["training"] = perf_counter() - began


def _gain(s: Mapping[str, Any], data: Scaled, work: Work, first: State, options: Mapping[str, Any]) -> None:
    """Go on with a predictor gain where the simulation errors are not white (the simplest noise that does)."""
    state = work.state
    assert state is not None
    if s["noise"] == "output" or (
        s["noise"] == "auto" and not s["shooting"] and not state.layout.gain and white(state, data)
    ):
        return
    if not state.layout.gain:
        widened = added_gain(state, data, first.K)
        if widened is None:
            work.warnings.append("no predictor gain was found that keeps the predictor finite")
            return
        state = widened
    _take(work, trained(state, data, stage="prediction errors", **options), worse_ok=True)


def _take(work: Work, found: tuple[State, LearningCurve, bool] | None, *, worse_ok: bool = False) -> None:
    """Take over a better network, and its learning curve."""
    if found is None:
        return
    state, curve, converged = found
    assert work.state is not None
    if worse_ok or state.layout.neurons != work.state.layout.neurons or state.score < work.state.score:
        work.state = state
        work.status = "converged" if converged else "stalled"
    work.curves.append(curve)


def _choose_states(data: Scaled, work: Work, tick: Tick | None) -> None:
    """Try more and more states; keep the number that Bayes' criterion likes best."""
    p, tried = data.y_level.size, {}
    best, best_bic, first = work.state, np.inf, work.state
    assert first is not None
    for n in range(p, p + _LARGEST + 1):
        if tick is not None:
            tick("choice of states")
        found = start_free(data, first.layout.dt, n)
        state = trained_start(found, data) if isinstance(found, Start) else None
        if state is None:
            continue
        after = trained(state, data, stage="choice of states", iterations=6, tick=tick)
        if after is None:
            continue
        tried[n] = after[0].bic
        if after[0].bic < best_bic:
            best, best_bic = after[0], after[0].bic
        elif n >= 2 + (best.layout.n if best else p):
            break
    work.state = best
    work.details["tried_states"] = [{"states": n, "bic": b} for n, b in tried.items()]
