"""First weights of a network of form ``one-axis`` by global search, where subspace models give none that leads on.

Over short shots the first state, B and the constants enter linearly and are solved for (variable projection, Golub and
Pereyra 1973); differential evolution looks for the free entries of A alone, in the logarithm of their size with sign.
Nothing runs away over a short shot, so that unstable plants have a finite cost everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.estimation.global_search import STAGE, GlobalFound, global_search
from ambid.estimation.progress import Tick, silent
from ambid.estimation.scaling import noise_floor
from ambid.nonlinear.networks.layout import Layout, one_axis_entries
from ambid.nonlinear.networks.nn_train import State, added_gain
from ambid.nonlinear.records import Scaled

FAR = 0.3  # part of the errors' variance that a linear regression may explain before a fit counts as failed
_PAST = 10  # samples of errors and inputs that it looks at
_SHOT = 128  # samples
_MOST = 8192  # samples of a record that are looked at
_DECADES = 4.5  # that rates may span, from the Nyquist frequency down
_TRIED = 3  # members of the last generation that are tried as starts
_PROCESS = (1e-8, 1e-5, 1e-2)  # variance of process noise over that of the states' steps, tried for the gain


def misfit(state: State, data: Scaled) -> float:
    """Return the part of the errors' variance that a linear regression on the past explains.

    On past errors and inputs; on past inputs alone for a network without gain, whose errors may be coloured. About 0
    where a search ended well: a linear model of high order predicts no better. Corrected for chance.

    Returns at most 1; 1 where the network diverges.
    """
    rows, targets = [], []
    problem = state.problem(data)
    with np.errstate(over="ignore", invalid="ignore"):
        errors = problem.errors(state.vector)[1]
    for e, shot in zip(errors, problem.shots, strict=True):
        known = np.hstack([e, shot.u[:, :-1]]) if state.layout.gain else shot.u[:, :-1]
        n = e.shape[0]
        past = [known[_PAST - k : n - k] for k in range(1, _PAST + 1)]
        rows.append(np.hstack([*past, np.ones((n - _PAST, 1))]))
        targets.append(e[_PAST:])
    Z, E = np.concatenate(rows), np.concatenate(targets)
    if not np.all(np.isfinite(E)):
        return 1.0
    left = E - Z @ np.linalg.lstsq(Z, E, rcond=1e-10)[0]
    n, p = E.shape
    before, after = E.T @ E / n, left.T @ left / max(n - Z.shape[1], 1)
    tiny = 1e-14 * np.eye(p)
    gained = float(np.linalg.slogdet(after + tiny)[1] - np.linalg.slogdet(before + tiny)[1])
    return 1.0 - float(np.exp(gained / p))


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
        """Return rates from numbers in -1 .. 1: sign, and logarithm of the size.

        `z`: (n_searched,). Returns (n_searched,), 1/s.
        """
        whole = _DECADES * np.log(10.0)
        out: Array = self.fastest * np.sinh(whole * z) / np.sinh(whole)
        return out

    def __call__(self, z: Array) -> float:
        """Return the logarithm of the determinant of the errors' covariance.

        `z`: (n_searched,). Returns infinite where numbers overflow.
        """
        found = self.solved(z)
        return np.inf if found is None else found[1]

    def solved(self, z: Array) -> tuple[Array, float, Array] | None:
        """Return all weights, the cost, and the errors' covariance.

        `z`: (n_searched,). Returns `theta`: (n_theta,); `noise`: (n_outputs, n_outputs), scaled.
        """
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
            seen = powers[:, list(layout.heads)] / self.noise[:, None]
            if not np.all(np.isfinite(seen)) or np.max(np.abs(seen)) > 1e100:
                return None
            O = seen.reshape(N * p, 3)  # noqa: E741
            Q = np.linalg.qr(O / np.maximum(np.linalg.norm(O, axis=0), 1e-300))[0]
            columns = []
            for _, r, c in linear:
                h = np.vstack([np.zeros((1, p)), seen[:-1] @ sampled[:3, 3 + r]])
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


def shot_cost(data: Scaled, dt: float, heads: tuple[int, ...], connections: str) -> ShotCost:
    """Cut records into short shots.

    `dt`: s; `heads`: state (position, velocity, current) that each output is.
    """
    shortest = min(y.shape[0] for y, _ in data.parts)
    length = max(min(_SHOT, shortest // 3), 8)
    Y, u = [], []
    for y, v in data.parts:
        last = min(y.shape[0], max(_MOST // len(data.parts), length)) // length * length
        Y.append(y[:last].reshape(-1, length, y.shape[1]))
        u.append(v[:last, 0].reshape(-1, length))
    scale = np.empty(3)
    for o, s in enumerate(heads):
        scale[s] = data.y_scale[o]
    if 1 not in heads:  # of the size that entries of A then have in the middle of what is searched
        scale[1] = scale[0] * 2.0 / dt * 10.0 ** (-_DECADES / 2.0)
    layout = Layout(
        form="one-axis", dt=dt, n_inputs=1, heads=heads, steps=(), entries=one_axis_entries(connections),
        scale=(*scale.tolist(), *data.u_scale.tolist()), rates=(1.0, 1.0), rows=(1, 2),
    )  # fmt: skip
    noise = np.maximum(noise_floor(np.concatenate([y for y, _ in data.parts])), 1e-9)
    return ShotCost(layout=layout, Y=np.concatenate(Y) / noise, u=np.concatenate(u), noise=noise)


def global_start(
    data: Scaled,
    dt: float,
    heads: tuple[int, ...],
    connections: str,
    *,
    seed: int,
    evaluations: int,
    workers: int = 1,
    tick: Tick = silent,
) -> tuple[State | None, GlobalFound]:
    """Search globally for a network of form ``one-axis`` that runs on the records, a predictor gain with it.

    `dt`: s; `heads`: state (position, velocity, current) that each output is. Returns `state`: none where no gain keeps
    the predictor finite.
    """
    cost = shot_cost(data, dt, heads, connections)
    n = len(cost.searched)
    found = global_search(
        cost, -np.ones(n), np.ones(n), seed=[seed, 5], evaluations=evaluations, workers=workers, tick=tick, stage=STAGE
    )
    best: State | None = None
    for z in (found.vector, *found.best[1:_TRIED]):
        state = _with_gain(cost, z, data)
        if state is not None and (best is None or state.score < best.score):
            best = state
    return best, found


def _with_gain(cost: ShotCost, z: Array, data: Scaled) -> State | None:
    """The network with the Kalman gain of a guessed process noise, the best of several guesses."""
    from scipy.linalg import solve_discrete_are

    solved = cost.solved(z)
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
    best: State | None = None
    for q in _PROCESS:
        try:
            P = solve_discrete_are(m.A.T, C.T, q * np.diag(step), noise + 1e-12 * np.eye(layout.p))
            K = np.linalg.solve(C @ P @ C.T + noise, C @ P @ m.A.T).T
        except (np.linalg.LinAlgError, ValueError):
            continue
        state = added_gain(bare, data, K)
        if state is not None and (best is None or state.score < best.score):
            best = state
    return best
