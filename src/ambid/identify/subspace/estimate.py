"""N4SID, PO-MOESP, CVA and PBSID-opt: state-space models in innovations form without a search (thesis eq. 1.1-1.3).

Solves: x+ = A x + B u + w, y = C x + D u + v, cov [w; v] = [Q S; S' R], and its Kalman gain, for stable and unstable
plants, any number of inputs (none: a time series) and outputs. N4SID, MOESP and CVA are biased under feedback; PBSID
is not. The record is compressed once to triangular factors; everything else is done on those.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify.blackbox.data import IOData
from ambid.identify.blackbox.fit import BlackBoxFit
from ambid.identify.blackbox.made import made
from ambid.identify.blackbox.state_space import StateSpaceModel
from ambid.identify.subspace.classical import Projection, canonical_states, classical_columns, projected, realised
from ambid.identify.subspace.compress import each_left_out, merged
from ambid.identify.subspace.jackknife import jackknife
from ambid.identify.subspace.order import state_criterion
from ambid.identify.subspace.plan import Method, Orders, Plan, planned
from ambid.identify.subspace.predictor_based import Prediction, Prior, predicted, predictor_columns, prior, regressed
from ambid.identify.subspace.realisation import Realisation
from ambid.identify.subspace.units import embedded, offsets, with_units
from ambid.identify.threads import one_thread

Array = NDArray[np.float64]
Tick = Callable[[], None] | None


def n4sid(
    data: IOData,
    orders: Orders,
    *,
    horizon: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = None,
    tick: Tick = None,
) -> BlackBoxFit:
    """Identify a state-space model by N4SID (Van Overschee and De Moor 1996, fig. 4.8; thesis eq. 1.1-1.3).

    Parameters
    ----------
    data : IOData
    orders : Mapping
        ``n``: number of states, ``"auto"`` or missing to choose it. ``nk``: known delay of the inputs in samples, one
        or one for each, at least 1 (default); larger ones become states of their own.
    horizon, past : int, optional
        Samples of future and past; chosen by an autoregression if missing.
    feedthrough : bool, optional
        Whether to estimate D. Missing: only where the record is said to be open loop and shows one, because a
        controller that acts within the sample cannot be told from a feedthrough.
    tick : callable, optional
        Called between steps.

    Returns
    -------
    BlackBoxFit

    Raises
    ------
    EstimationError
        If orders or horizons break a rule, a channel is constant, or the record is too short.
    """
    return _subspace("n4sid", data, orders, horizon, past, feedthrough, tick)


def moesp(
    data: IOData,
    orders: Orders,
    *,
    horizon: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = None,
    tick: Tick = None,
) -> BlackBoxFit:
    """Identify a state-space model by PO-MOESP (Verhaegen 1994; Van Overschee and De Moor 1996, sec. 4.3.2).

    Parameters
    ----------
    data : IOData
    orders : Mapping
        As for `n4sid`.
    horizon, past : int, optional
        Samples of future and past.
    feedthrough : bool, optional
        As for `n4sid`.
    tick : callable, optional

    Returns
    -------
    BlackBoxFit

    Raises
    ------
    EstimationError
        As for `n4sid`.
    """
    return _subspace("moesp", data, orders, horizon, past, feedthrough, tick)


def cva(
    data: IOData,
    orders: Orders,
    *,
    horizon: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = None,
    tick: Tick = None,
) -> BlackBoxFit:
    """Identify a state-space model by canonical variates (Larimore 1990; Van Overschee and De Moor 1996, sec. 4.3.3).

    Parameters
    ----------
    data : IOData
    orders : Mapping
        As for `n4sid`.
    horizon, past : int, optional
        Samples of future and past.
    feedthrough : bool, optional
        As for `n4sid`.
    tick : callable, optional

    Returns
    -------
    BlackBoxFit

    Raises
    ------
    EstimationError
        As for `n4sid`.
    """
    return _subspace("cva", data, orders, horizon, past, feedthrough, tick)


def pbsid(
    data: IOData,
    orders: Orders,
    *,
    horizon: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = None,
    tick: Tick = None,
) -> BlackBoxFit:
    """Identify a state-space model by PBSID-opt, consistent under feedback (Chiuso 2007, Automatica 43, 1034).

    The controller has to hold a delay of a sample; where it does not, D stays zero (the default) and the estimate
    stays consistent, but D itself cannot be identified.

    Parameters
    ----------
    data : IOData
    orders : Mapping
        As for `n4sid`.
    horizon, past : int, optional
        Samples of future and past, horizon <= past.
    feedthrough : bool, optional
        As for `n4sid`.
    tick : callable, optional

    Returns
    -------
    BlackBoxFit

    Raises
    ------
    EstimationError
        As for `n4sid`.
    """
    return _subspace("pbsid", data, orders, horizon, past, feedthrough, tick)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OrderModel:
    """The model of one order among several from one factorisation.

    Attributes
    ----------
    order : int
        Number of states, those of known delays not counted.
    model : StateSpaceModel
        In SI, known delays included.
    innovation : ndarray, shape (n_outputs, n_outputs), SI
        Covariance of the innovations.
    criterion : float
        Bayes' criterion by which orders are compared.
    singular_value : float
        The `order`-th one.
    """

    order: int
    model: StateSpaceModel
    innovation: Array
    criterion: float
    singular_value: float


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
        total = merged(plan.factors.arranged(_columns(plan)))
        found = _decomposed(plan, total, _prior(plan, total))
        criterion = _criterion(plan, found)
        out = []
        for n in range(1, min(plan.n_max, found.values.size) + 1):
            scaled = _model(plan, found, n)
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


def _subspace(
    method: Method,
    data: IOData,
    orders: Orders,
    horizon: int | None,
    past: int | None,
    feedthrough: bool | None,
    tick: Tick,
) -> BlackBoxFit:
    """Compress, decompose, choose the order, regress; then again without each group of time for the covariance."""
    with one_thread():
        plan = planned(method, data, orders, horizon=horizon, past=past, feedthrough=feedthrough, tick=tick)
        groups = plan.factors.arranged(_columns(plan))
        total = merged(groups)
        given = _prior(plan, total)
        found = _decomposed(plan, total, given)
        criterion = _criterion(plan, found)
        n = plan.n or max(1, int(np.argmin(criterion[: plan.n_max + 1])))
        if n > found.values.size:
            raise EstimationError(
                f"{method}: the record shows {found.values.size} states, not {n}. Lower n, or excite the plant more"
            )
        full = _model(plan, found, n)
        others = []
        for factor in each_left_out(groups):
            if tick is not None:
                tick()
            others.append(_model(plan, _decomposed(plan, factor, given), n))
        covariance = jackknife(full, others, plan.future)
    return _result(method, data, plan, found, full, covariance, criterion)


def _columns(plan: Plan) -> list[int]:
    if plan.method == "pbsid":
        return predictor_columns(plan.factors, plan.past)
    return classical_columns(plan.factors, plan.past, plan.future)


def _prior(plan: Plan, total: Array) -> Prior | None:
    """Return the prior of the autoregression, from all data: it stays when groups are left out."""
    if plan.method != "pbsid":
        return None
    return prior(total, past=plan.past, feedthrough=plan.feedthrough, like=plan.factors)


def _decomposed(plan: Plan, factor: Array, given: Prior | None) -> Projection | Prediction:
    if given is not None:
        sizes = {"past": plan.past, "future": plan.future}
        return predicted(factor, **sizes, feedthrough=plan.feedthrough, like=plan.factors, given=given)
    assert plan.method != "pbsid"
    return projected(factor, plan.method, past=plan.past, future=plan.future, like=plan.factors)


def _model(plan: Plan, found: Projection | Prediction, n: int) -> Realisation:
    if isinstance(found, Prediction):
        return regressed(found, n, feedthrough=plan.feedthrough)
    return realised(found, n, feedthrough=plan.feedthrough)


def _criterion(plan: Plan, found: Projection | Prediction) -> Array:
    """Return Bayes' criterion for 0, 1, 2 ... states."""
    n_u, n_y = plan.factors.n_inputs, plan.factors.n_outputs
    most = min(plan.n_max, found.values.size)
    if isinstance(found, Prediction):
        states, y = found.state[:most], found.y
    else:
        states, y = canonical_states(found)[:most], found.outputs[found.inputs.shape[0] :, :n_y].T
    return state_criterion(states, y, n_u, plan.factors.n_rows)


def _result(
    method: Method,
    data: IOData,
    plan: Plan,
    found: Projection | Prediction,
    full: Realisation,
    covariance: Array | None,
    criterion: Array,
) -> BlackBoxFit:
    """Give the numbers their units and say what has to be said of them."""
    core, scale = with_units(full, plan.channels, data.dt)
    model, places = embedded(core, plan.nk)
    if covariance is not None:
        wide = np.zeros((model.theta.size, model.theta.size))
        wide[np.ix_(places, places)] = covariance * np.outer(scale, scale)
        covariance = 0.5 * (wide + wide.T)
    n, n_y, n_u = full.A.shape[0], data.n_outputs, data.n_inputs
    y = plan.channels.scale_y
    warnings = []
    if covariance is None:
        warnings.append("no standard deviations: parts of the record do not show the same states. Lower n")
    if not full.stable_predictor:
        warnings.append("no gain was found with which the predictor is stable: its predictions run away. Change n")
    delays = {"nk": plan.nk} if any(k > 1 for k in plan.nk) else {}
    return made(
        method,
        data,
        orders={"n": n, **delays},
        model=model,
        covariance=covariance,
        n_estimated=n * (2 * n_y + n_u) + (n_u * n_y if plan.feedthrough else 0),
        offsets=offsets(full, plan),
        noise_covariance=full.innovation * np.outer(y, y),
        warnings=warnings,
        details={
            "singular_values": found.values.tolist(),
            "horizons": {"past": plan.past, "future": plan.future, "past_limited": plan.past_limited},
            "order_criterion": criterion.tolist(),
            "feedthrough": plan.feedthrough,
            "Q": full.Q.tolist(),
            "S": (full.S * y).tolist(),
            "R": (full.R * np.outer(y, y)).tolist(),
        },
    )
