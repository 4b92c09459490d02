"""Polynomial and rational NARMAX models, y(t) = b(y, u, e) / a(y, u, e) + e(t) (thesis eqs 3.1-3.4).

Terms in scaled signals as tables, their predictions, free runs and sensitivities over a record; the least-squares
problem of their coefficients; and the model, whose coefficients belong to deviations of the signals from fixed levels
(zero unless the data stand far from it), in SI.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.linear import triangle_of
from ambid.estimation.progress import Tick
from ambid.estimation.search import Found, search
from ambid.nonlinear.narmax.terms import Factor, Term, term_from_json, term_name, term_to_json
from ambid.nonlinear.records import Parts
from ambid.nonlinear.signals import finite, scaled, with_head

Table = NDArray[np.int64]

OUTPUTS = ("signed", "magnitude", "mean magnitude")
_ENOUGH = 1e-3  # gain, in the errors' variance, that ends a search: a step of 0.03 standard deviations

# --- recursions ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tables:
    """Terms as whole numbers, for the compiled recursions."""

    n_outputs: int
    n_inputs: int
    lag: int
    column: Table  # (n_factors,), column of the array of all signals, and lag, of each factor
    back: Table
    terms: Table  # (n_terms, most factors), factor numbers, -1 behind the last
    place: Table  # (n_terms, 2), output, and 1 for a term of the denominator
    noisy: bool  # whether a term holds innovations
    # 1 where only the magnitude of the outputs is measured, 2 where it is its mean over a sampling interval
    folded: int = 0

    def shape(self, free: bool) -> Table:
        """Return what the recursions take beside the tables; `free`: whether the model runs on its own outputs."""
        return np.array([self.lag, self.n_outputs, self.n_inputs, int(free), self.folded], dtype=np.int64)


def tables(
    numerators: Sequence[Sequence[Term]], denominators: Sequence[Sequence[Term]], n_inputs: int, *, folded: int = 0
) -> Tables:
    """Return the tables of a model; coefficients stand output by output, numerator before denominator."""
    n_y = len(numerators)
    rows: list[tuple[int, int, Term]] = []
    for o in range(n_y):
        rows += [(o, 0, x) for x in numerators[o]] + [(o, 1, x) for x in denominators[o]]
    factors: dict[Factor, int] = {}
    for _, _, x in rows:
        for f in x:
            factors.setdefault(f, len(factors))
    first = {"y": 0, "u": n_y, "e": n_y + n_inputs}
    width = max((len(x) for _, _, x in rows), default=0)
    numbers = np.full((len(rows), max(width, 1)), -1, dtype=np.int64)
    for k, (_, _, x) in enumerate(rows):
        numbers[k, : len(x)] = [factors[f] for f in x]
    return Tables(
        n_outputs=n_y,
        n_inputs=n_inputs,
        lag=max((f.lag for f in factors), default=0) or int(folded == 2),
        column=np.array([first[f.kind] + f.channel for f in factors], dtype=np.int64),
        back=np.array([f.lag for f in factors], dtype=np.int64),
        terms=numbers,
        place=np.array([(o, d) for o, d, _ in rows], dtype=np.int64).reshape(-1, 2),
        noisy=any(f.kind == "e" for f in factors),
        folded=folded,
    )


def signals(t: Tables, y: Array, u: Array) -> Array:
    """Return the array of all signals, (n_samples, 2 n_outputs + n_inputs), innovations and outputs not given zero."""
    n = u.shape[0]
    z = np.zeros((n, 2 * t.n_outputs + t.n_inputs))
    given = y[:n]
    z[: given.shape[0], : t.n_outputs] = given
    z[:, t.n_outputs : t.n_outputs + t.n_inputs] = u
    return z


def predict(t: Tables, theta: Array, y: Array, u: Array, *, free: bool = False) -> tuple[Array, Array]:
    """Return predictions or a `free` run on own outputs, and all signals behind them.

    Predictions are NaN before `lag`, and from where the recursion diverges on.
    """
    from ambid.nonlinear.narmax._kernels import run

    z = signals(t, y[: t.lag] if free else y, u)
    if t.folded:
        z[: t.lag, : t.n_outputs] *= _first_sign(t, theta, u)
    out = np.empty((z.shape[0], t.n_outputs))
    run(z, t.column, t.back, t.terms, t.place, theta, t.shape(free), out)
    return out, z


def _first_sign(t: Tables, theta: Array, u: Array) -> float:
    """Sign of the first outputs, of which only the magnitude is known: where the linear part is driven to at first."""
    width = np.count_nonzero(t.terms >= 0, axis=1)
    pushed, kept = 0.0, 1.0
    for k in np.flatnonzero((width == 1) & (t.place[:, 1] == 0)):
        c = int(t.column[t.terms[k, 0]])
        if c < t.n_outputs:
            kept -= float(theta[k])
        elif c < t.n_outputs + t.n_inputs:
            pushed += float(theta[k] * np.mean(u[: max(t.lag, 1), c - t.n_outputs]))
    return -1.0 if pushed * kept < 0 else 1.0


def derive(t: Tables, theta: Array, z: Array, *, free: bool = False) -> Array:
    """Return the exact derivative of `predict` by theta, (n_samples, n_outputs, n_terms); `z` are its signals."""
    from ambid.nonlinear.narmax._kernels import slopes

    out = np.empty((z.shape[0], t.n_outputs, theta.size))
    slopes(z, t.column, t.back, t.terms, t.place, theta, t.shape(free), out)
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem:
    """Weighted errors of the terms over records (an `estimation.search.Problem`)."""

    tables: Tables
    parts: Parts
    weight: Array  # (n_outputs,), of the errors of each output
    free: bool  # errors of the free run instead of the predictions

    def errors(self, theta: Array) -> list[Array]:
        """Return the errors of each record from sample `lag` on, scaled."""
        t = self.tables
        return [y[t.lag :] - predict(t, theta, y, u, free=self.free)[0][t.lag :] for y, u in self.parts]

    def cost(self, theta: Array) -> float:
        """Return the sum of squared weighted errors; infinite where the model diverges."""
        with np.errstate(over="ignore", invalid="ignore"):
            cost = float(sum(np.sum((e * self.weight) ** 2) for e in self.errors(theta)))
        return cost if np.isfinite(cost) else np.inf

    def rows(self, theta: Array) -> list[Array]:
        """Return weighted slopes and errors of each record, (n_rows, n_outputs, n_theta + 1)."""
        t, out = self.tables, []
        for y, u in self.parts:
            yhat, z = predict(t, theta, y, u, free=self.free)
            both = np.concatenate([derive(t, theta, z, free=self.free), (y - yhat)[:, :, None]], axis=2)
            out.append(both[t.lag :] * self.weight[:, None])
        return out

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r]."""
        return triangle_of([x.reshape(-1, x.shape[2]) for x in self.rows(theta)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Draft:
    """A model in scaled signals on its way."""

    numerators: tuple[tuple[Term, ...], ...]  # by output
    denominators: tuple[tuple[Term, ...], ...]
    theta: Array  # (n_theta,), scaled, output by output, numerator before denominator
    n_inputs: int
    err: dict[tuple[int, Term], float] = field(default_factory=dict)  # error reduction ratio, where there is one
    n_candidates: int = 0  # of one output, at most
    passes: int = 0  # over the data, in the choice of process terms
    folded: int = 0  # as in `Tables`

    @property
    def tables(self) -> Tables:
        """For the recursions."""
        return tables(self.numerators, self.denominators, self.n_inputs, folded=self.folded)

    def with_theta(self, theta: Array) -> Draft:
        """Return the same terms with other coefficients."""
        return replace(self, theta=theta)

    def without(self, dropped: Sequence[int], theta: Array) -> Draft:
        """Return a draft without the terms at some places in `theta` as it was; `theta` is of those that stay."""
        k = 0
        num: list[tuple[Term, ...]] = []
        den: list[tuple[Term, ...]] = []
        for o in range(len(self.numerators)):
            for terms, out in ((self.numerators[o], num), (self.denominators[o], den)):
                out.append(tuple(x for j, x in enumerate(terms) if k + j not in dropped))
                k += len(terms)
        return replace(self, numerators=tuple(num), denominators=tuple(den), theta=theta)

    def problem(self, parts: Parts, *, free: bool, weight: Array | None = None) -> Problem:
        """Return the problem of its coefficients; errors count alike without a `weight`."""
        weight = np.ones(len(self.numerators)) if weight is None else weight
        return Problem(tables=self.tables, parts=parts, weight=weight, free=free)

    def cost(self, parts: Parts, *, free: bool, weight: Array | None = None) -> float:
        """Return the sum of squared weighted errors; infinite where it diverges."""
        return self.problem(parts, free=free, weight=weight).cost(self.theta)

    def search(
        self,
        parts: Parts,
        *,
        free: bool,
        weight: Array | None = None,
        most: int = 40,
        tick: Tick | None = None,
        keep: Callable[[Array], None] | None = None,
    ) -> Found:
        """Search for the coefficients of the least sum of squared errors."""
        problem = self.problem(parts, free=free, weight=weight)
        n = sum(max(y.shape[0] - problem.tables.lag, 1) * y.shape[1] for y, _ in parts)
        return search(
            problem, self.theta, stage="simulation-error search" if free else "prediction-error search", most=most,
            tolerance=max(1e-10, _ENOUGH / n), damping=1e-4, tick=tick, keep=keep,
        )  # fmt: skip


# --- model -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Where the training samples lie: mean of the lagged signals and the matrix that makes their scatter round."""

    mean: Array  # (n_factors,), scaled
    # (n_factors, n_factors), such that \|whitening (x - mean)\| is 1 for the farthest training sample (Mahalanobis
    # distance)
    whitening: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class PolynomialNarmax:
    """A NARMAX model with constant coefficients (implements `ambid.nonlinear.model.NonlinearModel`).

    The predictor takes the innovations before its first prediction as zero.
    """

    dt: float  # s
    n_inputs: int
    # by output; 1 is added to the denominators, which are empty for a polynomial model
    numerators: tuple[tuple[Term, ...], ...]
    denominators: tuple[tuple[Term, ...], ...]
    theta: Array  # (n_theta,), SI, coefficients, output by output, numerator before denominator
    u_level: Array  # (n_inputs,), SI, what deviations are taken from, and the typical size of them
    u_scale: Array
    y_level: Array  # (n_outputs,), SI
    y_scale: Array
    cloud: Cloud  # of the lagged inputs and outputs in training
    # whether the outputs are those of the equation, their magnitudes, or the mean of the magnitudes now and one sample
    # ago, as a counter gives it. Past outputs get the sign that was predicted for them, the first ones that to which
    # the linear part is driven by the first inputs; a one-step prediction takes the measured mean for the magnitude
    # itself.
    output: str = "signed"

    @property
    def kind(self) -> str:
        """Under which files know it."""
        return "narmax"

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.numerators)

    @cached_property
    def tables(self) -> Tables:
        """The terms as the compiled recursions want them."""
        return tables(self.numerators, self.denominators, self.n_inputs, folded=OUTPUTS.index(self.output))

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return self.tables.lag

    @property
    def names(self) -> tuple[str, ...]:
        """Of the coefficients: their terms; denominators in the form ``1/(...)``."""
        n_y, n_u, out = self.n_outputs, self.n_inputs, []
        for o in range(n_y):
            before = f"y{o + 1}: " if n_y > 1 else ""
            out += [before + term_name(x, n_y, n_u) for x in self.numerators[o]]
            out += [f"{before}1/({term_name(x, n_y, n_u)})" for x in self.denominators[o]]
        return tuple(out)

    @cached_property
    def unit(self) -> Array:
        """What a scaled coefficient of 1 is in SI, shape (n_theta,)."""
        size = {"y": self.y_scale, "u": self.u_scale, "e": self.y_scale}
        out = []
        for o in range(self.n_outputs):
            for of, own in ((self.numerators[o], self.y_scale[o]), (self.denominators[o], 1.0)):
                out += [own / np.prod([size[f.kind][f.channel] for f in x]) for x in of]
        return np.array(out, dtype=np.float64)

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other coefficients."""
        return replace(self, theta=theta)

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`; past innovations are its own. NaN from where they diverge on."""
        ys, us = scaled(self, u, y)
        found, _ = predict(self.tables, self.theta / self.unit, ys, us)
        return self.y_level + self.y_scale * found

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`, past innovations included."""
        ys, us = scaled(self, u, y)
        theta = self.theta / self.unit
        _, z = predict(self.tables, theta, ys, us)
        return derive(self.tables, theta, z) * (self.y_scale[:, None] / self.unit)

    def simulate(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.simulate`, innovations zero."""
        whole, head = with_head(self, u, y)
        ys, us = scaled(self, u, whole)
        found, _ = predict(self.tables, self.theta / self.unit, ys, us, free=True)
        out: Array = self.y_level + self.y_scale * found
        out[:head] = whole[:head]
        return out

    def novelty(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.novelty`: Mahalanobis distance of the lagged signals."""
        ys, us = scaled(self, u, y)
        _, z = predict(self.tables, self.theta / self.unit, ys, us)
        x = lagged_signals(self.tables, z)
        out = np.full(ys.shape[0], np.nan)
        out[self.lag :] = np.linalg.norm((x - self.cloud.mean) @ self.cloud.whitening.T, axis=1)
        return out

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        arrays: dict[str, Any] = {
            k: getattr(self, k).tolist() for k in ("theta", "u_level", "u_scale", "y_level", "y_scale")
        }
        return {
            "dt_s": self.dt,
            "n_inputs": self.n_inputs,
            "output": self.output,
            "numerators": [[term_to_json(x) for x in terms] for terms in self.numerators],
            "denominators": [[term_to_json(x) for x in terms] for terms in self.denominators],
            **arrays,
            "cloud": {"mean": self.cloud.mean.tolist(), "whitening": self.cloud.whitening.tolist()},
        }

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back from what `as_json` made."""
        try:
            return cls(**_read(found))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise EstimationError(f"no NARMAX model ({type(error).__name__}: {error}). Write the file again") from error


def _read(found: dict[str, Any]) -> dict[str, Any]:
    """What the model is made with, checked."""
    num, den = (
        tuple(tuple(term_from_json(x) for x in terms) for terms in found[k]) for k in ("numerators", "denominators")
    )
    n_u, n_y = int(found["n_inputs"]), len(num)
    used = tables(num, den, n_u)
    n_seen = int(np.count_nonzero(used.column < n_y + n_u))
    sizes = {"theta": used.place.shape[0], "u_level": n_u, "u_scale": n_u, "y_level": n_y, "y_scale": n_y}
    arrays: dict[str, Any] = {k: finite(found[k], n, k) for k, n in sizes.items()}
    cloud = Cloud(
        mean=finite(found["cloud"]["mean"], n_seen, "cloud"),
        whitening=finite(found["cloud"]["whitening"], n_seen**2, "cloud").reshape(n_seen, n_seen),
    )
    if len(den) != n_y or np.any(used.column >= 2 * n_y + n_u):
        raise ValueError("terms name channels that the model does not have")
    if found["output"] not in OUTPUTS:
        raise ValueError(f"output is none of {', '.join(OUTPUTS)}")
    dt = float(found["dt_s"])
    return {
        "dt": dt,
        "n_inputs": n_u,
        "numerators": num,
        "denominators": den,
        "cloud": cloud,
        "output": found["output"],
        **arrays,
    }


def lagged_signals(t: Tables, z: Array) -> Array:
    """Return the lagged inputs and outputs that a model looks at, from sample `lag` on, of the signals of `predict`."""
    n = z.shape[0]
    seen = [k for k in range(t.column.size) if t.column[k] < t.n_outputs + t.n_inputs]
    if n <= t.lag or not seen:
        return np.empty((max(n - t.lag, 0), len(seen)))
    return np.stack([z[t.lag - t.back[k] : n - t.back[k], t.column[k]] for k in seen], axis=1)


def cloud_of(parts: list[Array]) -> Cloud:
    """Return where the lagged signals of all records lie; directions in which nothing moved count as very narrow."""
    x = np.concatenate(parts)
    mean = x.mean(axis=0) if x.size else np.zeros(x.shape[1])
    if not x.size:
        return Cloud(mean=mean, whitening=np.zeros((x.shape[1],) * 2))
    _, s, Vt = np.linalg.svd(x - mean, full_matrices=False)
    if s.size < x.shape[1] or not s[0] > 0:
        return Cloud(mean=mean, whitening=np.zeros((x.shape[1],) * 2))
    narrow = np.maximum(s, 1e-6 * s[0])
    W = Vt / (narrow / np.sqrt(x.shape[0]))[:, None]
    far = float(np.max(np.linalg.norm((x - mean) @ W.T, axis=1)))
    return Cloud(mean=mean, whitening=W / far if far > 0 else W)
