"""The loop of a record as it is: plant of an estimate, controller of the record or of the rig, measured sensitivity."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.closed import ClosedLoop, MeasuredSensitivity, Plant, measured_locally, measured_sensitivity
from ambid.control.controller import Controller, controller_of_loop, identify_controller
from ambid.control.margins import MISFIT, sensitivity_by_axis
from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate, plain_json
from ambid.physics.linear_model import LinearModel, model
from ambid.record import Record
from ambid.rig import Rig
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.spectra import Between, PeriodSpectra, find_excitation, period_spectra, references_of
from ambid.simulation.plant import closed_loop_poles, fed_back
from ambid.simulation.rotor_bench import kind_of

_NO_FEEDBACK = 1e-4  # share of an input below which nothing is fed back
_IMPLIED = 0.03  # part of its largest line below which an excitation that follows from [loop] is rounding
_POWER = 1e-4  # of the largest line, from which a reference that is not periodic excites
_MOST_LINES = 3000

Numbers = Estimate | RotorEstimate


def loop_of(
    estimate: Numbers, rig: Rig, rate_hz: float, spectra: PeriodSpectra | None, speed: float = 0.0
) -> ClosedLoop:
    """Return an estimate's closed loop, at a rotor's speed in rad/s, its controller by the record's `spectra`;
    EstimationError where nothing says what that is.
    """
    plant = plant_of(estimate, rate_hz, speed)
    return ClosedLoop.of(plant, controller_of(plant, rig, spectra))


def loop_and_peaks(
    estimate: Numbers, rig: Rig, bench: Record, spectra: PeriodSpectra | None, speed: float = 0.0
) -> tuple[ClosedLoop | None, Mapping[str, Any], tuple[str, ...]]:
    """Return a record's closed loop, sensitivity peaks, warnings; None: controller unknown. `spectra`: if there
    already.
    """
    of = estimate.plant if isinstance(estimate, RotorEstimate) else model(estimate.model)
    if not any(role in bench for role in references_of(of)) and (rig.loop is None or rig.open_loop):
        return None, {}, ()
    seen = spectra_of(bench, of, speed) if spectra is None else spectra
    try:
        loop = loop_of(estimate, rig, bench.rate_hz, seen, speed)
        refuse_unstable(loop, rig)
    except EstimationError as error:
        return None, {}, (f"no sensitivity: {error}",) if seen is not None and seen.R is not None else ()
    return loop, plain_json(sensitivity_by_axis(loop, measure(loop, bench, seen))), ()


def refuse_unstable(loop: ClosedLoop, rig: Rig) -> None:
    """Refuse a [loop] that would not hold the estimated plant: it is not the one of the record."""
    if loop.controller.source != "rig":
        return
    assert rig.loop is not None
    plant = loop.plant
    late = replace(rig.loop, delay=float(np.max(plant.delays)))
    pole = float(np.abs(closed_loop_poles(plant.theta, late, plant.rate_hz, of=plant.model)[0]))
    if pole > 1.0 + 1e-6:
        raise EstimationError(
            f"the rig's [loop] does not hold the estimated plant (largest pole {pole:.5g}), but the loop of a "
            "levitated rotor does: it is another controller. Correct [loop], or log the excitation as reference"
        )


def plant_of(estimate: Numbers, rate_hz: float, speed: float = 0.0) -> Plant:
    """Return the plant of an estimate, of a rotor at a speed in rad/s."""
    if isinstance(estimate, RotorEstimate):
        of: LinearModel = estimate.plant.at_speed(speed)
        theta: Mapping[str, float] = estimate.numbers
        missing = [p.name for p in of.parameters if p.name not in theta]
        if missing:
            raise EstimationError(
                f"the estimate does not know {', '.join(missing)}, and the rotor turns in this record. Identify it "
                "with a record at speed too"
            )
    else:
        of, theta = model(estimate.model), estimate.values
    if "position" not in {kind_of(role) for role in of.outputs}:
        raise EstimationError(
            f"model {of.name!r} has no position: there is no position loop, and no margin of it. Use model 'one-axis'"
        )
    names, covariance = estimate.covariance_names, estimate.covariance
    if isinstance(estimate, RotorEstimate):  # a rotor at rest has no gyroscopic terms
        own = {p.name for p in of.parameters}
        names = tuple(n for n in names if n in own or n.endswith(".delay"))
        covariance = estimate.covariance_of(names)
    return Plant.of(of, theta, estimate.delay, rate_hz, names, covariance)


def controller_of(plant: Plant, rig: Rig, spectra: PeriodSpectra | None) -> Controller:
    """Return the controller: of the record, else of the rig; EstimationError without either. One that misses more than
    `MISFIT` of the inputs is not taken: with noise in between, the coil's own equation fits as well.
    """
    missed: float | None = None
    if spectra is not None and spectra.R is not None:
        own = [[k for k in pair if k >= 0] for pair in fed_back(plant.model)]
        found = identify_controller(
            spectra.frequency_hz, spectra.mean_u, spectra.mean_y, spectra.R, rate_hz=spectra.rate_hz, own=own
        )
        back = np.einsum("kuy,ky->ku", found.response(spectra.frequency_hz)[0], spectra.mean_y)
        if np.max(np.abs(back)) < _NO_FEEDBACK * np.max(np.abs(spectra.mean_u)):
            raise EstimationError(
                "the inputs of the record follow its references alone: no loop is closed, and none has margins. Record "
                "the levitated rotor"
            )
        if found.misfit <= MISFIT:
            return found
        missed = found.misfit
    if rig.loop is not None and rig.loop.closed and not rig.open_loop:
        return controller_of_loop(rig.loop, plant.model, plant.rate_hz)
    if rig.open_loop:
        raise EstimationError(
            "the rig declares its records open_loop: no loop is closed, and none has margins. Record the levitated "
            "rotor"
        )
    if missed is not None:
        raise EstimationError(
            f"a linear controller misses {missed:.2g} of the inputs of the record, and what it seems to be may be far "
            "off: it computes with other signals than those that are logged, or inputs are limited. Log what it "
            "computes with, or give [loop] in the rig"
        )
    raise EstimationError(
        "neither a reference in the record nor [loop] in the rig says what the controller is. Log the excitation as "
        "reference, or give [loop]"
    )


def spectra_of(bench: Record, of: LinearModel, speed: float = 0.0) -> PeriodSpectra | None:
    """Return spectra at the excited lines, None where these are unknown; a record that is not periodic is one period,
    as the controller's law holds for any stretch.
    """
    found = find_excitation(bench, of)
    if found is not None:
        try:
            return period_spectra(bench, of, found, speed)
        except EstimationError:
            pass
    roles = [role for role in references_of(of) if role in bench]
    if not any(np.ptp(bench[role].values) > 0.0 for role in roles):
        return None

    def spectrum(names: tuple[str, ...]) -> Complex:
        x = np.column_stack([bench[n].values if n in bench else np.zeros(bench.n_samples) for n in names])
        return np.asarray(np.fft.rfft(x - x.mean(axis=0), axis=0) / bench.n_samples)

    R, U, Y = (spectrum(tuple(names)) for names in (references_of(of), of.inputs, of.outputs))
    power = np.sum(np.abs(R) ** 2, axis=1)
    lines = np.flatnonzero(power > _POWER * np.max(power))
    lines = lines[(lines > 0) & (lines < (bench.n_samples + 1) // 2)]
    lines = lines[:: max(1, -(-lines.size // _MOST_LINES))]
    frequency: Array = np.asarray(lines * (bench.rate_hz / bench.n_samples), dtype=np.float64)
    return PeriodSpectra(
        frequency_hz=frequency, U=U[None, lines], Y=Y[None, lines], R=R[lines],
        rate_hz=bench.rate_hz, period=bench.n_samples, dropped=0,
        between=Between(frequency_hz=np.empty(0), U=U[:0], Y=Y[:0]),
    )  # fmt: skip


def measure(
    loop: ClosedLoop, bench: Record | None, spectra: PeriodSpectra | None
) -> tuple[MeasuredSensitivity | None, ...]:
    """Return the measured sensitivity by axis; for a rig's controller, excitation is what inputs hold beside its
    answer.
    """
    none = (None,) * len(loop.plant.axes)
    if spectra is None:
        return none
    at = loop.at(spectra.frequency_hz)
    if spectra.R is None or loop.controller.source == "rig":
        implied = spectra.mean_u + np.einsum("kuy,ky->ku", at.K, spectra.mean_y)
        return measured_sensitivity(replace(spectra, R=implied), at, silent=_IMPLIED)
    if spectra.n_periods > 1:
        return measured_sensitivity(spectra, at)
    if bench is None:
        return none
    from ambid.signals.frf import frequency_response

    r, x = (
        np.column_stack([bench[role].values for role in roles])
        for roles in (references_of(loop.plant.model), [loop.plant.model.outputs[k] for k in at.positions])
    )
    try:
        found = frequency_response(r, x, bench.rate_hz, method="local", open_loop=True)
    except EstimationError:  # some frequencies are not excited: the model alone says the sensitivity
        return none
    found = found.between(float(spectra.frequency_hz[0]), float(spectra.frequency_hz[-1]))
    return measured_locally(found, loop.at(found.frequency_hz))
