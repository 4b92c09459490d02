"""State-space network of a plant whose sensor sees no sign, such as a pulse counter (nn with output=magnitude).

The sign is not in the data, and a search from a wrong one ends in a wrong minimum: linear models of one to four poles
are laid on a grid, each with the gain that fits the magnitude best, and the best of them are the starts. Then follow
Levenberg-Marquardt on the free run -> number of states by Bayes' criterion -> number of odd hidden units by how the run
goes on behind parts of the records -> training on all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import search
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.records import Parts, Scaled, scaled_records
from ambid.nonlinear.state_network import Layout, free_entries
from ambid.nonlinear.state_start import NO_START
from ambid.nonlinear.state_training import Fitting, State, Training, add_units, best_of, finish, train, train_each

MOST_STATES = 4
_DEFAULTS: Mapping[str, object] = {"output": "magnitude", "prior": 1.0, "starts": 20, "iterations": 50}
_USED = (*_DEFAULTS, "states", "neurons")
_FIXED: Mapping[str, tuple[object, ...]] = {"form": ("auto", "free"), "noise": ("auto", "output")}

_REAL = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98)  # poles of the grid
_RADII = (0.6, 0.8, 0.9, 0.95, 0.98)
_ANGLES = np.linspace(0.1, 1.6, 16)  # rad per sample
_SENSOR = 0.3  # its pole at first
_STEP = 0.4  # of the chain of states: near the size of 1 - pole for a plant that is sampled well
_REFINED = 8  # linear starts that are searched from
_CLEAR = 10.0  # of Bayes' criterion, which a larger model has to gain (Kass and Raftery 1995): errors are not white

_MOST_UNITS = 3
_FOLDS = (0.5, 0.625, 0.75)  # of each record are trained on in the choice of units ..
_AHEAD = 0.25  # .. and so much behind is run on
_BETTER = 0.95  # part of the held-out error to which further units have to bring it
_FIRST = 3  # iterations for what units put out, before what they see is searched for
_LAST = 10  # times as many iterations for the best start
_DAMPING = 1e-2
_ROUNDS = 3.0  # of weighting, for the share of the first


def nn_of_magnitude(
    records: Sequence[IOData], given: Mapping[str, object], seed: int, tick: Tick | None
) -> NonlinearFit:
    """Train a state-space network whose output is measured without sign.

    `given` are settings as the user gave them, checked: those that mean nothing here are refused.
    """
    _check(records, given)
    s: dict[str, Any] = {**_DEFAULTS, **given}
    found = scaled_records("nn", records, lag=40)
    u_scale, y_scale = np.hypot(found.u_level, found.u_scale), np.hypot(found.y_level, found.y_scale)
    data = Scaled(  # a magnitude has no level to take off
        parts=tuple((x.y / y_scale, x.u / u_scale) for x in records),
        y_level=np.zeros_like(y_scale), y_scale=y_scale, u_level=np.zeros_like(u_scale), u_scale=u_scale,
    )  # fmt: skip
    fitting, reason = Fitting(data=data), NO_START
    try:
        _train_all(s, records[0].dt, fitting, seed, tick)
    except KeyboardInterrupt:
        fitting.interrupt()
        reason = "interrupted before there was a first model"
    size = float(np.std(np.concatenate([y for y, _ in data.parts])))
    fitting.curves = [replace(c, training=c.training / max(size, 1e-300)) for c in fitting.curves]
    neurons = 0 if fitting.state is None else fitting.state.layout.neurons
    used = {k: s[k] for k in _USED if k in s} | {"form": "free", "noise": "output", "neurons": neurons}
    return finish(records, used, fitting, reason, seed=seed)


def _check(records: Sequence[IOData], given: Mapping[str, object]) -> None:
    for name, value in given.items():
        if name not in _USED and value not in _FIXED.get(name, ()):
            raise EstimationError(
                f"nn: {name} = {value!r} means nothing with output = magnitude; what does: {', '.join(_USED)}. Leave "
                "it out"
            )
    states = given.get("states")
    if isinstance(states, int) and states > MOST_STATES:
        raise EstimationError(f"nn: states = {states} with output = magnitude; at most {MOST_STATES}. Lower it")
    for r, x in enumerate(records):
        if x.n_outputs != 1 or not x.n_inputs:
            raise EstimationError("nn: output = magnitude is for one output and one input or more. Choose them")
        if np.min(x.y) < 0:
            raise EstimationError(
                f"nn: output {x.outputs[0]!r} of record {r + 1} is negative at sample {int(np.argmin(x.y))}; a "
                "magnitude is not. Use output = signed"
            )


def _train_all(s: Mapping[str, Any], dt: float, fitting: Fitting, seed: int, tick: Tick | None) -> None:
    began, starts = perf_counter(), int(s["starts"])
    tried = range(1, MOST_STATES + 1) if s.get("states") is None else (int(s["states"]),)
    units = range(_MOST_UNITS + 1) if s.get("neurons") is None else (int(s["neurons"]),)
    linear, choice, last = portions(
        tick, (4.0, len(_FOLDS) * sum(units) * starts * (len(units) > 1), units[-1] * starts)
    )  # fmt: skip
    _choose_states(tried, s, dt, fitting, linear)
    began = fitting.timed("linear", began)
    base = fitting.state
    if base is None:
        return
    neurons = _choose_units(s, fitting, base, seed, choice) if len(units) > 1 else units[0]
    began = fitting.timed("choice of units", began)
    if neurons:
        best = _train_units(base, fitting.data, neurons, s, seed, last)
        if best is not None:  # the best start to the very end
            longer = {**s, "iterations": _LAST * int(s["iterations"])}
            fitting.take(_train(fitting.data, longer, best.state, None) or best)
    fitting.timed("training", began)


# --- linear part -----------------------------------------------------------------------------------------------------


def _choose_states(tried: Sequence[int], s: Mapping[str, Any], dt: float, fitting: Fitting, tick: Tick | None) -> None:
    """The best linear network of each size; Bayes' criterion chooses among sizes."""
    data, least, values = fitting.data, np.inf, []
    best: Training | None = None
    for n, own in zip(tried, portions(tick, [1.0] * len(tried)), strict=True):
        begun = [State.of(layout, theta, data) for layout, theta in grid_starts(data.parts, n, _REFINED, dt)]
        of_size = best_of(train_each(begun, partial(_train, data, s), own))
        if of_size is None:
            continue
        at = of_size.state
        bic = at.bic + at.x0.size * float(np.log(at.n_rows))
        values.append({"states": n, "bic": bic})
        if bic < least - _CLEAR * (best is not None):
            best, least = of_size, bic
    fitting.take(best)
    fitting.details["tried_states"] = values


def grid_starts(parts: Parts, n: int, most: int, dt: float) -> list[tuple[Layout, Array]]:
    """Return the `most` best linear models of `n` states on the grid, the best first."""
    from scipy.signal import lfilter

    m = parts[0][1].shape[1]
    layout = magnitude_layout(n, m, 0, dt)
    y = np.concatenate([p[0][:, 0] for p in parts])
    scored: list[tuple[float, int, Array, int, float]] = []
    for A in pole_grid(n):
        for j in range(m):
            x = np.concatenate([np.abs(lfilter([0.0, 1.0], A, p[1][:, j])) for p in parts])
            size = float(x @ x)
            if np.isfinite(size) and size > 0:
                gain = float(x @ y) / size
                scored.append((float(np.sum((gain * x - y) ** 2)), len(scored), A, j, gain))
    scored.sort(key=lambda found: found[:2])
    return [(layout, _weights_of(layout, A, j, gain)) for _, _, A, j, gain in scored[:most]]


def magnitude_layout(n: int, n_inputs: int, neurons: int, dt: float) -> Layout:
    """Return the layout of `n` states in a chain behind a sensor without sign."""
    return Layout(
        form="free", dt=dt, n_inputs=n_inputs, heads=(n,), steps=(_STEP,) * (n - 1) + (0.0,),
        entries=free_entries((n,), n_inputs, constants=False), scale=(1.0,) * (n + n_inputs), rates=(1.0,) * n,
        rows=tuple(range(n)), neurons=neurons, sensor=True,
    )  # fmt: skip


def _weights_of(layout: Layout, A: Array, channel: int, gain: float) -> Array:
    """Weights of the model gain q^-1 / A(q^-1): last row from the polynomial in q - 1, B from the impulse response."""
    n = layout.n
    shifted = np.poly1d(A)(np.poly1d([1.0, 1.0])).coeffs  # of the powers of q - 1, highest first
    theta = np.zeros(layout.n_theta)
    theta[:n] = -shifted[:0:-1] / _STEP ** np.arange(n - 1, -1, -1)
    theta[n - 1] += 1.0
    M = layout.weights(theta)[:, :n]
    visible = np.stack([np.linalg.matrix_power(M, k)[0] for k in range(n)])
    response = np.zeros(n)
    for k in range(n):
        response[k] = gain * (k == 0) - float(A[1 : k + 1] @ response[:k][::-1])
    theta[n + channel : n + n * layout.n_inputs : layout.n_inputs] = np.linalg.solve(visible, response)
    theta[-1] = _SENSOR
    return theta


def pole_grid(n: int) -> list[Array]:
    """Return denominators (n + 1,) of linear models of `n` poles, of q^0, q^-1, ..."""
    if n < 2:
        return [np.array([1.0, -p]) for p in _REAL] if n else [np.ones(1)]
    pairs = [np.array([1.0, -2 * r * np.cos(w), r * r]) for r in _RADII for w in _ANGLES]
    pairs += [np.convolve([1.0, -p], [1.0, -q]) for p in _REAL for q in _REAL if q >= p]
    for _ in range(n - 2):
        pairs = [np.convolve(p, [1.0, -q]) for p in pairs for q in (_REAL if n == 3 else _REAL[1::2])]
    return pairs


# --- hidden units ----------------------------------------------------------------------------------------------------


def _choose_units(s: Mapping[str, Any], fitting: Fitting, linear: State, seed: int, tick: Tick | None) -> int:
    """Number of hidden units by the runs that go on behind the parts of the records that are trained on."""
    data, squares = fitting.data, np.zeros(_MOST_UNITS + 1)
    parts = iter(portions(tick, [k for _ in _FOLDS for k in range(1, _MOST_UNITS + 1)]))
    for share in _FOLDS:
        cut = [round(share * y.shape[0]) for y, _ in data.parts]
        fewer = replace(data, parts=tuple((y[:k], u[:k]) for (y, u), k in zip(data.parts, cut, strict=True)))
        n_rows = sum(cut)
        found = _train(fewer, s, replace(linear, n_rows=n_rows), None)
        base = replace(linear, n_rows=n_rows) if found is None else found.state
        squares[0] += _error_ahead(base, data, cut) ** 2
        for neurons in range(1, _MOST_UNITS + 1):
            best = _train_units(base, fewer, neurons, s, seed, next(parts))
            squares[neurons] += np.inf if best is None else _error_ahead(best.state, data, cut) ** 2
    errors = np.sqrt(squares / len(_FOLDS))
    fitting.details["held_out"] = [{"neurons": k, "error": float(e)} for k, e in enumerate(errors) if np.isfinite(e)]
    chosen = 0
    for k in range(1, errors.size):
        if errors[k] < _BETTER * errors[chosen]:
            chosen = k
    return chosen


def _error_ahead(at: State, data: Scaled, cut: list[int]) -> float:
    """Error of the run that goes on behind what was trained on, scaled."""
    ends = [min(k + round(_AHEAD * y.shape[0]), y.shape[0]) for (y, _), k in zip(data.parts, cut, strict=True)]
    longer = replace(data, parts=tuple((y[:end], u[:end]) for (y, u), end in zip(data.parts, ends, strict=True)))
    errors = at.problem(longer).errors(at.vector)[1]
    size = float(np.sqrt(np.mean(np.concatenate([e[k:] for e, k in zip(errors, cut, strict=True)]) ** 2)))
    return size if np.isfinite(size) else np.inf


def _train_units(
    base: State, data: Scaled, neurons: int, s: Mapping[str, Any], seed: int, tick: Tick | None
) -> Training | None:
    """The best of several random starts of a hidden layer; units have no effect at first."""
    begun = [add_units(base, neurons, float(s["prior"]), [seed, neurons, k]) for k in range(int(s["starts"]))]
    return best_of(train_each(begun, partial(_train, data, s), tick))


def _train(data: Scaled, s: Mapping[str, Any], start: State, tick: Tick | None) -> Training | None:
    """Train; units that put out nothing yet are begun against the errors of the linear part, their prior being strong.

    As long as they put out nothing the data say nothing of what they see, and the prior would take it away: what they
    see is held for the first iterations.
    """
    layout, most = start.layout, int(s["iterations"])
    stage = "hidden layer" if layout.neurons else "linear part"
    k, (n_W1, _, n_W2) = layout.n_directions, layout.hidden_sizes
    if n_W2 and not np.any(start.theta[k + n_W1 :]):
        free = start.problem(data)
        held = replace(free, held=slice(k, k + n_W1))
        begun = search(held, start.vector, stage=stage, most=_FIRST, damping=_DAMPING)
        first, tick = portions(tick, (1.0, _ROUNDS - 1.0))
        begun = search(free, begun.theta, stage=stage, most=most, tolerance=1e-6, damping=_DAMPING, tick=first)
        theta, x0 = free.split(begun.theta)
        start = replace(start, theta=theta, x0=x0)
    return train(start, data, stage=stage, iterations=most, tick=tick, damping=_DAMPING)
