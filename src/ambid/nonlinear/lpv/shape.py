"""The equations of an LPV model and its predictor, on scaled signals.

Equation form: A(q, p) y = B(q, p) u + c(p) + v; output form: A(q, p) x = B(q, p) u + c(p), y = x + v; both with the
error model D(q, p) v = C(q, p) e. All coefficients at time t are functions of p(t), and stand before the shifted
signals: (A y)(t) = y(t) + a_1(p(t)) y(t - 1) + ... (Toth 2010, sec. 3.1: static dependence, shifted form). Operators do
not commute with p, so that this is another model than one with p(t - k).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.roots import stable
from ambid.nonlinear.lpv.schedule import basis_values


@dataclass(frozen=True, slots=True, kw_only=True)
class LpvShape:
    """Orders of an LPV model of one output."""

    columns: tuple[int, ...]  # which inputs excite
    order: int  # of A
    nb: int  # coefficients of each input, and the smallest lag
    nk: int
    ar: int  # orders of D and C
    ma: int
    degree: int  # functions of p less one, in A, B, c and in C, D
    error_degree: int
    form: str  # whether v enters the difference equation or the output
    basis: str
    # whether c is a function of p. Where p is the last output itself c(p) says nothing that a_1(p) y(t - 1) does not.
    offset: str = "scheduled"

    @property
    def first(self) -> int:
        """Samples before the process part can be computed."""
        return max(self.order, self.nk + self.nb - 1 if self.columns else 0, 1)

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return self.first + self.ar

    @property
    def n_process(self) -> int:
        """Coefficients of A, B and the constant, each a function of p."""
        return self.order + len(self.columns) * self.nb + 1

    @property
    def n_offset(self) -> int:
        """Functions of p in the constant."""
        return 1 if self.offset == "constant" else self.degree + 1

    @property
    def n_process_theta(self) -> int:
        """Number of parameters of A, B and the constant, which are the first ones."""
        return (self.n_process - 1) * (self.degree + 1) + self.n_offset

    @property
    def n_theta(self) -> int:
        """Number of parameters."""
        return self.n_process_theta + (self.ar + self.ma) * (self.error_degree + 1)

    @property
    def n_start(self) -> int:
        """Numbers that stand for what was before a record: states of the output form, first innovations."""
        return (self.order if self.form == "output" else 0) + self.ma

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the coefficients, in the order of theta."""
        out = [f"a{k + 1}" for k in range(self.order)]
        for i in range(len(self.columns)):
            out += [f"b{i + 1}_{self.nk + k}" if len(self.columns) > 1 else f"b{self.nk + k}" for k in range(self.nb)]
        return (*out, "offset", *(f"d{k + 1}" for k in range(self.ar)), *(f"c{k + 1}" for k in range(self.ma)))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters: coefficient and number of the function of p."""
        found = []
        for k, x in enumerate(self.coefficients):
            where = self.place(k)
            found += [f"{x}[{j}]" for j in range(where.stop - where.start)]
        return tuple(found)

    def place(self, coefficient: int) -> slice:
        """Return where the parameters of a coefficient stand in theta.

        `coefficient`: number in `coefficients`.
        """
        K, Q, n, last = self.degree + 1, self.error_degree + 1, self.n_process, self.n_process_theta
        if coefficient < n:
            return slice(coefficient * K, min((coefficient + 1) * K, last))
        return slice(last + (coefficient - n) * Q, last + (coefficient - n + 1) * Q)

    def lagged_inputs(self, u: Array) -> Array:
        """Return the inputs that each sample depends on, and a column of ones.

        `u`: (n_samples, n_inputs), scaled. Returns zeros before the record.
        """
        n = u.shape[0]
        out = np.zeros((n, len(self.columns) * self.nb + 1))
        out[:, -1] = 1.0
        for i, column in enumerate(self.columns):
            for k in range(self.nb):
                lag = self.nk + k
                out[lag:, i * self.nb + k] = u[: max(n - lag, 0), column]
        return out

    def table(self) -> NDArray[np.int64]:
        """Return the orders as the compiled recursion takes them.

        Returns (6,).
        """
        own = int(self.form == "output")
        return np.array([self.order, self.ar, self.ma, own, self.first, self.n_offset], dtype=np.int64)


def stable_process(shape: LpvShape, theta: Array) -> bool:
    """Return whether the frozen process part is stable over the range of p.

    `theta`: (n_theta,), scaled.
    """
    return _stable(shape, theta, range(shape.order), shape.degree)


def sound(shape: LpvShape, theta: Array) -> bool:
    """Return whether the frozen predictor is stable over the range of p: C, and A in the output form.

    That a run stays finite does not say so: what was before the record is fitted as well, and can balance a mode that
    grows.

    `theta`: (n_theta,), scaled.
    """
    first = shape.n_process + shape.ar
    if shape.ma and not _stable(shape, theta, range(first, first + shape.ma), shape.error_degree):
        return False
    return shape.form == "equation" or stable_process(shape, theta)


def _stable(shape: LpvShape, theta: Array, coefficients: Sequence[int], degree: int) -> bool:
    values = basis_values(np.linspace(-1.0, 1.0, 4 * degree + 1), degree + 1, shape.basis)
    rows = np.stack([values @ theta[shape.place(k)] for k in coefficients], axis=1)
    return all(stable(np.concatenate([[1.0], row])) for row in rows)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """One record, ready for a shape."""

    y: Array  # (n_samples,), scaled
    W: Array  # (n_samples, n_w), lagged inputs and ones
    phi: Array  # functions of the scheduling signal
    psi: Array


def part_of(shape: LpvShape, y: Array, u: Array, s: Array) -> Part:
    """Prepare a record.

    `y`: (n_samples,), scaled; `u`: (n_samples, n_inputs), scaled; `s`: (n_samples,), scaled.
    """
    phi = basis_values(s, shape.degree + 1, shape.basis)
    same = shape.error_degree == shape.degree
    psi = phi if same else basis_values(s, shape.error_degree + 1, shape.basis)
    return Part(y=np.ascontiguousarray(y), W=shape.lagged_inputs(u), phi=phi, psi=psi)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Errors:
    """A record run through a predictor."""

    finite: bool  # whether nothing diverged; if not, the rest means nothing
    # (n_samples,), scaled, process part, predictions and innovations, the first `lag` of which are not computed
    x: Array
    g: Array
    e: Array
    J: Array  # (n_samples, n_theta + n_start), or (0, 0), derivatives of the prediction


def errors(shape: LpvShape, part: Part, theta: Array, start: Array | None = None, *, slopes: int = 0) -> Errors:
    """Run a record through the predictor.

    `theta`: (n_theta,), scaled; `start`: (n_start,), what was before the record; zeros if left out; `slopes`:
    derivatives: none, those by `start` alone, all.
    """
    from ambid.nonlinear.lpv._kernels import run

    n = part.y.size
    start = np.zeros(shape.n_start) if start is None else start
    x, g, e = np.zeros(n), np.zeros(n), np.zeros(n)
    J = np.zeros((n, shape.n_theta + shape.n_start) if slopes else (1, 1))
    finite = n <= shape.lag or run(
        part.y, part.W, part.phi, part.psi, theta, start, shape.table(), slopes, x, g, e, J
    )  # fmt: skip
    return Errors(finite=bool(finite), x=x, g=g, e=e, J=J)
