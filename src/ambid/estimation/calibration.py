"""What errors of calibration do to an estimate: scales that a record cannot show, and its intervals with them.

A channel whose gain is wrong, a sampling rate or a plane moves the estimate by d theta/d e for each unit of the error
(`linear_moves`; of a nonlinear bearing `bearing_moves` of its likelihood), and leaves little or nothing in the
residuals. Errors are independent of each other and of the noise:

    variance = variance of the record + Σ (d theta/d e · sd of e)².

A prior of covariance 1/Λ pulls against it: with covariance P of the estimate, d theta/d e is (I - P Λ) times what it
would be without.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeVar, cast

import numpy as np

from ambid.arrays import Array
from ambid.estimation.estimate import EstimatedParameter, Parametric
from ambid.estimation.likelihood import Fit
from ambid.estimation.predictor import assemble
from ambid.estimation.result import interval_95
from ambid.physics.linear_model import LinearModel
from ambid.physics.rotor_model import RotorModel
from ambid.physics.sensor_errors import Lines, SensorError, error_moves
from ambid.rig.rig import Rig

_BANDS, _EDGES = 200, 0.05  # of the spectrum of a record's inputs; part of the record in which it fades in, and out
_DUST = 1e-9
_UNIT, _RULED_OUT = 0.5, 4.0  # error from which a unit is wrong, not a scale; in sds of the rig, from which it is none


E = TypeVar("E", bound=Parametric)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Source:
    """Errors that go together, and their standard deviation where the rig says it."""

    errors: Sequence[SensorError]
    sd: float | None
    whole: float = 1.0  # error of 100 %


def calibrated(
    estimate: E, rig: Rig, plant: LinearModel | RotorModel, theta: Mapping[str, float], names: Sequence[str],
    moves: Callable[[Sequence[SensorError]], Array], *, offsets: Mapping[str, str] | None = None, places: bool = False,
) -> E:  # fmt: skip
    """Return an estimate with its intervals for what its rig says of calibration.

    `theta`: all numbers, SI; `names`: those that were estimated, in the order of what `moves` returns, d theta/d e of
    errors, (n_names, n_errors); `offsets`: of a law that is not linear, the number that is an offset, by channel: where
    it is estimated, it takes up what the offset's error moves; `places`: whether records at several places
    tell the law.
    """
    made, sources, own = cast("Any", estimate), _sources(rig, plant, theta), offsets or {}
    sources |= {
        f"{c.role}.offset": _Source(errors=[SensorError(kind="offset", channel=c.role)], sd=c.offset_sd)
        for c in rig.channels
        if c.offset_sd is not None and c.role in own and own[c.role] not in names
    }
    if places:
        sources["zeros"] = _Source(errors=[SensorError(kind="zero", channel="position")], sd=None)
    errors = list(dict.fromkeys(e for s in sources.values() for e in s.errors))
    try:
        moved = moves(errors)
    except np.linalg.LinAlgError:  # an estimate far from a plant, such as one that did not converge
        return estimate
    lengths = {p.name for p in plant.parameters if p.unit == "m"}
    size = np.array([plant.references(theta)[name] if name in lengths else theta[name] or 1.0 for name in names])
    calibration, variance = dict[str, Mapping[str, float]](), np.zeros(len(names))
    for name, s in sources.items():
        column = np.sum([moved[:, errors.index(e)] for e in s.errors], axis=0)
        variance += (column * (s.sd or 0.0)) ** 2
        share = column * s.whole / size
        calibration[name] = dict(zip(names, np.where(abs(share) < _DUST, 0.0, share).tolist(), strict=True))
    stated = {name: s.sd for name, s in sources.items() if s.sd is not None}
    all_offsets = {f"{c.role}.offset": c.offset_sd for c in rig.channels if c.offset_sd is not None}
    spread = dict(zip(names, np.sqrt(variance).tolist(), strict=True))
    parameters = tuple(_widened(p, spread.get(p.name, 0.0)) if stated else p for p in estimate.parameters)
    return cast(
        "E", replace(made, parameters=parameters, calibration=calibration, calibration_sd={**stated, **all_offsets})
    )


def linear_moves(
    rig: Rig, plant: LinearModel | RotorModel, theta: Mapping[str, float], names: Sequence[str], covariance: Array,
    lines: Sequence[Lines], errors: Sequence[SensorError], *, weight: tuple[Array, Array] | None = None,
) -> Array:  # fmt: skip
    """Return d theta/d e of a linear model, (n_names, n_errors), SI.

    `covariance`: what records and priors give, of the first of `names` on which there may be priors; `lines`: what the
    records show; `weight`: gain and slope of k_i/m over what the weight asks for, by which it moved the estimate.
    """
    references, n = plant.references(theta), len(covariance)
    moved = error_moves(plant, theta, errors, free=names, lines=lines)
    moved *= np.array([theta[name] or references.get(name, 1.0) for name in names])[:, None]
    weights = {p.name: p.sd**-2 for p in rig.parameters if p.role == "prior" and p.sd}
    moved[:n] -= covariance @ (np.array([weights.get(name, 0.0) for name in names[:n]])[:, None] * moved[:n])
    if weight is not None:
        gain, slope = weight
        by_weight = np.array([-float(e == SensorError(kind="gain", channel="current")) for e in errors])
        moved += np.outer(gain, by_weight - slope @ moved)
    return moved


def left_out(rig: Rig) -> tuple[str, ...]:
    """Return a warning of a result whose intervals hold nothing of the calibration that its rig states."""
    stated = [f"channels.{c.role}.gain_sd" for c in rig.channels if c.gain_sd is not None]
    stated += ["record.rate_sd"] if rig.record.rate_sd is not None else []
    if not stated:
        return ()
    return (f"no interval holds {', '.join(stated)} of the rig: they are of noise alone. 'ambid identify' holds both",)


def moved_by_sd(estimate: Any, names: Sequence[str]) -> dict[str, Array]:
    """Return by what one standard deviation of each error that the rig states moves numbers, SI, as `calibrated` counts
    it; none of an estimate that knows no calibration.
    """
    sds, shares = getattr(estimate, "calibration_sd", {}), getattr(estimate, "calibration", {})
    plant, size, planes = getattr(estimate, "plant", None), {n: estimate[n].value or 1.0 for n in names}, 1.0
    known = {"rate"}
    if isinstance(plant, RotorModel):  # lengths and planes count against the span
        lengths, references = {p.name for p in plant.parameters if p.unit == "m"}, plant.references(estimate.numbers)
        size |= {n: references[n] for n in lengths.intersection(names)}
        known, planes = known.union(plant.inputs, plant.outputs), plant.span(estimate.numbers)
    return {
        channel: np.array([shares[channel].get(n, 0.0) * size[n] for n in names]) * sds[channel]
        / (1.0 if channel in known else planes)
        for channel in sds.keys() & shares.keys()
    }  # fmt: skip


def explaining(
    rig: Rig, plant: LinearModel, theta: Mapping[str, float], names: Sequence[str], covariance: Array,
    lines: Sequence[Lines], slope: Array, far: float, *, own: Mapping[str, float] | None = None,
) -> dict[str, tuple[float, Array]]:  # fmt: skip
    """Return the errors of gains or of the rate that explain alone why slopeᵀ θ is too large by `far`, relative, and
    what they have moved `names` by, SI; none that the rig rules out, or that is large enough for a wrong unit.

    `covariance` (n, n): of the first of `names`, on which there may be priors; `own`: what an error of one does to what
    slopeᵀ θ is compared with, by channel.
    """
    out = dict[str, tuple[float, Array]]()
    sources = {name: s for name, s in _sources(rig, plant, theta).items() if s.errors[0].kind == "gain"}
    try:
        moved = linear_moves(rig, plant, theta, names, covariance, lines, [s.errors[0] for s in sources.values()])
    except np.linalg.LinAlgError:
        return out
    for (name, s), column in zip(sources.items(), moved.T, strict=True):
        whole = s.whole * column
        along = float(slope @ whole) - (own or {}).get(name, 0.0)
        size = far / along if abs(along) > _DUST else np.inf
        if abs(size) < min(_UNIT, np.inf if s.sd is None else _RULED_OUT * s.sd):
            out[name] = size, size * whole
    return out


def _sources(rig: Rig, plant: LinearModel | RotorModel, theta: Mapping[str, float]) -> dict[str, _Source]:
    """Return what may be wrong of a bench: gains of inputs and outputs, the rate, values and planes that are fixed."""
    sources = {
        c.role: _Source(errors=[SensorError(kind="gain", channel=c.role)], sd=c.gain_sd)
        for c in rig.channels
        if c.role in (*plant.inputs, *plant.outputs)
    }
    # a rate that is too high makes times too short
    sources["rate"] = _Source(errors=[SensorError(kind="gain", channel="time")], sd=rig.record.rate_sd, whole=-1.0)
    if not isinstance(plant, RotorModel):
        known = rig.parameters if rig.magnet is None else (*rig.parameters, *rig.magnet.parameters)
        return sources | {
            p.name: _Source(errors=[SensorError(kind="fixed", channel=p.name)], sd=None, whole=theta[p.name])
            for p in known
            if p.role == "fixed" and p.value and p.name in theta
        }
    fixed, span = {p.name for p in rig.parameters if p.role == "fixed"}, plant.span(theta)
    for b in (b for b in plant.bearings if not b.axial):
        read = [b.sensor_parameter(k) for k in range(len(b.z_sensors))]
        planes = {f"{b.name}.z": [f"{b.name}.z", *read], f"{b.name}.z_magnet": [f"{b.name}.z"]}
        for name, places in {**planes, **{place: [place] for place in read}}.items():
            if fixed.issuperset(places):
                errors = [SensorError(kind="fixed", channel=place) for place in places]
                sd = rig.plane_sd.get(f"{name.rstrip('0123456789')}_sd")
                sources[name] = _Source(errors=errors, sd=sd, whole=span)
    return sources


def _widened(p: EstimatedParameter, spread: float) -> EstimatedParameter:
    sd = float(np.hypot(p.sd, spread))
    return replace(p, sd_calibrated=sd, ci95_calibrated=interval_95(p.value, sd))


def lines_of(fit: Fit) -> Lines:
    """Return what the record of a fit shows: the spectrum of its inputs in bands, and the whitening of its predictor.

    With gain K and innovations of covariance S, residuals of the outputs become white as S^(-1/2) H^-1 e with
    H^-1 = I - C (z I - A + K C)^-1 K.
    """
    problem = fit.problem
    n = len(problem.u)
    fade = np.minimum(np.minimum(np.arange(n), np.arange(n)[::-1]) / (_EDGES * n), 1.0)  # Tukey's window
    spectrum = np.fft.rfft(problem.u * np.sin(0.5 * np.pi * fade)[:, None] ** 2, axis=0)[1:]
    edges = np.unique(np.geomspace(1, len(spectrum), _BANDS + 1).astype(int) - 1)
    bands = [slice(a, b) for a, b in pairwise(edges)]
    power = np.array([spectrum[band].T @ spectrum[band].conj() for band in bands])
    values, axes = np.linalg.eigh(power)
    middle = 0.5 * (edges[:-1] + edges[1:] - 1) + 1
    omega = 2.0 * np.pi * middle * problem.rate_hz / n
    predictor = assemble(problem, fit.vector, with_derivatives=False)
    if predictor is None:
        raise ValueError("the fit has no predictor; it has failed")
    A, C, K = predictor.A, predictor.C, predictor.gain
    z = np.exp(1j * omega * problem.stride / problem.rate_hz)[:, None, None]
    inverse = np.eye(len(C)) - C @ np.linalg.solve(z * np.eye(len(A)) - A + K @ C, K.astype(complex))
    root = np.linalg.inv(np.linalg.cholesky(fit.covariance))
    return Lines(
        plant=problem.model, omega=omega, excitation=axes * np.sqrt(np.maximum(values, 0.0))[:, None, :],
        whiten=np.asarray(root @ inverse / problem.scales.output, dtype=np.complex128),
    )  # fmt: skip
