"""The on-line job with any recursive estimator, block by block, line by line, published as it is, without a supervisor.

Regressions and polynomial models follow coefficients, the joint filters physical parameters of a bench.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders, check_order_names, io_data, order_per_input, orders_of, single_order
from ambid.errors import EstimationError, nearest
from ambid.estimation.estimate import Estimate
from ambid.job.data import WHOLE, Reading, names_of
from ambid.job.following import EstimatorWords, Following, Memory, tell
from ambid.job.track_start import rows_of, start_of
from ambid.physics.linear_model import model
from ambid.record import Source, cut, read_record
from ambid.recursive import (
    JointEkf,
    JointUkf,
    Lms,
    Nlms,
    RecursiveArx,
    RecursiveEstimator,
    RecursiveLeastSquares,
    RecursivePolynomial,
)
from ambid.recursive.lines import Event, StartWords, Track, TrackedValue, TrackHeader, TrackLine
from ambid.rig import Rig, default_rig
from ambid.settings.caller import refuse_given, setting

REGRESSIONS = ("rls", "lms", "nlms")
POLYNOMIALS = ("fir", "arx", "armax", "arma", "ararx", "ararmax", "oe", "bj")
JOINT = ("ekf", "ukf")
METHODS = ("rpem", *REGRESSIONS, *POLYNOMIALS, *JOINT)
_FIRST_S, _FIRST_SAMPLES = 0.1, 1000  # of the record, from which the sizes of the signals are taken
_STEP, _SMALL = {"lms": 1e-3, "nlms": 0.1}, 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Run:
    """An estimator with what it is fed, and what it is called."""

    estimator: RecursiveEstimator
    inputs: Array  # (n_samples, n_inputs)
    outputs: Array  # (n_samples, n_outputs)
    rate_hz: float
    t0: float  # time of the first sample, s of record
    scale: Array  # of the estimate, to SI
    model: str
    units: Mapping[str, str]
    origin: Mapping[str, object]
    start: Mapping[str, TrackedValue]
    said: StartWords  # of the start, or the method


def track_estimator(
    record: Source,
    rig: Rig | None,
    method: str,
    start: Estimate | str | Path | float | None,
    part: Reading,
    how: Following,
    settings: EstimatorWords,
) -> Track:
    """Follow a record with one of `METHODS` other than ``rpem``; `start` is of a joint filter."""
    if method not in METHODS:
        raise EstimationError(f"method {method!r} is unknown; known: {', '.join(METHODS)}.{nearest(method, METHODS)}")
    inputs, outputs = (names_of(settings.get(x)) for x in ("input", "output"))  # type: ignore[arg-type]
    orders = orders_of(settings.get("orders"))
    refusal = f"{setting('method', method)} takes no {{}}. Omit it"
    if method in JOINT:
        columns = {"input": inputs, "output": outputs, "orders": orders}
        refuse_given(columns, refusal)
        job = _joint(method, record, rig, start, how.memory, part)
    else:
        refuse_given({"rig": rig, "start": start}, refusal)
        whole = read_record(record, rate_hz=part.get("rate_hz"), units=part.get("units"), layout=part.get("layout"))
        span = part.get("from_s"), part.get("to_s")
        part_record = whole if span == WHOLE else cut(whole, *span)
        data = io_data(part_record, inputs, outputs, open_loop=settings.get("open_loop", False))
        if data.y.shape[1] != 1:
            raise EstimationError(
                f"{method} tracks one output; {data.y.shape[1]} were named. Name one with {setting('output')}"
            )
        job = _coefficients(method, data, orders, how.memory, settings.get("step"), part_record.start_s)
    label = f"{method}, memory {how.memory if isinstance(how.memory, str) else f'{how.memory:g} s'}"
    return _follow(job, label, how)


def _coefficients(
    method: str, data: IOData, orders: Orders | None, memory: Memory, step: float | None, t0: float
) -> _Run:
    """Coefficients of a model of named columns: regressions of scaled signals, or any polynomial structure."""
    samples = None if isinstance(memory, str) else memory / data.dt
    u, y, sizes = data.u, data.y, (np.ones(data.u.shape[1]), np.ones(1))
    estimator: Any
    if method in REGRESSIONS:
        na, nb, nk = _arx_orders(f"{setting('method', method)}", data, orders)
        u, y, sizes = _scale(method, data)
        estimator = _arx(method, (na, nb, nk), samples, step)
        label = f"arx na={na} nb={'/'.join(map(str, nb))} nk={'/'.join(map(str, nk))}"
    else:
        if step is not None or orders is None:
            raise EstimationError(
                f"{setting('method', method)} needs {setting('orders')} as numbers, and takes no {setting('step')}. "
                "Correct that"
            )
        if samples is not None and samples <= 1.0:
            raise EstimationError(f"{setting('memory')} {memory:g} s is not longer than one sample. Give a longer one")
        estimator = RecursivePolynomial(  # stores the first samples and fits them off-line
            method, orders, dt=data.dt, n_inputs=data.u.shape[1], open_loop=data.open_loop,
            forgetting=1.0 if samples is None else 1.0 - 1.0 / samples,
        )  # fmt: skip
        label = f"{method} {' '.join(f'{k}={v}' for k, v in orders.items())}"
    out, scale, units = data.units[data.outputs[0]], list[float](), dict[str, str]()
    for name in estimator.names:  # those of B lead from an input to the output, a constant has the output's unit
        if name[0] == "b":
            j = int(name.partition(".")[2] or 0)  # b1 or b1.0
            scale.append(float(sizes[1][0] / sizes[0][j]))
            units[name] = f"{out}/{data.units[data.inputs[j]]}"
        else:
            scale.append(float(sizes[1][0]) if name == "offset" else 1.0)
            units[name] = out if name == "offset" else ""
    return _Run(
        estimator=estimator, inputs=u, outputs=y, rate_hz=1 / data.dt, t0=t0, scale=np.array(scale), model=label,
        units=units, origin={name: data.record[name] for name in ("file", "sha256", "samples")}, start={},
        said={"warnings": _bias(method, data, estimator)},
    )  # fmt: skip


def _scale(method: str, data: IOData) -> tuple[Array, Array, tuple[Array, Array]]:
    """Return inputs and output at mean zero and size one, and sizes, from the first samples as on-line."""
    first = slice(0, max(_FIRST_SAMPLES, round(_FIRST_S / data.dt)))
    u, y = data.u, data.y
    means, sizes = zip(*((x[first].mean(axis=0), x[first].std(axis=0)) for x in (u, y)), strict=True)
    if not all((size > 0).all() for size in sizes):
        raise EstimationError(
            f"{method}: a signal is constant in the first {first.stop * data.dt:.3g} s, which set its scale. Begin "
            f"where the signals move, with {setting('from_s')}"
        )
    return (u - means[0]) / sizes[0], (y - means[1]) / sizes[1], sizes


def _arx_orders(who: str, data: IOData, orders: Orders | None) -> tuple[int, tuple[int, ...], tuple[int, ...]]:
    """Return na, and nb and nk of each input."""
    names = ("na", "nb", "nk")
    if orders is None or not data.inputs:
        raise EstimationError(
            f"{who} needs {setting('input')}, {setting('output')} and {setting('orders', 'na=2,nb=2,nk=1')} as "
            "numbers: none is chosen on-line. Give them"
        )
    check_order_names(who, orders, names, names)
    nb, nk = (order_per_input(who, orders, name, least, data.n_inputs) for name, least in (("nb", 1), ("nk", 0)))
    return single_order(who, orders, "na", 0), nb, nk


def _arx(
    method: str,
    orders: tuple[int, tuple[int, ...], tuple[int, ...]],
    memory: float | None,
    step: float | None,
) -> RecursiveArx:
    na, nb, nk = orders
    if step is not None and method not in _STEP:
        raise EstimationError(f"{setting('method', method)} takes no {setting('step')}. Omit it")
    if memory is not None and method in _STEP:
        raise EstimationError(
            f"{setting('method', method)} forgets by its {setting('step')} and takes no {setting('memory')}. Omit it"
        )
    size = _STEP.get(method, 0.0) if step is None else step
    make: dict[str, Callable[[tuple[str, ...]], RecursiveEstimator]] = {
        "lms": partial(Lms, step=size),
        "nlms": partial(Nlms, step=size, small=_SMALL),
        "rls": partial(RecursiveLeastSquares, memory=memory),
    }
    return RecursiveArx(na, nb, nk, offset=True, estimator=make[method])


def _bias(method: str, data: IOData, estimator: object) -> tuple[str, ...]:
    """Return what is doubtful before the first sample: bias under feedback, above all."""
    if method in ("rls", "lms", "nlms") and not data.open_loop:
        return (
            f"{method} is biased by feedback and by coloured noise. Use armax, or give "
            f"{setting('open_loop', True)} if there is no feedback",
        )
    return tuple(w for w in getattr(estimator, "warnings", ()) if "first window" not in w)


def _joint(
    method: str,
    record: Source,
    rig: Rig | None,
    start: Estimate | str | Path | float | None,
    memory: Memory,
    part: Reading,
) -> _Run:
    """Physical parameters in one filter with the plant's states; with a memory they walk as much as they are unsure."""
    source = rows_of(record, rig, **part)
    begin = start_of(source, rig or default_rig(), start=start, rig_speaks=rig is not None)
    estimate, rate, plant = begin.estimate, source.replay.rate_hz, model(begin.estimate.model)
    free = estimate.covariance_names
    sd = dict(zip(free, np.sqrt(np.diag(estimate.covariance)).tolist(), strict=True))
    rates = {} if isinstance(memory, str) else {name: sd[name] / np.sqrt(memory) for name in free}
    joint = (JointEkf if method == "ekf" else JointUkf).from_estimate(estimate, rate, rates=rates)
    units = {p.name: p.unit for p in plant.parameters}
    offsets = {f"{name}_offset": "N" if name == "force" else "V" for name in plant.disturbances}
    bench, first = source.record, begin.first
    return _Run(
        estimator=joint, rate_hz=rate, t0=source.t0 + first / rate, scale=np.ones(len(joint.names)), model=plant.name,
        inputs=np.column_stack([bench[x].values for x in plant.inputs])[first:],
        outputs=np.column_stack([bench[x].values for x in plant.outputs])[first:],
        units={k: units.get(k) or offsets[k] for k in joint.names},
        origin={**source.origin, "samples": bench.n_samples - first},
        start={k: TrackedValue(value=estimate.values[k], sd=sd[k]) for k in free}, said=begin.said,
    )  # fmt: skip


def _follow(run: _Run, method: str, how: Following) -> Track:
    """Feed the estimator with one reporting interval after the other."""
    every = max(1, round(how.every_s * run.rate_hz))
    header = TrackHeader(
        rate_hz=run.rate_hz, limit=how.limit, method=method, model=run.model, units=run.units,
        every_s=every / run.rate_hz, start=run.start, record=run.origin, **run.said,
    )  # fmt: skip
    parts = (slice(first, first + every) for first in range(0, run.outputs.shape[0], every))
    track = tell(header, (_line(run, part) for part in parts), how)
    return replace(track, totals=replace(track.totals, samples=run.estimator.n_used))


def _line(run: _Run, part: slice) -> TrackLine:
    """Take in one interval and say what the estimator makes of it."""
    estimator, before = run.estimator, run.estimator.n_rejected
    errors = estimator.update(run.inputs[part], run.outputs[part])
    t = run.t0 + min(part.stop, run.outputs.shape[0]) / run.rate_hz
    sd = np.sqrt(np.diag(estimator.covariance)) * run.scale
    informed = np.isfinite(errors).any()
    started = getattr(estimator, "started", True)
    events: tuple[Event, ...] = ()
    rejected = estimator.n_rejected - before
    if rejected:
        why = f"{rejected} samples not used: not finite, far beyond the noise, or too early for the model's lags"
        events = (Event(kind="rejected", t=t, why=why, samples=rejected),)
    return TrackLine(
        t=t,
        parameters={
            name: TrackedValue(
                value=float(value) if started else np.nan, sd=float(s) if started else np.nan, stale=not informed
            )
            for name, value, s in zip(estimator.names, estimator.estimate * run.scale, sd, strict=True)
        },
        error=_error(estimator, errors),
        state="tracking" if informed else "frozen",
        events=events,
    )


def _error(estimator: RecursiveEstimator, errors: Array) -> float:
    """Return the rms of the errors over what the estimator expects of them, NaN where it predicted nothing."""
    if isinstance(estimator, JointEkf | JointUkf):
        return estimator.error
    inner: Any = getattr(estimator, "_estimator", estimator)
    noise, squares = float(inner.noise_variance), errors[np.isfinite(errors)] ** 2
    return float(np.sqrt(squares.mean() / noise)) if squares.size and noise > 0.0 else float("nan")
