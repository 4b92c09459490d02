"""How far the magnet's curvature moves a linear estimate from its numbers at the operating point.

Beyond the tangent, f - k_i i + k_x x and λ - L i - k_i x are to the linear model a disturbance w = (of the force, less
the slope of that of the flux). It reaches the prediction error as v = C (q - A + K C)⁻¹ E w and moves the estimate by
-(JᵀJ)⁻¹ Jᵀ v, J the slopes of the weighted errors: the best linear approximation (Pintelon and Schoukens 2012, ch. 3)
through the predictor, theory.md sec. 11.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.closed import Plant
from ambid.control.drawn import Law, laws_of, magnet_check
from ambid.control.experiment import MOST, Lines, Task
from ambid.control.information import Information
from ambid.estimation.estimate import Check
from ambid.estimation.likelihood import Fit, products, run, weight_of, workspace_near
from ambid.estimation.predictor import assemble
from ambid.estimation.result import NORMAL_95
from ambid.physics.linear_model import discretise
from ambid.rig import Rig
from ambid.settings.caller import setting

# An interval that holds the shift is good enough up to so many sd of it (beyond, what is of higher degree moves numbers
# too), as long as half of it is no more than this part of the number.
_HELD, _WIDE = 3.0, 0.01
_TOLD = 0.25  # sd of the part of the curvature that a record shows, up to which the record is believed and not the law
_UNTOLD = 0.5  # sd from which it does not tell whether the law is there at all
_STEP = 1e-30  # of complex differences, which lose no digits


def beyond_tangent(law: Law, moved: Array, rate_hz: float) -> Array:
    """Return what the magnet does beyond its tangent to the next sample, (n - 1, 2), force in N and voltage in V;
    `moved` (n, 2): position and current from rest, SI.
    """
    x, i = moved.T
    (x0, i0), w, (k_x, k_i, L) = law.rest, law.energy, law.numbers(*law.rest)
    slope: Any = (w.value(x0 + x + 1j * _STEP, i0 + i), w.value(x0 + x, i0 + i + 1j * _STEP))  # of the co-energy
    force, flux = slope[0].imag / _STEP + k_x * x - k_i * i, slope[1].imag / _STEP - L * i - k_i * x
    return np.column_stack([0.5 * (force[1:] + force[:-1]), -np.diff(flux) * rate_hz])


def expected_shift(task: Task, lines: Lines, c: Complex, information: Information, law: Law) -> Array:
    """Return the shift (n,), in standard deviations, of what is estimated from an excitation, by its lines'
    `information`.
    """
    plant = task.loops[0].plant
    waves = task.limited(lines, [0]).waves(c)[:, :2]
    w = beyond_tangent(law, np.vstack([waves, waves[:1]]), task.rate_hz)
    spectrum = np.fft.rfft(w, axis=0)[lines] / (0.5 * task.period)
    omega = 2.0 * np.pi * task.frequency_hz(lines)
    d, _ = discretise(plant.space, 1.0 / task.rate_hz)
    z = np.exp(1j * omega / task.rate_hz)[:, None, None]
    y = d.C @ np.linalg.solve(z * np.eye(d.A.shape[0]) - d.A, d.E @ spectrum[:, :, None])
    sampled, driven = plant.sampled(task.frequency_hz(lines)), task.driven(lines, 0) * c[:, None]
    whiten = task.noise(plant).whiten(plant, omega)
    rows = whiten @ plant.slopes(sampled, driven) * information.sizes
    pull = 0.5 * task.samples * np.real(np.sum(rows.conj() * (whiten @ y), axis=(0, 1)))
    covariance = np.linalg.inv(information.total(np.abs(c) ** 2, task.samples)[0])
    return np.asarray(covariance @ pull / np.sqrt(np.diag(covariance)))


def seen_shift(fit: Fit, e: Array, law: Law) -> tuple[Array, float, float]:
    """Return each physical parameter's shift, SI, the part of the law that the record shows, and its sd. `e` (n_used,
    2): innovations at the fit, scaled; motion is the predictor's, which does not know its sample's noise: no bias from
    that.
    """
    problem, weight = fit.problem, weight_of(fit.covariance)
    at = assemble(problem, fit.vector, with_derivatives=False)
    assert at is not None
    sc = problem.scales
    w = beyond_tangent(law, problem.y[problem.skip :] - e * sc.output, problem.rate_hz)
    F, E, size = at.A - at.gain @ at.C, at.E[:, : w.shape[1]], sc.disturbance[: w.shape[1]]  # the others drive noise
    v = run(np.hstack([F, E]), w / size, np.zeros(len(F))) @ at.C.T @ weight.T
    pulls = products(problem, fit.vector, weight, workspace_near(fit, problem), [(v, (0,))])
    assert pulls is not None
    own, p = range(v.shape[1]), problem.size
    prior = fit.J_prior @ pulls.turn
    along = np.sum([pulls.cross[o, :, o] for o in own], axis=0)
    inverse = np.linalg.pinv(pulls.rows[:p, :p] + prior.T @ prior, rcond=1e-13, hermitian=True)
    step = inverse @ along[:p]
    left = float(np.trace(pulls.inner)) - along[:p] @ step
    pull = along[p] - step @ (pulls.rows[:p, p] + prior.T @ fit.r_prior)
    shift = -(pulls.turn @ step)[: problem.n_physical] * problem.magnitude
    return shift, float(pull / left), float(left**-0.5)


def magnet_checks(fit: Fit, e: Array, rig: Rig, at: Mapping[str, float], sd: Array) -> dict[str, Check]:
    """Check that curvature moves no number by more than its `sd` (n_physical,), SI, or the interval that holds it,
    allows, as far as a law is known, and that what the rig gives of it is that of the estimate.
    `e`: see `seen_shift`. A rig's law counts unless the record contradicts it; with an assumed gap only as far as the
    record shows it, and what that shows beyond the law is of second order in the shift, and no larger one.
    """
    theta = fit.problem.parameters(fit.vector)
    plant = Plant(model=fit.problem.model, theta=theta, delays=np.zeros(1), rate_hz=fit.problem.rate_hz)
    laws, assumed = laws_of(plant, rig, at)
    if not laws:
        return {}
    shift, part, part_sd = seen_shift(fit, e, laws[""])
    if not np.all(np.isfinite([*shift, part, part_sd])):  # a gap that the motion would close
        return {}
    counted = float(np.clip(part, 0.0, 1.0 if laws[""].known else np.inf))
    if part_sd > _TOLD:
        counted = float(laws[""].known and (part > 0.5 or part_sd > _UNTOLD))
    names = fit.problem.estimated
    values = dict(zip(names, (counted * shift / sd).tolist(), strict=True))
    passed, text = judge_shift(
        values, dict(zip(names, (counted * shift).tolist(), strict=True)), theta, in_interval=True
    )
    if not passed:
        text += f" ({assumed[0]}; the record shows {part:.2g} ± {part_sd:.2g} of it)"
        text += (
            f". Record with {advised(values):.2g} of the excitation or less, or identify with "
            f"{setting('identify_nonlinear')}"
        )
    cause = "" if passed else "curvature"
    curved = Check(passed=passed, values={**values, "part": part, "part_sd": part_sd}, detail=text, cause=cause)
    spread = dict(zip(names, np.hypot(sd, counted * shift).tolist(), strict=True))
    agrees = magnet_check(laws, theta, spread)
    return {"curvature": curved} if agrees is None else {"curvature": curved, "magnet_agrees": agrees}


def advised(shift: Mapping[str, float]) -> float:
    """Return the part of the amplitude with which no number moves too far: shift over sd grows with its third power."""
    return float((MOST / max(map(abs, shift.values()))) ** (1.0 / 3.0))


def judge_shift(
    shift: Mapping[str, float], size: Mapping[str, float], theta: Mapping[str, float], *, in_interval: bool
) -> tuple[bool, str]:
    """Return whether shifts in sd are small, or part of intervals that can bear them (`in_interval`: not of a design,
    whose excitation can still be smaller), and what is said of them; `size`: SI.
    """
    worst = sorted(shift, key=lambda name: -abs(shift[name]))
    far = [name for name in worst if abs(shift[name]) > MOST]
    if not far:
        most = f"{worst[0]} by {shift[worst[0]]:+.2f} sd"
        return True, f"over this motion the magnet's curvature moves no number far ({most} at most)"
    half = {n: NORMAL_95 * abs(size[n]) * np.hypot(1.0, 1.0 / shift[n]) for n in far}
    small = in_interval and all(abs(shift[n]) <= _HELD and half[n] <= _WIDE * abs(theta[n]) for n in far)
    listed = ", ".join(f"{n} by {shift[n]:+.1f} sd ({100.0 * size[n] / abs(theta[n]):+.2g} %)" for n in far)
    text = f"over this motion the magnet's curvature moves {listed} from the value at the operating point"
    return small, f"{text}; the intervals hold it" if small else text
