"""Modes from a record: common poles of all outputs by maximum likelihood on its Fourier transform, leakage included.

About a mode each output's spectrum is Y = (sum_r a_r/(jw - p_r) + P(w)) U + sum_r b_r/(jw - p_r) + Q(w) + V: poles p
are common; residues a, transients b (first and last state) and polynomials P, Q for all that is farther away are linear
(Pintelon and Schoukens 2012, sec. 6.3.2; McKelvey and Guerin 2012). A hold, a delay or a sensor changes a, P and Q, not
p. Each mode is fitted in a window of its own, with its neighbours, by variable projection (Golub and Pereyra 1973); the
noise V is what the fit leaves about each line, model errors included. The search begins with a common denominator in
powers of z, numerators for inputs and leakage, by linear least squares in overlapping bands for all orders (Guillaume
et al. 2003); its lowest coefficient is 1, so that poles of noise come out unstable (Cauberghe 2004).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check
from ambid.estimation.linear import one_thread
from ambid.estimation.modes import (
    Modal,
    Tolerance,
    TrialPole,
    assurance,
    clusters,
    followed,
    mode_of,
    modes_checks,
    student,
    trial_poles,
)
from ambid.estimation.result import NORMAL_95
from ambid.estimation.search import Rows, search
from ambid.settings.caller import setting

DEGREE = 2  # of polynomials that stand for what is far away
MOST_DAMPED = 0.15  # above, a resonance is no line: rigid and control modes are taken for what is far away
_BAND_LINES, _BAND_SHARE = 600, 0.15  # lines, and part of its frequency, that a band has at least
_ORDERS = (2, 32)
_NEAR = Tolerance(frequency=0.001, damping=0.25, least=0.002, shape=0.9)
_DROP_DB = 15.0  # between the excitation's band and the floor beside it
_LEAST_LINES = 60


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spectra:
    """Spectra of a record in a band, and the variance of the noise of each output."""

    omega: Array  # (n_lines,), rad/s
    U: Complex  # (n_lines, 1 + n_inputs), a column of ones for the leakage, then the inputs
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
    """Return the spectra of a record in a band, by default that of its inputs."""
    f, (low, high), (U, Y) = lines_in_band(data, (data.u, data.y), band, _LEAST_LINES, "modes")
    silent = [name for name, x in zip(data.inputs, U.T, strict=True) if not np.any(x)]
    if silent:
        raise EstimationError(f"input {silent[0]!r} does not move between {low:g} and {high:g} Hz. Omit it")
    size = np.sqrt(np.mean(np.abs(U) ** 2, axis=0))
    columns = np.hstack([np.full((f.size, 1), 1.0 + 0j), U / size])
    step = 2 * np.pi / data.dt / data.n_samples
    return Spectra(omega=2 * np.pi * f, U=columns, Y=Y, variance=_local_noise(columns, Y), step=step)


def lines_in_band(
    data: IOData, signals: Sequence[Array], band: tuple[float, float] | None, least: int, what: str
) -> tuple[Array, tuple[float, float], list[Complex]]:
    """Return the frequencies of the lines in a band in Hz (by default the first signals'), the band, and spectra
    (n_lines, n) there; refuse fewer than `least` lines, which `what` needs.
    """
    n = data.y.shape[0]
    spectra = [np.fft.rfft(x - x.mean(axis=0), axis=0)[1 : (n + 1) // 2] / np.sqrt(n) for x in signals]
    f = np.arange(1, spectra[0].shape[0] + 1) * (1.0 / data.dt / n)
    low, high = excited_band(spectra[0], f) if band is None else band
    keep = (f >= low) & (f <= high)
    if np.count_nonzero(keep) < least:
        raise EstimationError(
            f"{np.count_nonzero(keep)} lines of the record between {low:g} and {high:g} Hz; {what} want {least}. Use a "
            f"longer record or a wider {setting('band')}"
        )
    return f[keep], (low, high), [x[keep] for x in spectra]


def light_poles(order: int, p: Complex, shapes: Complex, low: float, high: float) -> list[TrialPole]:
    """Return the poles that are lightly damped and lie from `low` to below `high`, rad/s."""
    use = (p.real < 0) & (-p.real < 2 * MOST_DAMPED * np.abs(p)) & (p.imag >= low) & (p.imag < high)
    return trial_poles(order, p[use], shapes[use])


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
    for first, last, begin, end in overlapping_bands(lines.omega, lines.step):
        low, high = lines.omega[begin], lines.omega[end - 1] + lines.step
        poles = _followed_poles(lines.part(first, last))
        tried += [p for p in poles[0] if low <= p.pole.imag < high]
        stable += [c for c in poles[1] if low <= c.imag < high]
        say(last / n)
    return stable, tried


def overlapping_bands(
    omega: Array, step: float, lines: int = _BAND_LINES, share: float = _BAND_SHARE
) -> Iterator[tuple[int, int, int, int]]:
    """Yield first and last line of bands that overlap by half, and of the part of each that counts: these follow on
    each other. `lines`, `share`: lines, and part of its frequency, that a band has at least.
    """
    first, begin, n = 0, 0, omega.size
    while True:
        size = max(lines, int(share * omega[first] / step))
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
    rows = [light_poles(*trial, low, high) for trial in _common_denominators(lines, models)]
    poles = followed(rows, _NEAR)
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
        numerator = (solved @ a).reshape(n_y, m, order + 1)[:, 1:]
        residues = np.einsum("jum,pm->pju", numerator, roots[:, None] ** at[: order + 1])
        out.append((order, 1j * centre + np.log(roots) / period, principal(residues)))
    return out


def principal(residues: Complex) -> Complex:
    """Return the shape (n, n_outputs) that residues (n, n_outputs, n_inputs) of all inputs share most."""
    if residues.shape[2] == 1:
        return np.asarray(residues[:, :, 0])
    u, s, _ = np.linalg.svd(residues, full_matrices=False)
    return np.asarray(u[:, :, 0] * s[:, :1])


_REACH = 10.0  # of a window to either side, in half bandwidths of its mode
_FEWEST = 24  # lines of a window to either side, at least
_SMOOTH = 10  # lines to either side over which what the fit leaves is averaged
_LEVERAGE = 0.9  # most that a line's own share in its fit counts
_PASSES = 5  # at most
_WHITE = 0.3  # correlation of what is left from line to line, up to which it is noise
_ALIKE, _WEAK = 0.9, 0.1  # likeness of two shapes, and size of one beside the other, that make them one mode
_SHARE, _LEAST_SHARE = 0.01, 0.001  # part of an output's energy at a mode's frequency that must be the mode's ...
_CLEAR = 10.0  # ... the less where it stands so many times out of what is left
_MISFIT, _COLOURED = 0.1, 0.5  # energy left at a mode, and its correlation from line to line, that speak of model error
_DOUBLE = 0.3  # second singular value of a mode's residues over the first, from which it is two
_LOST = 0.5  # energy left from which a mode's numbers are not shown


# --- the likelihood about one mode ----------------------------------------------------------------------------------


@dataclass(slots=True, eq=False)
class _Projected:
    """What variable projection leaves at some poles."""

    inverse: Complex  # (n_lines, n_poles + n_fixed), step/(jw - p)
    Q: Complex  # (n_outputs, n_lines, n_columns), of the weighted columns
    root: Complex  # (n_outputs, n_columns, n_columns), from the coefficients' own unit covariance
    c: Complex  # (n_outputs, n_columns)
    e: Complex  # (n_outputs, n_lines), weighted

    @property
    def leverage(self) -> Array:
        """Share of each line in its own fit, (n_outputs, n_lines)."""
        return np.asarray(np.minimum(np.sum(np.abs(self.Q) ** 2, axis=2), _LEVERAGE))

    @property
    def cost(self) -> float:
        """Sum of squares: minus the logarithm of the likelihood."""
        return float(np.sum(np.abs(self.e) ** 2))


class _Window:
    """Lines about a mode: poles that are searched, poles beside them that are known, polynomials."""

    def __init__(self, lines: Spectra, fixed: Complex) -> None:
        self.lines, self.fixed = lines, fixed
        self.variance = lines.variance
        omega = lines.omega
        x = (omega - omega.mean()) / max(np.ptp(omega) / 2, 1e-300)
        powers = x[:, None] ** np.arange(DEGREE + 1)
        self.smooth = (lines.U[:, :, None] * powers[:, None, :]).reshape(omega.size, -1)
        self._at: tuple[bytes, _Projected] | None = None

    def project(self, poles: Complex, *, without_input: int | None = None) -> _Projected:
        """Fit what is linear; `without_input`: a pole that the inputs do not excite."""
        key = poles.tobytes()
        if without_input is None and self._at is not None and self._at[0] == key:
            return self._at[1]
        lines = self.lines
        inverse = lines.step / (1j * lines.omega[:, None] - np.r_[poles, self.fixed])
        of_poles = (inverse[:, :, None] * lines.U[:, None, :]).reshape(lines.omega.size, -1)
        if without_input is not None:
            m = lines.U.shape[1]
            of_poles = np.delete(of_poles, np.arange(without_input * m + 1, (without_input + 1) * m), axis=1)
        columns = np.concatenate([of_poles, self.smooth], axis=1)
        weight = 1.0 / np.sqrt(self.variance.T)
        weighted = weight[:, :, None] * columns
        size = np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-300)
        Q, R = np.linalg.qr(weighted / size)
        diagonal = np.abs(np.einsum("jaa->ja", R))
        R[np.any(diagonal < 1e-13, axis=1)] += 1e-13 * np.eye(R.shape[1])  # two poles in one place
        root = np.linalg.inv(R) / np.swapaxes(size, 1, 2)
        y = (weight * lines.Y.T)[:, :, None]
        along = conjugate(Q) @ y
        projected = _Projected(inverse=inverse, Q=Q, root=root, c=(root @ along)[:, :, 0], e=(y - Q @ along)[:, :, 0])
        if without_input is None:
            self._at = key, projected
        return projected

    def slopes(self, poles: Complex) -> Complex:
        """Derivatives of the residuals by the real and the imaginary part of each pole, in steps: (2n, n_outputs,
        n_lines); the change of the projection itself has no part in the gradient (Kaufman 1975).
        """
        at, m = self.project(poles), self.lines.U.shape[1]
        weight, out = 1.0 / np.sqrt(self.variance.T), []
        for r in range(poles.size):
            d = weight * (at.c[:, r * m : (r + 1) * m] @ self.lines.U.T) * at.inverse[:, r] ** 2
            d = d - (at.Q @ (conjugate(at.Q) @ d[:, :, None]))[:, :, 0]
            out += [-d, -1j * d]
        return np.array(out)

    def _rows(self) -> Rows:
        def residual(v: Array) -> Array:
            e = self.project(v.view(np.complex128) * self.lines.step).e.ravel()
            return np.concatenate([e.real, e.imag])

        def slope(v: Array) -> Array:
            J = self.slopes(v.view(np.complex128) * self.lines.step).reshape(v.size, -1)
            return np.concatenate([J.real, J.imag], axis=1).T

        return Rows(residual, slope)

    def search(self, poles: Complex) -> Complex:
        """Most likely poles from these on, the noise as it is."""
        start = np.ascontiguousarray(poles / self.lines.step).view(np.float64).copy()
        end = search(self._rows(), start, most=25, tolerance=1e-7)
        return np.asarray(end.theta.view(np.complex128) * self.lines.step)

    def fit(self, poles: Complex, rounds: int = 2) -> Complex:
        """Most likely poles, the noise from what the fit leaves."""
        for _ in range(rounds):
            poles = self.search(poles)
            # the noise about each line is what is left there, model errors included.
            at = self.project(poles)
            power = np.abs(at.e) ** 2 * self.variance.T / (1 - at.leverage)
            self.variance = np.maximum(_averaged(power.T), 1e-14 * np.mean(np.abs(self.lines.Y) ** 2, axis=0))
            self._at = None
        return self.search(poles)

    def covariance(self, poles: Complex) -> tuple[Array, Array]:
        """Covariances (2n, 2n) of real and imaginary parts in (rad/s)²: of the likelihood, outputs whose errors go
        together counted so (sandwich), and of the (one-step) jackknife over outputs, zero with one output.
        """
        at, J = self.project(poles), self.slopes(poles)
        apart = np.real(np.einsum("ajk,bjk->jab", J.conj(), J))
        H = np.sum(apart, axis=0)
        inverse = np.linalg.pinv(H, hermitian=True)
        e = at.e / np.sqrt(1 - at.leverage)
        together = _averaged(np.einsum("jk,ik->kji", e, e.conj()))
        middle = np.real(np.einsum("ajk,kji,bik->ab", J.conj(), together, J, optimize=True)) / 2
        n_y, square = e.shape[0], self.lines.step**2
        if n_y == 1:
            return inverse @ middle @ inverse * square, np.zeros_like(H)
        score = np.real(np.einsum("ajk,jk->ja", J.conj(), at.e))
        moved = np.array([np.linalg.pinv(H - h, hermitian=True) @ g for h, g in zip(apart, score, strict=True)])
        moved -= moved.mean(axis=0)
        return inverse @ middle @ inverse * square, moved.T @ moved * ((n_y - 1) / n_y) * square


def _averaged(values: NDArray[np.inexact]) -> NDArray[np.inexact]:
    """Averages over neighbouring lines (axis 0), fewer at the ends."""
    n = values.shape[0]
    total = np.concatenate([np.zeros((1, *values.shape[1:]), dtype=values.dtype), np.cumsum(values, axis=0)])
    low, high = np.maximum(np.arange(n) - _SMOOTH, 0), np.minimum(np.arange(n) + _SMOOTH + 1, n)
    width = (high - low).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray((total[high] - total[low]) / width)


# --- which modes there are ------------------------------------------------------------------------------------------


@dataclass(slots=True, eq=False)
class _Candidate:
    """A pole in its window, with what speaks for it."""

    pole: complex
    gain: float = 0.0  # of -2 log likelihood over what its numbers cost (BIC), the lesser of pole and input
    share: float = 0.0  # most of an output's energy at its frequency
    clear: float = 0.0  # its energy over what is left there, in the same output
    misfit: float = 0.0  # energy left there
    correlation: float = 0.0  # of what is left, from line to line
    shape: Complex = field(default_factory=lambda: np.zeros(0, dtype=np.complex128))
    second: float = 0.0  # of the residues over all inputs: second singular value over the first
    shape_variance: Array = field(default_factory=lambda: np.zeros(0))
    likelihood: Array = field(default_factory=lambda: np.zeros((2, 2)))
    jackknife: Array = field(default_factory=lambda: np.zeros((2, 2)))

    @property
    def frequency_hz(self) -> float:
        return abs(self.pole) / (2 * np.pi)

    @property
    def damping(self) -> float:
        return -self.pole.real / abs(self.pole)


def _half_width(pole: complex, step: float) -> float:
    """Of a mode's window, rad/s: enough half bandwidths and lines, no more than a quarter of its frequency."""
    return max(min(_REACH * abs(pole.real), 0.25 * pole.imag), _FEWEST * step)


def _window(lines: Spectra, k: int, poles: Complex) -> tuple[_Window, Complex, int]:
    """Window of pole k: lines, the poles that are searched (pole k and those inside), and where pole k stands."""
    own, width = poles[k], _half_width(complex(poles[k]), lines.step)
    distance = np.abs(poles.imag - own.imag)
    part = lines.between((own.imag - width) / (2 * np.pi), (own.imag + width) / (2 * np.pi))
    most = max(int(part.omega.size / (2.5 * lines.U.shape[1])) - DEGREE - 1, 1)  # columns that its lines tell apart
    near = [j for j in np.argsort(distance) if distance[j] < 3 * width][:most]
    inside = [j for j in near if distance[j] < width][:5]
    outside = [j for j in near if j not in inside]
    return _Window(part, poles[outside]), poles[inside], inside.index(k)


def _refine(lines: Spectra, candidates: list[_Candidate], say: Callable[[float], None]) -> list[_Candidate]:
    """Fit each candidate in its window, drop what is no mode, and again with those that are left."""
    for turn in range(_PASSES):
        poles = np.array([c.pole for c in candidates])
        for k, c in enumerate(candidates):
            _fit(lines, k, poles, c, judge=turn > 0)
            say((turn + (k + 1) / len(candidates)) / _PASSES)
        modes = _kept(candidates, lines, judged=turn > 0)
        before, candidates = len(candidates), modes
        if turn == 1:
            poles = np.array([c.pole for c in modes])
            candidates = [x for k, c in enumerate(modes) for x in _split(lines, k, poles, c)]
        if not candidates or (turn > 0 and len(candidates) == before == len(modes)):
            return candidates
    return candidates


def _split(lines: Spectra, k: int, poles: Complex, c: _Candidate) -> list[_Candidate]:
    """Two modes of different shape where one pole stands for both, else the one."""
    if c.correlation < _WHITE:  # what one pole leaves of two is no noise
        return [c]
    window, inside, at = _window(lines, k, poles)
    n, m = lines.Y.shape[1], lines.U.shape[1]
    if n < 2 or window.lines.omega.size < 2 * (window.smooth.shape[1] + m * (inside.size + 1)):
        return [c]
    apart = 0.4j * abs(c.pole.real)
    pair = window.fit(np.r_[c.pole - apart, c.pole + apart, np.delete(inside, at)])
    two = window.project(pair)
    one = window.project(window.search(inside))
    gain = 2 * (one.cost - two.cost) - (2 + 2 * n * m) * np.log(2 * two.e.size)
    damped = np.all((pair[:2].real < 0) & (-pair[:2].real < MOST_DAMPED * np.abs(pair[:2])))
    near = np.all(np.abs(pair[:2] - c.pole) < 2 * abs(c.pole.real))
    shapes = principal(np.array([two.c[:, r * m + 1 : (r + 1) * m] for r in (0, 1)]))
    strength = np.linalg.norm(shapes, axis=1)
    alike = assurance(shapes[0].tolist(), shapes[1].tolist()) > _ALIKE or strength.min() < _WEAK * strength.max()
    if gain < 0 or alike or not (damped and near):
        return [c]
    return [_Candidate(pole=complex(p)) for p in pair[:2]]


def _fit(lines: Spectra, k: int, poles: Complex, c: _Candidate, *, judge: bool) -> None:
    """Fit pole k in its window and, where asked, see what speaks for it; `poles` is brought up to date."""
    window, inside, at = _window(lines, k, poles)
    if window.lines.omega.size < 2 * window.smooth.shape[1]:
        c.pole = complex(abs(c.pole))  # at the border of the band, too few lines: dropped as undamped
        return
    fitted = window.fit(inside)
    moved = abs(fitted[at].imag - c.pole.imag)
    c.pole = complex(fitted[at]) if moved < _half_width(c.pole, lines.step) / 2 else complex(abs(c.pole))
    poles[k] = c.pole
    if not judge or c.pole.real >= 0:
        return
    own, m = window.project(fitted), lines.U.shape[1]
    rest = np.delete(fitted, at)
    without = window.project(window.search(rest)) if rest.size else window.project(rest)
    deaf = window.project(fitted, without_input=at)
    numbers, n = own.e.size * 2, lines.Y.shape[1]
    price = np.log(numbers)
    c.gain = min(
        2 * (without.cost - own.cost) - (2 + 2 * n * m) * price, 2 * (deaf.cost - own.cost) - 2 * n * (m - 1) * price
    )
    _describe(window, fitted, at, c, deaf)
    likelihood, jackknife = window.covariance(fitted)
    own_two = slice(2 * at, 2 * at + 2)
    c.likelihood, c.jackknife = likelihood[own_two, own_two], jackknife[own_two, own_two]


def _describe(window: _Window, poles: Complex, at: int, c: _Candidate, deaf: _Projected) -> None:
    """Shape, share of the energy and what is left at the mode's frequency; `deaf`: the fit where inputs do not excite
    the mode, which leaves what nothing else explains.
    """
    fitted, lines, m = window.project(poles), window.lines, window.lines.U.shape[1]
    residues = fitted.c[:, at * m : (at + 1) * m]
    near = np.abs(lines.omega - c.pole.imag) <= max(1.5 * abs(c.pole.real), 1.5 * lines.step)
    energy = np.maximum(np.sum(np.abs(lines.Y[near]) ** 2, axis=0), 1e-300)
    left, deprived = (np.sum((np.abs(x.e) ** 2 * window.variance.T)[:, near], axis=1) for x in (fitted, deaf))
    shares = np.maximum(deprived - left, 0.0) / energy
    best = int(np.argmax(shares))
    c.share, c.clear = float(shares[best]), float(shares[best] * energy[best] / max(left[best], 1e-300))
    c.misfit = float(np.sum(left / energy * shares) / max(np.sum(shares), 1e-300))
    wide = np.abs(lines.omega - c.pole.imag) <= max(4 * abs(c.pole.real), 8 * lines.step)
    e = fitted.e[:, wide]
    c.correlation = float(abs(np.sum(e[:, 1:] * e[:, :-1].conj())) / max(np.sum(np.abs(e) ** 2), 1e-300))
    c.shape = principal(residues[None, :, 1:])[0]
    strength = np.linalg.svd(residues[:, 1:], compute_uv=False)
    c.second = float(strength[1] / strength[0]) if strength.size > 1 else 0.0
    covariance = np.sum(np.abs(fitted.root) ** 2, axis=2)[:, at * m + 1 : (at + 1) * m]
    c.shape_variance = np.mean(covariance, axis=1)


def _kept(candidates: list[_Candidate], lines: Spectra, *, judged: bool) -> list[_Candidate]:
    """Candidates that are modes: damped, in the band, not twice, and where judged worth their numbers and energy."""
    low, high = lines.omega[0], lines.omega[-1]
    modes = list[_Candidate]()
    for c in sorted(candidates, key=lambda c: -c.gain if judged else abs(c.pole.real)):
        damped = c.pole.real < 0 and c.damping <= (MOST_DAMPED if judged else 2 * MOST_DAMPED)
        wanted = _LEAST_SHARE if c.clear >= _CLEAR else _SHARE
        worth = not judged or (c.gain > 0 and c.share >= wanted)
        if damped and worth and low <= c.pole.imag <= high and not any(_same(c, d, lines.step) for d in modes):
            modes.append(c)
    return sorted(modes, key=lambda c: c.pole.imag)


def _same(one: _Candidate, other: _Candidate, step: float) -> bool:
    """Whether two poles are one resonance: nearer than they are wide, and alike in shape where that is known."""
    width = abs(one.pole.real) + abs(other.pole.real)
    apart = abs(one.pole - other.pole)
    if apart < max(0.1 * width, 0.2 * step):
        return True
    if one.shape.size < 2 or other.shape.size < 2:
        return apart < (0.1 if not one.shape.size else 0.5) * width
    return apart < width and assurance(one.shape.tolist(), other.shape.tolist()) > _ALIKE


# --- the result -----------------------------------------------------------------------------------------------------


def find_modes(
    data: IOData,
    count: int | Literal["auto"] = "auto",
    *,
    band: tuple[float, float] | None = None,
    tick: Callable[[str, float], object] | None = None,
) -> Modal:
    """Estimate `count` modes ("auto", or the most significant) that inputs excite and outputs show, in a `band` in Hz,
    default where inputs have power; EstimationError where it has too few lines.
    """

    def say(stage: str, share: float) -> None:
        if tick is not None:
            tick(stage, share)

    with one_thread():
        lines = spectra(data, band)
        starts, tried = starting_poles(lines, lambda x: say("modes: starts", x))
        unique = _kept([_Candidate(pole=p) for p in starts], lines, judged=False)
        candidates = _refine(lines, unique, lambda x: say("modes: likelihood", x)) if unique else []
    if count != "auto":
        candidates = sorted(sorted(candidates, key=lambda c: -c.gain)[:count], key=lambda c: c.pole.imag)
    limits = float(lines.omega[0] / (2 * np.pi)), float(lines.omega[-1] / (2 * np.pi))
    modes = []
    for c in candidates:  # the larger of the likelihood's interval and the jackknife's over outputs
        spreads = [(c.likelihood, NORMAL_95)]
        spreads += [(c.jackknife, student(data.n_outputs - 1))] if data.n_outputs > 1 else []
        modes.append(mode_of(c.pole, spreads, data.outputs, c.shape, c.shape_variance, visible=c.misfit < _LOST))
    checks = modes_checks(tuple(modes), count, limits, f"Excite more, longer, or give {setting('band')}")
    return Modal(
        status="converged" if candidates else "failed",
        method="maximum likelihood on the record's spectrum, transients included",
        modes=tuple(modes),
        checks={**checks, "modes_fit": _fit_check(candidates), **_rank_check(candidates, data.inputs)},
        inputs=data.inputs,
        outputs=data.outputs,
        units={x: data.units[x] for x in (*data.inputs, *data.outputs)},
        band_hz=limits,
        poles=tuple(tried),
        record=data.record,
        details={
            "energy_share": [c.share for c in candidates],
            "misfit": [c.misfit for c in candidates],
            "residual_correlation": [c.correlation for c in candidates],
            "gain": [c.gain for c in candidates],
        },
    )


def _fit_check(candidates: list[_Candidate]) -> Check:
    """Whether linear modes fit the lines about them."""
    poor = [c for c in candidates if c.misfit > _LOST or (c.misfit > _MISFIT and c.correlation > _COLOURED)]
    names = ", ".join(f"{c.frequency_hz:.4g} Hz ({100 * c.misfit:.0f} %)" for c in poor)
    if not poor:
        most = 100 * max((c.misfit for c in candidates), default=0.0)
        return Check(passed=True, detail=f"at most {most:.2g} % of the energy at a mode is left")
    return Check(
        passed=False,
        detail=f"what linear modes leave of the energy at {names} is not noise: a nonlinear or drifting resonance, or "
        "two modes in one place. Excite less, or record more outputs",
    )


def _rank_check(candidates: list[_Candidate], inputs: Sequence[str]) -> dict[str, Check]:
    """Whether each mode moves in one shape whichever input excites it: two modes in one place do not."""
    if len(inputs) < 2:
        return {}
    double = ", ".join(f"{c.frequency_hz:.4g} Hz" for c in candidates if c.second > _DOUBLE)
    detail = f"two modes in one place at {double}: frequency and damping are means, the shape is the stronger one's"
    remedy = ". Excite one plane at a time"
    return {"modes_single": Check(passed=not double, detail=detail + remedy if double else "each mode has one shape")}
