"""The function of a hybrid model in scaled signals: polynomial, one hidden layer, linear noise model.

yhat(t) = P(y, u) theta + W2 tanh(W1 z + b1) + (C(q^-1) - 1) e(t), z = [y(t-1).., u(t-nk)..], with C the polynomial
1 + C1 q^-1 + .. of `ne` matrices (thesis eqs 3.23-3.24; there z holds past innovations too, which is an option here).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from ambid.arrays import Array
from ambid.nonlinear.narmax.candidates import candidates
from ambid.nonlinear.narmax.recursion import Tables, tables
from ambid.nonlinear.narmax.terms import Factor, Term, term_name
from ambid.nonlinear.networks.narx_function import NarxShape


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """One record as regressors, from the first row that is predicted on."""

    P: tuple[Array, ...]  # (n_rows, n_terms of the output), values of the polynomial's terms, by output
    z: Array  # (n_rows, n_regressors), regressors of the hidden layer, without innovations
    y: Array  # (n_rows, n_outputs)


@dataclass(frozen=True, kw_only=True)
class HybridShape:
    """Terms and sizes of a hybrid model."""

    terms: tuple[tuple[Term, ...], ...]  # of the polynomial, by output, without innovations
    ne: int  # order of C
    network: NarxShape  # lags of the hidden layer's regressors, and its units
    deep: bool = False  # whether past innovations are regressors of the hidden layer too

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return self.network.n_outputs

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return self.network.n_inputs

    @property
    def neurons(self) -> int:
        """Hidden units."""
        return self.network.neurons

    @cached_property
    def tables(self) -> Tables:
        """The terms as the compiled recursions want them."""
        return tables(self.terms, ((),) * self.n_outputs, self.n_inputs)

    @cached_property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return max(self.tables.lag, self.network.lag, self.ne)

    @property
    def n_deep(self) -> int:
        """Past innovations that enter the hidden layer."""
        return self.n_outputs * self.ne if self.deep else 0

    @cached_property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """Numbers in the polynomial, in C, W2, W1, b1."""
        p, h, d = self.n_outputs, self.neurons, self.network.n_regressors + self.n_deep
        return sum(map(len, self.terms)), p * p * self.ne, p * h, h * d, h

    @cached_property
    def n_theta(self) -> int:
        """Numbers in all."""
        return sum(self.sizes)

    @property
    def n_linear(self) -> int:
        """Numbers in the polynomial and in C, which come first."""
        return sum(self.sizes[:2])

    @property
    def noise_terms(self) -> tuple[Term, ...]:
        """Past innovations as terms, in the order of the columns of C."""
        return tuple((Factor("e", q, k),) for k in range(1, self.ne + 1) for q in range(self.n_outputs))

    @property
    def names(self) -> tuple[str, ...]:
        """Of all numbers, in their order."""
        p, m = self.n_outputs, self.n_inputs
        out = [f"y{o + 1}" if p > 1 else "y" for o in range(p)]
        before = [f"{name}: " if p > 1 else "" for name in out]
        found = [before[o] + term_name(x, p, m) for o in range(p) for x in self.terms[o]]
        found += [before[o] + term_name(x, p, m) for o in range(p) for x in self.noise_terms]
        z: list[Term] = [(Factor("y" if c < p else "u", int(c if c < p else c - p), int(b)),)
                         for c, b in zip(*self.network.tables, strict=True)]  # fmt: skip
        z += self.noise_terms if self.deep else ()
        found += [f"{name}: unit {k + 1}" for name in out for k in range(self.neurons)]
        found += [f"unit {k + 1}: {term_name(x, p, m)}" for k in range(self.neurons) for x in z]
        return (*found, *(f"unit {k + 1}: 1" for k in range(self.neurons)))

    def with_sizes(self, *, neurons: int | None = None, ne: int | None = None) -> Self:
        """Return the same model with another number of units or another order of C."""
        network = self.network if neurons is None else replace(self.network, neurons=neurons)
        return replace(self, network=network, ne=self.ne if ne is None else ne)

    def parts(self, theta: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Split all numbers.

        `theta`: (n_theta,). Returns coefficients (n_terms,), C (n_outputs, n_outputs ne), W2 (n_outputs, neurons), W1
        (neurons, n_regressors) and b1 (neurons,).
        """
        p, h, d = self.n_outputs, self.neurons, self.network.n_regressors + self.n_deep
        theta, (n_p, n_c, n_2, n_1, _) = np.ascontiguousarray(theta), self.sizes
        a, b, c = n_p + n_c, n_p + n_c + n_2, n_p + n_c + n_2 + n_1
        C, W2, W1 = theta[n_p:a].reshape(p, p * self.ne), theta[a:b].reshape(p, h), theta[b:c].reshape(h, d)
        return theta[:n_p], C, W2, W1, theta[c:]

    def rows(self, y: Array, u: Array) -> Rows:
        """Return regressors and outputs of every sample from `lag` on.

        `y`: (n_samples, n_outputs), scaled; `u`: (n_samples, n_inputs), scaled.
        """
        lag = self.lag
        P = []
        for x in self.terms:
            found = candidates(x, [y], [u], None, lag)
            P.append(np.ascontiguousarray(found.columns(range(len(x)))))
        z = self.network.regressors(y, u)[lag - self.network.lag :]
        return Rows(P=tuple(P), z=z, y=y[lag:])

    def innovations(self, theta: Array, rows: Rows) -> tuple[Array, Array]:
        """Return one-step errors, zero before the first row, and the outputs of the hidden units.

        `theta`: (n_theta,). Returns `E`: (n_rows, n_outputs), naN from a divergence on; `T`: (n_rows, neurons).
        """
        from ambid.nonlinear.hybrid._kernels import innovations

        c, C, W2, W1, b1 = self.parts(theta)
        d, first = self.network.n_regressors, 0
        left = rows.y.copy()
        for o, P in enumerate(rows.P):
            left[:, o] -= P @ c[first : first + P.shape[1]]
            first += P.shape[1]
        E, T = np.zeros(left.shape), np.zeros((left.shape[0], self.neurons))
        a = np.ascontiguousarray(rows.z @ W1[:, :d].T + b1)
        innovations(left, a, W2, np.ascontiguousarray(W1[:, d:]), C, E, T)
        return E, T

    def slopes(self, theta: Array, rows: Rows, E: Array, T: Array, part: slice, before: Array | None = None) -> Array:
        """Return the exact derivative of the predictions by theta over part of the rows, past innovations included.

        `theta`: (n_theta,); `E`, `T`: that `innovations` returned; `part`: of the rows; `before`: (n_before, n_outputs,
        n_theta), slopes of the rows right before, `ne` of them; none before the first row. Returns (n of the part,
        n_outputs, n_theta).
        """
        from ambid.nonlinear.hybrid._kernels import passed_on

        _, C, W2, W1, _ = self.parts(theta)
        p, h, d = self.n_outputs, self.neurons, self.network.n_regressors
        z, t, v = rows.z[part], T[part], self._past(E, part)
        n, first = z.shape[0], 0 if before is None else before.shape[0]
        D = np.zeros((first + n, p, self.n_theta))
        if before is not None:
            D[:first] = before
        at, k = np.cumsum((0, *self.sizes)), 0
        seen = np.hstack([z, v]) if self.deep else z
        for o, P in enumerate(rows.P):
            D[first:, o, k : k + P.shape[1]] = P[part]
            k += P.shape[1]
            m = v.shape[1]
            D[first:, o, at[1] + o * m : at[1] + (o + 1) * m] = v
            D[first:, o, at[2] + o * h : at[2] + (o + 1) * h] = t
            back = (1.0 - t**2) * W2[o]
            D[first:, o, at[3] : at[4]] = (back[:, :, None] * seen[:, None, :]).reshape(n, -1)
            D[first:, o, at[4] :] = back
        if self.ne:
            passed_on(D, first, np.ascontiguousarray(t), W2, np.ascontiguousarray(W1[:, d:]), C)
        return D[first:]

    def _past(self, E: Array, part: slice) -> Array:
        """Innovations before each row of a part, shape (n of the part, n_outputs ne)."""
        n, p = E.shape
        start, stop, _ = part.indices(n)
        out = np.zeros((max(stop - start, 0), p * self.ne))
        for k in range(1, self.ne + 1):
            low = max(start, k)
            out[low - start :, (k - 1) * p : k * p] = E[low - k : max(stop - k, 0)]
        return out

    def free_run(self, theta: Array, y: Array, u: Array) -> Array:
        """Run freely from the first `lag` outputs on, innovations zero.

        `theta`: (n_theta,); `y`: (n_samples, n_outputs), scaled, only the first `lag` rows are looked at; `u`:
        (n_samples, n_inputs), scaled. Returns (n_samples, n_outputs), naN from a divergence on.
        """
        from ambid.nonlinear.hybrid._kernels import free_run

        c, _, W2, W1, b1 = self.parts(theta)
        t, z = self.tables, np.hstack([y, u])
        W1 = np.ascontiguousarray(W1[:, : self.network.n_regressors])
        place = np.ascontiguousarray(t.place[:, 0])
        free_run(t.column, t.back, t.terms, place, c, *self.network.tables, W1, b1, W2, self.lag, z)
        return z[:, : self.n_outputs]

    def noise_radius(self, theta: Array) -> float:
        """Return the largest magnitude of a root of C: below 1 the predictor forgets how it began.

        `theta`: (n_theta,). Returns 0 without noise model; infinite where C is not finite.
        """
        p, m = self.n_outputs, self.n_outputs * self.ne
        if not m:
            return 0.0
        F = np.zeros((m, m))
        F[:p] = -self.parts(theta)[1]
        F[p:, : m - p] = np.eye(m - p)
        if not np.all(np.isfinite(F)):
            return float("inf")
        return float(np.max(np.abs(np.linalg.eigvals(F))))
