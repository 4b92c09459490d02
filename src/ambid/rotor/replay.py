"""A rotor's estimate on a record, its own or another: what the model leaves, beside what noise would. Nothing is fitted
but the levels of the noise, from the scatter between periods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check
from ambid.physics.rotor_model import RotorModel
from ambid.rotor.conclusion import line_checks
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.likelihood import Experiment, Point, fit_noise, sampled
from ambid.rotor.response import Sampled


@dataclass(frozen=True, kw_only=True, eq=False)
class RotorReplay:
    """The lines of a record, and an estimate there."""

    estimate: RotorEstimate
    experiment: Experiment

    @cached_property
    def model(self) -> RotorModel:
        """The model at the speed of the record."""
        return at_speed(self.estimate, self.experiment.speed)

    @cached_property
    def sampled(self) -> Sampled:
        """The model at the lines of the record."""
        return sampled(self.experiment, self.model, point_of(self.estimate))

    @cached_property
    def H(self) -> Complex:
        """Response of the model, (n_lines, n_y, n_u)."""
        return self.sampled.transfer()

    @cached_property
    def left(self) -> Complex:
        """What the model leaves of the outputs, mean over the periods, (n_lines, n_y)."""
        spectra = self.experiment.spectra
        return np.asarray(spectra.mean_y - np.einsum("kyu,ku->ky", self.H, spectra.mean_u))

    @cached_property
    def covariance(self) -> Complex:
        """Covariance of `left` by noise alone, (n_lines, n_y, n_y)."""
        spectra = self.experiment.spectra
        between = sampled(self.experiment, self.model, point_of(self.estimate), between=True)
        return np.asarray(fit_noise(spectra.between, between, self.sampled).covariance / spectra.n_periods)

    @cached_property
    def whitened(self) -> tuple[Complex, Array]:
        """`left` over its noise, and the expected square of what the estimate's own error adds, both (n_lines, n_y)."""
        whiten = np.linalg.inv(np.linalg.cholesky(self.covariance))
        moved = whiten @ slopes(self.estimate, self.sampled, self.model, self.experiment.spectra.mean_u)
        added = np.einsum("kyn,nm,kym->ky", moved, self.estimate.covariance, moved.conj(), optimize=True)
        return np.asarray((whiten @ self.left[:, :, None])[:, :, 0]), np.asarray(added.real)


def validation(runs: Sequence[RotorReplay]) -> tuple[dict[str, dict[str, Any]], dict[str, Check]]:
    """Return how much of the excited lines an estimate explains by output, and tests of what it leaves, which allow for
    its own error: C_e + J P Jᴴ, with P its covariance.
    """
    outcomes: dict[str, dict[str, Any]] = {}
    for k, role in enumerate(runs[0].model.outputs):
        left = sum(float(np.sum(np.abs(run.left[:, k]) ** 2)) for run in runs)
        whole = sum(float(np.sum(np.abs(run.experiment.spectra.mean_y[:, k]) ** 2)) for run in runs)
        noise = sum(float(np.sum(np.real(run.covariance[:, k, k]))) for run in runs)
        outcomes[role] = {
            "one_step": 1.0 - float(np.sqrt(left / max(whole, 1e-300))), "simulation": None,
            "innovation_rms": float(np.sqrt(2.0 * left / len(runs))), "over_noise": float(np.sqrt(left / noise)),
        }  # fmt: skip
    parts = [(run.experiment, *run.whitened) for run in runs]
    return outcomes, line_checks(runs[0].model.outputs, parts)


def at_speed(estimate: RotorEstimate, speed: float) -> RotorModel:
    """Return the model of an estimate at a speed in rad/s; EstimationError where it does not know what turns."""
    model = estimate.plant.at_speed(speed)
    unknown = [p.name for p in model.parameters if p.name not in estimate.numbers]
    if unknown:
        raise EstimationError(
            f"the estimate comes from rest and does not hold {', '.join(unknown)}, without which it says nothing at "
            "speed. Identify from a record at speed too"
        )
    return model


def point_of(estimate: RotorEstimate) -> Point:
    """Return numbers and delays of an estimate."""
    late = [estimate.delay[role] for role in estimate.plant.inputs]
    return Point(theta=estimate.numbers, delays=np.array([d.samples + d.fraction for d in late]))


def slopes(estimate: RotorEstimate, response: Sampled, model: RotorModel, U: Complex) -> Complex:
    """Return the derivative of H U by the numbers of the covariance, (n_lines, n_y, n); `U`: (n_lines, n_u)."""
    names_of_model, late = {p.name for p in model.parameters}, [f"{role}.delay" for role in model.inputs]
    names = [name for name in estimate.covariance_names if name in names_of_model]
    rows = response.slopes(U, [model.derivative(estimate.numbers, name) for name in names], len(late))
    at = {name: k for k, name in enumerate([*names, *late])}
    whole = np.zeros((*rows.shape[:2], len(estimate.covariance_names)), dtype=complex)
    for k, name in enumerate(estimate.covariance_names):
        if name in at:
            whole[:, :, k] = rows[:, :, at[name]]
    return whole


def replays(estimate: RotorEstimate, experiments: Sequence[Experiment]) -> tuple[RotorReplay, ...]:
    """Return an estimate on records; EstimationError where a record does not fit it."""
    rate = float(str(estimate.record["rate_hz"]))
    for e in experiments:
        if abs(e.spectra.rate_hz / rate - 1) > 1e-6:
            raise EstimationError(
                f"the record is sampled at {e.spectra.rate_hz:g} Hz, that of the estimate at {rate:g} Hz; the rates "
                "must agree. Resample the record, or identify from it"
            )
        at_speed(estimate, e.speed)
    return tuple(RotorReplay(estimate=estimate, experiment=e) for e in experiments)
