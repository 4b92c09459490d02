"""State-space models by prediction error: the maximum of the likelihood, started from a subspace estimate.

Solves: min log det (1/N) sum e e' with x+ = A x + B u + K e, y = C x + D u + e, for stable and unstable plants, any
number of inputs and outputs, with and without feedback. Efficient where the innovations are white (Ljung 1999, sec.
9.3): its covariance is the inverse of the information matrix, singular only along mere changes of states.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.made import made
from ambid.blackbox.orders import Orders
from ambid.blackbox.state_space import StateSpaceModel
from ambid.blackbox.subspace.engine import FirstModel, first_model
from ambid.blackbox.subspace.plan import Method
from ambid.blackbox.subspace.prediction_error import Found, Point, searched, started
from ambid.blackbox.subspace.realisation import Realisation, kalman_gain
from ambid.blackbox.subspace.units import embedded, operating_point, with_units
from ambid.errors import EstimationError
from ambid.estimation.linear import directions
from ambid.estimation.threads import one_thread

Tick = Callable[[], None] | None

_LOOSE = 1e6  # condition of the scaled information's root from which states are told apart by rounding alone


def sspem(
    data: IOData,
    orders: Orders,
    *,
    horizon: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = None,
    tick: Tick = None,
) -> BlackBoxFit:
    """Identify a state-space model by prediction error (local coordinates: McKelvey et al. 2004, Automatica 40, 1629).

    Parameters
    ----------
    data : IOData
    orders : Mapping
        ``n``: number of states, ``"auto"`` or missing to choose it. ``nk``: known delay of the inputs in samples, one
        or one for each, at least 1 (default); larger ones become states of their own.
    horizon, past : int, optional
        Samples of future and past of the subspace estimate it starts from.
    feedthrough : bool, optional
        Whether to estimate D; as for `n4sid` if missing.
    tick : callable, optional
        Called between steps.

    Returns
    -------
    BlackBoxFit
        Consistent under feedback as long as n states hold plant and noise.

    Raises
    ------
    EstimationError
        If orders or horizons break a rule, a channel is constant, the record is too short, or no subspace estimate has
        a stable predictor.
    """
    with one_thread():
        first = first_model("pbsid", data, orders, horizon, past, feedthrough, tick)
        n, given = first.full.A.shape[0], first.plan.channels
        u, y = (given.u - given.mean_u) / given.scale_u, (given.y - given.mean_y) / given.scale_y
        numbers = n * (u.shape[1] + 2 * y.shape[1] + 1) + y.shape[1] * (1 + first.plan.feedthrough * u.shape[1])
        if y.size < 2 * numbers:
            raise EstimationError(
                f"sspem: {y.shape[0]} samples for {numbers} numbers; it wants at least {2 * numbers} values. "
                "Lower n, or take a longer record"
            )
        method, start = _start(data, first, orders, u, y, horizon, past, tick)
        found = searched(start, u, y, feedthrough=first.plan.feedthrough, tick=tick)
    return _result(data, first, found, method, start)


def _start(
    data: IOData,
    first: FirstModel,
    orders: Orders,
    u: Array,
    y: Array,
    horizon: int | None,
    past: int | None,
    tick: Tick,
) -> tuple[Method, Point]:
    """Take the subspace estimate with the smallest determinant: pbsid, and cva where there is no feedback."""
    n = first.full.A.shape[0]
    tried: list[tuple[Method, Realisation]] = [("pbsid", first.full)]
    if data.open_loop or not data.n_inputs:
        try:
            both = {**orders, "n": n}
            other = first_model("cva", data, both, horizon, past, first.plan.feedthrough, tick)
            tried.append(("cva", other.full))
        except EstimationError:  # a record too short for cva may still do for pbsid
            pass
    points = list[tuple[Method, Point]]()
    for method, one in tried:
        point = started(_model(one, one.K, data.dt), one.innovation + 1e-12 * np.eye(y.shape[1]), u, y)
        if point is None:
            K, noise, _ = kalman_gain(one.A, one.C, np.eye(n), np.zeros_like(one.K), np.eye(y.shape[1]))
            point = started(_model(one, K, data.dt), noise, u, y)
        if point is not None:
            points.append((method, point))
    if not points:
        raise EstimationError(
            "sspem: no subspace estimate of this order has a stable predictor to start from. Change n"
        )
    return min(points, key=lambda pair: pair[1].cost)


def _model(one: Realisation, K: Array, dt: float) -> StateSpaceModel:
    return StateSpaceModel(A=one.A, B=one.B, C=one.C, D=one.D, K=K, dt=dt)


def _result(data: IOData, first: FirstModel, found: Found, method: Method, start: Point) -> BlackBoxFit:
    """Give the numbers their units and say what has to be said of them."""
    m, plan, given = found.point.model, first.plan, first.plan.channels
    n_samples, n_y = given.y.shape
    # each output has its share of the numbers
    widened = n_samples / (n_samples - found.n_numbers / n_y)
    noise = found.point.noise * widened
    scaled = _realisation(m, noise)
    core, scale = with_units(scaled, given, data.dt)
    model, places = embedded(core, plan.nk)
    half = found.tangent * scale[:, None]
    own = half @ directions(found.information).inverse() @ half.T * widened
    covariance = np.zeros((model.theta.size, model.theta.size))
    covariance[np.ix_(places, places)] = 0.5 * (own + own.T)
    condition = _condition(found.information)
    warnings = []
    if found.point.exact:
        warnings.append(
            "the record shows no noise: the errors are rounding, and so are the standard deviations. The noise model K "
            "means nothing"
        )
    elif condition > _LOOSE:
        warnings.append(
            f"the record does not tell all {m.order} states apart (condition {condition:.1g}): standard deviations "
            "along what it does not show mean little. Lower n"
        )
    delays = {"nk": plan.nk} if any(k > 1 for k in plan.nk) else {}
    return made(
        "sspem",
        data,
        orders={"n": m.order, **delays},
        model=model,
        covariance=covariance,
        n_estimated=found.tangent.shape[1],
        offsets=operating_point(scaled, given, found.point.constant),
        noise_covariance=noise * np.outer(given.scale_y, given.scale_y),
        status="converged" if found.converged else "stalled",
        warnings=warnings,
        details={
            "start": method,
            "iterations": found.iterations,
            "gain_nats": 0.5 * (start.cost - found.point.cost),
            "left_nats": 0.5 * found.promise,
            "condition_number": condition,
            "covariance": {"kind": "information"},
            "feedthrough": plan.feedthrough,
            "horizons": {"past": plan.past, "future": plan.future, "past_limited": plan.past_limited},
            "order_criterion": None if first.criterion is None else first.criterion.tolist(),
        },
    )


def _realisation(m: StateSpaceModel, noise: Array) -> Realisation:
    return Realisation(
        A=m.A, B=m.B, C=m.C, D=m.D, K=m.K, innovation=noise, Q=m.K @ noise @ m.K.T, S=m.K @ noise, R=noise
    )


def _condition(root: Array) -> float:
    """Condition number of the columns over their sizes, at most 1e18."""
    s = np.linalg.svd(root / np.maximum(np.linalg.norm(root, axis=0), 1e-150), compute_uv=False)
    return float(s[0] / max(s[-1], 1e-18 * s[0]))
