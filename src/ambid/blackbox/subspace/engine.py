"""From a plan to a result: decomposition, order, horizons, regressions, covariance. The same way for all methods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.made import made
from ambid.blackbox.orders import Orders
from ambid.blackbox.subspace.classical import Projection, classical_columns, projected, realised
from ambid.blackbox.subspace.compress import each_left_out, triangular
from ambid.blackbox.subspace.dependence import relation, told_apart
from ambid.blackbox.subspace.jackknife import jackknife
from ambid.blackbox.subspace.order import state_criterion
from ambid.blackbox.subspace.plan import Method, Plan, planned
from ambid.blackbox.subspace.predictor_based import Prediction, Prior, predicted, predictor_columns, prior, regressed
from ambid.blackbox.subspace.realisation import Realisation
from ambid.blackbox.subspace.units import embedded, offsets, with_units
from ambid.errors import EstimationError
from ambid.estimation.threads import one_thread

Tick = Callable[[], None] | None

_HORIZONS = (4, 6, 8, 11, 15, 20)  # samples of future that are tried


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FirstModel:
    """An estimate without covariance, and what it came from."""

    plan: Plan
    given: Prior | None  # of the autoregression, where there is one
    found: Projection | Prediction  # states of all orders
    full: Realisation  # scaled channels
    criterion: Array | None  # (n_states + 1,), or None, by which the order was chosen; None where it was given


def fitted(
    method: Method,
    data: IOData,
    orders: Orders,
    horizon: int | None,
    past: int | None,
    feedthrough: bool | None,
    tick: Tick,
) -> BlackBoxFit:
    """Compress, decompose, choose the order, regress; then again without each group of time for the covariance.

    `horizon`, `past`: samples.
    """
    with one_thread():
        first = first_model(method, data, orders, horizon, past, feedthrough, tick)
        plan, given, found, full, criterion = first.plan, first.given, first.found, first.full, first.criterion
        n, others = full.A.shape[0], []
        for factor in each_left_out(plan.factors.arranged(_columns(plan))):
            if tick is not None:
                tick()
            others.append(model_of(plan, _decomposed(plan, factor, given), n))
        covariance = jackknife(full, others, plan.future, with_bias=method != "pbsid")
    return _result(method, data, plan, found, given, full, covariance, criterion)


def first_model(
    method: Method,
    data: IOData,
    orders: Orders,
    horizon: int | None,
    past: int | None,
    feedthrough: bool | None,
    tick: Tick,
) -> FirstModel:
    """Compress, decompose, choose the order, regress.

    `horizon`, `past`: samples.
    """
    plan = planned(method, data, orders, horizon=horizon, past=past, feedthrough=feedthrough, tick=tick)
    criterion = None if plan.n else order_criterion(plan)
    n = plan.n or max(1, int(np.argmin(criterion)) if criterion is not None else 1)
    if method != "pbsid" and horizon is None:
        plan = _with_horizons(plan, n, keep_past=past is not None)
    told_apart(plan.factors, plan.total, data.inputs, n + plan.feedthrough)
    given, found = decomposition(plan)
    return FirstModel(plan=plan, given=given, found=found, full=model_of(plan, found, n), criterion=criterion)


def decomposition(plan: Plan) -> tuple[Prior | None, Projection | Prediction]:
    """Decompose what all data say.

    Returns `given`: of the autoregression, where there is one; `found`: states of all orders.
    """
    total = triangular(plan.total[:, [0, *_columns(plan)]])
    given = _prior(plan, total)
    return given, _decomposed(plan, total, given)


def _with_horizons(plan: Plan, n: int, *, keep_past: bool) -> Plan:
    """Return the plan with the horizon whose model leaves the least innovations, freedom taken into account.

    A long horizon averages noise out of slow states and brings it into fast ones; no rule knows which a plant has.
    """
    f, n_y = plan.factors, plan.factors.n_outputs
    best, best_cost = plan, np.inf
    for future in sorted({*_HORIZONS, plan.future}):
        past = plan.past if keep_past else max(plan.past, future)
        if (future - 1) * n_y < n or past + future > f.length:
            continue
        tried = replace(plan, past=past, future=future)
        found = decomposition(tried)[1]
        if found.values.size < n:
            continue
        model = model_of(tried, found, n)
        free = f.n_rows - past * (f.n_inputs + n_y) - future * f.n_inputs
        if not model.stable_predictor or free < 1:
            continue
        spread = model.innovation * (f.n_rows / free) + 1e-18 * np.eye(n_y)
        cost = float(np.linalg.slogdet(spread)[1])
        if cost < best_cost:
            best, best_cost = tried, cost
    return best


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


def model_of(plan: Plan, found: Projection | Prediction, n: int) -> Realisation:
    """Return the model of one order."""
    shown = found.values.size
    if n > shown:
        states = "1 state" if shown == 1 else f"{shown} states"
        raise EstimationError(f"{plan.method}: the record shows {states}, not {n}. Lower n, or excite the plant more")
    if isinstance(found, Prediction):
        return regressed(found, n, feedthrough=plan.feedthrough)
    return realised(found, n, feedthrough=plan.feedthrough)


def order_criterion(plan: Plan) -> Array:
    """Return Bayes' criterion for 0, 1, 2 ... states, for every method from the autoregression's states.

    Their order is that of their use for prediction, under feedback too, which oblique projections do not give.

    Returns (n_states + 1,).
    """
    past = plan.past if plan.method == "pbsid" else min(max(plan.autoregression, plan.past), plan.factors.length - 1)
    future = max(min(past, plan.future), -(-plan.n_max // plan.factors.n_outputs))
    states = decomposition(replace(plan, method="pbsid", past=past, future=min(future, past)))[1]
    assert isinstance(states, Prediction)
    most = min(plan.n_max, states.values.size)
    return state_criterion(states.state[:most], states.y, plan.factors.n_inputs, plan.factors.n_rows)


def _result(
    method: Method,
    data: IOData,
    plan: Plan,
    found: Projection | Prediction,
    given: Prior | None,
    full: Realisation,
    covariance: Array | None,
    criterion: Array | None,
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
    related = relation(plan.factors, plan.total, data.inputs, plan.past) if method == "pbsid" else None
    if related is not None:  # its long autoregression has no unique solution, and the prior shares the effect out
        warnings.append(f"{related}: pbsid may share their effects out wrongly. Use cva or n4sid, or leave one out")
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
            "order_criterion": None if criterion is None else criterion.tolist(),
            "feedthrough": plan.feedthrough,
            "covariance": {"kind": "jackknife", "groups": int(plan.factors.groups.shape[0])},
            "condition_number": _condition(plan),
            "prior": None if given is None else {"decay": given.decay, "size": given.size.tolist()},
            "Q": full.Q.tolist(),
            "S": (full.S * y).tolist(),
            "R": (full.R * np.outer(y, y)).tolist(),
        },
    )


def _condition(plan: Plan) -> float:
    """Return the condition number of the scaled regressors, at most 1e18: beyond is rounding."""
    n_y = plan.factors.n_outputs
    columns = _columns(plan)[: -n_y if plan.method == "pbsid" else -n_y * plan.future]
    values = np.linalg.svd(triangular(plan.total[:, [0, *columns]])[1:, 1:], compute_uv=False)
    return float(values[0] / max(values[-1], 1e-18 * values[0]))
