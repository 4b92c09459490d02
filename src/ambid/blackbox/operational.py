"""Modes from outputs alone by covariance-driven stochastic subspace (SSI-COV; Peeters and De Roeck 1999).

White excitation makes covariances R(l) = C A^(l-1) G; the singular vectors of the block Toeplitz matrix of R(1) ...
R(2i-1) give O_i, its shift A, and A the poles. Each band is shifted to zero and taken as a complex signal at its own
rate: a mode is one pole there, and few lags reach far. Standard deviations are from the jackknife over stretches (Efron
and Tibshirani 1993, ch. 11). A harmonic looks like a mode without damping, but its envelope is steady, where that of a
mode driven by noise has E|z|^4 = 2 (E|z|^2)^2 (Jacobsen, Andersen and Brincker 2007).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.blackbox.data import IOData
from ambid.blackbox.mode_starts import MOST_DAMPED, light_poles, lines_in_band, overlapping_bands
from ambid.estimation.estimate import Check
from ambid.estimation.linear import one_thread
from ambid.estimation.modes import (
    Modal,
    OfPole,
    PoleCluster,
    Tolerance,
    TrialPole,
    clusters,
    followed,
    mode_of,
    modes_checks,
    student,
)
from ambid.settings.caller import setting

_NEAR = Tolerance(frequency=0.002, damping=0.5, least=0.004, shape=0.9)
_BANDS, _SHARE = 8, 0.25  # at most so many bands, each so wide beside its frequency
_PEAK = 4.0  # power at a mode's frequency over that beside it
_ROWS = 160  # of the Toeplitz matrix, about: lags times outputs
_LAGS = (12, 60)
_MEMORY = 40.0  # periods of the middle of the band that lags reach: a time constant at 0.4 % damping
_ORDERS = 20
_STRETCHES = 12  # of the jackknife
_STEADY = 1.5  # fourth moment of an envelope over its squared second: 2 for noise, 1 for a harmonic
_LEAST_LINES = 120


@dataclass(slots=True, eq=False)
class _Band:
    """Covariances of one band of the record, by stretch."""

    centre: float  # rad/s, of the shift: of the first line
    period: float  # s, between samples of the shifted signal
    R: Complex  # (n_stretches, n_lags + 1, n_outputs, n_outputs), sums
    counts: Array  # (n_stretches, n_lags + 1)

    def covariances(self, without: int | None = None) -> Complex:
        """Return them (n_lags + 1, n_outputs, n_outputs), `without` a stretch."""
        use = np.ones(self.R.shape[0], dtype=bool)
        if without is not None:
            use[without] = False
        return np.asarray(np.sum(self.R[use], axis=0) / np.sum(self.counts[use], axis=0)[:, None, None])


@dataclass(slots=True, eq=False)
class _Found(OfPole):
    """A mode of one band with what its stretches say."""

    pole: complex
    shape: Complex
    covariance: Array
    variance: Array
    steadiness: float

    @property
    def harmonic(self) -> bool:
        return self.steadiness < _STEADY


def operational_modes(
    data: IOData,
    count: int | Literal["auto"] = "auto",
    *,
    band: tuple[float, float] | None = None,
    tick: Callable[[str, float], object] | None = None,
) -> Modal:
    """Estimate `count` modes ("auto", or the best known) that unmeasured broadband noise excites, in a `band` in Hz,
    default where outputs have power; EstimationError where it has too few lines.
    """
    n, rate = data.y.shape[0], 1.0 / data.dt
    f, _, (Y,) = lines_in_band(data, (data.y,), band, _LEAST_LINES, "operational modes")
    omega = 2 * np.pi * f
    size = np.sqrt(np.mean(np.abs(Y) ** 2, axis=0))
    estimates, tried = list[_Found](), list[TrialPole]()
    with one_thread():
        for first, last, begin, end in overlapping_bands(
            omega, 2 * np.pi * rate / n, max(omega.size // _BANDS, 600), _SHARE
        ):
            inside = omega[begin], omega[end - 1] + 2 * np.pi * rate / n
            own, poles = _of_band(Y[first:last] / size, omega[first:last], inside)
            estimates, tried = estimates + own, tried + poles
            if tick is not None:
                tick("modes: stochastic subspace", last / omega.size)
    for x in estimates:
        x.shape, x.variance = x.shape * size, x.variance * size**2
    estimates = _separate(estimates)
    if count != "auto":
        best = sorted(estimates, key=lambda x: (x.harmonic, np.trace(x.covariance) / x.pole.real**2))[:count]
        estimates = sorted(best, key=lambda x: x.pole.imag)
    limits = float(f[0]), float(f[-1])
    interval = student(_STRETCHES - 1)
    modes = tuple(
        mode_of(x.pole, [(x.covariance, interval)], data.outputs, x.shape, x.variance, visible=not x.harmonic)
        for x in estimates
    )
    steady = ", ".join(f"{x.frequency_hz:.4g} Hz" for x in estimates if x.harmonic)
    remedy = f"{steady}: the envelope is steady, as a harmonic's is. Take it for no mode, or record at another speed"
    random = Check(passed=not steady, detail=remedy if steady else "no mode is a harmonic")
    checks = modes_checks(modes, count, limits, f"Record longer, or give {setting('band')}")
    return Modal(
        status="converged" if estimates else "failed",
        method="covariance-driven stochastic subspace, broadband excitation not measured",
        modes=modes,
        checks={**checks, "modes_random": random},
        inputs=(),
        outputs=data.outputs,
        units={x: data.units[x] for x in data.outputs},
        band_hz=limits,
        poles=tuple(tried),
        record=data.record,
        details={"envelope": [x.steadiness for x in estimates]},
    )


def _of_band(Y: Complex, omega: Array, inside: tuple[float, float]) -> tuple[list[_Found], list[TrialPole]]:
    """Modes of one band and all poles that were tried, inside the part that counts."""
    band = _shifted(Y, omega)
    R = band.covariances()
    models = list(range(1, _ORDERS + 1))
    trials = zip(models, _poles(R, band, models), strict=True)
    rows = [light_poles(order, p, shapes, *inside) for order, (p, shapes) in trials]
    poles = followed(rows, _NEAR)
    stable = clusters(poles, models, _NEAR)
    return _known(stable, poles, band, Y, omega), poles


def _shifted(Y: Complex, omega: Array) -> _Band:
    """Covariances of a band as a complex signal at the band's own rate."""
    n, n_y = Y.shape
    step = (omega[-1] - omega[0]) / (n - 1)
    memory = int(_MEMORY * n * step / omega[n // 2])
    lags = 2 * max(min(memory, _ROWS // n_y, _LAGS[1]), _LAGS[0])
    z = np.fft.ifft(Y, axis=0) * np.sqrt(n)
    edges = np.linspace(0, n, _STRETCHES + 1).astype(int)
    R = np.zeros((_STRETCHES, lags, n_y, n_y), dtype=np.complex128)
    counts = np.zeros((_STRETCHES, lags))
    for s, (a, b) in enumerate(pairwise(edges)):
        for k in range(lags):
            late = z[a + k : min(b + k, n)]
            R[s, k] = late.T @ z[a : a + late.shape[0]].conj()
            counts[s, k] = late.shape[0]
    return _Band(centre=float(omega[0]), period=2 * np.pi / (n * step), R=R, counts=counts)


def _poles(R: Complex, band: _Band, models: Sequence[int]) -> list[tuple[Complex, Complex]]:
    """Poles (n,), rad/s, and shapes (n, n_outputs) of all orders from one Toeplitz matrix."""
    n_y, i = R.shape[1], R.shape[0] // 2
    toeplitz = np.block([[R[i + a - b] for b in range(i)] for a in range(i)])
    U, s, _ = np.linalg.svd(toeplitz)
    out = []
    for order in models:
        observed = U[:, :order] * np.sqrt(s[:order])
        A = np.linalg.lstsq(observed[:-n_y], observed[n_y:], rcond=None)[0]
        z, vectors = np.linalg.eig(A)
        angle = np.mod(np.angle(z), 2 * np.pi)  # the band is one turn, from its first line
        p = (np.log(np.maximum(np.abs(z), 1e-300)) + 1j * angle) / band.period + 1j * band.centre
        out.append((p, (observed[:n_y] @ vectors).T))
    return out


def _known(
    stable: Sequence[PoleCluster], poles: Sequence[TrialPole], band: _Band, Y: Complex, omega: Array
) -> list[_Found]:
    """Clusters at the order that is nearest to their centre, with the spread over stretches left out in turn."""
    nearest = [min((p for p in poles if p.order in c.orders), key=lambda p: abs(p.pole - c.pole)) for c in stable]
    at = [p for p in nearest if _stands_out(Y, omega, p)]
    orders = sorted({p.order for p in at})
    if not at:
        return []
    again = [dict(zip(orders, _poles(band.covariances(s), band, orders), strict=True)) for s in range(_STRETCHES)]
    out = []
    for trial in at:
        own = np.array(trial.shape)
        largest = int(np.argmax(np.abs(own)))
        moved = []
        for trials in again:
            p, shapes = trials[trial.order]
            k = int(np.argmin(np.abs(p - trial.pole)))
            shape = shapes[k] / shapes[k, largest]
            moved.append(np.r_[p[k].real, p[k].imag, shape.real, shape.imag])
        spread = np.array(moved) - np.mean(moved, axis=0)
        factor = (_STRETCHES - 1) / _STRETCHES
        variance = np.sum(spread[:, 2:] ** 2, axis=0) * factor
        # steadiness: fourth moment over squared second of the envelope of the mode's lines, along its shape.
        step = omega[1] - omega[0]
        near = np.abs(omega - trial.pole.imag) <= max(3 * abs(trial.pole.real), 4 * step)
        along = Y[near] @ np.conj(np.array(trial.shape))
        power = np.abs(np.fft.ifft(along, 4 * along.size)) ** 2
        out.append(
            _Found(
                pole=trial.pole, shape=own / own[largest], covariance=spread[:, :2].T @ spread[:, :2] * factor,
                variance=variance[: own.size] + variance[own.size :],
                steadiness=float(np.mean(power**2) / np.mean(power) ** 2),
            )
        )  # fmt: skip
    return out


def _stands_out(Y: Complex, omega: Array, p: TrialPole) -> bool:
    """Whether the power along a mode's shape has a peak at its frequency, more than chance makes."""
    power = np.abs(Y @ np.conj(np.array(p.shape))) ** 2
    away, width = np.abs(omega - p.pole.imag), abs(p.pole.real)
    step = omega[1] - omega[0]
    near = away <= max(width, 1.5 * step)
    floor = (away > max(4 * width, 6 * step)) & (away < max(12 * width, 60 * step))
    if not floor.any():
        return True
    level = np.median(power[floor]) / np.log(2)
    return bool(np.mean(power[near]) > _PEAK * (1 + 2 / np.sqrt(np.count_nonzero(near))) * level)


def _separate(estimates: list[_Found]) -> list[_Found]:
    """Modes that are damped, known, and not twice, in order of frequency."""
    modes = list[_Found]()
    for x in sorted(estimates, key=lambda x: float(np.trace(x.covariance))):
        damped = 0 < -x.pole.real <= MOST_DAMPED * abs(x.pole)
        certain = x.harmonic or max(x.covariance[0, 0], x.covariance[1, 1]) < x.pole.real**2
        near = any(abs(x.pole - y.pole) < 0.3 * (abs(x.pole.real) + abs(y.pole.real)) for y in modes)
        if damped and certain and not near:
            modes.append(x)
    return sorted(modes, key=lambda x: x.pole.imag)
