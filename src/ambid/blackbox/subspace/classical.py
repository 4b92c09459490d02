"""N4SID, PO-MOESP and CVA: the state from an oblique projection of the future on the past along future inputs.

Solves: Y_f = Gamma x + H U_f + noise with x in the span of the past; one singular value decomposition, whose weights
are the whole difference between the three methods (Van Overschee and De Moor 1996, ch. 4, table 4.1); then A, C from
one regression of states on states and B, D from the structure of its input part (their robust algorithm, fig. 4.8).
All of it happens in the coordinates of the triangular factor, whose size does not depend on the record's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.subspace.compress import Factors
from ambid.blackbox.subspace.realisation import Realisation, kalman_gain, least_squares

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
    """Return the columns of a projection: future inputs, past, future outputs.

    `past`, `future`: samples; together at most the window.
    """
    now = factors.length - future
    ahead = (now, factors.length)
    return factors.columns("u", *ahead) + factors.columns("z", now - past, now) + factors.columns("y", *ahead)


def projected(factor: Array, weighting: Weighting, *, past: int, future: int, like: Factors) -> Projection:
    """Project the future on the past along the future inputs and decompose it.

    `factor`: (n_columns, n_columns), of the constant and `classical_columns`; `past`, `future`: samples; `like`: for
    the sizes.
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
        weight, undo = _canonical(outputs[k1:])
        target = weight @ perpendicular
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


def _canonical(future: Array) -> tuple[Array, Array]:
    """Return the weight that makes the future white, and its inverse; directions that are not there are left out."""
    _, size, vectors = np.linalg.svd(future, full_matrices=False)
    keep = size > 1e-10 * size[0]
    return vectors[keep] / size[keep, None], vectors[keep].T * size[keep]


def realised(projection: Projection, n: int, *, feedthrough: bool) -> Realisation:
    """Return the model of order `n`.

    `feedthrough`: whether to estimate D; else it is zero.
    """
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
    return Realisation(A=A, B=B, C=C, D=D, K=K, innovation=innovation, Q=Q, S=S, R=R, stable_predictor=stable)


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
