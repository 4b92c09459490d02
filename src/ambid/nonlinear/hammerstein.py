"""Hammerstein models: a static polynomial of each input, then a linear difference equation (Giri and Bai 2010).

y(t) = sum a_k y(t-k) + sum b_ij w_i(t-nk-j) + c + e(t), w_i = u_i + g_i2 u_i^2 + .. + g_id u_i^d, in scaled signals.
Multiplied out it is linear in its coefficients; the nearest products b g of these begin the search (Bai 1998).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from time import perf_counter
from typing import Any, ClassVar, Self

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.linear import least_squares
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import search
from ambid.nonlinear.fit import NO_WEIGHTS, NonlinearFit, Settings, choice, read_settings, whole
from ambid.nonlinear.lagged import Block, LaggedFunction, Mask, Regressors, Table, Terms, lags
from ambid.nonlinear.lagged_problem import (
    Draft,
    finish,
    laplace,
    problem_at,
    refine,
)
from ambid.nonlinear.records import Scaled, scaled_records


@dataclass(frozen=True, slots=True, kw_only=True)
class HammersteinSettings:
    """Settings of a Hammerstein fit."""

    ny: int = whole("lags of the output; 2", 0, 50, 2)
    nu: int = whole("lags of each input; 2", 1, 50, 2)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    degree: int = whole("of the static polynomial of each input; 3", 1, 9, 3)
    iterations: int = whole("of each search, at most; 60", 1, 2000, 60)
    focus: str = choice(
        "prediction or simulation: errors that are minimised in the end; prediction", "prediction", "simulation"
    )


@dataclass(frozen=True, kw_only=True)
class Hammerstein:
    """Powers of lagged inputs whose coefficients are products of those of the static and of the linear part."""

    terms: Terms
    m: int
    ny: int
    nu: int
    degree: int

    uses = property(lambda self: self.terms.uses)
    bends = property(lambda self: self.terms.bends)
    prepare = property(lambda self: self.terms.prepare)

    @property
    def n_theta(self) -> int:
        """Number of parameters: a, b, c, g."""
        return self.ny + self.m * (self.nu + self.degree - 1) + 1

    def parts(self, theta: Array) -> tuple[Array, Array, Array, Array]:
        """Return a, b (m, nu), c and the coefficients of the powers (m, degree), those of the first one."""
        a, b, c, g = np.split(theta, np.cumsum([self.ny, self.m * self.nu, 1]))
        return a, b.reshape(self.m, -1), c, np.hstack([np.ones((self.m, 1)), g.reshape(self.m, -1)])

    def coefficients(self, theta: Array) -> Array:
        """Return the coefficients of the terms: outputs, constant, then inputs, lags, powers."""
        a, b, c, g = self.parts(theta)
        return np.concatenate([a, c, (b[:, :, None] * g[:, None, :]).ravel()])

    def values(self, theta: Array, rows: tuple[Array, ...]) -> Array:
        """As `Block.values`."""
        return self.terms.values(self.coefficients(theta), rows)

    def derivatives(self, theta: Array, rows: tuple[Array, ...], live: Mask, at: Table) -> tuple[Array, Array]:
        """As `Block.derivatives`."""
        _, b, _, g = self.parts(theta)
        every = np.ones(self.terms.n_theta, dtype=np.bool_)
        D, by_x = self.terms.derivatives(self.coefficients(theta), rows, every, at)
        by_power = D[:, :, self.ny + 1 :].reshape(*D.shape[:2], self.m, self.nu, self.degree)
        by_b = np.einsum("toijd,id->toij", by_power, g).reshape(*D.shape[:2], -1)
        by_g = np.einsum("toijd,ij->toid", by_power, b)[..., 1:].reshape(*D.shape[:2], -1)
        out = np.concatenate([D[:, :, : self.ny], by_b, D[:, :, self.ny, None], by_g], axis=2)
        return out[:, :, live], by_x

    def fill(self, theta: Array, numbers: dict[str, Any]) -> None:
        """As `Block.fill`."""
        self.terms.fill(self.coefficients(theta), numbers)


@dataclass(frozen=True, kw_only=True)
class HammersteinFunction(LaggedFunction):
    """Sizes of a Hammerstein model of one output."""

    kind: ClassVar[str] = "hammerstein"
    m: int  # inputs
    ny: int
    nu: int
    nk: int
    degree: int

    @cached_property
    def regressors(self) -> Regressors:
        """What it looks at."""
        return lags(1, self.m, ny=self.ny, nu=self.nu, nk=self.nk)

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """What it is the sum of."""
        inputs = range(self.ny, self.ny + self.m * self.nu)
        rows = [[k] for k in range(self.ny)] + [[]] + [[k] * d for k in inputs for d in range(1, self.degree + 1)]
        table = np.array([r + [-1] * (self.degree - len(r)) for r in rows], dtype=np.int64)
        terms = Terms(n_outputs=1, terms=table, place=np.zeros((len(rows), 2), dtype=np.int64))
        return (Hammerstein(terms=terms, m=self.m, ny=self.ny, nu=self.nu, degree=self.degree),)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all parameters."""
        powers = [f"u{i + 1 if self.m > 1 else ''}^{d}" for i in range(self.m) for d in range(2, self.degree + 1)]
        return (*self.regressors.names, "1", *powers)

    def as_json(self) -> dict[str, Any]:
        """As `LaggedFunction.as_json`."""
        return {"sizes": asdict(self)}

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> Self:
        """Read it back."""
        return cls(**{k: int(v) for k, v in document["sizes"].items()})

    def start(self, data: Scaled) -> Array:
        """Return parameters by least squares on the polynomial multiplied out, its rank reduced to one."""
        rows = [self.rows(y, u) for y, u in data.parts]
        T = np.concatenate([r.prepared[0][0] for r in rows])
        k = least_squares(T, np.concatenate([r.y[:, 0] for r in rows]))
        b, g = [], []
        for one in k[self.ny + 1 :].reshape(self.m, self.nu, self.degree):
            U, s, Vt = np.linalg.svd(one)
            first = Vt[0, 0] if abs(Vt[0, 0]) > 1e-3 else 1e-3
            b.append(s[0] * first * U[:, 0])
            g.append(Vt[0, 1:] / first)
        return np.concatenate([k[: self.ny], *b, k[self.ny, None], *g])


def hammerstein(
    records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None
) -> NonlinearFit:
    """Identify a Hammerstein model of one output, without randomness; biased under feedback unless its errors are
    white. `tick` is called with the stage and may raise KeyboardInterrupt.
    """
    s = read_settings(HammersteinSettings, "hammerstein", settings)
    data = scaled_records("hammerstein", records, lag=max(s.ny, s.nk + s.nu - 1, 1))
    if data.n_outputs > 1 or not data.u_level.size:
        raise EstimationError("hammerstein: a model has one output, and inputs. Choose one output, and an input")
    function = HammersteinFunction(m=data.u_level.size, ny=s.ny, nu=s.nu, nk=s.nk, degree=s.degree)
    draft = Draft(
        structure="hammerstein", records=records, settings=asdict(s), seed=seed, data=data, function=function,
        theta=function.start(data),
    )  # fmt: skip
    ticks = portions(tick, (1.0, 2.0 * (s.focus == "simulation")))

    def identify() -> None:
        began = perf_counter()
        problem = problem_at(function, data.parts, draft.theta)
        ended = search(problem, draft.theta, stage="search", most=s.iterations, tick=ticks[0], keep=draft.keep)
        draft.keep(ended.theta)
        draft.settle(ended, problem, "Levenberg-Marquardt, prediction errors")
        began = draft.timed("search", began)
        if s.focus == "simulation":
            refine(draft, partial(problem_at, function, data.parts, free=True), s.iterations, ticks[1], "terms")
            draft.timed("simulation errors", began)

    reason = draft.guarded(identify)
    problem = problem_at(function, data.parts, draft.theta, free=draft.free)
    if reason or not np.isfinite(problem.cost(draft.theta)):
        return draft.failed(reason or NO_WEIGHTS)
    return finish(draft, problem, laplace(problem, draft.theta), units="lags or powers")
