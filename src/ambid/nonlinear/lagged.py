"""One model for every difference equation whose right side is a function of past signals.

yhat(t) = f(x(t), theta), x past outputs, inputs and innovations (`Regressors`), f a sum of blocks: `Linear`, `Terms`
(polynomial), `Tanh` (a hidden layer), `Radial` (units about centres). Predictions, free runs and exact derivatives
D(t) = df/dtheta + sum of (df/dx_k) D(t - k) (`kernels.propagate`) are written once. A family is a subclass of
`LaggedFunction`; `LaggedModel` adds scaling, units and cloud; `lagged_problem` searches. Scheduled coefficients are
`Terms` with basis functions as inputs. Signals here are scaled; time is axis 0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.nonlinear.records import ScaledModel, read_numbers, scaled, with_head

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
        """Return slopes by `live` parameters, (n, n_outputs, n_live), and by regressors at places, (n or 1, n_outputs,
        at.size); one row stands for all.
        """
        ...

    def fill(self, theta: Array, numbers: dict[str, Any]) -> None:
        """Put its parameters into those that the compiled run takes."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Terms:
    """Sums of coefficient times product of regressors."""

    n_outputs: int
    terms: Table  # (n_terms, most factors), places of regressors, -1 behind the last
    place: Table  # (n_terms,), output

    @property
    def n_theta(self) -> int:
        """Number of parameters."""
        return int(self.place.shape[0])

    @cached_property
    def _owned(self) -> tuple[slice | Table, ...]:
        """Where the terms of each output stand in theta."""
        return tuple(_as_slice(np.flatnonzero(self.place == o)) for o in range(self.n_outputs))

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
        return bool(np.any(inside.sum(axis=1) > 1))

    def prepare(self, x: Array) -> tuple[Array, ...]:
        """As `Block.prepare`."""
        out = np.ones((self.n_theta, x.shape[0]))
        columns = np.ascontiguousarray(x.T)
        for row, term in zip(out, self.terms, strict=True):
            for v in term[term >= 0]:
                row *= columns[v]
        return np.ascontiguousarray(out.T), x

    def values(self, theta: Array, rows: tuple[Array, ...]) -> Array:
        """As `Block.values`."""
        T = rows[0]
        out = np.empty((T.shape[0], self.n_outputs), dtype=theta.dtype)
        for o, own in enumerate(self._owned):
            out[:, o] = T[:, own] @ theta[own]
        return out

    def derivatives(self, theta: Array, rows: tuple[Array, ...], live: Mask, at: Table) -> tuple[Array, Array]:
        """As `Block.derivatives`."""
        T, x = rows
        n, p = T.shape[0], self.n_outputs
        out = np.zeros((n, p, self.n_theta if np.any(live) else 0))
        for o, own in enumerate(self._owned if np.any(live) else ()):
            out[:, o, own] = T[:, own]
        varies = any(rest for v in at for _, _, rest in self._holds.get(int(v), ()))
        by_x = np.zeros((n if varies else 1, p, at.size))
        for j, v in enumerate(at):
            for k, times, rest in self._holds.get(int(v), ()):
                slope = theta[k] * times
                for w in rest:
                    slope = slope * x[:, w]
                by_x[:, self.place[k], j] += slope
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
        place = np.array(outputs, dtype=np.int64)
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
    """W phi, phi_k = exp(-|M x - C_k|^2 / (2 width_k^2)): W (p, h), C (h, n_seen), log widths (h,); M, no parameter,
    says which regressors the units see, in which metric.
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

    def squared(self, theta: NDArray[Any], projected: Array) -> NDArray[Any]:
        """Return squared distances of M x from the centres, in widths, shape (n, neurons)."""
        _, C, s = self.parts(theta)
        q = np.zeros((projected.shape[0], self.neurons), dtype=C.dtype)
        for j in range(self.n_seen):
            q += (projected[:, j, None] - C[:, j]) ** 2
        scaled: NDArray[Any] = q * np.exp(-2.0 * s)
        return scaled

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
        (projected,), p, h = rows, self.n_outputs, self.neurons
        W, C, s = self.parts(theta)
        n, (a, b, _) = projected.shape[0], np.cumsum(self.sizes)
        q = self.squared(theta, projected)
        phi = np.exp(-0.5 * q)
        geometry, bends = bool(np.any(live[a:])), self.bends(at)
        out = np.zeros((n, p, self.n_theta if geometry else a))
        by_x = np.zeros((n if bends else 1, p, at.size))
        if geometry or bends:
            by_seen = -(phi * np.exp(-2.0 * s))[:, :, None] * (projected[:, None, :] - C)
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


_FAR = 1e6  # times the typical size of a signal: a recursion that is beyond has diverged


@dataclass(frozen=True, kw_only=True, eq=False)
class Regressors:
    """Past signals that a model looks at: column in [outputs, inputs, innovations] and lag of each."""

    n_outputs: int
    n_inputs: int
    column: Table
    back: Table

    @cached_property
    def lag(self) -> int:
        """Largest lag."""
        return int(self.back.max(initial=0))

    @cached_property
    def noisy(self) -> Table:
        """Places of the innovations among the regressors."""
        return np.flatnonzero(self.column >= self.n_outputs + self.n_inputs)

    @cached_property
    def own(self) -> Table:
        """Places of the outputs among the regressors."""
        return np.flatnonzero(self.column < self.n_outputs)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """How each is written, such as ``y(t-1)``; with several channels a signal carries its number, from 1."""
        channels = channel_names("y", self.n_outputs) + channel_names("u", self.n_inputs)
        channels += channel_names("e", self.n_outputs)
        return tuple(
            f"{channels[c]}(t-{b})" if b else f"{channels[c]}(t)" for c, b in zip(self.column, self.back, strict=True)
        )

    def signals(self, y: Array, u: Array) -> Array:
        """Return all signals beside each other, innovations of zero last, if the model looks at any."""
        return np.hstack([y, u, np.zeros_like(y)] if self.noisy.size else [y, u])

    def rows(self, z: Array, lag: int) -> Array:
        """Return the regressors of every sample of `signals` from `lag` on, shape (n_samples - lag, n_regressors)."""
        n = z.shape[0]
        out = np.empty((max(n - lag, 0), self.column.size))
        for d, (c, b) in enumerate(zip(self.column, self.back, strict=True)):
            out[:, d] = z[lag - b : max(n - b, lag - b), c]
        return out


def channel_names(letter: str, n: int) -> list[str]:
    """Return ``y`` for one channel, ``y1``, ``y2``, ... for several."""
    return [f"{letter}{k + 1}" if n > 1 else letter for k in range(n)]


def lags(n_outputs: int, n_inputs: int, *, ny: int, nu: int, nk: int, ne: int = 0) -> Regressors:
    """Return `ny` lags of every output, `nu` of every input from `nk` on, then `ne` of the innovations, lag by lag."""
    pairs = [(o, k) for o in range(n_outputs) for k in range(1, ny + 1)]
    pairs += [(n_outputs + i, nk + k) for i in range(n_inputs) for k in range(nu)]
    pairs += [(n_outputs + n_inputs + o, k) for k in range(1, ne + 1) for o in range(n_outputs)]
    table = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    column, back = (np.ascontiguousarray(x) for x in table.T)
    return Regressors(n_outputs=n_outputs, n_inputs=n_inputs, column=column, back=back)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """A record, or part of it, as a function sees it, from sample `lag` on."""

    z: Array  # (n_samples, n_columns), all signals, those before included
    x: Array  # (n, n_regressors)
    y: Array  # (n, n_outputs), measured
    prepared: tuple[tuple[Array, ...], ...]  # by block

    def part(self, span: slice) -> Rows:
        """Return some of the rows."""
        prepared = tuple(tuple(a[span] for a in one) for one in self.prepared)
        return Rows(z=self.z, x=self.x[span], y=self.y[span], prepared=prepared)


class LaggedFunction(ABC):
    """The function of a family, in scaled signals."""

    kind: ClassVar[str]
    ellipsoid: ClassVar[bool] = False  # whether the ellipsoid alone says where it was trained

    @property
    @abstractmethod
    def regressors(self) -> Regressors:
        """What it looks at."""

    @property
    @abstractmethod
    def blocks(self) -> tuple[Block, ...]:
        """What it is the sum of; parameters stand in this order."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Of all parameters."""

    @abstractmethod
    def as_json(self) -> dict[str, Any]:
        """Return the fields by which files know it."""

    @classmethod
    @abstractmethod
    def from_json(cls, document: dict[str, Any]) -> Self:
        """Read it back."""

    @classmethod
    def read_model(cls, document: dict[str, Any]) -> LaggedModel:
        """Read a model of the family back."""
        function = cls.from_json(document)
        n_cloud = np.arange(function.regressors.column.size)[function.in_cloud].size
        numbers = read_numbers(document, function.n_theta, function.n_inputs, function.n_outputs, n_cloud)
        return LaggedModel(dt=float(document["dt_s"]), function=function, **numbers)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return self.regressors.n_outputs

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return self.regressors.n_inputs

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return max(self.regressors.lag, 1)

    @property
    def in_cloud(self) -> slice | Table:
        """Regressors whose cloud says where the model was trained: all but innovations."""
        x = self.regressors
        return np.flatnonzero(x.column < x.n_outputs + x.n_inputs) if x.noisy.size else slice(None)

    def unit(self, y_scale: Array, u_scale: Array) -> Array | float:
        """Return what a scaled parameter of 1 is in the model's `theta`."""
        del y_scale, u_scale
        return 1.0

    def is_stable(self, theta: Array) -> bool:
        """Whether the predictor forgets how it began, as far as its parameters say so."""
        del theta
        return True

    @cached_property
    def edges(self) -> Table:
        """Where the parameters of each block begin, and where the last ones end."""
        return np.cumsum([0, *(b.n_theta for b in self.blocks)])

    @property
    def n_theta(self) -> int:
        """Number of parameters."""
        return int(self.edges[-1])

    def split(self, theta: Array) -> list[Array]:
        """Return the parameters of each block."""
        return np.split(np.ascontiguousarray(theta), self.edges[1:-1])

    def rows(self, y: Array, u: Array) -> Rows:
        """Return a measured record as rows, innovations zero."""
        return self.rows_of(self.regressors.signals(y, u), y)

    def rows_of(self, z: Array, y: Array, earlier: Rows | None = None) -> Rows:
        """Return signals as rows beside measured outputs; with `earlier`, only innovations have changed since."""
        x, noisy = self.regressors.rows(z, self.lag), self.regressors.noisy
        prepared = tuple(
            block.prepare(x) if earlier is None or block.uses(noisy) else earlier.prepared[k]
            for k, block in enumerate(self.blocks)
        )
        return Rows(z=z, x=x, y=y[self.lag :], prepared=prepared)

    def values(self, theta: Array, rows: Rows) -> Array:
        """Return the function, shape (n, n_outputs)."""
        summands = [b.values(t, r) for b, t, r in zip(self.blocks, self.split(theta), rows.prepared, strict=True)]
        return np.asarray(sum(summands[1:], summands[0]))

    def derivatives(self, theta: Array, rows: Rows, at: Table, live: Mask | None = None) -> tuple[Array, Array]:
        """Return slopes of the function by the live parameters, and by the regressors at some places."""
        live = np.ones(self.n_theta, dtype=np.bool_) if live is None else live
        own = np.split(live, self.edges[1:-1])
        summands = [
            b.derivatives(t, r, m, at)
            for b, t, r, m in zip(self.blocks, self.split(theta), rows.prepared, own, strict=True)
        ]
        by_x = summands[0][1]
        for _, more in summands[1:]:
            by_x = by_x + more
        return np.concatenate([d for d, _ in summands], axis=2), by_x

    @cached_property
    def affine(self) -> bool:
        """Whether innovations enter without bends: then they follow from errors without them by a linear filter."""
        return not any(b.bends(self.regressors.noisy) for b in self.blocks)

    def predict(self, theta: Array, rows: Rows) -> tuple[Array, Rows]:
        """Return one-step predictions (n, n_outputs), NaN from where innovations diverge on, and the rows with their
        innovations.
        """
        predictions, z = self._predicted(theta, rows)
        if z is None:
            return predictions, rows
        measured = np.concatenate([rows.z[: self.lag, : self.n_outputs], rows.y])
        return predictions, self.rows_of(z, measured, rows)

    def errors(self, theta: Array, rows: Rows) -> Array:
        """Return one-step errors, shape (n, n_outputs), NaN from a divergence on."""
        return rows.y - self._predicted(theta, rows)[0]

    def _predicted(self, theta: Array, rows: Rows) -> tuple[Array, Array | None]:
        """One-step predictions, and the signals with innovations in them if the model looks at any."""
        x, lag, p = self.regressors, self.lag, self.n_outputs
        if not x.noisy.size:
            return self.values(theta, rows), None
        z = rows.z.copy()
        if not self.affine:
            return self._run(theta, z, free=False)[lag:], z
        from ambid.nonlinear.kernels import propagate

        E = rows.y - self.values(theta, rows)
        gain = np.zeros((1, p, x.noisy.size))  # what past innovations take off errors
        for block, own, r in zip(self.blocks, self.split(theta), rows.prepared, strict=True):
            if block.uses(x.noisy):
                gain = gain - block.derivatives(own, r, np.zeros(block.n_theta, dtype=np.bool_), x.noisy)[1]
        propagate(E[:, :, None], np.ascontiguousarray(gain), *self._recurrence(x.noisy), 0)
        far = np.flatnonzero(~np.all(np.abs(E) < _FAR, axis=1))
        if far.size:
            E[far[0] :] = np.nan
        z[lag:, p + x.n_inputs :] = E
        return rows.y - E, z

    def free_run(self, theta: Array, y: Array, u: Array) -> tuple[Array, Array]:
        """Return a run on own outputs from `lag` on, (n_samples, n_outputs), NaN where diverged, and all signals behind
        it.
        """
        z = self.regressors.signals(y, u)
        out = self._run(theta, z, free=True)
        out[: self.lag] = y[: self.lag]
        return out, z

    def _run(self, theta: Array, z: Array, *, free: bool) -> Array:
        from ambid.nonlinear.kernels import run

        p, none = self.n_outputs, np.zeros((0, 0))
        numbers: dict[str, Any] = {
            "terms": np.zeros((0, 0), dtype=np.int64),
            "place": np.zeros(0, dtype=np.int64), "theta": np.zeros(0), "W2": none, "W1": none, "b1": np.zeros(0),
            "W": none, "M": none, "C": none, "s": np.zeros(0),
        }  # fmt: skip
        for block, own in zip(self.blocks, self.split(theta), strict=True):
            block.fill(own, numbers)
        out, x = np.empty((z.shape[0], p)), self.regressors
        shape = np.array([self.lag, p, p + x.n_inputs, int(free)], dtype=np.int64)
        run(z, x.column, x.back, shape, out, *numbers.values())
        return out

    def _recurrence(self, at: Table) -> tuple[Table, Table]:
        """Output and lag that the regressors at some places come from."""
        x = self.regressors
        column = x.column[at]
        return np.where(column < x.n_outputs, column, column - x.n_outputs - x.n_inputs), x.back[at]

    def slopes(
        self, theta: Array, rows: Rows, *, free: bool, live: Mask | None = None, before: Array | None = None
    ) -> Array:
        """Return the exact derivative (n, n_outputs, n_live) of predictions, or of a free run, whose `rows` these are.
        `before`: that at rows right before, none where `rows` begin with the first.
        """
        x = self.regressors
        at = x.own if free else x.noisy
        G, by_x = self.derivatives(theta, rows, at, live)
        if not at.size:
            return G
        from ambid.nonlinear.kernels import propagate

        first = 0 if before is None else before.shape[0]
        out = G if before is None else np.concatenate([before, G])
        propagate(out, np.ascontiguousarray(by_x if free else -by_x), *self._recurrence(at), first)
        return out[first:]


@dataclass(frozen=True, kw_only=True, eq=False)
class LaggedModel(ScaledModel):
    """A lagged function with parameters, scaling and training cloud (an `ambid.nonlinear.fit.NonlinearModel`);
    innovations before its first prediction are zero.
    """

    dt: float  # s
    function: LaggedFunction

    @property
    def kind(self) -> str:
        """Under which files know it."""
        return self.function.kind

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return self.function.lag

    @property
    def names(self) -> tuple[str, ...]:
        """Of all parameters."""
        return self.function.names

    @cached_property
    def unit(self) -> Array | float:
        """As `ScaledModel.unit`."""
        return self.function.unit(self.y_scale, self.u_scale)

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`; past innovations are its own. NaN from where they diverge on."""
        ys, us = scaled(self, u, y)
        out = np.full(ys.shape, np.nan)
        if ys.shape[0] > self.lag:
            out[self.lag :] = self.function.predict(self.scaled_theta, self.function.rows(ys, us))[0]
        predictions: Array = self.y_level + self.y_scale * out
        return predictions

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`, past innovations included."""
        ys, us = scaled(self, u, y)
        out = np.zeros((*ys.shape, self.theta.size))
        if ys.shape[0] > self.lag:
            function, theta = self.function, self.scaled_theta
            _, rows = function.predict(theta, function.rows(ys, us))
            out[self.lag :] = function.slopes(theta, rows, free=False)
        return out * (self.y_scale[:, None] / self.unit)

    def simulate(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.simulate`, innovations zero."""
        whole, head = with_head(self, u, y)
        ys, us = scaled(self, u, whole)
        out: Array = self.y_level + self.y_scale * self.function.free_run(self.scaled_theta, ys, us)[0]
        out[:head] = whole[:head]
        return out

    def novelty(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.novelty`, of the regressors (see `nonlinear.records`)."""
        ys, us = scaled(self, u, y)
        function, out = self.function, np.full(ys.shape[0], np.nan)
        if ys.shape[0] > self.lag:
            out[self.lag :] = self.cloud.novelty(function.rows(ys, us).x[:, function.in_cloud])
        return out

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        return {"dt_s": self.dt, **self.function.as_json(), **self.numbers_json()}
