"""Innovations of a record and their exact Jacobian, compressed by QR block after block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.identify.predictor import assemble
from ambid.identify.problem import PredictorProblem

Array = NDArray[np.float64]

_BLOCK = 2048  # samples: sensitivities of one block stay in the second-level cache
_QR_ROWS = 512  # rows of one small QR: below the size at which the linear algebra library starts threads


class Workspace:
    """What repeated evaluations of one problem share: scaled data, and the last gain to start the next Riccati solve.

    Parameters
    ----------
    problem : PredictorProblem

    Attributes
    ----------
    y : ndarray, shape (n_used, n_outputs)
        Scaled outputs.
    z : ndarray, shape (n_used, n_lags n_inputs + n_outputs + 1)
        What drives the predictor: inputs at the problem's lags, y, 1.
    gain : ndarray or None
    """

    def __init__(self, problem: PredictorProblem) -> None:
        n_samples, d = problem.y.shape[0], problem.delay
        at = np.arange(problem.skip, n_samples, problem.stride)
        self.y = np.ascontiguousarray(problem.y[at] / problem.scales.output)
        # inputs after the last sample do not exist; they would act only after the last output
        u = problem.u / problem.scales.input
        lagged = [u[np.minimum(at - d - s, n_samples - 1)] for s in problem.lags]
        self.z = np.hstack([*lagged, self.y, np.ones((at.size, 1))])
        self.gain: Array | None = None


def innovations(problem: PredictorProblem, vector: Array, work: Workspace | None = None) -> Array | None:
    """Return the innovations in scaled output units.

    Parameters
    ----------
    problem : PredictorProblem
    vector : ndarray, shape (size,)
    work : Workspace, optional
        Of this problem, to save making it again.

    Returns
    -------
    ndarray, shape (n_used, n_outputs), or None where there is no predictor at `vector`
    """
    work = work or Workspace(problem)
    predictor = assemble(problem, vector, near=work.gain, with_derivatives=False)
    if predictor is None:
        return None
    work.gain = predictor.gain
    e = work.y - run(predictor.M, work.z, predictor.x0)[:-1] @ predictor.C.T
    return e if np.all(np.isfinite(e[-1])) else None


def run(M: Array, z: Array, x0: Array) -> Array:
    """Run the recursion x+ = M [x; z].

    Parameters
    ----------
    M : ndarray, shape (n, n + n_z)
    z : ndarray, shape (n_samples, n_z)
    x0 : ndarray, shape (n,)

    Returns
    -------
    ndarray, shape (n_samples + 1, n)
        States before each sample, and after the last.
    """
    from ambid.identify._kernels import state_scan

    n = x0.size
    x = np.empty((z.shape[0] + 1, n))
    x[0] = x0
    np.matmul(z, M[:, n:].T, out=x[1:])
    state_scan(np.ascontiguousarray(M[:, :n]), x)
    return x


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearisation:
    """Weighted innovations and Jacobian at one vector, compressed by QR.

    Attributes
    ----------
    r : ndarray, shape (size + 1,)
    J : ndarray, shape (size + 1, size)
        Same norm, gradient and singular values as the full residual and Jacobian: they differ by an orthogonal matrix.
    covariance : ndarray, shape (n_outputs, n_outputs)
        Mean of e e^T, scaled output units.
    """

    r: Array
    J: Array
    covariance: Array


def linearise(
    problem: PredictorProblem, vector: Array, weight: Array, work: Workspace | None = None
) -> Linearisation | None:
    """Return the compressed weighted residual and its exact Jacobian.

    Parameters
    ----------
    problem : PredictorProblem
    vector : ndarray, shape (size,)
    weight : ndarray, shape (n_outputs, n_outputs)
        Lower triangular W with W^T W the inverse innovation covariance (scaled).
    work : Workspace, optional
        Of this problem.

    Returns
    -------
    Linearisation or None where there is no predictor at `vector`
    """
    work = work or Workspace(problem)
    p, moment = problem.size, np.zeros_like(weight)
    blocks = []
    for e, rows in residual_blocks(problem, vector, weight, work):
        moment += e.T @ e
        blocks.append(reduce_rows(rows))
    if not blocks or not np.all(np.isfinite(moment)):
        return None
    reduced = reduce_rows(np.vstack(blocks), last=True)
    full = np.zeros((p + 1, p + 1))
    full[: reduced.shape[0]] = reduced
    return Linearisation(r=full[:, p].copy(), J=full[:, :p].copy(), covariance=moment / problem.n_used)


def reduce_rows(rows: Array, *, last: bool = False) -> Array:
    """Replace rows by fewer that differ by an orthogonal matrix (QR of short stacks).

    Parameters
    ----------
    rows : ndarray, shape (n_rows, n_columns)
    last : bool
        Reduce to at most n_columns rows, instead of that many for each stack.

    Returns
    -------
    ndarray, shape (fewer, n_columns)
    """
    if last:
        return np.asarray(np.linalg.qr(rows, mode="r"))
    whole = rows.shape[0] // _QR_ROWS * _QR_ROWS
    if not whole:
        return rows.copy()
    factors = np.asarray(np.linalg.qr(rows[:whole].reshape(-1, _QR_ROWS, rows.shape[1]), mode="r"))
    return np.vstack([factors.reshape(-1, rows.shape[1]), rows[whole:]])


def reduce_blocks(blocks: Iterable[Array]) -> Array:
    """Reduce all rows of several blocks to at most as many as they have columns.

    Parameters
    ----------
    blocks : iterable of ndarray, each of shape (n_rows, n_columns)

    Returns
    -------
    ndarray, shape (at most n_columns, n_columns)
    """
    return reduce_rows(np.vstack([reduce_rows(b) for b in blocks]), last=True)


def residual_blocks(
    problem: PredictorProblem, vector: Array, weight: Array, work: Workspace
) -> Iterator[tuple[Array, Array]]:
    """Yield innovations and rows [W de/dq, W e] block after block, so that memory does not grow with the record.

    Parameters
    ----------
    problem : PredictorProblem
    vector : ndarray, shape (size,)
    weight : ndarray, shape (n_outputs, n_outputs)
    work : Workspace

    Yields
    ------
    e : ndarray, shape (block, n_outputs)
        Innovations, scaled, unweighted.
    rows : ndarray, shape (block * n_outputs, size + 1)
        Time runs slowest; overwritten by the next block. Nothing is yielded where there is no predictor at `vector`.
    """
    from ambid.identify._kernels import sensitivity_scan

    predictor = assemble(problem, vector, near=work.gain)
    if predictor is None:
        return
    work.gain = predictor.gain
    n, p, n_y, n_used = predictor.x0.size, problem.size, work.y.shape[1], work.y.shape[0]
    # a state basis in which the weighted outputs are the first states: sensitivities are then read off, not multiplied;
    # they are carried with the sign of e = y - C x
    whitened = weight @ predictor.C
    basis = -np.vstack([whitened, null_space(whitened)])
    F = basis @ predictor.M[:, :n] @ np.linalg.inv(basis)
    forcing = np.zeros((predictor.M.shape[1], n, p + 1))
    forcing[:, :, :p] = np.tensordot(basis, predictor.dM, axes=1).swapaxes(0, 1)
    flat = forcing.reshape(-1, n * (p + 1))
    s = np.zeros((min(_BLOCK, n_used) + 1, n, p + 1))
    s[0, :, problem.slices["initial"]] = basis
    x0, w = predictor.x0, np.empty((s.shape[0] - 1, n + work.z.shape[1]))
    rows = np.empty((s.shape[0] - 1, n_y, p + 1))
    for a in range(0, n_used, _BLOCK):
        b = min(a + _BLOCK, n_used)
        x, block, part = run(predictor.M, work.z[a:b], x0), s[: b - a + 1], w[: b - a]
        e = work.y[a:b] - x[:-1] @ predictor.C.T
        part[:, :n], part[:, n:], x0 = x[:-1], work.z[a:b], x[-1]
        np.matmul(part, flat, out=block[1:].reshape(b - a, -1))
        sensitivity_scan(F, block)
        rows[: b - a] = block[:-1, :n_y]
        rows[: b - a, :, p] = e @ weight.T
        yield e, rows[: b - a].reshape(-1, p + 1)
        s[0] = block[-1]


def null_space(a: Array) -> Array:
    """Return orthonormal rows that complete the row space of a full-rank wide matrix.

    Parameters
    ----------
    a : ndarray, shape (r, n), r <= n

    Returns
    -------
    ndarray, shape (n - r, n)
    """
    q, _ = np.linalg.qr(a.T, mode="complete")
    return np.ascontiguousarray(q[:, a.shape[0] :].T)
