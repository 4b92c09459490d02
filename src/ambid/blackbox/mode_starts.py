"""Spectra of a record about its modes, and poles from which the search for modes begins.

A common denominator of all outputs in powers of z, numerators for inputs and leakage, is fitted by linear least squares
in overlapping bands for all orders (Guillaume et al. 2003); its lowest coefficient is 1, so that poles of noise come
out unstable (Cauberghe 2004). So do those of modes that noise or distortion covers line by line: responses averaged
over ever more lines show these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array, Complex
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.modes import Tolerance, TrialPole, clusters, followed, trial_poles
from ambid.settings.caller import setting

DEGREE = 2  # of polynomials that stand for what is far away
MOST_DAMPED = 0.15  # above, a resonance is no line: rigid and control modes are taken for what is far away
_BAND_LINES, _BAND_SHARE = 600, 0.15  # lines, and part of its frequency, that a band has at least
_ORDERS = (2, 32)
_BESIDE = 3  # lines to either side of a pole that show its shape
_NEAR = Tolerance(frequency=0.001, damping=0.25, least=0.002, shape=0.9)
_DROP_DB = 15.0  # between the excitation's band and the floor beside it
_LEAST_LINES = 60


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spectra:
    """Spectra of a record in a band, and the variance of the noise of each output."""

    omega: Array  # (n_lines,), rad/s
    U: Complex  # (n_lines, 1 + n_inputs), a column of ones for the leakage, then inputs; of a response the ones alone
    Y: Complex  # (n_lines, n_outputs)
    variance: Array  # (n_lines, n_outputs)
    step: float  # rad/s from line to line

    def part(self, first: int, last: int) -> Spectra:
        """Return some of the lines."""
        s = slice(first, last)
        return replace(self, omega=self.omega[s], U=self.U[s], Y=self.Y[s], variance=self.variance[s])

    def between(self, low_hz: float, high_hz: float) -> Spectra:
        """Return the lines of a band."""
        first, last = np.searchsorted(self.omega, [2 * np.pi * low_hz, 2 * np.pi * high_hz])
        return self.part(int(first), int(last))


def spectra(data: IOData, band: tuple[float, float] | None) -> Spectra:
    """Return the spectra of a record in a band in Hz, by default that of its inputs."""
    n = data.n_samples
    U, Y = (np.fft.rfft(x - x.mean(axis=0), axis=0)[1 : (n + 1) // 2] / np.sqrt(n) for x in (data.u, data.y))
    f = np.arange(1, U.shape[0] + 1) * (1.0 / data.dt / n)
    low, high = excited_band(U, f) if band is None else band
    keep = (f >= low) & (f <= high)
    if np.count_nonzero(keep) < _LEAST_LINES:
        raise EstimationError(
            f"{np.count_nonzero(keep)} lines of the record between {low:g} and {high:g} Hz; modes want {_LEAST_LINES}. "
            f"Use a longer record or a wider {setting('band')}"
        )
    f, U, Y = f[keep], U[keep], Y[keep]
    silent = [name for name, x in zip(data.inputs, U.T, strict=True) if not np.any(x)]
    if silent:
        raise EstimationError(f"input {silent[0]!r} does not move between {low:g} and {high:g} Hz. Omit it")
    size = np.sqrt(np.mean(np.abs(U) ** 2, axis=0))
    columns = np.hstack([np.full((f.size, 1), 1.0 + 0j), U / size])
    step = 2 * np.pi / data.dt / n
    return Spectra(omega=2 * np.pi * f, U=columns, Y=Y, variance=_local_noise(columns, Y), step=step)


def excited_band(U: Complex, frequency_hz: Array) -> tuple[float, float]:
    """Return lowest and highest frequency in Hz of where inputs, spectra `U` (n_lines, n_inputs), have power: the upper
    of two classes of level over the logarithm of the frequency (Otsu 1979); all lines where there is no floor beside
    it.
    """
    width = max(frequency_hz.size // 2000, 16)
    n = frequency_hz.size // width
    if n < 8:
        return float(frequency_hz[0]), float(frequency_hz[-1])
    power = np.abs(U[: n * width]) ** 2
    level = np.median(power.reshape(n, width, -1), axis=1)  # a line of the mains does not move a median
    level = 10 * np.log10(np.sum(level / np.maximum(level.max(axis=0), 1e-300), axis=1) + 1e-30)
    centre = frequency_hz[: n * width].reshape(n, width).mean(axis=1)
    weight = np.diff(np.log(np.r_[centre[0] / 2, centre]))
    order = np.argsort(level)
    x, w = level[order], weight[order]
    below, total = np.cumsum(w), np.sum(w)
    mean_below = np.cumsum(w * x) / below
    mean_above = (np.sum(w * x) - np.cumsum(w * x))[:-1] / (total - below)[:-1]
    between = (below * (total - below))[:-1] * (mean_above - mean_below[:-1]) ** 2
    k = int(np.argmax(between))
    if mean_above[k] - mean_below[k] < _DROP_DB:
        return float(frequency_hz[0]), float(frequency_hz[-1])
    inside = np.flatnonzero(level > 0.5 * (x[k] + x[k + 1]))
    edges = inside[0] * width, min((inside[-1] + 1) * width, frequency_hz.size) - 1
    return float(frequency_hz[edges[0]]), float(frequency_hz[edges[1]])


def _local_noise(U: Complex, Y: Complex) -> Array:
    """Variance that polynomials of response and leakage leave in short stretches; medians pass over resonances."""
    n_unknown = (DEGREE + 1) * U.shape[1]
    width = n_unknown + 12
    n = max(Y.shape[0] // width, 1)
    x = np.linspace(-1, 1, width)[:, None] ** np.arange(DEGREE + 1)
    u, y = (a[: n * width].reshape(n, width, -1) for a in (U, Y))
    columns = (u[:, :, :, None] * x[:, None, :]).reshape(n, width, -1)
    Q = np.linalg.qr(columns)[0]
    left = y - Q @ (conjugate(Q) @ y)
    level = np.log(np.sum(np.abs(left) ** 2, axis=1) / 12 + 1e-300)
    half = min(7, n - 1)
    wide = np.pad(level, ((half, half), (0, 0)), mode="reflect")
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(wide, 2 * half + 1, axis=0), axis=-1)
    at = (np.arange(n) + 0.5) * width
    lines = np.arange(Y.shape[0])
    return np.asarray(np.exp(np.column_stack([np.interp(lines, at, column) for column in smooth.T])))


def conjugate(x: Complex) -> Complex:
    """Return the conjugate transpose of each matrix."""
    return np.asarray(np.conj(np.swapaxes(x, -1, -2)))


def starting_poles(lines: Spectra, say: Callable[[float], None]) -> tuple[list[complex], list[TrialPole]]:
    """Return poles that stay as the order grows, band by band, and all that were tried."""
    stable, tried, n = list[complex](), list[TrialPole](), lines.omega.size
    for first, last, begin, end in _overlapping_bands(lines.omega, lines.step):
        low, high = lines.omega[begin], lines.omega[end - 1] + lines.step
        poles = _followed_poles(lines.part(first, last))
        tried += [p for p in poles[0] if low <= p.pole.imag < high]
        stable += [c for c in poles[1] if low <= c.imag < high]
        say(last / n)
    return stable, tried


def averaged_responses(lines: Spectra) -> Iterator[Spectra]:
    """Yield responses to the inputs, averaged over ever more lines: less noise, for modes that are wider than that."""
    m = lines.U.shape[1] - 1
    width = 4 * m
    while (n := lines.omega.size // width) >= _LEAST_LINES:
        U, Y = (x[: n * width].reshape(n, width, -1) for x in (lines.U[:, 1:], lines.Y))
        floor = 1e-12 * width * np.mean(np.abs(U) ** 2) * np.eye(m)
        G = np.asarray(np.linalg.solve(conjugate(U) @ U + floor, conjugate(U) @ Y), dtype=np.complex128).reshape(n, -1)
        centre, ones = lines.omega[: n * width].reshape(n, width).mean(axis=1), np.ones((n, 1), dtype=np.complex128)
        yield Spectra(omega=centre, U=ones, Y=G, variance=_local_noise(ones, G), step=width * lines.step)
        width *= 4


def _overlapping_bands(omega: Array, step: float) -> Iterator[tuple[int, int, int, int]]:
    """Yield first and last line of bands that overlap by half, and of the part of each that counts: these follow on
    each other.
    """
    first, begin, n = 0, 0, omega.size
    while True:
        size = max(_BAND_LINES, int(_BAND_SHARE * omega[first] / step))
        last = min(first + size, n)
        if n - last < size // 4:
            last = n
        end = last if last == n else last - size // 4
        yield first, last, begin, end
        if last == n:
            return
        first, begin = first + size // 2, end


def _followed_poles(lines: Spectra) -> tuple[list[TrialPole], list[complex]]:
    """Poles of all orders in one band, and the centres of stable clusters."""
    n_lines, columns = lines.U.shape
    most = min(_ORDERS[1], int(0.5 * n_lines / columns) - 1)
    models = list(range(_ORDERS[0], most + 1, 2))
    low, high = np.nextafter(lines.omega[0], np.inf), lines.omega[-1]

    def light(order: int, p: Complex, shapes: Complex) -> list[TrialPole]:
        use = (p.real < 0) & (-p.real < 2 * MOST_DAMPED * np.abs(p)) & (p.imag >= low) & (p.imag < high)
        return trial_poles(order, p[use], shapes[use])

    poles = followed([light(*trial) for trial in _common_denominators(lines, models)], _NEAR)
    return poles, [c.pole for c in clusters(poles, models, _NEAR)]


def _common_denominators(lines: Spectra, models: Sequence[int]) -> list[tuple[int, Complex, Complex]]:
    """Order, poles (n,) and shapes (n, n_outputs) of common denominators by linear least squares: products of powers of
    x = exp(s T) depend on their difference alone, so that a few sums over the lines hold the normal equations of all
    orders.
    """
    n, (n_lines, m), n_y = max(models), lines.U.shape, lines.Y.shape[1]
    angle = 0.9 * 2 * np.pi / n_lines
    period, centre = angle / lines.step, lines.omega[n_lines // 2]
    x = np.exp(1j * angle * (np.arange(n_lines) - n_lines // 2))
    powers = x[None, :] ** np.arange(-n, n + 1)[:, None]
    weight = 1.0 / lines.variance
    both = lines.U.conj()[:, :, None, None] * lines.U[:, None, :, None] * weight[:, None, None, :]
    R, S, T = (
        (powers @ g.reshape(n_lines, -1)).reshape(2 * n + 1, *g.shape[1:])
        for g in (
            both,
            lines.U.conj()[:, :, None] * (lines.Y * weight)[:, None, :],
            np.abs(lines.Y) ** 2 * weight,
        )
    )
    at = np.arange(n + 1)
    lag = at[None, :] - at[:, None] + n
    out = []
    for order in models:
        k, size = lag[: order + 1, : order + 1], m * (order + 1)
        own = R[k].transpose(4, 2, 0, 3, 1).reshape(n_y, size, size)
        cross = S[k].transpose(3, 2, 0, 1).reshape(n_y, size, order + 1)
        scale = np.einsum("jaa->j", own).real / size
        solved = np.linalg.solve(own + 1e-12 * scale[:, None, None] * np.eye(size), cross)
        M = np.sum(T[k].transpose(2, 0, 1) - conjugate(cross) @ solved, axis=0)
        a = np.r_[1.0, np.linalg.lstsq(M[1:, 1:], -M[1:, 0], rcond=1e-14)[0]]
        roots = np.roots(a[::-1])
        roots = roots[np.abs(roots) > 1e-3]
        numerator = (solved @ a).reshape(n_y, m, order + 1)
        residues = np.einsum("jum,pm->pju", numerator, roots[:, None] ** at[: order + 1])
        # In its response about the pole, since what leakage and input share may be told apart badly.
        nearest = np.clip(np.rint(np.angle(roots) / angle).astype(int) + n_lines // 2, _BESIDE, n_lines - 1 - _BESIDE)
        about = residues @ lines.U[nearest[:, None] + np.arange(-_BESIDE, _BESIDE + 1)].swapaxes(1, 2)
        out.append((order, 1j * centre + np.log(roots) / period, principal(about)))
    return out


def principal(residues: Complex) -> Complex:
    """Return the shape (n, n_outputs) that columns (n, n_outputs, n_columns) share most."""
    if residues.shape[2] == 1:
        return np.asarray(residues[:, :, 0])
    u, s, _ = np.linalg.svd(residues, full_matrices=False)
    return np.asarray(u[:, :, 0] * s[:, :1])
