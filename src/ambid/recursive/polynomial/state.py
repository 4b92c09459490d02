"""What a recursive polynomial estimator carries from sample to sample, packed for the compiled recursion.

P = U D U' is the covariance of the coefficients in units of the noise variance; S = sum of (product of the forgetting
factors)^2 (noise variance at that time) psi psi'. Where nothing is forgotten, the error of the estimate has covariance
P times the noise variance; otherwise P S P: a calm after the samples that told the coefficients changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.polynomial.orders import Layout
from ambid.errors import EstimationError
from ambid.recursive.polynomial.plan import plan_of

Table = NDArray[np.int64]

COUNTED = (3, 4, 5, 6, 7)  # places in `State.count`: used, rejected, waited, projected, held
_OFTEN = 1e-3
_COLUMNS = 512  # samples that the buffer takes before its end becomes the next history


@dataclass(frozen=True, slots=True, kw_only=True)
class Forgetting:
    """How fast old samples lose their weight: lambda(t) = final + growth (lambda(t - 1) - final)."""

    # weight of the last sample beside the present one in the long run; 1 forgets nothing. The memory is 1/(1 - final)
    # samples.
    final: float = 1.0
    first: float | None = None  # the same at the beginning; None: `final`
    growth: float = 0.99  # between 0 and 1: how slowly the one becomes the other

    def __post_init__(self) -> None:
        for name, value in (("final", self.final), ("first", self.first), ("growth", self.growth)):
            if value is not None and not 0.0 < value <= 1.0:
                raise EstimationError(f"forgetting: {name} = {value}; it must be above 0 and at most 1. Correct it")

    @property
    def memory(self) -> float:
        """Samples of about the same weight, in the long run."""
        return float("inf") if self.final == 1.0 else 1.0 / (1.0 - self.final)

    @property
    def forgets(self) -> bool:
        """Whether any sample loses weight."""
        return self.final < 1.0 or (self.first is not None and self.first < 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class State:
    """Arrays that the compiled recursion works on, in the order of its arguments."""

    plan: Table  # see `plan` and `_kernels`
    meta: Table
    count: Table
    # (7 + n_inputs,), forgetting factors, squared errors and their weight, noise variance of the start, levels that
    # are taken off
    real: Array
    theta: Array  # (n,), estimate: free coefficients, then the constant
    coef: Array  # (2 + n,), 1, -1, then the same, C and F kept stable: what the filters use
    UD: Array  # (n, n), S is empty where nothing is forgotten
    S: Array
    limit: Array  # (n,), variances beyond which forgetting rests
    signals: Array  # (n_rows, n_columns)
    work: Array  # (3, 2 + n)

    def arrays(self) -> tuple[Any, ...]:
        """Return all arrays in the order in which the recursion takes them."""
        return tuple(getattr(self, f.name) for f in fields(self))

    @property
    def at(self) -> Array:
        """Estimate with C and F kept stable, shape (n,)."""
        return self.coef[2:]

    @property
    def levels(self) -> Array:
        """What is taken off output and inputs, shape (1 + n_inputs,)."""
        return self.real[6:]

    def counts(self) -> dict[str, int]:
        """Return how many samples were used, rejected, waited, projected and held."""
        names = ("used", "rejected", "waited", "projected", "held")
        return {name: int(self.count[k]) for name, k in zip(names, COUNTED, strict=True)}

    @property
    def at_border(self) -> bool:
        """Whether the filters had to stop short of the estimate often, or do so now."""
        return bool(self.count[6] > _OFTEN * self.count[8] or not np.array_equal(self.theta, self.at))

    @property
    def waits(self) -> bool:
        """Whether nothing is predicted for want of history."""
        return bool(self.count[1] < self.meta[2] or self.count[2])

    @property
    def worse(self) -> float:
        """Standard deviation of the innovations over that of the start."""
        return float(np.sqrt(self.real[3] / self.real[4] / self.real[5]))

    def go_on_counting(self, before: State | None, samples: int) -> None:
        """Take over counters and the forgetting of the moment, as if the samples had been taken in one by one.

        `before`: none: this is the first estimate; `samples`: taken in so far.
        """
        self.count[list(COUNTED)] = [samples, 0, 0, 0, 0] if before is None else before.count[list(COUNTED)]
        if before is not None:
            self.real[0] = before.real[0]

    def copy(self) -> State:
        """Return a state that shares nothing with this one."""
        return State(**{f.name: getattr(self, f.name).copy() for f in fields(self)})


def new_state(
    layout: Layout,
    *,
    theta: Array,
    P: Array,
    limit: Array,
    noise_variance: float,
    weight: float,
    centre: Array,
    forgetting: Forgetting,
) -> State:
    """Return a state with no past signals.

    `theta`: (n,), free coefficients, then the constant; `P`: (n, n), covariance over noise variance; `limit`: (n,);
    `weight`: samples that the noise variance is worth; `centre`: (1 + n_inputs,), levels of output and inputs that are
    taken off.
    """
    plan = plan_of(layout)
    longest = int(plan.meta[2])
    first = forgetting.final if forgetting.first is None else forgetting.first
    factor = upper_root(P)
    root = np.diag(factor).copy()
    UD = (factor / root).T.copy()
    np.fill_diagonal(UD, root**2)
    count = np.zeros(16, dtype=np.int64)
    count[0] = longest
    inverse = np.linalg.inv(factor / np.sqrt(np.diag(P))[:, None]) / np.sqrt(np.diag(P))
    from ambid.recursive.polynomial._kernels import follow

    coef, work = np.concatenate([[1.0, -1.0], theta]), np.zeros((3, 2 + theta.size))
    follow(plan.rows, plan.meta, theta, coef, work[2])
    return State(
        plan=plan.rows,
        meta=plan.meta,
        count=count,
        real=np.concatenate(
            [[first, forgetting.final, forgetting.growth, noise_variance * weight, weight, noise_variance], centre]
        ),
        theta=theta.copy(),
        coef=coef,
        UD=UD,
        S=np.asarray(inverse.T @ inverse) * noise_variance if forgetting.forgets else np.empty((0, 0)),
        limit=limit.copy(),
        signals=np.zeros((plan.n_signals, longest + _COLUMNS)),
        work=work,
    )


def upper_root(P: Array) -> Array:
    """Return an upper triangle G with P = G G', to rounding.

    `P`: (n, n), symmetric, its diagonal positive. Returns (n, n).
    """
    size = np.sqrt(np.diag(P))
    unit = P / size[:, None] / size
    values, vectors = np.linalg.eigh((unit + unit.T) / 2)
    rows = (vectors * np.sqrt(np.maximum(values, 1e-14))).T
    # QR of the reversed root: unit = rows' rows, and J R' J is upper
    R = np.asarray(np.linalg.qr(rows[:, ::-1], mode="r"))
    G = R.T[::-1, ::-1]
    G = G * np.sign(np.where(np.diag(G) == 0.0, 1.0, np.diag(G)))
    return np.asarray(size[:, None] * G)


def covariance_of(state: State, *, doubtful: bool = False) -> Array:
    """Return the covariance of the coefficients, symmetric and positive definite by construction.

    Returns (n, n).
    """
    P = _of_error(state)
    return P + np.diag(np.where(np.isfinite(state.limit), state.limit, 0.0)) if doubtful else P


def _of_error(state: State) -> Array:
    """Return the covariance of the error of a recursion that began near enough to the truth."""
    UD = state.UD
    d = np.diag(UD)
    G = np.triu(UD.T, 1) + np.eye(d.size)
    G = G * np.sqrt(d)
    if not state.S.size:
        return np.asarray(noise_variance_of(state) * (G @ G.T))
    lower = np.tril(state.S)
    S = lower + np.tril(lower, -1).T
    H = G.T @ S @ G
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    G = G @ (vectors * np.sqrt(np.maximum(values, 1e-14 * values[-1])))
    return np.asarray(G @ G.T)


def noise_variance_of(state: State) -> float:
    """Return the variance of the innovations."""
    return float(state.real[3] / state.real[4])
