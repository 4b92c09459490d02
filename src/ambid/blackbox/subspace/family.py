"""Models of all orders from one factorisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.state_space import StateSpaceModel
from ambid.blackbox.subspace.engine import decomposition, model_of, order_criterion
from ambid.blackbox.subspace.plan import Method, planned
from ambid.blackbox.subspace.units import embedded, with_units
from ambid.errors import EstimationError
from ambid.estimation.threads import one_thread

Tick = Callable[[], None] | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OrderModel:
    """The model of one order among several from one factorisation."""

    order: int  # number of states, those of known delays not counted
    model: StateSpaceModel  # in SI, known delays included
    innovation: Array  # (n_outputs, n_outputs), SI, covariance of the innovations
    criterion: float  # bayes' criterion by which orders are compared
    singular_value: float  # the `order`-th one


def subspace_models(
    data: IOData,
    method: Method,
    n_max: int,
    *,
    nk: int | tuple[int, ...] = 1,
    horizon: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = None,
    tick: Tick = None,
) -> tuple[OrderModel, ...]:
    """Identify the models of all orders up to `n_max` from one factorisation, as a stabilisation diagram wants them.

    Parameters
    ----------
    data : IOData
    method : {"n4sid", "moesp", "cva", "pbsid"}
    n_max : int
        Largest order.
    nk : int or tuple of int, optional
        Known delay of the inputs in samples.
    horizon, past : int, optional
        Samples of future and past.
    feedthrough : bool, optional
        As for `n4sid`.
    tick : callable, optional
        Called between steps.

    Returns
    -------
    tuple of OrderModel
        Orders 1, 2 ... n_max; fewer where horizons or data show fewer states. Without covariance: `n4sid` and its
        kin give that for one order.

    Raises
    ------
    EstimationError
        As for `n4sid`.
    """
    if n_max < 1:
        raise EstimationError(f"{method}: largest order {n_max}; it must be at least 1. Raise it")
    with one_thread():
        plan = planned(
            method, data, {"nk": nk}, horizon=horizon, past=past, feedthrough=feedthrough, n_max=n_max, tick=tick
        )
        _, found = decomposition(plan)
        criterion = order_criterion(plan)
        out = []
        for n in range(1, min(plan.n_max, found.values.size, criterion.size - 1) + 1):
            scaled = model_of(plan, found, n)
            model, _ = with_units(scaled, plan.channels, data.dt)
            scale = plan.channels.scale_y
            out.append(
                OrderModel(
                    order=n,
                    model=embedded(model, plan.nk)[0],
                    innovation=scaled.innovation * np.outer(scale, scale),
                    criterion=float(criterion[n]),
                    singular_value=float(found.values[n - 1]),
                )
            )
            if tick is not None:
                tick()
    return tuple(out)
