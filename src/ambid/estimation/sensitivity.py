"""Innovations of a record and their exact Jacobian, compressed to a triangle block after block.

Away from everything known the blocks are reduced by QR. Near a place whose triangle T is known, sensitivities are taken
along the columns of T^-1, which are nearly orthonormal: their Gram matrix then loses no digits, and costs a fifth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import column_sizes
from ambid.estimation.predictor import Predictor, PredictorProblem, assemble

_BLOCK = 1024  # samples: sensitivities of one block stay in the second-level cache
_QR_ROWS = 256  # rows of one small QR: below the size at which the linear algebra library starts threads
_MOST_BLOCKS = 64  # that are held before they are reduced together
_WELL = 1e-6  # least eigenvalue of a Gram matrix with unit diagonal that a triangle is taken from
_TURNED = 1e-9  # least singular value, over the largest, of the scaled triangle that others are taken along


class Workspace:
    """What repeated evaluations of one problem share: scaled data, and the last triangle with its inverse, along
    whose columns the next Jacobian is taken.

    `y`: (n_used, n_outputs), scaled outputs; `w`: (n_used, n_states + n_lags n_inputs + n_outputs + 1), room for the
    states of the predictor, and what drives it: inputs at the problem's lags, y, 1; `z`: (n_used, n_lags n_inputs +
    n_outputs + 1), what drives the predictor, a view of `w`.
    """

    def __init__(self, problem: PredictorProblem) -> None:
        d, n_used = problem.delay, problem.n_used
        self.y = problem.y[problem.skip :: problem.stride] / problem.scales.output
        n, (n_u, n_y) = len(problem.model.states), (problem.u.shape[1], problem.y.shape[1])
        self.w = np.empty((n_used, n + len(problem.lags) * n_u + n_y + 1))
        self.z = self.w[:, n:]
        for j, s in enumerate(problem.lags):
            # inputs after the last sample do not exist; they would act only after the last output
            here, there = self.z[:, j * n_u : (j + 1) * n_u], problem.u[problem.skip - d - s :: problem.stride]
            there = there[:n_used]
            here[: there.shape[0]] = there
            here[there.shape[0] :] = problem.u[-1]
            here /= problem.scales.input
        self.z[:, -1 - n_y : -1], self.z[:, -1] = self.y, 1.0
        self.turn: tuple[Array, Array] | None = None
        self._problem = problem
        self._weight, self._weighted = np.zeros((0, 0)), self.y
        self._buffers: tuple[Array, ...] = ()

    def of(self, problem: PredictorProblem) -> Workspace:
        """Return the workspace of a problem: this one, where the scaled data are the same."""
        own, new = self._problem, problem
        same = (
            own.u is new.u and own.y is new.y and (own.delay, own.skip, own.stride) == (new.delay, new.skip, new.stride)
        )
        same = same and own.lags == new.lags and np.array_equal(own.scales.input, new.scales.input)
        if not same or not np.array_equal(own.scales.output, new.scales.output):
            return Workspace(problem)
        if self.turn is not None and self.turn[0].shape[0] != problem.size:
            self.turn = None
        return self

    def near(self, triangle: Array) -> None:
        """Take note of a triangle that is about that of the next Jacobian."""
        self.turn = _turn(triangle)

    def buffers(self, *shapes: tuple[int, ...]) -> tuple[Array, ...]:
        """Return scratch arrays, the same ones as long as the shapes stay the same: fresh pages cost more than sums.

        Returns not initialised.
        """
        if tuple(b.shape for b in self._buffers) != shapes:
            self._buffers = tuple(_aligned(shape) for shape in shapes)
        return self._buffers

    def weighted(self, weight: Array) -> Array:
        """Return the outputs times a weight, kept while the weight stays the same.

        `weight`: (n_outputs, n_outputs). Returns (n_used, n_outputs).
        """
        if not np.array_equal(weight, self._weight):
            self._weight, self._weighted = weight.copy(), self.y @ weight.T
        return self._weighted


def _aligned(shape: tuple[int, ...]) -> Array:
    """Return an array that begins where a cache line does: vector instructions want that."""
    size = int(np.prod(shape))
    raw = np.empty(size + 8)
    first = -(raw.ctypes.data // 8) % 8
    return raw[first : first + size].reshape(shape)


def innovations(
    problem: PredictorProblem, vector: Array, work: Workspace | None = None, predictor: Predictor | None = None
) -> Array | None:
    """Return the innovations in scaled output units.

    `vector`: (size,); `work`, `predictor`: of this problem, to save making them again. Returns (n_used,
    n_outputs), or None where there is no predictor at `vector`.
    """
    from ambid.estimation.kernels import state_scan

    work = work or Workspace(problem)
    predictor = predictor or assemble(problem, vector, with_derivatives=False)
    if predictor is None:
        return None
    state_scan(predictor.M, work.w, predictor.x0.copy())
    e = work.y - work.w[:, : predictor.x0.size] @ predictor.C.T
    return e if np.all(np.isfinite(e[-1])) else None


def run(M: Array, z: Array, x0: Array) -> Array:
    """Run the recursion x+ = M [x; z].

    `M`: (n, n + n_z); `z`: (n_samples, n_z); `x0`: (n,). Returns (n_samples + 1, n), states before each sample, and
    after the last.
    """
    from ambid.estimation.kernels import state_scan

    n = x0.size
    w, x = np.empty((z.shape[0], n + z.shape[1])), x0.copy()
    w[:, n:] = z
    state_scan(M, w, x)
    return np.vstack([w[:, :n], x])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearisation:
    """Weighted innovations and Jacobian at one vector, compressed by QR."""

    r: Array  # (size + 1,)
    # (size + 1, size), same norm, gradient and singular values as the full residual and Jacobian: they differ by an
    # orthogonal matrix
    J: Array
    covariance: Array  # (n_outputs, n_outputs), mean of e e^T, scaled output units


def linearise(
    problem: PredictorProblem, vector: Array, weight: Array, work: Workspace | None = None
) -> Linearisation | None:
    """Return the compressed weighted residual and its exact Jacobian.

    `vector`: (size,); `weight`: (n_outputs, n_outputs), lower triangular W with W^T W the inverse innovation covariance
    (scaled); `work`: of this problem.
    """
    work = work or Workspace(problem)
    p, moment = problem.size, np.zeros_like(weight)
    full = _near_triangle(problem, vector, weight, work, moment) if work.turn is not None else None
    if full is None:
        blocks, moment[:] = list[Array](), 0.0
        for rows in residual_blocks(problem, vector, weight, work):
            e = rows[:, :, p]
            moment += e.T @ e
            blocks.append(reduce_rows(rows.reshape(-1, p + 1)))
            if len(blocks) == _MOST_BLOCKS:
                blocks = [reduce_rows(np.vstack(blocks), last=True)]
        if not blocks or not np.all(np.isfinite(moment)):
            return None
        reduced = reduce_rows(np.vstack(blocks), last=True)
        full = np.zeros((p + 1, p + 1))
        full[: reduced.shape[0]] = reduced
    work.turn = _turn(full[:p, :p])
    back = np.linalg.inv(weight)
    return Linearisation(r=full[:, p].copy(), J=full[:, :p].copy(), covariance=back @ moment @ back.T / problem.n_used)


def _near_triangle(
    problem: PredictorProblem, vector: Array, weight: Array, work: Workspace, moment: Array
) -> Array | None:
    """Triangle of [J | r] from the Gram matrix along the last triangle's directions, None where digits run short."""
    assert work.turn is not None
    (last, turn), p = work.turn, problem.size
    gram = np.zeros((p + 1, p + 1))
    for rows in residual_blocks(problem, vector, weight, work, turn):
        e = rows[:, :, p]
        moment += e.T @ e
        for o in range(rows.shape[1]):
            gram += rows[:, o].T @ rows[:, o]
    if not np.all(np.isfinite(gram)) or not np.all(np.diag(gram) > 0.0):
        return None
    size = np.sqrt(np.diag(gram))
    gram /= np.outer(size, size)
    if np.linalg.eigvalsh(gram)[0] < _WELL:
        return None
    full = np.linalg.cholesky(gram).T * size
    full[:, :p] = full[:, :p] @ last
    return np.asarray(full)


def _turn(triangle: Array) -> tuple[Array, Array] | None:
    """A triangle and its inverse, None where the data do not tell some directions apart."""
    size = column_sizes(triangle)
    scaled = triangle / size
    s = np.linalg.svd(scaled, compute_uv=False)
    if not s[-1] > _TURNED * s[0]:
        return None
    return triangle, np.linalg.inv(scaled) / size[:, None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Products:
    """Scalar products over a whole record of J, e and lagged signals, J along the directions of `turn`."""

    turn: Array  # (size, size)
    rows: Array  # (size + 1, size + 1), of [J turn, e], summed over the outputs
    cross: Array  # (n_outputs, size + 1, n_columns), of [J turn, e] of each output and the lagged signals
    inner: Array  # (n_columns, n_columns), of the lagged signals
    squares: Array  # (n_outputs,), of e
    scores: Array  # (n_stretches, size), J' e of stretches of the record, by each number


def products(
    problem: PredictorProblem,
    vector: Array,
    weight: Array,
    work: Workspace,
    lagged: Sequence[tuple[Array, tuple[int, ...]]] = (),
    stretches: int = 1,
) -> Products | None:
    """Return all scalar products that checks and robust covariances are made of, from one pass of sensitivities.

    `lagged`: signals, (n_used, n_signals), with the lags at which they become columns, lag by lag, zero before the
    record; `stretches`: into about how many the record is cut. None where there is no predictor, or the data do not
    tell all numbers apart.
    """
    p, n_used, n_y = problem.size, problem.n_used, work.y.shape[1]
    if work.turn is None and linearise(problem, vector, weight, work) is None:
        return None
    turn = np.eye(p) if work.turn is None else work.turn[1]
    length = max(1, n_used // stretches)
    n_columns = sum(len(lags) * signals.shape[1] for signals, lags in lagged)
    rows, cross, inner = np.zeros((p + 1, p + 1)), np.zeros((n_y, p + 1, n_columns)), np.zeros((n_columns, n_columns))
    squares, scores, first = np.zeros(n_y), np.zeros((-(-n_used // length), p)), 0
    for block in residual_blocks(problem, vector, weight, work, turn):
        m = block.shape[0]
        columns = _lagged_block(lagged, first, m, n_columns)
        inner += columns.T @ columns
        for o in range(n_y):
            own = block[:, o]
            rows += own.T @ own
            cross[o] += own.T @ columns
            squares[o] += own[:, p] @ own[:, p]
            for b in range(first // length, (first + m - 1) // length + 1):
                part = own[max(b * length - first, 0) : (b + 1) * length - first]
                scores[b] += part[:, :p].T @ part[:, p]
        first += m
    if not first or not np.all(np.isfinite(rows)):
        return None
    back = np.eye(p) if work.turn is None else work.turn[0]
    return Products(turn=turn, rows=rows, cross=cross, inner=inner, squares=squares, scores=scores @ back)


def _lagged_block(lagged: Sequence[tuple[Array, tuple[int, ...]]], first: int, m: int, width: int) -> Array:
    """Samples `first` to ``first + m`` of the columns of all signals at all their lags, (m, width)."""
    out, place = np.zeros((m, width)), 0
    for signals, lags in lagged:
        for lag in lags:
            there = signals[max(first - lag, 0) : max(first + m - lag, 0)]
            out[m - there.shape[0] :, place : place + signals.shape[1]] = there
            place += signals.shape[1]
    return out


def reduce_rows(rows: Array, *, last: bool = False) -> Array:
    """Replace rows by fewer that differ by an orthogonal matrix (QR of short stacks).

    `rows`: (n_rows, n_columns); `last`: reduce to at most n_columns rows, instead of that many for each stack. Returns
    (fewer, n_columns).
    """
    if last:
        return np.asarray(np.linalg.qr(rows, mode="r"))
    whole = rows.shape[0] // _QR_ROWS * _QR_ROWS
    if not whole:
        return rows.copy()
    factors = np.asarray(np.linalg.qr(rows[:whole].reshape(-1, _QR_ROWS, rows.shape[1]), mode="r"))
    return np.vstack([factors.reshape(-1, rows.shape[1]), rows[whole:]])


def residual_blocks(
    problem: PredictorProblem, vector: Array, weight: Array, work: Workspace, turn: Array | None = None
) -> Iterator[Array]:
    """Yield rows [W de/dq, W e] block after block, so that memory does not grow with the record.

    `vector`: (size,); `weight`: (n_outputs, n_outputs); `turn`: (size, size), directions along whose columns the
    derivatives are taken, instead of by each number. Returns (block, n_outputs, size + 1), a view, overwritten by
    the next block. Nothing is yielded where there is no predictor at `vector`.
    """
    from ambid.estimation.kernels import sensitivity_scan, state_scan

    predictor = assemble(problem, vector)
    if predictor is None:
        return
    n, p, n_y, n_used = predictor.x0.size, problem.size, work.y.shape[1], work.y.shape[0]
    # a state basis whose first states are the weighted predicted outputs with their sign turned: weighted innovations
    # are then W y plus a state, and sensitivities of innovations are read off, not multiplied
    whitened = weight @ predictor.C
    basis = -np.vstack([whitened, null_space(whitened)])
    turned = np.linalg.inv(basis)
    M = basis @ predictor.M
    M[:, :n] = M[:, :n] @ turned
    # vector instructions take eight numbers at a time, and pay from sixteen on: columns of zeros fill up to that
    width, length = max(16, -(-(p + 1) // 8) * 8), min(_BLOCK, n_used)
    forcing = np.zeros((n, M.shape[1], width))
    forcing[:, :, :p] = np.tensordot(basis, predictor.dM, axes=1)
    forcing[:, :n] = turned.T @ forcing[:, :n]
    if turn is not None:
        forcing[:, :, :p] = forcing[:, :, :p] @ turn
    through = None  # what numbers that move C do to the innovations at once
    if predictor.dC.shape[2]:
        through = np.zeros((n_y, n, width))
        through[:, :, : predictor.dC.shape[2]] = -np.tensordot(weight, predictor.dC, axes=1)
        through = turned.T @ through
        if turn is not None:
            through[:, :, :p] = through[:, :, :p] @ turn
    rows, s = work.buffers((n, length, width), (n, width))
    s[:], x = 0.0, basis @ predictor.x0
    s[:, problem.slices["initial"]] = basis
    if turn is not None:
        s[:, :p] = s[:, :p] @ turn
    F, outputs = np.ascontiguousarray(M[:, :n]), work.weighted(weight)
    for a in range(0, n_used, _BLOCK):
        part = work.w[a : a + _BLOCK]
        # whole in memory also where the last block is shorter: another layout would be compiled anew
        block = rows.reshape(-1)[: n * part.shape[0] * width].reshape(n, -1, width)
        state_scan(M, part, x)
        np.matmul(part, forcing, out=block)
        sensitivity_scan(F, part, outputs[a : a + _BLOCK], s, block, p)
        if through is not None:
            block[:n_y] += part[:, :n] @ through
        yield block[:n_y, :, : p + 1].swapaxes(0, 1)


def null_space(a: Array) -> Array:
    """Return orthonormal rows that complete the row space of a full-rank wide matrix.

    `a`: (r, n), r <= n. Returns (n - r, n).
    """
    q, _ = np.linalg.qr(a.T, mode="complete")
    return np.ascontiguousarray(q[:, a.shape[0] :].T)
