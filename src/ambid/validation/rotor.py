"""What speaks for and against an estimate of a rotor: the innovations of its predictor, and its numbers.

A sign that both sensors of a plane share, or a wrong unit, fits fully: only numbers tell. A force factor is positive
where sensor, current and voltage count in one direction; each axis has a bench's sizes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.bearing.multistart import Signals
from ambid.bearing.sizes import check_units
from ambid.bearing.uncertainty import noise_levels, scatter
from ambid.estimation.colours import colours_of
from ambid.estimation.estimate import Check, OutputFit
from ambid.estimation.likelihood import Fit, innovations
from ambid.estimation.linear import directions
from ambid.estimation.predictor import assemble
from ambid.estimation.uncertainty import chi_squared_tail
from ambid.physics.linear_model import Parameter, model
from ambid.physics.rotor_model import RotorModel
from ambid.record import Record
from ambid.rotor.conclusion import FOLD, Evidence, numbers_of, shifts_of
from ambid.rotor.prediction import PredictorFit, predictor_scores, searched_of
from ambid.rotor.scores import agreement_checks, suspects
from ambid.rotor.spectra import beside_harmonics
from ambid.validation.physical import by_bands, innovation_products, innovation_tests
from ambid.validation.residuals import consistent_check, fit_of, uncorrelated_check, white_check


def of_predictor(found: PredictorFit) -> Evidence:
    """Return the evidence of innovations: score tests of whiteness and against past inputs, one-step fit, levels."""
    fit, problem = found.fit, found.fit.problem
    e = innovations(problem, fit.vector, fit.work)
    if e is None:
        raise ValueError("the fit has no predictor; it has failed")
    sums = innovation_products(fit, e)
    white, past = innovation_tests(fit, sums)
    e = e * problem.scales.output
    share, size = fit_of(e, problem.y[problem.skip :]), np.sqrt(np.mean(e**2, axis=0))
    causes = predictor_scores(found)
    checks = {"residuals_white": _told(white_check(white), fit), "residuals_uncorrelated": uncorrelated_check(past)}
    shifts, robust = shifts_of(found, causes), _robust(found, sums.scores)
    own = np.diag(numbers_of(found).covariance)
    checks["uncertainty_consistent"] = consistent_check(float(np.sqrt(np.max(robust / own))))
    if not all(c.passed for c in checks.values()):
        shifts += [np.diag(np.sqrt(np.maximum(robust - own, 0.0))), _by_bands(found)]
        checks = {
            name: c if c.passed else replace(c, detail=f"{c.detail}; the intervals hold how far its parts disagree")
            for name, c in checks.items()
        }
    return Evidence(
        method="predictor",
        noise=_noise(fit),
        fit={
            role: OutputFit(one_step=float(a), simulation=None, innovation_sd=float(b))
            for role, a, b in zip(found.model.outputs, share, size, strict=True)
        },
        shifts=shifts,
        checks={
            **checks,
            **_asked(agreement_checks(causes, found.model)),
            **({} if suspects(causes) else _line_check(e, found, problem.rate_hz)),
        },
    )


def _robust(found: PredictorFit, scores: Array) -> Array:
    """Return the variance of each number by the scatter of stretches of the record."""
    fit, (_, chain) = found.fit, found.unknowns.estimated(found.vector)
    whole = directions(np.vstack([fit.J, fit.J_prior])).inverse()[: chain.shape[1]]
    return np.asarray(np.sum((chain @ whole @ scatter(scores).T) ** 2, axis=1))


def _by_bands(found: PredictorFit) -> Array:
    """Return how far each number moves without bands of the record, (n_bands, n_numbers)."""
    moves, (_, chain) = by_bands(found.fit), found.unknowns.estimated(found.vector)
    return np.asarray(np.clip(moves, -FOLD, FOLD) @ chain[:, : moves.shape[1]].T)


def _told(check: Check, fit: Fit) -> Check:
    """Return a check of noise that says what colour it has in the model."""
    poles = {c.source.rpartition("_")[2].rstrip("0123456789"): c.frequency_hz for c in colours_of(fit.problem)}
    words = " and ".join(f"noise of each {kind} has a low-pass part of {pole:.3g} Hz" for kind, pole in poles.items())
    return replace(check, detail=f"{check.detail}; {words}") if words else check


def _noise(fit: Fit) -> dict[str, float]:
    """Return the rms of every source, SI: of its white part and its low-pass ones."""
    problem, plain = fit.problem, searched_of(fit)
    predictor = assemble(problem, fit.vector, with_derivatives=False)
    assert predictor is not None
    disturbance, sensor = noise_levels(fit, predictor)
    rms = {**sensor, **disturbance}
    square = {name: rms[name] ** 2 for name in (*plain.outputs, *plain.disturbances)}
    driving = problem.model.disturbances[len(plain.disturbances) :]
    for colour, name in zip(colours_of(problem), driving, strict=True):  # held noise through a low pass
        square[colour.source] += rms[name] ** 2 * np.tanh(0.5 * colour.omega / problem.rate_hz)
    return {name: float(np.sqrt(x)) for name, x in square.items()}


def _asked(checks: dict[str, Check]) -> dict[str, Check]:
    """Return checks of which none that passed says more than was asked of innovations."""
    fine = checks.get("sensors_agree")
    if fine is None or not fine.passed:
        return checks
    text = (
        "no gain, lag or cross-talk of a channel shows in the innovations, which were not asked of eddy currents or of "
        "curvature of the magnets"
    )
    return {**checks, "sensors_agree": replace(fine, detail=text)}


_CHANCE = 1e-6  # probability below which a line counts as seen
_NEAR, _NARROW = 12, 0.8  # frequencies on either side, and what part of their power is of a line


def _line_check(e: Array, found: PredictorFit, rate_hz: float) -> dict[str, Check]:
    """Name the line of which innovations hold most, if there is one: power at a single frequency, over the median. Not
    at harmonics of the speed: what was taken out of inputs and outputs there differs by how each began.
    """
    n, n_y = e.shape
    power = np.abs(np.fft.rfft(e * np.hanning(n)[:, None], axis=0)[3 : n // 2]) ** 2
    power /= np.median(power, axis=0) / np.log(2.0)  # of an exponential
    frequencies = rate_hz / n * np.arange(3, n // 2)
    power[beside_harmonics(frequencies, found.speeds[0] / (2.0 * np.pi), 2.0 * rate_hz / n)] = 1.0
    whole = power.sum(axis=1)
    j = int(np.argmax(whole))
    over = whole[max(j - _NEAR, 0) : j + _NEAR + 1] - n_y
    narrow = float(np.sum(whole[max(j - 1, 0) : j + 2] - n_y)) > _NARROW * float(over.sum())
    if not narrow or whole.size * chi_squared_tail(2 * n_y, 2.0 * float(whole[j])) > _CHANCE:
        return {}
    frequency, channel = float(frequencies[j]), found.model.outputs[int(np.argmax(power[j]))]
    # a predictor of coloured noise takes part of a line to other channels
    most = "" if colours_of(found.fit.problem) else f", most in {channel}"
    check = Check(
        passed=False, cause="line", size=frequency, alternatives=("mode",),
        detail=f"a line at {frequency:.4g} Hz stands in the innovations{most}: hum, motion of the base, a "
        "tone, or a bending mode that the model lacks. Look for it with the excitation off",
    )  # fmt: skip
    return {"lines": check}


_LONGEST = 30.0  # m between planes: shafts of turbine sets
_SURE = 3.0  # standard deviations from which a sign is known


def plausible_checks(
    plant: RotorModel,
    numbers: Mapping[str, float],
    sd: Mapping[str, float],
    parameters: Sequence[Parameter],
    bench: Record,
) -> dict[str, Check]:
    """Judge signs and sizes of an estimate in SI; `sd`: of its numbers, `parameters`: what the rig says."""
    signs = _signs(plant, numbers, sd, parameters)
    units = _lengths(plant, numbers) or _units(plant, numbers, bench)
    return {
        "signs": Check(passed=not signs, detail=signs or "every force pulls the way that its sensor counts"),
        "units": Check(passed=not units, detail=units or "all sizes are typical of magnetic bearings"),
    }


def _signs(
    plant: RotorModel, numbers: Mapping[str, float], sd: Mapping[str, float], parameters: Sequence[Parameter]
) -> str:
    """Name the axes whose force factor is negative though the rig does not say so."""
    negative = {p.name for p in parameters if p.role != "free" and (p.value or 0.0) < 0.0}
    wrong = [
        axis
        for axis in plant.axes
        if (name := f"{axis}.k_i") not in negative and numbers[name] < -_SURE * sd.get(name, 0.0)
    ]
    if not wrong:
        return ""
    columns = "position, or voltage and current" if plant.coils else "position or current"
    return (
        f"k_i of {', '.join(wrong)} is negative: a column there has its sign reversed ({columns}). Give it gain = -1 "
        "in [channels], or k_i a negative prior if it counts that way"
    )


def _lengths(plant: RotorModel, numbers: Mapping[str, float]) -> str:
    planes = {p: numbers[p] for p in plant.places if p in numbers}
    reach = float(np.ptp(list(planes.values()))) if planes else 0.0
    if reach <= _LONGEST:
        return ""
    return f"the planes are {reach:.3g} m apart (usually up to {_LONGEST:g} m). Check their units in [bearings]"


def _units(plant: RotorModel, numbers: Mapping[str, float], bench: Record) -> str:
    """Say which size of an axis with a coil is none of a bench, and the slip of a unit that would explain it."""
    one = model("one-axis")
    for j in plant.coils:
        axis = plant.axes[j]
        roles = {role: f"{axis}_{role}" for role in (*one.inputs, *one.outputs)}
        if any(role not in bench for role in roles.values()):
            continue
        u, y = (np.column_stack([bench[roles[r]].values for r in part]) for part in (one.inputs, one.outputs))
        own = {q: numbers[f"{axis}.{q}"] for q in ("k_i", "k_x", "R", "L")}
        signals = Signals(u=u, y=y, rate_hz=bench.rate_hz)
        check = check_units({**own, "m": numbers["m"]}, (), signals, one)
        if not check.passed:
            return f"axis {axis}: {check.detail.replace('channels.', f'channels.{axis}_')}"
    return ""
