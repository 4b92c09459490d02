"""First weights of a state-space network: delay, subspace model, and the thesis's training.

PBSID-opt, for any stability and feedback, is turned into the network's states: outputs, and rates (``one-axis``, matrix
logarithm) or differences (``free``).
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError, counted
from ambid.estimation.linear import triangle_of
from ambid.estimation.progress import Tick, guessed
from ambid.nonlinear.fit import LearningCurve
from ambid.nonlinear.records import Scaled
from ambid.nonlinear.state_network import ONE_AXIS, Layout
from ambid.nonlinear.state_training import State, add_gain, shift_inputs, train
from ambid.signals.delay import find_delay as delay

NO_START = "no starting network stays finite on these records: check the columns for their size and for jumps"
SHORT = 6  # samples of past that a subspace model looks back: enough where the plant is stable and sampled well

LARGEST = 20  # samples of delay that are looked for
_HISTORY = 12  # past outputs in the first guess of a delay
_MOST = 5000  # samples that the first guess looks at
_SHORT = 5  # iterations of a short training
_WORTH = 2.0  # gain of the log likelihood, times two, for which a neighbour is taken
_TRAINED = 3000  # samples that short trainings look at

# --- subspace models -------------------------------------------------------------------------------------------------


def first_network(data: Scaled, dt: float, n: int, heads: tuple[int, ...] = (), past: int = SHORT) -> State | str:
    """Return a first network of `n` states from a model `past` samples back, or why there is none; with `heads`, the
    states (position, velocity, current) that outputs are, in the form ``one-axis``, else ``free``.
    """
    p = data.n_outputs
    if n < p:
        raise EstimationError(
            f"nn: {counted(n, 'state')} for {counted(p, 'output')}; each output is a state. Raise states"
        )
    model = _subspace(data, n, past)
    if isinstance(model, str):
        return model
    A, B, C, K = model
    chains, ahead = tuple(n // p + (o < n % p) for o in range(p)), A - np.eye(n)
    first = np.cumsum((0, *chains))[:-1].tolist()
    if heads:
        continuous = _logarithm(A, B, dt)
        if continuous is None:
            return "the sampled model has no continuous one (a pole on the negative real axis): sample faster"
        A, B = continuous
        chains, first, ahead = tuple(2 if s == 0 and 1 not in heads else 1 for s in heads), list(heads), A
    T, steps = np.zeros((n, n)), np.zeros(n)
    for o, length in enumerate(chains):
        row = C[o]
        for j in range(first[o], first[o] + length):
            T[j] = row
            if j + 1 < first[o] + length:
                size = 1.0 if heads else max(float(np.linalg.norm(row)), 1e-300)
                row = row @ ahead
                steps[j] = float(np.linalg.norm(row)) / size
                row = row / (steps[j] or 1.0)
    if not np.linalg.cond(T) < 1e10:
        return (
            "position, velocity and current cannot be distinguished in the record: excite more"
            if heads
            else "not all states are observable from the outputs: lower states, or excite more"
        )
    M = np.hstack([T @ A @ np.linalg.inv(T), T @ B, np.zeros((n, 1))])
    if heads:
        layout = one_axis_layout(data, dt, heads, steps[0] or 1.0, M)
    else:
        scale = (*np.repeat(data.y_scale, chains).tolist(), *data.u_scale.tolist())
        layout = Layout.free(dt, chains, steps.tolist(), scale)
    state = add_gain(State.of(layout, np.array([M[r, c] for r, c in layout.entries]), data), data, T @ K)
    return NO_START if state is None else state


def one_axis_layout(data: Scaled, dt: float, heads: tuple[int, ...], unit: float, M: Array) -> Layout:
    """Return the layout ``one-axis`` of `M` = [A | B | c]; an unmeasured velocity has size `unit`, x1' = x2 in SI."""
    scale = np.empty(3)
    for o, s in enumerate(heads):
        scale[s] = data.y_scale[o]
    if 1 not in heads:
        scale[1] = scale[0] * unit
    return Layout(
        form="one-axis", dt=dt, n_inputs=1, heads=heads, steps=(), entries=ONE_AXIS,
        scale=(*scale.tolist(), *data.u_scale.tolist()),
        rates=tuple(float(np.linalg.norm(M[r, :4])) or 1.0 for r in (1, 2)), rows=(1, 2),
    )  # fmt: skip


def _subspace(data: Scaled, n: int, past: int) -> tuple[Array, Array, Array, Array] | str:
    """Predictor-based subspace model of the longest record, in scaled signals."""
    from ambid.blackbox.subspace import pbsid

    y, u = max(data.parts, key=lambda part: part[0].shape[0])
    names = tuple(f"u{k}" for k in range(u.shape[1])), tuple(f"y{k}" for k in range(y.shape[1]))
    past = max(2 * -(-n // y.shape[1]), past)
    past = min(past, max(y.shape[0] // (3 * (y.shape[1] + u.shape[1])) - 2, 2))
    try:
        io = IOData(u=u, y=y, dt=1.0, inputs=names[0], outputs=names[1], units=dict.fromkeys(names[0] + names[1], "1"))
        model = pbsid(io, {"n": n}, horizon=past, feedthrough=False).model
    except (EstimationError, np.linalg.LinAlgError) as error:
        return f"no starting model: {error}"
    matrices = tuple(np.asarray(getattr(model, k), dtype=np.float64) for k in "ABCK")
    if not all(np.all(np.isfinite(x)) for x in matrices):
        return "no starting model: its matrices are not finite"
    return matrices  # type: ignore[return-value]


def _logarithm(A: Array, B: Array, dt: float) -> tuple[Array, Array] | None:
    """Continuous A and B whose zero-order hold is A and B; None where there is no real one."""
    from scipy.linalg import logm

    n, m = B.shape
    poles = np.linalg.eigvals(A)
    if np.any((poles.real <= 0) & (np.abs(poles.imag) < 1e-9 * np.abs(poles))):
        return None
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:], block[n:, n:] = A, B, np.eye(m)
    log = np.asarray(logm(block))
    if np.iscomplexobj(log):
        if np.max(np.abs(log.imag)) > 1e-6 * np.max(np.abs(log.real)):
            return None
        log = log.real
    return log[:n, :n] / dt, log[:n, n:] / dt


def matrices_json(layout: Layout, A: Array, B: Array, *, sampled: bool) -> dict[str, object] | None:
    """Return scaled A and B in SI, made continuous if they are those of a sample; None where there is no logarithm."""
    pair = _logarithm(A, B, layout.dt) if sampled else (A, B)
    if pair is None:
        return None
    n, size = layout.n, np.array(layout.scale)
    unit = size[:n, None] / size
    return {"A": (pair[0] * unit[:, :n]).tolist(), "B": (pair[1] * unit[:, n:]).tolist()}


# --- delay -----------------------------------------------------------------------------------------------------------


def guess_delay(data: Scaled) -> int:
    """Return the least delay at which a long linear fit sees an input, 0 if none. Where inputs act weakly within a
    sample it cannot tell neighbours apart: see `find_delay`.
    """
    y, u = (x[-_MOST:] for x in max(data.parts, key=lambda part: part[0].shape[0]))
    largest = min(LARGEST, y.shape[0] // 8 - 2 * _HISTORY)
    if largest < 1 or not u.shape[1]:
        return 0
    delays = [
        delay(u[:, i], y[:, o], max_delay=largest, order=_HISTORY) for i in range(u.shape[1]) for o in range(y.shape[1])
    ]
    return min((x.samples for x in delays if x.samples is not None), default=0)


def find_delay(state: State, whole: Scaled, delay: int, tick: Tick | None, *, rather_late: bool = False) -> int:
    """Go to neighbours of a guess while a short training has smaller errors; `state`: a first network at `delay`,
    `whole` unshifted.
    """
    share = _TRAINED // len(whole.parts)
    cut = replace(whole, parts=tuple((y[:share], u[:share]) for y, u in whole.parts))
    n = sum(y.shape[0] for y, _ in cut.parts)
    largest = min(LARGEST, min(y.shape[0] for y, _ in cut.parts) // 4) if whole.u_level.size else 0
    errors = dict[int, float]()

    def error(trial: int) -> float:
        nonlocal state
        if trial not in errors:
            data = shift_inputs(cut, trial)
            start = State.of(state.layout, state.theta, data)
            trained = train(start, data, stage="", iterations=_SHORT, rounds=1, damping=1e-6)
            errors[trial] = np.inf if trained is None else trained.state.score
            if trained is not None and errors[trial] <= min(errors.values()):
                state = trained.state
            if tick is not None:
                tick("delay", guessed(len(errors), 3.0))
        return errors[trial]

    for step in (1, -1):
        worth = -step * float(np.log(n)) if rather_late else _WORTH
        while 0 <= delay + step <= largest and n * (error(delay) - error(delay + step)) > worth:
            delay += step
    return delay


# --- the thesis's training ------------------------------------------------------------------------------------------


def train_one_step(
    state: State, data: Scaled, iterations: int
) -> tuple[tuple[LearningCurve, LearningCurve], dict[str, object]]:
    """Train from zero weights as the thesis does, and by Gauss-Newton: J = sum |x(k+1) - A x(k) - B u(k) - c|^2, states
    measured where all are, else predicted; v <- v - eta dJ/dv (thesis eqs 5.1, 5.2). State noise biases both. A and B
    are by training, in SI and continuous in the form ``one-axis``.
    """
    problem, layout = state.problem(data), state.layout
    X = [x[:-1] for x in problem.errors(state.vector)[0]]
    if layout.p == layout.n:
        X = [y[:, np.argsort(layout.heads)] for y, _ in data.parts]
    began = perf_counter()
    size = np.maximum(np.concatenate(X).std(axis=0), 1e-300)
    rows = [np.hstack([x[:-1] / size, u[:-1], x[1:] / size]) for x, (_, u) in zip(X, problem.parts, strict=True)]
    n, d = layout.n, layout.n + layout.n_inputs + 1
    N = sum(r.shape[0] for r in rows)
    R = triangle_of(rows)
    past, target = R[:, :d], R[:, d:]
    seconds = [perf_counter() - began]

    def rms(v: Array) -> float:
        return float(np.sqrt(np.sum((target - past @ v) ** 2) / (N * n)))

    curvature = float(np.linalg.svd(past, compute_uv=False)[0] ** 2)
    v = np.zeros((d, n))
    errors = [rms(v)]
    for _ in range(iterations):
        v = v + past.T @ (target - past @ v) / curvature
        seconds.append(perf_counter() - began)
        errors.append(rms(v))
    again = perf_counter()
    solved: Array = np.asarray(np.linalg.lstsq(past, target, rcond=1e-13)[0], dtype=np.float64)
    last = np.array([seconds[0], seconds[0] + perf_counter() - again]), np.array([errors[0], rms(solved)])
    descent, gauss_newton = (
        LearningCurve(method=f"{name}, one-step errors of the states", seconds=took, training=left)
        for name, took, left in (
            ("steepest descent (thesis eq. 5.2)", np.array(seconds), np.array(errors)), ("Gauss-Newton", *last)
        )
    )  # fmt: skip
    back = np.concatenate([1.0 / size, np.ones(d - n)])
    matrices: dict[str, object] = {}
    for name, w in (("steepest descent", v), ("Gauss-Newton", solved)):
        M = (w * back[:, None] * size).T
        matrices[name] = matrices_json(layout, M[:, :n], M[:, n:-1], sampled=layout.form == "one-axis")
    return (descent, gauss_newton), matrices
