"""What every subspace method starts from: a record compressed to triangular factors, projections, realisations.

Row t of the window matrix H is [1, z(t), ..., z(t+L-1)] with z = [u, y]; blocks of rows are folded into one running
triangular factor for each group of time, R'R = H'H. N4SID, MOESP and CVA solve Y_f = Gamma x + H U_f + noise, x in the
span of the past, by one SVD, whose weights are their whole difference (Van Overschee and De Moor 1996, ch. 4, table
4.1); A, C, then B, D by regression (robust algorithm, fig. 4.8). PBSID-opt takes the state from y(t) = sum_k Phi_k
z(t-k) + d + e(t), regressors older than e(t), whatever made the inputs (Chiuso and Picci 2005; Chiuso 2007, Automatica
43, 1034). The prior Phi_k ~ N(0, size decay^k), its two numbers by the marginal likelihood (Pillonetto, Chen, Chiuso,
De Nicolao and Ljung 2022, ch. 4), holds directions that band-limited inputs leave unseen and shifting brings into view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.linalg import solve_discrete_are, solve_triangular

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.model import StateSpaceModel
from ambid.errors import EstimationError
from ambid.signals.delay import lagged_triangle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channels:
    """Inputs and outputs with what they are centred and divided by before anything is factored."""

    u: Array  # (n_samples, n_inputs), SI
    y: Array  # (n_samples, n_outputs), SI
    mean_u: Array  # (n_inputs,), SI, mean and standard deviation
    scale_u: Array
    mean_y: Array  # (n_outputs,), SI
    scale_y: Array

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.y.shape[0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Factors:
    """Triangular factors of the window matrix, one for each group of time, for scaled channels."""

    # (n_groups, n_columns, n_columns), upper triangular. Columns: constant, then z = [u, y] of each sample of the
    # window, oldest first.
    groups: Array
    length: int  # samples in a window
    n_rows: int  # windows in the record
    n_inputs: int
    n_outputs: int

    def columns(self, what: str, first: int, last: int) -> list[int]:
        """Return the columns of samples `first` to `last` (not included) of the window, by sample, oldest first."""
        n_z = self.n_inputs + self.n_outputs
        inside = {"u": range(self.n_inputs), "y": range(self.n_inputs, n_z), "z": range(n_z)}[what]
        return [1 + k * n_z + j for k in range(first, last) for j in inside]

    def arranged(self, columns: Sequence[int]) -> Array:
        """Return the groups' factors (n_groups, n_chosen, n_chosen) for the constant, then `columns` in order."""
        chosen = self.groups[:, :, [0, *columns]]
        return np.stack([triangular_factor(g) for g in chosen])


def channels(data: IOData) -> Channels:
    """Look at the size of every channel."""
    u, y = data.u, data.y
    for values, names, what in ((u, data.inputs, "input"), (y, data.outputs, "output")):
        for name, column in zip(names, values.T, strict=True):
            if not np.ptp(column) > 1e-12 * np.max(np.abs(column)):
                raise EstimationError(f"{what} {name!r} is constant; it excites no dynamics. Omit it, or excite it")
    return Channels(u=u, y=y, mean_u=u.mean(0), scale_u=u.std(0), mean_y=y.mean(0), scale_y=y.std(0))


def compress(channels: Channels, length: int, n_groups: int) -> Factors:
    """Fold all windows of `length` samples of a record into triangular factors of `n_groups` groups of time."""
    n_rows = channels.n_samples - length + 1
    edges = np.linspace(0, n_rows, n_groups + 1).astype(int)
    groups = []
    for first, last in pairwise(edges):
        part = slice(first, last + length - 1)
        u = (channels.u[part] - channels.mean_u) / channels.scale_u
        z = [*u.T, *((channels.y[part] - channels.mean_y) / channels.scale_y).T]
        window = [(x, lag) for lag in range(length - 1, -1, -1) for x in z]
        groups.append(lagged_triangle([(np.ones(z[0].size), 0), *window], length - 1))
    return Factors(
        groups=np.array(groups),
        length=length,
        n_rows=n_rows,
        n_inputs=channels.mean_u.size,
        n_outputs=channels.mean_y.size,
    )


def triangular_factor(rows: Array) -> Array:
    """Return the square upper triangular factor of `rows`, padded with zero rows where there are fewer than columns."""
    factor = np.asarray(np.linalg.qr(rows, mode="r"))
    missing = rows.shape[1] - factor.shape[0]
    return np.vstack([factor, np.zeros((missing, rows.shape[1]))]) if missing > 0 else factor


def merge_factors(groups: Array) -> Array:
    """Return the triangular factor of all groups (n_groups, n_columns, n_columns) together."""
    total = np.array(groups[0])
    for g in groups[1:]:
        total = triangular_factor(np.vstack([total, g]))
    return total


def leave_each_out(groups: Array) -> list[Array]:
    """Return, for each of the groups (n_groups, n_columns, n_columns), the triangular factor of all others."""
    n = groups.shape[0]
    after: list[Array | None] = [None] * n
    for g in range(n - 1, 0, -1):
        later = after[g]
        after[g - 1] = groups[g] if later is None else triangular_factor(np.vstack([groups[g], later]))
    out, before = [], None
    for g in range(n):
        parts = [x for x in (before, after[g]) if x is not None]
        out.append(triangular_factor(np.vstack(parts)))
        before = groups[g] if before is None else triangular_factor(np.vstack([before, groups[g]]))
    return out


_TOGETHER = 1e-6  # part of an input that the others do not hold: less is rounding of the record
_FORESEEN = 1e-8  # of an input that its own past does not hold: below it is smooth, and dependence is not to be seen
_TAKES_PART = 1e-3  # coefficient beside the largest from which an input is named


def check_inputs_differ(factors: Factors, total: Array, names: Sequence[str], window: int) -> None:
    """Refuse inputs `names` of which one follows from the others, at the same sample or over a `window` of samples, as
    many as a numerator of the model has coefficients; `total`: factor of all groups.
    """
    for length in sorted({1, window}):
        relation = input_relation(factors, total, names, length)
        if relation is not None:
            raise EstimationError(f"{relation}: their effects cannot be distinguished. Omit one")


def input_relation(factors: Factors, total: Array, names: Sequence[str], window: int) -> str | None:
    """Say which inputs move together within a `window` of samples (at most those of the factors); none where every
    input has something of its own. `total`: factor of all groups.
    """
    n_u, now = factors.n_inputs, factors.length - 1
    length = min(window, now + 1)
    every = factors.columns("u", now + 1 - length, now + 1)
    for j in range(n_u if n_u > 1 else 0):
        own = every[j::n_u]
        others = [c for i, c in enumerate(every) if i % n_u != j]
        r = triangular_factor(total[:, [0, *own[:-1], *others, own[-1]]])
        target, history = r[1:, -1], length - 1
        alone, left = float(np.linalg.norm(target[history:])), abs(float(target[-1]))
        if alone <= _FORESEEN * np.linalg.norm(target) or left >= _TOGETHER * alone:
            continue
        size = np.abs(np.linalg.lstsq(r[1:-1, 1:-1], target[:-1], rcond=1e-13)[0])[history:]
        weight = np.insert(size.reshape(length, n_u - 1).max(axis=0), j, np.inf)
        largest = np.max(weight[np.isfinite(weight)])
        quoted = [repr(name) for name, w in zip(names, weight, strict=True) if w > _TAKES_PART * largest]
        within = "" if length == 1 else f" within {length} samples"
        return (
            f"inputs {', '.join(quoted[:-1])} and {quoted[-1]} move together{within} (all but {left / alone:.1g} of "
            f"one follows from the rest; {_TOGETHER:g} or more is needed)"
        )
    return None


_NOISE_FREE = 1e-18  # variance beside outputs of unit variance that counts as rounding


def autoregression_criterion(factors: Factors, factor: Array) -> Array:
    """Return Akaike's criterion, N log det(residual covariance) + 2 (numbers estimated), of autoregressions with inputs
    of 0, 1, 2 ... lags, (window,), from the factor of all groups.
    """
    now, n_y, n_z = factors.length - 1, factors.n_outputs, factors.n_inputs + factors.n_outputs
    newest_first = [c for k in range(now - 1, -1, -1) for c in factors.columns("z", k, k + 1)]
    columns = [0, *newest_first, *factors.columns("y", now, now + 1)]
    y = triangular_factor(factor[:, columns])[1:, -n_y:]
    rest = [y[k * n_z :] for k in range(now + 1)]
    left = np.array([_log_det_of(e.T @ e / factors.n_rows) for e in rest])
    return np.asarray(factors.n_rows * left + 2.0 * n_y * n_z * np.arange(now + 1))


def state_criterion(states: Array, y: Array, n_inputs: int, n_rows: int) -> Array:
    """Return Bayes' criterion (n_states + 1,) of 0, 1, 2 ... leading states (rows, leading first) as predictors of
    y(t), the first coordinates of `y` being those of the states.
    """
    basis = np.linalg.qr(states.T)[0]
    by_state = y[:, : basis.shape[0]] @ basis
    full = triangular_factor(y.T)
    covariance = full.T @ full
    parts = np.einsum("ik,jk->kij", by_state, by_state)
    # what is left, from the end: sums of squares, never a difference that rounding makes negative
    rest = y.copy()
    rest[:, : basis.shape[0]] -= by_state @ basis.T
    last = rest @ rest.T
    left = np.concatenate([last + np.cumsum(parts[::-1], axis=0)[::-1], last[None]])
    left[0] = covariance
    n_y = y.shape[0]
    log_det = np.array([_log_det_of(v / n_rows) for v in left])
    n = np.arange(log_det.size)
    return np.asarray(n_rows * log_det + n * (2 * n_y + n_inputs) * np.log(n_rows))


def _log_det_of(covariance: Array) -> float:
    return float(np.linalg.slogdet(covariance + _NOISE_FREE * np.eye(covariance.shape[0]))[1])


_FLOORS = (1e-18, 1e-14, 1e-10, 1e-6)  # noise added to outputs of unit variance until the Riccati equation has a root

_DEPENDENT = 1e-11  # diagonal beside its largest below which columns count as dependent


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Realisation:
    """x+ = A x + B u + w, y = C x + D u + v with cov [w; v] = [Q S; S' R], and its innovations form; scaled
    channels.
    """

    model: StateSpaceModel  # without a sampling interval
    innovation: Array  # (n_outputs, n_outputs), covariance of the innovations
    Q: Array
    S: Array
    R: Array  # (n_outputs, n_outputs)
    stable_predictor: bool = True  # false where no gain was found that makes A - K C stable


def kalman_gain(A: Array, C: Array, Q: Array, S: Array, R: Array) -> tuple[Array, Array, bool]:
    """Return K = (A P C' + S)(C P C' + R)^-1 of the stationary predictor, P from its Riccati equation, the innovations'
    covariance C P C' + R, and whether A - K C is stable; if not, K is the least-squares gain S R^-1.
    """
    eye = np.eye(C.shape[0])
    for floor in _FLOORS:
        noise = 0.5 * (R + R.T) + floor * eye
        try:
            P = solve_discrete_are(A.T, C.T, 0.5 * (Q + Q.T), noise, s=S)
        except (np.linalg.LinAlgError, ValueError):
            continue
        innovation = C @ P @ C.T + noise
        K = np.linalg.solve(innovation, (A @ P @ C.T + S).T).T
        if np.all(np.isfinite(K)) and radius(A - K @ C) < 1.0:
            return K, 0.5 * (innovation + innovation.T), True
    noise = 0.5 * (R + R.T) + _FLOORS[-1] * eye
    return np.asarray(np.linalg.solve(noise, S.T).T), noise, False


def radius(A: Array) -> float:
    """Return the largest magnitude of the eigenvalues of `A`."""
    return float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))


def least_squares(rows: Array, right: Array) -> Array:
    """Solve min |rows x - right| through an orthogonal factor; deficient columns get the shortest solution."""
    n = rows.shape[1]
    if rows.shape[0] >= n > 0:
        factor = np.asarray(np.linalg.qr(np.hstack([rows, right]), mode="r"))
        size = np.abs(np.diag(factor[:n, :n]))
        if np.min(size) > _DEPENDENT * np.max(size):
            return np.asarray(solve_triangular(factor[:n, :n], factor[:n, n:], check_finite=False))
    return np.asarray(np.linalg.lstsq(rows, right, rcond=_DEPENDENT / 10)[0])


def observability(A: Array, C: Array, length: int) -> Array:
    """Return [C; C A; ...; C A^(length-1)], (length * n_outputs, n)."""
    blocks = [C]
    for _ in range(length - 1):
        blocks.append(blocks[-1] @ A)
    return np.vstack(blocks)


Weighting = Literal["n4sid", "moesp", "cva"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Projection:
    """The weighted projection and what the regressions need, in coordinates of the triangular factor."""

    # (future * n_outputs, n_values), left singular vectors, weights undone: leading columns, divided by their scale,
    # span the observability matrix
    U: Array
    values: Array  # (n_values,), singular values, of windows of unit weight
    inputs: Array  # (n_future_inputs, n_inputs * future), triangular factor of the future inputs
    # (n_all, future * n_outputs), coordinates of the future outputs: rows future inputs, past, y(t), rest
    outputs: Array
    past: int  # columns of the past
    n_rows: int
    n_inputs: int
    n_outputs: int


def classical_columns(factors: Factors, past: int, future: int) -> list[int]:
    """Return the columns of a projection, future inputs, past, future outputs, of samples that fit into the window."""
    now = factors.length - future
    ahead = (now, factors.length)
    return factors.columns("u", *ahead) + factors.columns("z", now - past, now) + factors.columns("y", *ahead)


def project(factor: Array, weighting: Weighting, *, past: int, future: int, like: Factors) -> Projection:
    """Project the future on the past along the future inputs and decompose it; `factor`: of the constant and
    `classical_columns`; `past`, `future`: samples; `like`: for the sizes.
    """
    n_u, n_y = like.n_inputs, like.n_outputs
    r = factor[1:, 1:]  # without the row of the constant everything is centred, as a constant in each regression does
    k1, width = n_u * future, (n_u + n_y) * past
    k2 = k1 + width
    outputs = r[:, k2:]
    perpendicular = outputs[k1:k2].T  # of the future, on the past, both without the future inputs
    target, undo = perpendicular, None
    if weighting == "n4sid":
        target = least_squares(r[k1:k2, k1:k2], perpendicular.T).T @ r[:k2, k1:k2].T
    elif weighting == "cva":
        # whitened; directions that are not there are left out
        _, size, vectors = np.linalg.svd(outputs[k1:], full_matrices=False)
        keep = size > 1e-10 * size[0]
        target, undo = (vectors[keep] / size[keep, None]) @ perpendicular, vectors[keep].T * size[keep]
    left, values, _ = np.linalg.svd(target, full_matrices=False)
    unit = np.sqrt(like.n_rows)
    return Projection(
        U=left if undo is None else undo @ left / unit,
        values=values if weighting == "cva" else values / unit,
        inputs=r[:k1, :k1],
        outputs=outputs,
        past=width,
        n_rows=like.n_rows,
        n_inputs=n_u,
        n_outputs=n_y,
    )


def realise(projection: Projection, n: int, *, feedthrough: bool) -> Realisation:
    """Return the model of order `n`, with D zero without `feedthrough`."""
    p, n_y, n_u = projection, projection.n_outputs, projection.n_inputs
    k1 = p.inputs.shape[0]
    k2, k3 = k1 + p.past, k1 + p.past + n_y
    gamma = p.U[:, :n] * np.sqrt(np.maximum(p.values[:n], 1e-300))
    pinv, pinv_short = (np.asarray(np.linalg.pinv(g)) for g in (gamma, gamma[:-n_y]))
    state = np.zeros((n, k3))
    state[:, :k2] = pinv @ p.outputs[:k2].T
    left = np.vstack([pinv_short @ p.outputs[:k3, n_y:].T, p.outputs[:k3, :n_y].T])
    inputs = np.zeros((k1, k3))
    inputs[:, :k1] = p.inputs.T
    both = least_squares(np.vstack([state, inputs]).T, left.T).T
    AC = both[:, :n]
    rest = left - AC @ state
    BD, by_inputs = _input_part(gamma, pinv, pinv_short, AC, rest[:, :k1], p.inputs, n_u, n_y, feedthrough)
    rest[:, :k1] -= by_inputs
    covariance = rest @ rest.T / p.n_rows
    A, C = AC[:n], AC[n:]
    Q, S, R = covariance[:n, :n], covariance[:n, n:], covariance[n:, n:]
    K, innovation, stable = kalman_gain(A, C, Q, S, R)
    B, D = BD[n_y:], BD[:n_y]
    model = StateSpaceModel(A=A, B=B, C=C, D=D, K=K, dt=None)
    return Realisation(model=model, innovation=innovation, Q=Q, S=S, R=R, stable_predictor=stable)


def _input_part(
    gamma: Array,
    pinv: Array,
    pinv_short: Array,
    AC: Array,
    rest: Array,
    inputs: Array,
    n_u: int,
    n_y: int,
    feedthrough: bool,
) -> tuple[Array, Array]:
    """Solve for [D; B] of what the future inputs do in the state regression, linear in them (book, sec. 4.4.2)."""
    n, size = gamma.shape[1], gamma.shape[0]
    future = size // n_y
    if not n_u:
        return np.zeros((n_y + n, 0)), np.zeros_like(rest)
    column = np.zeros((size, n_y + n))  # of the Toeplitz matrix H, by [D; B]
    column[:n_y, :n_y] = np.eye(n_y)
    column[n_y:, n_y:] = gamma[:-n_y]
    blocks = np.empty((future, n + n_y, n_y + n))
    for k in range(future):
        here = np.zeros_like(column)
        here[k * n_y :] = column[: size - k * n_y]
        blocks[k] = -AC @ (pinv @ here)
        if k:
            blocks[k, :n] += pinv_short @ here[n_y:]
        else:
            blocks[k, :n, n_y:] += np.eye(n)
            blocks[k, n:, :n_y] += np.eye(n_y)
    if not feedthrough:
        blocks = blocks[:, :, n_y:]
    # rest = sum_k blocks[k] X inputs_k', with inputs_k the factor's columns of u(t + k)
    parts = inputs.reshape(inputs.shape[0], future, n_u)
    rows = np.einsum("kai,ckj->acij", blocks, parts).reshape(rest.size, -1)
    x = least_squares(rows, rest.reshape(-1, 1))
    X = x.reshape(-1, n_u)
    if not feedthrough:
        X = np.vstack([np.zeros((n_y, n_u)), X])
    return X, (rows @ x).reshape(rest.shape)


_LEAST_NOISE = 1e-9  # innovations' deviation beside outputs of unit deviation: less is rounding
_DECAYS = (0.6, 0.75, 0.85, 0.92, 0.96, 0.98, 1.0)  # of the prior's variance, per sample of lag
_SIZES = 10.0 ** np.arange(-3.0, 21.0, 0.5)  # of the prior's variance, whitened outputs on scaled channels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """What is believed of an autoregression before the data: coefficients of lag k are N(0, size decay^k)."""

    decay: float
    size: Array  # (n_outputs,), for whitened outputs
    whiten: Array  # (n_outputs, n_outputs), y @ whiten has innovations of unit covariance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction:
    """States of all orders and what the regressions need, in coordinates of the triangular factor."""

    values: Array  # (n_values,), singular values, in innovations' standard deviations
    state: Array  # (n_values, n_coordinates), coordinates of the states at t and t + 1, unit variance, leading first
    ahead: Array
    u: Array  # (n_inputs, n_coordinates)
    y: Array  # (n_outputs, n_coordinates)
    n_rows: int


def predictor_columns(factors: Factors, past: int) -> list[int]:
    """Return the columns of the regression: `past` samples, fewer than the window, u(t), y(t)."""
    now = factors.length - 1
    return (
        factors.columns("z", now - past, now) + factors.columns("u", now, now + 1) + factors.columns("y", now, now + 1)
    )


def fit_prior(factor: Array, *, past: int, feedthrough: bool, like: Factors) -> Prior:
    """Return the autoregression's prior that makes the data most likely; `factor`: of the constant and
    `predictor_columns`; `past`: samples; `like`: for the sizes.
    """
    rows, y, lags = _regression(factor, past, feedthrough, like)
    k = rows.shape[1]
    # upper triangular, error' error is the covariance of the innovations
    error = np.linalg.qr(y[k:], mode="r") / np.sqrt(max(like.n_rows - k, 1))
    size = np.maximum(np.abs(np.diag(error)), _LEAST_NOISE)
    sign = np.where(np.diag(error) < 0, -1.0, 1.0)
    whiten = np.linalg.inv(np.triu(error, 1) + np.diag(sign * size))
    y = y[:k] @ whiten
    best = np.inf
    for decay in _DECAYS:
        fade = decay ** (0.5 * lags)
        left, s, _ = np.linalg.svd(rows * fade)
        c = left.T @ y
        grown = 1.0 + _SIZES[:, None] * s**2  # (sizes, k)
        cost = np.sum(np.log(grown), axis=1)[:, None] + (1.0 / grown) @ c**2  # (sizes, outputs)
        total = float(np.sum(np.min(cost, axis=0)))
        if total < best:
            best, chosen = total, (decay, _SIZES[np.argmin(cost, axis=0)])
    return Prior(decay=chosen[0], size=chosen[1], whiten=np.asarray(whiten))


def predict_states(
    factor: Array, *, past: int, future: int, feedthrough: bool, like: Factors, prior: Prior
) -> Prediction:
    """Fit the autoregression with its `prior` and decompose what it says of `future` <= `past` samples; `factor`: of
    the constant and `predictor_columns`; `feedthrough`: whether u(t) acts on y(t); `like`: for the sizes.
    """
    n_u, n_y = like.n_inputs, like.n_outputs
    n_z, width = n_u + n_y, (n_u + n_y) * past
    r = factor[1:, 1:]
    rows, y, lags = _regression(factor, past, feedthrough, like)
    phi = _with_prior(rows, y[: rows.shape[1]] @ prior.whiten, lags, prior)[:width].T  # in innovations' deviations
    blocks = np.zeros((future, n_y, width))
    for i in range(future):
        blocks[i, :, i * n_z :] = phi[:, : width - i * n_z]
    future_taps = blocks.reshape(future * n_y, width)
    left, values, right = np.linalg.svd(future_taps @ r[:width, :width].T, full_matrices=False)
    n_values = int(np.sum(values > 1e-13 * values[0]))
    unit = np.sqrt(like.n_rows)
    state = np.zeros((n_values, r.shape[0]))
    state[:, :width] = right[:n_values] * unit
    to_state = (left[:, :n_values].T @ future_taps) * (unit / values[:n_values, None])
    return Prediction(
        values=values[:n_values] / unit,
        state=state,
        ahead=to_state @ r[:, n_z : width + n_z].T,
        u=r[:, width : width + n_u].T,
        y=r[:, width + n_u :].T,
        n_rows=like.n_rows,
    )


def regress_states(prediction: Prediction, n: int, *, feedthrough: bool) -> Realisation:
    """Return the model of order `n`, with D zero without `feedthrough`."""
    p = prediction
    x, ahead, n_u = p.state[:n], p.ahead[:n], p.u.shape[0]
    regressors = np.vstack([x, p.u]) if feedthrough else x
    CD = least_squares(regressors.T, p.y.T).T
    C = CD[:, :n]
    D = CD[:, n:] if feedthrough else np.zeros((p.y.shape[0], n_u))
    e = p.y - CD @ regressors
    ABK = least_squares(np.vstack([x, p.u, e]).T, ahead.T).T
    A, B, K = ABK[:, :n], ABK[:, n : n + n_u], ABK[:, n + n_u :]
    w = ahead - A @ x - B @ p.u
    Q, S, R = w @ w.T / p.n_rows, w @ e.T / p.n_rows, e @ e.T / p.n_rows
    innovation, stable = R, True
    if radius(A - K @ C) >= 1.0:
        K, innovation, stable = kalman_gain(A, C, Q, S, R)
    model = StateSpaceModel(A=A, B=B, C=C, D=D, K=K, dt=None)
    return Realisation(model=model, innovation=innovation, Q=Q, S=S, R=R, stable_predictor=stable)


def _regression(factor: Array, past: int, feedthrough: bool, like: Factors) -> tuple[Array, Array, Array]:
    """Return the triangular rows of the regressors, the coordinates of y(t), and the lag of every regressor."""
    n_u, n_z = like.n_inputs, like.n_inputs + like.n_outputs
    width = n_z * past
    k = width + (n_u if feedthrough else 0)
    lags = np.concatenate([np.repeat(np.arange(past, 0, -1.0), n_z), np.zeros(k - width)])
    return factor[1 : 1 + k, 1 : 1 + k], factor[1:, 1 + width + n_u :], lags


def _with_prior(rows: Array, right: Array, lags: Array, prior: Prior) -> Array:
    """Solve for whitened coefficients, the prior as further rows: orthogonal, and once for outputs of one size."""
    out = np.empty((rows.shape[1], right.shape[1]))
    for size in np.unique(prior.size):
        chosen = prior.size == size
        deviation = np.sqrt(size) * prior.decay ** (0.5 * lags)
        scaled = np.vstack([rows * deviation, np.eye(lags.size)])
        target = np.vstack([right[:, chosen], np.zeros((lags.size, int(chosen.sum())))])
        both = np.asarray(np.linalg.qr(np.hstack([scaled, target]), mode="r"))
        n = lags.size
        out[:, chosen] = deviation[:, None] * solve_triangular(both[:n, :n], both[:n, n:])
    return out


def jackknife(full: Realisation, others: Sequence[Realisation], length: int, *, with_bias: bool) -> Array | None:
    """Return the covariance of vec(A, B, C, D, K), each row by row, from models without one group each, compared by
    `length` block rows of observability; `with_bias` adds the square of the bias. None where a basis cannot be matched.
    """
    wanted, rows = observability(full.model.A, full.model.C, length), []
    for one in others:
        try:
            T = least_squares(observability(one.model.A, one.model.C, length), wanted)
            rows.append(one.model.in_states(T).theta)
        except np.linalg.LinAlgError:
            return None
    values = np.array(rows)
    if not np.all(np.isfinite(values)):
        return None
    deviations = values - values.mean(0)
    groups = values.shape[0]
    covariance = (groups - 1) / groups * deviations.T @ deviations
    if with_bias:
        bias = (groups - 1) * (values.mean(0) - full.model.theta)
        covariance = covariance + np.outer(bias, bias)
    return np.asarray(covariance)
