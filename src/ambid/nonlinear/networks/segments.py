"""Errors of a state-space network over records, or over shots of them (multiple shooting), with their exact slopes.

Unknown are the weights and one state at the beginning of each shot. Where a shot goes on with the record of the one
before it, the jump between them is a row too: multiple shooting with continuity penalties (Bock 1983), which keeps the
predictions of an unstable plant from running away. Each shot is reduced to a triangle before all are joined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import triangle_of
from ambid.nonlinear.networks.layout import Layout, Matrices
from ambid.nonlinear.records import Parts

_ROWS = 2048  # that are joined and reduced at once: they stay in the cache


class Penalty(Protocol):
    """Further rows that hang on the weights alone."""

    def rows(self, theta: Array) -> tuple[Array, Array]:
        """Return the slopes and the rows themselves, target less value.

        `theta`: (n_theta,). Returns `J`: (n_rows, n_theta); `r`: (n_rows,).
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot:
    """A stretch of a record that is run in one go."""

    y: Array  # (n_samples, n_outputs), scaled
    u: Array  # (n_samples, n_inputs + 1), scaled, last column 1
    goes_on: bool  # whether it begins where the shot before it ends


def shots(parts: Parts, length: int | None) -> tuple[Shot, ...]:
    """Cut records into shots.

    `length`: samples of a shot; None for whole records.
    """
    out = []
    for y, u in parts:
        full = np.hstack([u, np.ones((u.shape[0], 1))])
        first = list(range(0, y.shape[0], length or y.shape[0]))
        if len(first) > 1 and y.shape[0] - first[-1] < 2:
            first.pop()
        for k, a in enumerate(first):
            b = first[k + 1] if k + 1 < len(first) else y.shape[0]
            out.append(Shot(y=np.ascontiguousarray(y[a:b]), u=np.ascontiguousarray(full[a:b]), goes_on=k > 0))
    return tuple(out)


def run(layout: Layout, m: Matrices, shot: Shot, x0: Array) -> tuple[Array, Array]:
    """Return states and innovations of a shot.

    `x0`: (n,). Returns `X`: (n_samples + 1, n); `E`: (n_samples, n_outputs), naN from a divergence on.
    """
    from ambid.nonlinear.networks._kernels import run_states

    X, E = np.empty((shot.u.shape[0] + 1, layout.n)), np.empty((shot.u.shape[0], layout.p))
    run_states(
        m.A, m.B, m.K, layout.head_table, m.G, m.W1, m.b1, m.W2, int(layout.anchored), shot.u, shot.y,
        np.ascontiguousarray(x0), X, E,
    )  # fmt: skip
    return X, E


def slopes(layout: Layout, m: Matrices, shot: Shot, X: Array, E: Array, s: Array) -> Array:
    """Return the slopes of the predictions of a shot; `s` is changed from the first state's slopes to the last's.

    `X`, `E`: that `run` returned; `s`: (n, n_columns). Returns (n_samples, n_outputs, n_columns).
    """
    from ambid.nonlinear.networks._kernels import slope_states

    out = np.empty((shot.u.shape[0], layout.p, s.shape[1]))
    D = np.ascontiguousarray(np.moveaxis(np.concatenate([m.dA, m.dB, m.dK, m.dG], axis=2), 0, 2))
    used = np.any(D != 0.0, axis=2).astype(np.int64)
    slope_states(
        m.A, m.K, layout.head_table, m.G, m.W1, m.b1, m.W2, int(layout.anchored), D, used, shot.u, X, E, s, out
    )  # fmt: skip
    return out


def largest_pole(layout: Layout, theta: Array) -> float:
    """Return the largest modulus of the poles of the linear predictor, A - K C.

    `theta`: (n_theta,), scaled. Returns infinite where the matrices are not finite.
    """
    m = layout.matrices(theta)
    F = m.A.copy()
    F[:, layout.head_table] -= m.K
    return float(np.max(np.abs(np.linalg.eigvals(F)))) if np.all(np.isfinite(F)) else np.inf


@dataclass(frozen=True, kw_only=True, eq=False)
class StateProblem:
    """Weighted errors of a state-space network; unknown are (weights, first state of every shot)."""

    layout: Layout
    shots: tuple[Shot, ...]
    weight: Array  # (n_outputs, n_outputs), errors times it have unit covariance
    jump: Array  # (n,), one over the standard deviation of the jump of each state between shots
    penalties: Sequence[Penalty] = ()
    held: tuple[int, ...] = ()  # weights that are not searched for
    # modulus that no pole of the linear predictor A - K C may reach. Without it the search creeps towards a predictor
    # that runs away from its first state on: on a plant without process noise that fits the sample a little better.
    farthest: float = np.inf

    def split(self, v: Array) -> tuple[Array, Array]:
        """Return weights and first states.

        `v`: (n_theta + n_shots n,). Returns `theta`: (n_theta,); `x0`: (n_shots, n).
        """
        return v[: self.layout.n_theta], v[self.layout.n_theta :].reshape(len(self.shots), self.layout.n)

    def errors(self, v: Array) -> tuple[list[Array], list[Array]]:
        """Return states and errors of every shot.

        `v`: (n_theta + n_shots n,). Returns `X`: (n_samples + 1, n); `E`: (n_samples, n_outputs).
        """
        theta, x0 = self.split(v)
        m = self.layout.matrices(theta)
        found = [run(self.layout, m, s, x) for s, x in zip(self.shots, x0, strict=True)]
        return [X for X, _ in found], [E for _, E in found]

    def cost(self, v: Array) -> float:
        """Return the sum of squares of all rows.

        `v`: (n_theta + n_shots n,). Returns infinite where the model diverges.
        """
        theta, x0 = self.split(v)
        if not np.all(np.isfinite(v)) or np.max(np.abs(theta)) > 1e12:
            return np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            if np.isfinite(self.farthest) and not largest_pole(self.layout, theta) < self.farthest:
                return np.inf
            X, E = self.errors(v)
            found = sum(float(np.sum((e @ self.weight) ** 2)) for e in E)
            for k in range(1, len(X)):
                if self.shots[k].goes_on:
                    found += float(np.sum(((X[k - 1][-1] - x0[k]) * self.jump) ** 2))
            for p in self.penalties:
                found += float(np.sum(p.rows(theta)[1] ** 2))
        return found if np.isfinite(found) else np.inf

    def triangle(self, v: Array) -> Array:
        """Return the triangle of [J | r] of all rows.

        `v`: (n_theta + n_shots n,). Returns (at most n_columns, n_theta + n_shots n + 1).
        """
        theta, x0 = self.split(v)
        layout, n, P = self.layout, self.layout.n, self.layout.n_theta
        m = layout.matrices(theta)
        rows, last_X, last_s = [], np.empty(0), np.empty(0)
        width = P + n * len(self.shots) + 1
        with np.errstate(over="ignore", invalid="ignore"):
            for k, shot in enumerate(self.shots):
                own = slice(P + k * n, P + (k + 1) * n)
                X, E = run(layout, m, shot, x0[k])
                if k and shot.goes_on:
                    rows.append(self._jump_rows(last_X, last_s, x0[k], k, width))
                s = np.hstack([np.zeros((n, P)), np.eye(n)])
                J = slopes(layout, m, shot, X, E, s)
                small = triangle_of(
                    [self._weighted(J[k : k + _ROWS], E[k : k + _ROWS]) for k in range(0, J.shape[0], _ROWS)]
                )
                wide = np.zeros((small.shape[0], width))
                wide[:, :P], wide[:, own], wide[:, -1] = small[:, :P], small[:, P:-1], small[:, -1]
                rows.append(wide)
                last_X, last_s = X[-1], s
            for p in self.penalties:
                J, r = p.rows(theta)
                rows.append(np.hstack([J, np.zeros((r.size, width - P - 1)), r[:, None]]))
        whole = np.concatenate(rows)
        whole[:, list(self.held)] = 0.0
        return triangle_of([whole])

    def sample_rows(self, v: Array) -> list[Array]:
        """Return slopes and errors of every sample, joined to ones of unit variance.

        `v`: (n_theta + n_shots n,). Returns (n_samples, n_outputs, n_theta + n_shots n + 1), of each shot.
        """
        theta, x0 = self.split(v)
        layout, n, P = self.layout, self.layout.n, self.layout.n_theta
        m, out = layout.matrices(theta), []
        for k, shot in enumerate(self.shots):
            X, E = run(layout, m, shot, x0[k])
            J = slopes(layout, m, shot, X, E, np.hstack([np.zeros((n, P)), np.eye(n)]))
            both = np.moveaxis(self._weighted(J, E).reshape(layout.p, E.shape[0], -1), 0, 1)
            wide = np.zeros((*both.shape[:2], v.size + 1))
            wide[:, :, :P], wide[:, :, P + k * n : P + (k + 1) * n] = both[:, :, :P], both[:, :, P:-1]
            wide[:, :, -1] = both[:, :, -1]
            out.append(wide)
        return out

    def _weighted(self, J: Array, E: Array) -> Array:
        """Slopes and errors of all outputs, joined to ones of unit variance."""
        out = np.empty((self.layout.p, J.shape[0], J.shape[2] + 1))
        for q, row in enumerate(self.weight.T):
            out[q, :, :-1] = row[q] * J[:, q]
            out[q, :, -1] = E @ row
            for o in range(q):  # the weight is triangular
                out[q, :, :-1] += row[o] * J[:, o]
        return out.reshape(-1, J.shape[2] + 1)

    def _jump_rows(self, before: Array, s: Array, x0: Array, k: int, width: int) -> Array:
        """Rows of x0[k] - (where the shot before ends) = 0."""
        n, P = self.layout.n, self.layout.n_theta
        out = np.zeros((n, width))
        out[:, :P], out[:, P + (k - 1) * n : P + k * n] = -s[:, :P], -s[:, P:]
        out[:, P + k * n : P + (k + 1) * n] = np.eye(n)
        out[:, -1] = before - x0
        scaled: Array = out * self.jump[:, None]
        return scaled
