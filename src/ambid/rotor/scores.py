"""What the model of a rotor leaves out, or holds at a wrong value: score tests of the residuals, by cause: z = c⊥ᵀ
r/|c⊥|, size = c⊥ᵀ r/|c⊥|², c⊥ a cause's column outside the Jacobian's space (Rao 1948; Breusch and Pagan 1980).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array, Complex
from ambid.estimation.estimate import Check
from ambid.estimation.linear import directions, triangle_of
from ambid.physics.rotor_model import RotorModel
from ambid.physics.sensor_errors import SensorError, logged_error, position_errors
from ambid.rotor.likelihood import Experiment, Likelihood, Point, sampled

_FAR = 4.5
_OWN = 1e-5  # part of a column outside the Jacobian's space, squared, below which the data do not tell it from J


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """A cause, how sure it is in standard deviations, and what it would have to be."""

    kind: str  # "fixed", "gain", "lag", "cross-talk", "eddy"
    name: str  # of the number, or the channel
    z: float
    size: float  # change of the number, relative gain, lag in s, share, time constant in s
    gain: float  # by how much it would lower the sum of squares


def scores(problem: Likelihood, v: Array) -> list[Score]:
    """Return the causes that the residuals may have, the surest first."""
    rows = problem.rows(v, corrected=True)
    at, model = problem.point(v), problem.unknowns.model
    fixed = [SensorError(kind="fixed", channel=p.name) for p in problem.unknowns.known if p.role == "fixed"]
    causes = [*fixed, *position_errors(model)]
    named = [(e.kind, e.channel) for e in causes] + ([] if "a" in model.extras else [("eddy", "a")])
    columns = [
        np.concatenate([_real(w.whiten, c) for c in _columns(e, model, at, causes)], axis=1)
        for e, w in zip(problem.experiments, problem.weights, strict=True)
    ]
    J, r = np.concatenate([block[:, :-1] for block in rows]), np.concatenate([block[:, -1] for block in rows])
    C = np.concatenate(columns)
    inverse = directions(triangle_of([J])).inverse(1e-9)
    outside = C - J @ (inverse @ (J.T @ C))
    own, whole = np.sum(outside**2, axis=0), np.sum(C**2, axis=0)
    along = outside.T @ r
    spread = np.sqrt(max(1.0, float(r @ r) / r.size))
    found = [
        Score(kind=kind, name=name, z=float(a / np.sqrt(o) / spread), size=float(a / o), gain=float(a * a / o))
        for (kind, name), a, o, w in zip(named, along, own, whole, strict=True)
        if o > _OWN * w and o > 0.0
    ]
    return sorted(found, key=lambda s: -abs(s.z))


def sensor_gain(problem: Likelihood, v: Array) -> float:
    """Return by how much a sensor's gain, lag or cross-talk, or an eddy pole, would lower the sum of squares."""
    return max((s.gain for s in scores(problem, v) if s.kind != "fixed"), default=0.0)


def _columns(e: Experiment, model: RotorModel, at: Point, causes: Sequence[SensorError]) -> Iterator[Complex]:
    """Yield what each cause adds to the outputs, (n_lines, n_y); an eddy pole last, where it is not in the model."""
    of, mean, turned = sampled(e, model, at), e.spectra.mean_u, model.at_speed(e.speed)
    y = of.states(mean) @ of.space.C.T
    omega, outputs = e.spectra.omega, list(model.outputs)
    for cause in causes:
        if cause.kind == "fixed":
            yield of.slopes(mean, [turned.derivative(at.theta, cause.channel)])[:, :, 0]
            continue
        added, k = np.zeros_like(y), outputs.index(cause.channel)
        other = y[:, outputs.index(cause.other)] if cause.other else None
        added[:, k] = logged_error(cause.kind, y[:, k], omega, other)
        yield added
    if "a" not in model.extras:
        rate = np.zeros((y.shape[0], len(model.axes)), dtype=complex)
        for j, axis in enumerate(model.axes):
            role = f"{axis}_current"
            current = y[:, outputs.index(role)] if role in outputs else mean[:, j]
            rate[:, j] = logged_error("lag", at.theta[f"{axis}.k_i"] * current, omega)
        yield (of.disturbed()[:, :, : len(model.axes)] @ rate[:, :, None])[:, :, 0]


def _real(whiten: Complex, c: Complex) -> Array:
    block = (whiten @ c[:, :, None])[:, :, 0].reshape(-1, 1)
    return np.asarray(np.sqrt(2.0) * np.concatenate([block.real, block.imag]))


def agreement_checks(found: Sequence[Score], model: RotorModel) -> dict[str, Check]:
    """Judge what is fixed, and the sensors, by their scores."""
    fixed = [s for s in found if s.kind == "fixed"]
    others = [s for s in found if s.kind != "fixed"]
    units = {p.name: p.unit for p in model.parameters}
    checks: dict[str, Check] = {}
    for name, group, fine in (
        ("fixed_agree", fixed, "the record agrees with the planes and the other fixed numbers"),
        ("sensors_agree", others, "no gain, lag or cross-talk of a sensor and no eddy pole shows in the residuals"),
    ):
        if not group:
            continue
        worst = group[0]
        passed = abs(worst.z) < _FAR
        checks[name] = Check(
            passed=passed, values={"z": worst.z, "size": worst.size},
            detail=fine if passed else _words(worst, units.get(worst.name, "1")),
        )  # fmt: skip
    return checks


def _words(s: Score, unit: str) -> str:
    sure, axis = f"z = {abs(s.z):.3g}", s.name.split("_")[0]
    if s.kind == "fixed":
        shown = f"{1e3 * s.size:+.3g} mm" if unit == "m" else f"{s.size:+.3g} {unit}"
        return f"the record contradicts {s.name}: {shown} would fit better ({sure}). Measure it, or let it be free"
    if s.kind == "gain":
        return f"{s.name} reads {100 * s.size:+.3g} % beside the others ({sure}). Calibrate it, or free {axis}.gain"
    if s.kind == "lag":
        return f"{s.name} lags by {1e6 * s.size:.3g} us ({sure}). Add {axis}.sensor_pole to [parameters]"
    if s.kind == "eddy":
        return (
            f"the positions lag behind the currents by {1e6 * s.size:.3g} us ({sure}). Add to [parameters] an eddy "
            "pole, a, or the poles of the sensors"
        )
    return (
        f"{s.name} holds {100 * s.size:+.3g} % of the other plane ({sure}): cross-talk, or turned. Check its mounting"
    )
