"""The stages of a fit of a state-space network: choice of states, physics, hidden layer, predictor gain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Literal

import numpy as np

from ambid.estimation.progress import Tick, part_of, portions
from ambid.nonlinear.fit import LearningCurve
from ambid.nonlinear.networks.nn_hidden import added_network
from ambid.nonlinear.networks.nn_train import State, added_gain, descended, trained, white
from ambid.nonlinear.networks.shooting import shooting
from ambid.nonlinear.networks.start import Start, start_free
from ambid.nonlinear.records import Scaled

_LARGEST = 5  # states beyond the outputs that are tried


def _nothing() -> Scaled:
    none = np.empty(0)
    return Scaled(parts=(), y_level=none, y_scale=none, u_level=none, u_scale=none)


@dataclass(slots=True)
class Work:
    """What a fit has come to, so that an interruption loses nothing."""

    state: State | None = None  # the best network so far; None before the first
    status: Literal["converged", "stalled"] = "converged"
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)
    base: State | None = None  # the physics alone, where a hidden layer was put on it
    data: Scaled = field(default_factory=_nothing)  # each output beside the input that acts at its time
    delay: int = 0
    rivals: list[State] = field(default_factory=list)  # what every start of a hidden layer came to


def trained_start(start: Start, data: Scaled) -> State | None:
    """Return the start with its gain, if it runs; else None."""
    return added_gain(State.of(start.layout, start.theta, data), data, start.K)


def identify(s: Mapping[str, Any], data: Scaled, work: Work, seed: int, tick: Tick | None) -> None:
    """Train the first network of `work`.

    `s`: settings; `work`: with a first network; changed.
    """
    parts = portions(
        tick,
        (_LARGEST if s["form"] == "free" and "states" not in s else 0, 3, 3 * int(s["starts"]) * (s["neurons"] > 0), 3),
    )
    choice, physics, hidden, gain = parts
    began = perf_counter()
    if s["form"] == "free" and "states" not in s:
        _choose_states(data, work, choice)
    assert work.state is not None
    first = work.state
    if s["descent"]:
        curves, work.details["one_step_training"] = descended(first, data, int(s["descent"]))
        work.curves.extend(curves)
        work.timing_s["one-step training"] = perf_counter() - began
        began = perf_counter()
    most = int(s["iterations"])
    if s["shooting"]:
        _take(work, shooting(first, data, int(s["shooting"]), iterations=most, tick=physics), worse_ok=True)
    elif s["noise"] == "output" or (s["noise"] == "auto" and first.stable):
        found = trained(first.without_gain(), data, stage="simulation errors", iterations=most, tick=physics)
        _take(work, found, worse_ok=True)
    if s["neurons"]:
        anchored, work.base = s["residual"] == "anchored", work.state
        starts = int(s["starts"])
        for k in range(starts):
            found = added_network(
                work.base, data, int(s["neurons"]), float(s["prior"]), anchored, seed=[seed, k], iterations=most,
                tick=part_of(hidden, k / starts, (k + 1) / starts),
            )  # fmt: skip
            _take(work, found)
            work.rivals += [found[0]] if found else []
    _gain(s, data, work, first, most, gain)
    work.timing_s["training"] = perf_counter() - began


def _gain(s: Mapping[str, Any], data: Scaled, work: Work, first: State, most: int, tick: Tick | None) -> None:
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
    _take(work, trained(state, data, stage="prediction errors", iterations=most, tick=tick), worse_ok=True)


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
        own = part_of(tick, (n - p) / (_LARGEST + 1), (n - p + 1) / (_LARGEST + 1))
        if own is not None:
            own("choice of states", 0.0)
        found = start_free(data, first.layout.dt, n)
        state = trained_start(found, data) if isinstance(found, Start) else None
        if state is None:
            continue
        after = trained(state, data, stage="choice of states", iterations=6, tick=own)
        if after is None:
            continue
        tried[n] = after[0].bic
        if after[0].bic < best_bic:
            best, best_bic = after[0], after[0].bic
        elif n >= 2 + (best.layout.n if best else p):
            break
    work.state = best
    work.details["tried_states"] = [{"states": n, "bic": b} for n, b in tried.items()]
