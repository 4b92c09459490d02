"""What lagged functions are the sum of, each with parameters of its own.

`Linear`, `Terms` (a polynomial or rational function), `Tanh` (one hidden layer), `Radial` (units about centres). They
give values, and slopes by their parameters and by regressors, of many rows at once; all signals are scaled.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

Table = NDArray[np.int64]
Mask = NDArray[np.bool_]


class Block(Protocol):
    """One summand of a lagged function, with `n_theta` parameters; `x` (n, n_regressors) stands for the rows."""

    @property
    def n_theta(self) -> int:
        """Number of parameters."""
        ...

    def bends(self, at: Table) -> bool:
        """Whether it is anything but affine in the regressors at some places, the others fixed."""
        ...

    def uses(self, at: Table) -> bool:
        """Whether it looks at any of the regressors at some places."""
        ...

    def prepare(self, x: Array) -> tuple[Array, ...]:
        """Return what it needs of the rows whatever its parameters, each with rows along axis 0."""
        ...

    def values(self, theta: Array, rows: tuple[Array, ...]) -> Array:
        """Return its values, shape (n, n_outputs)."""
        ...

    def derivatives(self, theta: Array, rows: tuple[Array, ...], live: Mask, at: Table) -> tuple[Array, Array]:
        """Return slopes by the parameters where `live` and by the regressors at some places.

        Of shapes (n, n_outputs, n_live) and (n or 1, n_outputs, at.size); one row stands for all.
        """
        ...

    def fill(self, theta: Array, numbers: dict[str, Any]) -> None:
        """Put its parameters into those that the compiled run takes."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Terms:
    """Sums of coefficient times product of regressors: numerators, over 1 + denominators where there are any.

    Where there are, it is the only block of its kind.
    """

    n_outputs: int
    terms: Table  # (n_terms, most factors), places of regressors, -1 behind the last
    place: Table  # (n_terms, 2), output, and 1 for the denominator

    @property
    def n_theta(self) -> int:
        """Number of parameters."""
        return int(self.place.shape[0])

    @cached_property
    def _owned(self) -> tuple[tuple[slice | Table, slice | Table], ...]:
        """Where numerator and denominator of each output stand in theta."""
        found = [[np.flatnonzero(np.all(self.place == (o, b), axis=1)) for b in (0, 1)] for o in range(self.n_outputs)]
        return tuple((_as_slice(up), _as_slice(down)) for up, down in found)

    @cached_property
    def _rational(self) -> bool:
        return bool(np.any(self.place[:, 1]))

    @cached_property
    def _holds(self) -> dict[int, list[tuple[int, int, list[int]]]]:
        """Terms that hold a regressor: number, power, and the factors that its slope has."""
        out: dict[int, list[tuple[int, int, list[int]]]] = {}
        for k, term in enumerate(self.terms):
            factors = [int(v) for v in term if v >= 0]
            for v in dict.fromkeys(factors):
                rest = list(factors)
                rest.remove(v)
                out.setdefault(v, []).append((k, factors.count(v), rest))
        return out

    def uses(self, at: Table) -> bool:
        """As `Block.uses`."""
        return any(int(v) in self._holds for v in at)

    def bends(self, at: Table) -> bool:
        """As `Block.bends`."""
        inside = np.isin(self.terms, at)
        return bool(np.any(inside.sum(axis=1) > 1) or np.any(inside[self.place[:, 1] == 1]))

    def _varies(self, at: Table) -> bool:
        """Whether slopes by regressors at some places are not the same everywhere."""
        return self._rational or any(rest for v in at for _, _, rest in self._holds.get(int(v), ()))

    def prepare(self, x: Array) -> tuple[Array, ...]:
        """As `Block.prepare`."""
        out = np.ones((self.n_theta, x.shape[0]))
        columns = np.ascontiguousarray(x.T)
        for row, term in zip(out, self.terms, strict=True):
            for v in term[term >= 0]:
                row *= columns[v]
        return np.ascontiguousarray(out.T), x

    def _numerators(self, theta: Array, T: Array) -> Array:
        out = np.empty((T.shape[0], self.n_outputs), dtype=theta.dtype)
        for o, (up, _) in enumerate(self._owned):
            out[:, o] = T[:, up] @ theta[up]
        return out

    def denominators(self, theta: Array, rows: tuple[Array, ...]) -> Array:
        """Return the denominators' values, ones without, shape (n, n_outputs)."""
        T, out = rows[0], np.ones((rows[0].shape[0], self.n_outputs))
        for o, (_, down) in enumerate(self._owned):
            out[:, o] += T[:, down] @ theta[down]
        return out

    def values(self, theta: Array, rows: tuple[Array, ...]) -> Array:
        """As `Block.values`."""
        found = self._numerators(theta, rows[0])
        return found / self.denominators(theta, rows) if self._rational else found

    def derivatives(self, theta: Array, rows: tuple[Array, ...], live: Mask, at: Table) -> tuple[Array, Array]:
        """As `Block.derivatives`."""
        T, x = rows
        n, p = T.shape[0], self.n_outputs
        by_value = np.ones((1, p, 2))  # slopes by numerator and denominator
        if self._rational:
            num, den = self._numerators(theta, T), self.denominators(theta, rows)
            by_value = np.stack([1.0 / den, -num / den**2], axis=2)
        out = np.zeros((n, p, self.n_theta if np.any(live) else 0))
        for o, both in enumerate(self._owned if np.any(live) else ()):
            for below, own in enumerate(both):
                out[:, o, own] = T[:, own] * by_value[:, o, below, None]
        by_x = np.zeros((n if self._varies(at) else 1, p, at.size))
        for j, v in enumerate(at):
            for k, times, rest in self._holds.get(int(v), ()):
                o, below = self.place[k]
                slope = theta[k] * times * by_value[:, o, below]
                for w in rest:
                    slope = slope * x[:, w]
                by_x[:, o, j] += slope
        return out if np.all(live) else out[:, :, live[: out.shape[2]]], by_x

    def fill(self, theta: Array, numbers: dict[str, Any]) -> None:
        """As `Block.fill`."""
        width = max(numbers["terms"].shape[1], self.terms.shape[1])
        tables = [
            np.pad(x, ((0, 0), (0, width - x.shape[1])), constant_values=-1) for x in (numbers["terms"], self.terms)
        ]
        numbers.update(terms=np.concatenate(tables), place=np.concatenate([numbers["place"], self.place]))
        numbers["theta"] = np.concatenate([numbers["theta"], theta])


def _as_slice(at: Table) -> slice | Table:
    """Places as a slice, which copies nothing, if they have no gaps."""
    whole = slice(int(at[0]), int(at[-1]) + 1) if at.size else slice(0, 0)
    return whole if whole.stop - whole.start == at.size else at


@dataclass(frozen=True, kw_only=True, eq=False)
class Linear(Terms):
    """L x + c over some of the regressors as terms: L (p, width) by output, then c (p,) if there is a constant."""

    width: int

    @classmethod
    def over(cls, n_outputs: int, at: slice, *, constant: bool) -> Self:
        """Return L x + c over the regressors `at`."""
        each = [*range(at.start, at.stop)]
        terms = each * n_outputs + [-1] * (n_outputs * constant)
        outputs = [o for o in range(n_outputs) for _ in each] + [*range(n_outputs)] * constant
        place = np.array([(o, 0) for o in outputs], dtype=np.int64).reshape(-1, 2)
        table = np.array(terms, dtype=np.int64).reshape(-1, 1)
        return cls(n_outputs=n_outputs, terms=table, place=place, width=len(each))

    def parts(self, theta: Array) -> tuple[Array, Array]:
        """Return L and c."""
        n = self.n_outputs * self.width
        return theta[:n].reshape(self.n_outputs, self.width), theta[n:]


@dataclass(frozen=True, kw_only=True, eq=False)
class Tanh:
    """W2 tanh(W1 x + b1), one hidden layer over the first regressors: W2 (p, h), W1 (h, d), b1 (h,)."""

    n_outputs: int
    width: int  # regressors that it looks at
    neurons: int

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers in W2, W1 and b1."""
        return self.n_outputs * self.neurons, self.neurons * self.width, self.neurons

    @property
    def n_theta(self) -> int:
        """Number of parameters."""
        return sum(self.sizes)

    def parts(self, theta: Array) -> tuple[Array, Array, Array]:
        """Return W2, W1 and b1."""
        a, b, _ = np.cumsum(self.sizes)
        return theta[:a].reshape(self.n_outputs, -1), theta[a:b].reshape(self.neurons, self.width), theta[b:]

    def hidden(self, theta: Array, x: Array) -> Array:
        """Return what the units give, shape (n, neurons)."""
        _, W1, b1 = self.parts(theta)
        return np.asarray(np.tanh(x @ W1.T + b1))

    def uses(self, at: Table) -> bool:
        """As `Block.uses`."""
        return self.neurons > 0 and bool(np.any(at < self.width))

    bends = uses

    def prepare(self, x: Array) -> tuple[Array, ...]:
        """As `Block.prepare`."""
        return (x[:, : self.width],)

    def values(self, theta: Array, rows: tuple[Array, ...]) -> Array:
        """As `Block.values`."""
        return np.asarray(self.hidden(theta, rows[0]) @ self.parts(theta)[0].T)

    def derivatives(self, theta: Array, rows: tuple[Array, ...], live: Mask, at: Table) -> tuple[Array, Array]:
        """As `Block.derivatives`."""
        (x,), p, h = rows, self.n_outputs, self.neurons
        W2, W1, _ = self.parts(theta)
        T = self.hidden(theta, x)
        n, inside = x.shape[0], at < self.width
        out = np.zeros((n, p, self.n_theta))
        bends = h > 0 and bool(np.any(inside))
        by_x = np.zeros((n if bends else 1, p, at.size))
        a, b, _ = np.cumsum(self.sizes)
        for o in range(p):
            back = (1.0 - T**2) * W2[o]
            out[:, o, o * h : (o + 1) * h] = T
            out[:, o, a:b] = (back[:, :, None] * x[:, None, :]).reshape(n, -1)
            out[:, o, b:] = back
            if bends:
                by_x[:, o, inside] = back @ W1[:, at[inside]]
        return out if np.all(live) else out[:, :, live], by_x

    def fill(self, theta: Array, numbers: dict[str, Any]) -> None:
        """As `Block.fill`."""
        numbers.update(zip(("W2", "W1", "b1"), map(np.ascontiguousarray, self.parts(theta)), strict=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class Radial:
    """W phi, phi_k = exp(-|M x - C_k|^2 / (2 width_k^2)): W (p, h), C (h, n_seen), logarithms of the widths (h,).

    M, no parameter, says which regressors the units see, and in which metric.
    """

    n_outputs: int
    metric: Array  # (n_seen, n_regressors), M
    neurons: int

    @property
    def n_seen(self) -> int:
        """Length of M x."""
        return int(self.metric.shape[0])

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers in W, C and the logarithms of the widths."""
        return self.n_outputs * self.neurons, self.neurons * self.n_seen, self.neurons

    @property
    def n_theta(self) -> int:
        """Number of parameters."""
        return sum(self.sizes)

    def parts(self, theta: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Return W, C and the logarithms of the widths."""
        a, b, _ = np.cumsum(self.sizes)
        return theta[:a].reshape(self.n_outputs, -1), theta[a:b].reshape(self.neurons, self.n_seen), theta[b:]

    def squared(self, theta: NDArray[Any], seen: Array) -> NDArray[Any]:
        """Return squared distances of M x from the centres, in widths, shape (n, neurons)."""
        _, C, s = self.parts(theta)
        q = np.zeros((seen.shape[0], self.neurons), dtype=C.dtype)
        for j in range(self.n_seen):
            q += (seen[:, j, None] - C[:, j]) ** 2
        found: NDArray[Any] = q * np.exp(-2.0 * s)
        return found

    def uses(self, at: Table) -> bool:
        """As `Block.uses`."""
        return self.neurons > 0 and bool(np.any(self.metric[:, at]))

    bends = uses

    def prepare(self, x: Array) -> tuple[Array, ...]:
        """As `Block.prepare`."""
        return (x @ self.metric.T,)

    def values(self, theta: Array, rows: tuple[Array, ...]) -> Array:
        """As `Block.values`."""
        return np.asarray(np.exp(-0.5 * self.squared(theta, rows[0])) @ self.parts(theta)[0].T)

    def derivatives(self, theta: Array, rows: tuple[Array, ...], live: Mask, at: Table) -> tuple[Array, Array]:
        """As `Block.derivatives`."""
        (seen,), p, h = rows, self.n_outputs, self.neurons
        W, C, s = self.parts(theta)
        n, (a, b, _) = seen.shape[0], np.cumsum(self.sizes)
        q = self.squared(theta, seen)
        phi = np.exp(-0.5 * q)
        geometry, bends = bool(np.any(live[a:])), self.bends(at)
        out = np.zeros((n, p, self.n_theta if geometry else a))
        by_x = np.zeros((n if bends else 1, p, at.size))
        if geometry or bends:
            by_seen = -(phi * np.exp(-2.0 * s))[:, :, None] * (seen[:, None, :] - C)
        for o in range(p):
            out[:, o, o * h : (o + 1) * h] = phi
            if geometry:
                out[:, o, a:b] = (-W[o, :, None] * by_seen).reshape(n, -1)
                out[:, o, b:] = W[o] * phi * q
            if bends:
                by_x[:, o] = np.einsum("k,nkj->nj", W[o], by_seen) @ self.metric[:, at]
        return out if np.all(live) else out[:, :, live[: out.shape[2]]], by_x

    def fill(self, theta: Array, numbers: dict[str, Any]) -> None:
        """As `Block.fill`."""
        numbers.update(zip(("W", "C", "s"), map(np.ascontiguousarray, self.parts(theta)), strict=True))
        numbers.update(M=np.ascontiguousarray(self.metric))
