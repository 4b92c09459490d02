"""N4SID, PO-MOESP, CVA and PBSID-opt: state-space models in innovations form without a search (thesis eq. 1.1-1.3).

Solves x+ = A x + B u + w, y = C x + D u + v, cov [w; v] = [Q S; S' R], and its Kalman gain, for stable and unstable
plants, any inputs (none: a time series) and outputs; all but PBSID are biased under feedback. The record is compressed
once to triangular factors, without each group of time for the covariance (jackknife; Shao and Tu 1995, ch. 2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders, check_order_names, left_open, single_order
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.model import Offsets, StateSpaceModel
from ambid.blackbox.subspace_projection import (
    Channels,
    Factors,
    Prediction,
    Prior,
    Projection,
    Realisation,
    autoregression_criterion,
    channels,
    check_inputs_differ,
    classical_columns,
    compress,
    fit_prior,
    input_relation,
    jackknife,
    leave_each_out,
    merge_factors,
    predict_states,
    predictor_columns,
    project,
    realise,
    regress_states,
    state_criterion,
    triangular_factor,
)
from ambid.errors import EstimationError, counted
from ambid.estimation.linear import one_thread

Method = Literal["n4sid", "moesp", "cva", "pbsid"]

_GROUPS = 20  # of time, for the jackknife: its standard deviations are good to 1 / sqrt(2 * 19)
_AUTO_MAX = 10  # largest order tried where none is given
_LONGEST = {"n4sid": 20, "moesp": 20, "cva": 20, "pbsid": 60}  # samples of past
_WIDEST = {"n4sid": 100, "moesp": 100, "cva": 100, "pbsid": 240}  # columns of past


Tick = Callable[[], None] | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plan:
    """All that an estimate needs."""

    method: Method
    n: int | None  # order; None to choose it
    n_max: int  # largest order that the horizons and the record allow
    past: int  # samples
    future: int
    feedthrough: bool
    channels: Channels
    factors: Factors
    total: Array  # (n_columns, n_columns), all groups together
    autoregression: int  # lags that an autoregression wants, and half as many again
    past_limited: bool  # whether the criterion wanted a longer past than was tried


def plan_estimate(
    method: Method, data: IOData, orders: Orders, horizon: int | None, feedthrough: bool | None, tick: Tick
) -> Plan:
    """Check orders and options, compress the record, choose what was left open; `horizon`: samples of future and of
    past; `feedthrough`: whether to estimate D.
    """
    check_order_names(method, orders, ("n",))
    n = None if left_open(orders, "n") else single_order(method, orders, "n", 1, remedy="Correct it, or give 'auto'")
    scaled = channels(data)
    largest = n or _AUTO_MAX
    longest = _longest(method, data, scaled.n_samples, largest, horizon)
    length = longest + 1 if method == "pbsid" else 2 * longest
    factors = compress(scaled, length, _GROUPS)
    if tick is not None:
        tick()
    total = merge_factors(factors.groups)
    check_inputs_differ(factors, total, data.inputs, 1)
    criterion = autoregression_criterion(factors, total)
    wanted = wanted_lags = int(np.argmin(criterion))
    least = _shortest(data, largest, bool(n))
    if method == "pbsid":  # the prior makes a long past cheap, and a short one is what leaves bias
        least, wanted = max(least, 20), wanted + wanted // 2
    chosen = horizon or min(max(wanted, least), longest)
    largest = min(largest, (chosen - 1) * data.n_outputs, chosen * (data.n_inputs + data.n_outputs))
    return Plan(
        method=method,
        n=n,
        n_max=largest,
        past=chosen,
        future=chosen,
        feedthrough=_feedthrough(data, factors, total, chosen) if feedthrough is None else feedthrough,
        channels=scaled,
        factors=factors,
        total=total,
        autoregression=max(20, wanted_lags + wanted_lags // 2),
        past_limited=horizon is None and wanted_lags >= length - 1,
    )


def _longest(method: Method, data: IOData, n_samples: int, n: int, horizon: int | None) -> int:
    """Return the longest past to try: what the record carries at two rows for a column, within the method's bounds."""
    n_z = data.n_inputs + data.n_outputs
    spans = 1 if method == "pbsid" else 2
    carried = int(n_samples / (2.5 * spans * n_z + spans)) - 1
    if horizon is not None and horizon < 2:
        raise EstimationError(f"{method}: horizon = {horizon} samples; it must be at least 2. Raise it")
    if horizon is not None and (horizon - 1) * data.n_outputs < n:
        raise EstimationError(
            f"{method}: a horizon of {horizon} samples identifies at most {(horizon - 1) * data.n_outputs} states "
            f"of {counted(data.n_outputs, 'output')}, not {n}. Raise it, or lower n"
        )
    needed = _shortest(data, n, strict=False)
    least = max(horizon or 0, needed)
    if carried < least:
        raise EstimationError(
            f"{method}: {n_samples} samples allow horizons of {max(carried, 0)}; order {n} needs {least}. Lower "
            "the order, or use a longer record"
        )
    return horizon or min(carried, max(min(_LONGEST[method], _WIDEST[method] // n_z), needed + 5))


def _shortest(data: IOData, n: int, strict: bool = True) -> int:
    """Return the shortest horizon that shows n states; with some room where the order is settled and that is cheap."""
    least = max(-(-n // data.n_outputs) + 1, 2)
    return max(least, min(n + 5, 10)) if strict else least


def _feedthrough(data: IOData, factors: Factors, total: Array, past: int) -> bool:
    """Say whether u(t) acts on y(t) at once: by Bayes' criterion, and only where no feedback can feign it."""
    n_u, n_y = data.n_inputs, data.n_outputs
    if not (n_u and data.open_loop):
        return False
    now = factors.length - 1
    columns: Sequence[int] = [
        0,
        *factors.columns("z", now - min(past, now), now),
        *factors.columns("u", now, now + 1),
        *factors.columns("y", now, now + 1),
    ]
    y = triangular_factor(total[:, columns])[-(n_u + n_y) :, -n_y:]
    without, with_it = (np.linalg.slogdet(e.T @ e / factors.n_rows + 1e-18 * np.eye(n_y))[1] for e in (y, y[n_u:]))
    return bool(factors.n_rows * (without - with_it) > n_u * n_y * np.log(factors.n_rows))


def to_units(scaled: Realisation, channels: Channels, dt: float) -> tuple[StateSpaceModel, Array]:
    """Return the model in SI, and what its coefficients were multiplied by, (n_theta,)."""
    u, y = channels.scale_u, channels.scale_y
    n = scaled.model.order
    factors = (np.ones((n, n)), np.ones((n, 1)) / u, y[:, None] * np.ones(n), y[:, None] / u, np.ones((n, 1)) / y)
    scale = np.concatenate([f.ravel() for f in factors])
    return replace(scaled.model.with_theta(scaled.model.theta * scale), dt=dt), scale


def offsets(scaled: Realisation, plan: Plan) -> Offsets:
    """Return the operating point at which the innovations have no mean, by the shortest shift of the means: shifts dy
    and du move it by Py dy - Pu du, the predictor's answers at frequency zero, finite for unstable plants and
    integrators too.
    """
    f, s = plan.factors, scaled.model
    mean = plan.total[0] / plan.total[0, 0]
    now = f.length - 1
    error = mean[f.columns("y", now, now + 1)] - s.D @ mean[f.columns("u", now, now + 1)]
    F, G = s.A - s.K @ s.C, np.hstack([s.B - s.K @ s.D, s.K])
    row = s.C
    for k in range(now - 1, -1, -1):
        error = error - row @ (G @ mean[f.columns("z", k, k + 1)])
        row = row @ F
    n, n_u, channels = s.A.shape[0], s.B.shape[1], plan.channels
    at_rest = s.C @ np.linalg.solve(np.eye(n) - F, G)
    slope = np.hstack([np.eye(s.C.shape[0]) - at_rest[:, n_u:], -(s.D + at_rest[:, :n_u])])
    shift = np.linalg.lstsq(slope, -error, rcond=1e-6)[0]
    n_y = s.C.shape[0]
    return Offsets(
        u=channels.mean_u - shift[n_y:] * channels.scale_u, y=channels.mean_y - shift[:n_y] * channels.scale_y
    )


_HORIZONS = (4, 6, 8, 11, 15, 20)  # samples of future that are tried


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FirstModel:
    """An estimate without covariance, and what it came from."""

    plan: Plan
    given: Prior | None  # of the autoregression, where there is one
    found: Projection | Prediction  # states of all orders
    full: Realisation  # scaled channels
    criterion: Array | None  # (n_states + 1,), or None, by which the order was chosen; None where it was given


def estimate(
    method: Method, data: IOData, orders: Orders, *, horizon: int | None = None, feedthrough: bool | None = None,
    tick: Tick = None,
) -> BlackBoxFit:  # fmt: skip
    """Compress, decompose, choose the order, regress; again without each group of time for the covariance. ``n``
    states, ``"auto"`` or missing to choose it, input delays counted; `feedthrough` left open: only where the record is
    declared open loop and shows one, as a controller that acts within the sample cannot be told from a feedthrough.
    """
    with one_thread():
        plan = plan_estimate(method, data, orders, horizon, feedthrough, tick)
        criterion = None if plan.n else order_criterion(plan)
        n = plan.n or max(1, int(np.argmin(criterion)) if criterion is not None else 1)
        if method != "pbsid" and horizon is None:
            plan = _choose_horizons(plan, n)
        check_inputs_differ(plan.factors, plan.total, data.inputs, n + plan.feedthrough)
        prior, states = decomposition(plan)
        first = FirstModel(plan=plan, given=prior, found=states, full=model_of(plan, states, n), criterion=criterion)
        others = []
        for factor in leave_each_out(plan.factors.arranged(_columns(plan))):
            if tick is not None:
                tick()
            others.append(model_of(plan, _decompose(plan, factor, prior), n))
        covariance = jackknife(first.full, others, plan.future, with_bias=method != "pbsid")
    return _result(method, data, first, covariance)


def decomposition(plan: Plan) -> tuple[Prior | None, Projection | Prediction]:
    """Decompose what all data say into the autoregression's `prior`, where there is one, and `found`, states of all
    orders.
    """
    total = triangular_factor(plan.total[:, [0, *_columns(plan)]])
    prior = None  # the prior of the autoregression, from all data: it stays when groups are left out
    if plan.method == "pbsid":
        prior = fit_prior(total, past=plan.past, feedthrough=plan.feedthrough, like=plan.factors)
    return prior, _decompose(plan, total, prior)


def _choose_horizons(plan: Plan, n: int) -> Plan:
    """Return the plan with the horizon that leaves the least innovations, freedom taken into account: a long one
    averages noise out of slow states and brings it into fast ones; no rule knows which a plant has.
    """
    f, n_y = plan.factors, plan.factors.n_outputs
    best, best_cost = plan, np.inf
    for future in sorted({*_HORIZONS, plan.future}):
        past = max(plan.past, future)
        if (future - 1) * n_y < n or past + future > f.length:
            continue
        tried = replace(plan, past=past, future=future)
        states = decomposition(tried)[1]
        if states.values.size < n:
            continue
        model = model_of(tried, states, n)
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


def _decompose(plan: Plan, factor: Array, prior: Prior | None) -> Projection | Prediction:
    if prior is not None:
        sizes = {"past": plan.past, "future": plan.future}
        return predict_states(factor, **sizes, feedthrough=plan.feedthrough, like=plan.factors, prior=prior)
    assert plan.method != "pbsid"
    return project(factor, plan.method, past=plan.past, future=plan.future, like=plan.factors)


def model_of(plan: Plan, decomposed: Projection | Prediction, n: int) -> Realisation:
    """Return the model of one order."""
    most = decomposed.values.size
    if n > most:
        states = "1 state" if most == 1 else f"{most} states"
        raise EstimationError(
            f"{plan.method}: the record identifies {states}, not {n}. Lower n, or excite the plant more"
        )
    if isinstance(decomposed, Prediction):
        return regress_states(decomposed, n, feedthrough=plan.feedthrough)
    return realise(decomposed, n, feedthrough=plan.feedthrough)


def order_criterion(plan: Plan) -> Array:
    """Return Bayes' criterion for 0, 1, 2 ... states, (n_states + 1,), for every method from the autoregression's
    states, whose order is that of their use for prediction, under feedback too, which oblique projections do not give.
    """
    past = plan.past if plan.method == "pbsid" else min(max(plan.autoregression, plan.past), plan.factors.length - 1)
    future = max(min(past, plan.future), -(-plan.n_max // plan.factors.n_outputs))
    states = decomposition(replace(plan, method="pbsid", past=past, future=min(future, past)))[1]
    assert isinstance(states, Prediction)
    most = min(plan.n_max, states.values.size)
    return state_criterion(states.state[:most], states.y, plan.factors.n_inputs, plan.factors.n_rows)


def _result(method: Method, data: IOData, first: FirstModel, covariance: Array | None) -> BlackBoxFit:
    """Give the numbers their units and say what has to be said of them; `covariance`: of the scaled coefficients."""
    plan, prior, full = first.plan, first.given, first.full
    n, n_y, n_u = full.model.order, data.n_outputs, data.n_inputs
    y, criterion = plan.channels.scale_y, first.criterion
    model, scale = to_units(full, plan.channels, data.dt)
    warnings = []
    if covariance is None:
        warnings.append("no standard deviations: parts of the record do not identify the same states. Lower n")
    else:
        covariance = covariance * np.outer(scale, scale)
        covariance = 0.5 * (covariance + covariance.T)
    if not full.stable_predictor:
        warnings.append("no gain gives a stable predictor: its predictions diverge. Change n")
    columns = _columns(plan)[: -n_y if plan.method == "pbsid" else -n_y * plan.future]  # the regressors, scaled
    sizes = np.linalg.svd(triangular_factor(plan.total[:, [0, *columns]])[1:, 1:], compute_uv=False)
    related = input_relation(plan.factors, plan.total, data.inputs, plan.past) if method == "pbsid" else None
    if related is not None:  # its long autoregression has no unique solution, and the prior shares the effect out
        warnings.append(f"{related}: pbsid may attribute their effects wrongly. Use cva or n4sid, or omit one")
    return build_fit(
        method,
        data,
        orders={"n": n},
        model=model,
        covariance=covariance,
        noise_covariance=full.innovation * np.outer(y, y),
        n_estimated=n * (2 * n_y + n_u) + (n_u * n_y if plan.feedthrough else 0),
        offsets=offsets(full, plan),
        warnings=warnings,
        details={
            "horizons": {"past": plan.past, "future": plan.future, "past_limited": plan.past_limited},
            "order_criterion": None if criterion is None else criterion.tolist(),
            "feedthrough": plan.feedthrough,
            "singular_values": first.found.values.tolist(),
            "covariance": {"kind": "jackknife", "groups": int(plan.factors.groups.shape[0])},
            "condition_number": float(sizes[0] / max(sizes[-1], 1e-18 * sizes[0])),  # at most: beyond is rounding
            "prior": None if prior is None else {"decay": prior.decay, "size": prior.size.tolist()},
            "Q": full.Q.tolist(),
            "S": (full.S * y).tolist(),
            "R": (full.R * np.outer(y, y)).tolist(),
        },
    )


n4sid = partial(estimate, "n4sid")  # Van Overschee and De Moor 1996, fig. 4.8
moesp = partial(estimate, "moesp")  # Verhaegen 1994; Van Overschee and De Moor 1996, sec. 4.3.2
cva = partial(estimate, "cva")  # Larimore 1990; Van Overschee and De Moor 1996, sec. 4.3.3
# Chiuso 2007, Automatica 43, 1034. The controller has to hold a delay of a sample; where it does not, D stays zero (the
# default) and the estimate stays consistent, but D itself cannot be identified.
pbsid = partial(estimate, "pbsid")
