"""First weights of a state-space network: delay, subspace model, the thesis's training, and global search.

PBSID-opt, for any stability and feedback, is turned into the network's states: outputs, and rates (``one-axis``, matrix
logarithm) or differences (``free``). Else differential evolution searches free entries of A (log size, sign): over
short shots, where unstable plants' costs are finite, first state, B and constants are linear (Golub and Pereyra 1973).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError, counted
from ambid.estimation.global_search import STAGE, GlobalFound, global_search
from ambid.estimation.linear import triangle_of
from ambid.estimation.predictor import noise_floor
from ambid.estimation.progress import Tick, guessed, silent
from ambid.nonlinear.fit import LearningCurve
from ambid.nonlinear.records import Scaled
from ambid.nonlinear.state_network import ONE_AXIS, Layout
from ambid.nonlinear.state_training import State, add_gain, best_of, shift_inputs, train
from ambid.signals.delay import find_delay as delay

NO_START = "no starting network stays finite on these records: check the columns for their size and for jumps"
SHORT = 6  # samples of past that a subspace model looks back: enough where the plant is stable and sampled well

LARGEST = 20  # samples of delay that are looked for
_HISTORY = 12  # past outputs in the first guess of a delay
_MOST = 5000  # samples that the first guess looks at
_SHORT = 5  # iterations of a short training
_WORTH = 2.0  # gain of the log likelihood, times two, for which a neighbour is taken
_TRAINED = 3000  # samples that short trainings look at

_SHOT = 128  # samples
_SHOTS = 8192  # samples of a record that are cut into shots
_DECADES = 4.5  # that rates may span, from the Nyquist frequency down
_TRIED = 3  # members of the last generation that are tried as starts
_PROCESS = (1e-8, 1e-5, 1e-2)  # variance of process noise over that of the states' steps, tried for the gain

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


# --- global search ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class ShotCost:
    """Cost of the free entries of A over short shots, everything linear solved for."""

    layout: Layout  # form ``one-axis``
    Y: Array  # (n_shots, n_samples, n_outputs), outputs over their noise
    u: Array  # (n_shots, n_samples)
    noise: Array  # (n_outputs,), outputs' noise, scaled

    @property
    def searched(self) -> list[tuple[int, int]]:
        """Entries of A that are free."""
        return [(r, c) for r, c in self.layout.entries if c < 3]

    @property
    def fastest(self) -> float:
        """Largest rate that is looked for, 1/s: a decay within a sample."""
        return 2.0 / self.layout.dt

    def entries(self, z: Array) -> Array:
        """Return rates in 1/s from numbers in -1 .. 1: sign, and logarithm of the size."""
        whole = _DECADES * np.log(10.0)
        out: Array = self.fastest * np.sinh(whole * z) / np.sinh(whole)
        return out

    def __call__(self, z: Array) -> float:
        """Return the logarithm of the determinant of the errors' covariance; infinite where numbers overflow."""
        solution = self.solve(z)
        return np.inf if solution is None else solution[1]

    def solve(self, z: Array) -> tuple[Array, float, Array] | None:
        """Return all weights, the cost, and the errors' covariance, all scaled."""
        from scipy.linalg import expm, toeplitz

        layout, (S, N, p) = self.layout, self.Y.shape
        theta = np.zeros(layout.n_theta)
        a = dict(zip(self.searched, self.entries(z), strict=True))
        for k, at in enumerate(layout.entries):
            theta[k] = a.get(at, 0.0)
        linear = [(k, r, c) for k, (r, c) in enumerate(layout.entries) if c >= 3]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            block = np.zeros((6, 6))
            block[:3, :3], block[:3, 3:] = layout.weights(theta)[:, :3], np.eye(3)
            sampled = expm(block * layout.dt)
            if not np.all(np.isfinite(sampled)):
                return None
            powers = np.empty((N, 3, 3))  # from the first state to the outputs of each sample
            powers[0] = np.eye(3)
            for t in range(1, N):
                powers[t] = powers[t - 1] @ sampled[:3, :3]
            visible = powers[:, list(layout.heads)] / self.noise[:, None]
            if not np.all(np.isfinite(visible)) or np.max(np.abs(visible)) > 1e100:
                return None
            O = visible.reshape(N * p, 3)  # noqa: E741
            Q = np.linalg.qr(O / np.maximum(np.linalg.norm(O, axis=0), 1e-300))[0]
            columns = []
            for _, r, c in linear:
                h = np.vstack([np.zeros((1, p)), visible[:-1] @ sampled[:3, 3 + r]])
                if c == 4:
                    columns.append(np.broadcast_to(np.cumsum(h, axis=0), (S, N, p)))
                else:
                    columns.append(np.stack([self.u @ toeplitz(h[:, o], np.zeros(N)).T for o in range(p)], axis=2))
            flat = [x.reshape(S, N * p) for x in (self.Y, *columns)]
            target, *forced = (x - (x @ Q) @ Q.T for x in flat)
            F = np.stack([x.ravel() for x in forced], axis=1)
            if not np.all(np.isfinite(F)):
                return None
            size = np.maximum(np.linalg.norm(F, axis=0), 1e-300)
            weights = np.linalg.lstsq(F / size, target.ravel(), rcond=1e-10)[0] / size
            left = (target.ravel() - F @ weights).reshape(S * N, p)
        for (k, _, _), w in zip(linear, weights, strict=True):
            theta[k] = w
        noise = left.T @ left / (S * N)
        if not np.all(np.isfinite(noise)):
            return None
        return theta, float(np.linalg.slogdet(noise + 1e-12 * np.eye(p))[1]), noise * self.noise[:, None] * self.noise


def shot_cost(data: Scaled, dt: float, heads: tuple[int, ...]) -> ShotCost:
    """Cut records into short shots; `heads` are the states (position, velocity, current) that outputs are."""
    shortest = min(y.shape[0] for y, _ in data.parts)
    length = max(min(_SHOT, shortest // 3), 8)
    Y, u = [], []
    for y, v in data.parts:
        last = min(y.shape[0], max(_SHOTS // len(data.parts), length)) // length * length
        Y.append(y[:last].reshape(-1, length, y.shape[1]))
        u.append(v[:last, 0].reshape(-1, length))
    # a velocity of the size that entries of A then have in the middle of what is searched
    layout = one_axis_layout(data, dt, heads, 2.0 / dt * 10.0 ** (-_DECADES / 2.0), np.zeros((3, 5)))
    noise = np.maximum(noise_floor(np.concatenate([y for y, _ in data.parts])), 1e-9)
    return ShotCost(layout=layout, Y=np.concatenate(Y) / noise, u=np.concatenate(u), noise=noise)


def search_start(
    data: Scaled, dt: float, heads: tuple[int, ...], *, seed: int, evaluations: int, tick: Tick = silent
) -> tuple[State | None, GlobalFound]:
    """Search globally for a ``one-axis`` network with gain that runs on the records; no state where no gain keeps it
    finite.
    """
    cost = shot_cost(data, dt, heads)
    n = len(cost.searched)
    result = global_search(
        cost, -np.ones(n), np.ones(n), seed=[seed, 5], evaluations=evaluations, tick=tick, stage=STAGE
    )
    return best_of(_add_kalman_gain(cost, z, data) for z in (result.vector, *result.best[1:_TRIED])), result


def _add_kalman_gain(cost: ShotCost, z: Array, data: Scaled) -> State | None:
    """The network with the Kalman gain of a guessed process noise, the best of several guesses."""
    from scipy.linalg import solve_discrete_are

    solved = cost.solve(z)
    if solved is None:
        return None
    theta, _, noise = solved
    layout = replace(
        cost.layout, rates=tuple(float(np.linalg.norm(cost.layout.weights(theta)[r, :4])) or 1.0 for r in (1, 2))
    )
    bare = State.of(layout, theta, data)
    m: Any = layout.matrices(theta)
    C = np.eye(3)[list(layout.heads)]
    step = np.maximum(np.abs(m.A - np.eye(3)).sum(axis=1), 1e-9) ** 2

    def kalman(q: float) -> State | None:
        try:
            P = solve_discrete_are(m.A.T, C.T, q * np.diag(step), noise + 1e-12 * np.eye(layout.p))
            return add_gain(bare, data, np.linalg.solve(C @ P @ C.T + noise, C @ P @ m.A.T).T)
        except (np.linalg.LinAlgError, ValueError):
            return None

    return best_of(map(kalman, _PROCESS))
