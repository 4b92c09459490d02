"""Where a bending mode is missing: a scan of the residuals for one more pole pair by linear least squares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array, Complex
from ambid.physics.rotor_model import RotorModel
from ambid.rotor.likelihood import Experiment, Point, Weight, sampled

_STEP = 0.004  # of the frequencies that are tried, relative
_DAMPINGS = (0.002, 0.006, 0.02, 0.06)
_SPLITS = (0, 1, 2, 3, 4, 6, 8, 11, 15, 20, 27, 36, 48, 64, 85)  # steps from a mode at rest to its two whirls
_START_DAMPING = (0.001, 0.05)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A mode that the residuals ask for: `gain` is by how much it lowers the sum of squares, roughly."""

    omega: float
    zeta: float
    gyro: float
    bearings: Mapping[str, float]  # shape at the bearings, by place
    sensors: Mapping[str, float]
    gain: float

    def named(self, r: int) -> dict[str, float]:
        """Return its numbers as those of mode `r` of the model."""
        shape = {f"mode{r}.{place}": x for place, x in {**self.bearings, **self.sensors}.items()}
        return {f"mode{r}.omega": self.omega, f"mode{r}.zeta": self.zeta, f"gyro.{r}{r}": self.gyro, **shape}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Motion:
    """Residuals and forces as circular motions, or of one plane: by direction (+1, -1, 0)."""

    direction: int
    force: Complex  # (n_lines, n_bearings)
    left: Complex  # (n_lines, n_sensors)
    weight: Array  # (n_lines, n_sensors), inverse variances


def scan(
    experiment: Experiment, model: RotorModel, at: Point, weight: Weight, band: tuple[float, float]
) -> Candidate | None:
    """Return the mode within a band in Hz that explains most of what the model leaves over; None without one.

    With shape b at bearings and s at sensors it adds x_s = s D(jw) Σ b f, f the magnets' forces, beside a static
    compliance for modes above the band. At speed W circular motions x ± jy have D± = 1/(w² - W_l² ± g W W_l + 2 j zeta
    w W_l), W_l the line, resonances at w exp(±d), 2 sinh d = g W/w, tried as pairs at rest with g > 0. The rank-one
    part of s bᵀ starts a search; magnets move the pole: w² = seen² - Σ k_x b².
    """
    motions, places = _motions(experiment, model, at, weight)
    omega = 2.0 * np.pi * np.exp(np.arange(np.log(band[0]), np.log(band[1]), _STEP))
    turning = motions[0].direction != 0
    best: tuple[float, float, float, float, Array] | None = None
    for zeta in _DAMPINGS:
        sums = [_sums(m, experiment.spectra.omega, omega, zeta) for m in motions]
        for n in [k for k in _SPLITS if 2 * k < omega.size] if turning else (0,):
            middle = np.arange(n, omega.size - n)
            ways = [middle + n * m.direction * (1 if experiment.speed > 0.0 else -1) for m in motions]
            gains, products = _explained(
                sum(G[w] for (G, _), w in zip(sums, ways, strict=True)),
                sum(r[w] for (_, r), w in zip(sums, ways, strict=True)),
            )
            k = int(np.argmax(gains))
            if best is None or gains[k] > best[0]:
                split = 2.0 * float(np.sinh(n * _STEP))
                best = float(gains[k]), float(omega[middle[k]]), zeta, split, products[k]
    if best is None or not best[0] > 0.0:
        return None
    gain, omega_of_mode, zeta, split, product = best
    U, size, Vt = np.linalg.svd(product)  # (n_sensors, n_bearings)
    shape_b, shape_s = Vt[0] * np.sqrt(size[0]), U[:, 0] * np.sqrt(size[0])
    at_b, at_s = places
    pulled = 0.0
    for b, x in zip(at_b, shape_b, strict=True):
        axis = next(j for j, (bearing, plane) in enumerate(model.placed) if f"{bearing.name}.z" == b and plane < 2)
        pulled += at.theta[f"{model.axes[axis]}.k_x"] * x**2
    own = omega_of_mode**2 - pulled
    own = own if 0.5 * omega_of_mode**2 < own < 2.0 * omega_of_mode**2 else omega_of_mode**2
    return Candidate(
        omega=float(np.sqrt(own)), zeta=float(np.clip(zeta, *_START_DAMPING)),
        gyro=split * omega_of_mode / abs(experiment.speed) if turning else 0.0,
        bearings=dict(zip(at_b, shape_b.tolist(), strict=True)), sensors=dict(zip(at_s, shape_s.tolist(), strict=True)),
        gain=gain,
    )  # fmt: skip


def _motions(
    experiment: Experiment, model: RotorModel, at: Point, weight: Weight
) -> tuple[list[_Motion], tuple[Sequence[str], Sequence[str]]]:
    """Return residuals and forces by direction of whirl, and the places of bearings and sensors."""
    spectra, turned = experiment.spectra, model.at_speed(experiment.speed)
    response = sampled(experiment, model, at)
    x = response.states(spectra.mean_u)
    left = spectra.mean_y - x @ response.space.C.T
    variance = np.real(
        np.diagonal(np.linalg.inv(np.conj(np.swapaxes(weight.whiten, 1, 2)) @ weight.whiten), axis1=1, axis2=2)
    )
    magnets, _ = turned.rows(at.theta)
    n, states = len(turned.coordinates), list(turned.states)
    force = np.zeros((x.shape[0], len(model.axes)), dtype=complex)
    for j, axis in enumerate(model.axes):
        name = f"{axis}_effective_current" if "a" in model.extras else f"{axis}_current"
        current = x[:, states.index(name)] if name in states else spectra.mean_u[:, j]
        force[:, j] = at.theta[f"{axis}.k_i"] * current - at.theta[f"{axis}.k_x"] * (x[:, :n] @ magnets[j])
    radial = [b for b in model.bearings if not b.axial]
    at_b = [f"{b.name}.z" for b in radial]
    at_s = [b.sensor_parameter(k) for b in radial for k in range(len(b.z_sensors))]

    def of_plane(plane: int) -> tuple[Complex, Complex, Array] | None:
        f = np.zeros((x.shape[0], len(at_b)), dtype=complex)
        e, w = np.zeros((x.shape[0], len(at_s)), dtype=complex), np.zeros((x.shape[0], len(at_s)))
        if plane not in model.planes:
            return None
        for j, (b, p) in enumerate(model.placed):
            if p == plane:
                f[:, at_b.index(f"{b.name}.z")] = force[:, j]
        for k, (j, number) in enumerate(model.sensors):
            if model.placed[j][1] == plane:
                s = at_s.index(model.placed[j][0].sensor_parameter(number))
                e[:, s], w[:, s] = left[:, k], 1.0 / variance[:, k]
        return f, e, w

    one, other = of_plane(0), of_plane(1)
    if one is None or other is None or not turned.turning:
        alone = [_Motion(direction=0, force=m[0], left=m[1], weight=m[2]) for m in (one, other) if m is not None]
        return alone, (at_b, at_s)
    half = np.sqrt(0.5)
    return [
        _Motion(
            direction=sign, force=half * (one[0] + 1j * sign * other[0]), left=half * (one[1] + 1j * sign * other[1]),
            weight=2.0 / (1.0 / np.maximum(one[2], 1e-300) + 1.0 / np.maximum(other[2], 1e-300)),
        )
        for sign in (1, -1)
    ], (at_b, at_s)  # fmt: skip


def _sums(m: _Motion, line: Array, omega: Array, zeta: float) -> tuple[Array, Array]:
    """Return the normal equations (n_omega, n_sensors, 2 n_bearings, 2 n_bearings) and (..., 2 n_bearings) of a mode
    and a static compliance. With D = 1/(a + jb), Re(D* q) = |D|² (a Re q - b Im q): one real matrix serves all.
    """
    n_b, n_s = m.force.shape[1], m.left.shape[1]
    reach = omega[:, None] ** 2 - line**2
    power = 1.0 / (reach**2 + (2.0 * zeta * omega[:, None] * line) ** 2)

    def through(q: Complex) -> Array:
        """Return Re Σ D* q over the lines."""
        lagged = (2.0 * zeta * omega)[:, None] * (power @ (line[:, None] * q.imag))
        return np.asarray(omega[:, None] ** 2 * (power @ q.real) - power @ (line[:, None] ** 2 * q.real) - lagged)

    q = (np.conj(m.force)[:, :, None] * m.force[:, None, :]).reshape(line.size, -1)
    G, r = np.zeros((omega.size, n_s, 2 * n_b, 2 * n_b)), np.zeros((omega.size, n_s, 2 * n_b))
    for s in range(n_s):
        weighed = q * m.weight[:, s, None]
        p = np.conj(m.force) * (m.weight[:, s] * m.left[:, s])[:, None]
        G[:, s, :n_b, :n_b] = (power @ weighed.real).reshape(-1, n_b, n_b)
        G[:, s, :n_b, n_b:] = through(weighed).reshape(-1, n_b, n_b)
        G[:, s, n_b:, :n_b] = G[:, s, :n_b, n_b:].transpose(0, 2, 1)
        G[:, s, n_b:, n_b:] = weighed.real.sum(axis=0).reshape(n_b, n_b)
        r[:, s, :n_b] = through(p)
        r[:, s, n_b:] = p.real.sum(axis=0)
    return G, r


def _explained(G: Array, r: Array) -> tuple[Array, Array]:
    """Return what a mode explains beyond a static compliance, (n_omega,), and its products s bᵀ."""
    n_b = r.shape[2] // 2
    size = np.sqrt(np.maximum(np.einsum("fsii->fsi", G), 1e-300))
    scaled = G / size[..., :, None] / size[..., None, :] + 1e-9 * np.eye(2 * n_b)
    b = r / size
    full = np.linalg.solve(scaled, b[..., None])[..., 0]
    fixed = np.linalg.solve(scaled[..., n_b:, n_b:], b[..., n_b:, None])[..., 0]
    gain = np.einsum("fsi,fsi->f", full, b) - np.einsum("fsi,fsi->f", fixed, b[..., n_b:])
    return 2.0 * gain, (full / size)[..., :n_b]
