"""What errors of calibration do to an estimate: scales that a record cannot show, and its intervals with them.

A channel whose gain is wrong, a sampling rate or a plane moves the estimate by d theta/d e for each unit of the error
(`ambid.physics.sensor_errors`), and leaves little or nothing in the residuals. Errors are independent of each other and
of the noise:

    variance = variance of the record + Σ (d theta/d e · sd of e)².

A prior of covariance 1/Λ pulls against it: with covariance P of the estimate, d theta/d e is (I - P Λ) times what it
would be without.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array, Complex
from ambid.estimation.estimate import EstimatedParameter
from ambid.estimation.likelihood import Fit
from ambid.estimation.predictor import assemble
from ambid.estimation.result import NORMAL_95
from ambid.physics.linear_model import LinearModel, Parameter
from ambid.physics.rotor_model import RotorModel
from ambid.physics.sensor_errors import SensorError, error_moves
from ambid.rig.rig import Rig

_BANDS = 200  # of the spectrum of a record's inputs
_DUST = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Lines:
    """What a record shows of a plant: rad/s, (n_lines, n_inputs, n_experiments) and (n_lines, n_outputs, n_outputs)."""

    omega: Array
    excitation: Complex
    whiten: Complex


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Numbers:
    """Estimated numbers of a plant, SI, with the covariance that the record and the priors give them."""

    plant: LinearModel | RotorModel
    theta: Mapping[str, float]
    names: tuple[str, ...]
    covariance: Array
    known: Sequence[Parameter]


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibrated:
    """What calibration makes of an estimate.

    `parameters`: with their intervals; `calibration`: by channel, and ``"rate"``, the per cent by which 1 % of it would
    move each estimated parameter; `calibration_sd`: what the rig says of each source of error, relative or SI.
    """

    parameters: tuple[EstimatedParameter, ...]
    calibration: Mapping[str, Mapping[str, float]]
    calibration_sd: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))


def calibrated(parameters: Sequence[EstimatedParameter], numbers: Numbers, rig: Rig, lines: Lines) -> Calibrated:
    """Return the intervals of an estimate with what its rig says of calibration."""
    n, plant = numbers, numbers.plant
    channels = [c for c in rig.channels if c.role in (*plant.inputs, *plant.outputs)]
    errors = {c.role: SensorError(kind="gain", channel=c.role) for c in channels}
    errors["rate"] = SensorError(kind="gain", channel="time")
    sd = {**{c.role: c.gain_sd for c in channels}, "rate": rig.record.rate_sd}
    moves = error_moves(
        plant, n.theta, list(errors.values()), free=n.names,
        omega=lines.omega, excitation=lines.excitation, whiten=lines.whiten,
    )  # fmt: skip
    moves[:, -1] *= -1.0  # a rate that is too high makes times too short
    references = plant.references(n.theta)
    size = np.array([n.theta[name] or references.get(name, 1.0) for name in n.names])
    weight = {p.name: p.sd**-2 for p in n.known if p.role == "prior" and p.sd}
    held = np.array([weight.get(name, 0.0) for name in n.names])
    moved = size[:, None] * moves
    moved -= n.covariance @ (held[:, None] * moved)
    per_cent = moved / size[:, None]
    stated = {name: x for name, x in sd.items() if x is not None}
    spread = np.sqrt(np.sum((moved * [stated.get(name, 0.0) for name in errors]) ** 2, axis=1))
    offsets = {f"{c.role}.offset": c.offset_sd for c in channels if c.offset_sd is not None}
    return Calibrated(
        parameters=tuple(
            _widened(p, dict(zip(n.names, spread.tolist(), strict=True)).get(p.name, 0.0)) if stated else p
            for p in parameters
        ),
        calibration={
            error: dict(zip(n.names, np.where(abs(column) < _DUST, 0.0, column).tolist(), strict=True))
            for error, column in zip(errors, per_cent.T, strict=True)
        },
        calibration_sd={**stated, **offsets},
    )


def _widened(p: EstimatedParameter, spread: float) -> EstimatedParameter:
    sd = float(np.hypot(p.sd, spread))
    return replace(p, sd_calibrated=sd, ci95_calibrated=(p.value - NORMAL_95 * sd, p.value + NORMAL_95 * sd))


def lines_of(fit: Fit) -> Lines:
    """Return what the record of a fit shows: the spectrum of its inputs in bands, and the whitening of its predictor.

    With gain K and innovations of covariance S, residuals of the outputs become white as S^(-1/2) H^-1 e with
    H^-1 = I - C (z I - A + K C)^-1 K.
    """
    problem = fit.problem
    spectrum = np.fft.rfft(problem.u, axis=0)[1:]
    edges = np.unique(np.geomspace(1, len(spectrum), _BANDS + 1).astype(int) - 1)
    bands = [slice(a, b) for a, b in pairwise(edges)]
    power = np.array([spectrum[band].T @ spectrum[band].conj() for band in bands])
    values, axes = np.linalg.eigh(power)
    middle = 0.5 * (edges[:-1] + edges[1:] - 1) + 1
    omega = 2.0 * np.pi * middle * problem.rate_hz / len(problem.u)
    predictor = assemble(problem, fit.vector, with_derivatives=False)
    if predictor is None:
        raise ValueError("the fit has no predictor; it has failed")
    A, C, K = predictor.A, predictor.C, predictor.gain
    z = np.exp(1j * omega * problem.stride / problem.rate_hz)[:, None, None]
    inverse = np.eye(len(C)) - C @ np.linalg.solve(z * np.eye(len(A)) - A + K @ C, K.astype(complex))
    root = np.linalg.inv(np.linalg.cholesky(fit.covariance))
    return Lines(
        omega=omega, excitation=axes * np.sqrt(np.maximum(values, 0.0))[:, None, :],
        whiten=np.asarray(root @ inverse / problem.scales.output, dtype=np.complex128),
    )  # fmt: skip
