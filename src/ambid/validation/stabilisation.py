"""Stabilisation diagram of subspace models: poles of all orders, and which of them are of the plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, cast, get_args

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.subspace import subspace_models
from ambid.errors import EstimationError, nearest
from ambid.estimation.modes import PoleCluster, Tolerance, TrialPole, clusters, followed, trial_poles

Method = Literal["n4sid", "moesp", "cva", "pbsid"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stabilisation:
    """Poles of models of all orders."""

    method: Method
    orders: tuple[int, ...]
    poles: tuple[TrialPole, ...]  # lowest order first
    modes: tuple[PoleCluster, ...]  # lowest frequency first
    singular_values: tuple[float, ...]  # by order
    criteria: tuple[float, ...]  # bayes' criterion by order, less is better

    @property
    def suggested(self) -> int:
        """Order of least criterion."""
        return self.orders[int(np.argmin(self.criteria))]


def stabilisation(
    data: IOData,
    method: str = "pbsid",
    n_max: int = 20,
    *,
    tick: Callable[[], None] | None = None,
) -> Stabilisation:
    """Identify models of all orders up to `n_max` and follow their poles.

    `method`: all but pbsid are biased under feedback; `tick`: called between steps; may raise to interrupt.
    """
    methods = get_args(Method)
    if method not in methods:
        raise EstimationError(f"method {method!r} is not one of {', '.join(methods)}.{nearest(method, methods)}")
    models = subspace_models(data, cast(Method, method), n_max, tick=tick)
    near = Tolerance()
    rows = [_poles(m.order, m.model.A, m.model.C, data) for m in models]
    poles = followed(rows, near)
    return Stabilisation(
        method=cast(Method, method),
        orders=tuple(m.order for m in models),
        poles=tuple(poles),
        modes=clusters(poles, [m.order for m in models], near),
        singular_values=tuple(m.singular_value for m in models),
        criteria=tuple(m.criterion for m in models),
    )


def _poles(order: int, A: Array, C: Array, data: IOData) -> list[TrialPole]:
    """Poles with their mode shapes, outputs in units of their standard deviations; poles at z = 0 are delays."""
    values, vectors = np.linalg.eig(A)
    shapes = ((C / np.maximum(np.std(data.y, axis=0), 1e-300)[:, None]) @ vectors).T
    no_delay = np.abs(values) >= 1e-8
    return trial_poles(order, np.log(values[no_delay].astype(complex)) / data.dt, shapes[no_delay])
