"""Frequency-domain maximum likelihood of a rotor on period spectra, its noise and feedback: e(k) = Y(k) - H(k; theta)
U(k) at the excited lines; no frequency response is formed (Pintelon and Schoukens 2012, sec. 9.11; theory.md sec. 10).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.estimation.linear import directions, least_squares, triangle_of
from ambid.estimation.search import Found, search
from ambid.physics.rotor_model import RotorModel
from ambid.rotor.response import Sampled
from ambid.rotor.spectra import Between, PeriodSpectra, smoothed
from ambid.rotor.unknowns import Unknowns

_ROOT_2 = np.sqrt(2.0)
_CORRECTIONS = 6
_FAR = 50.0  # logarithms beyond which a number is no machine's
_SETTLED = 1e-3  # squared length of a corrected step, in standard deviations, below which it is over
_NOISE_STEPS = 40
_NOISE_SETTLED = 1e-3
_COLOURED, _CLIPPED = 6.0, 8.0  # score from which noise is coloured; power over its mean up to which a line counts
_COLOURED_LINES, _POLES = 12, 10  # lines below the lowest pole of a low pass, and poles that are tried
_MOST_COLOURS = 24
_OWN_PART = 1e-3  # of the information of a coloured part, that others do not have
_LEAST = 1e-14  # level of a source, over the mean power that it would explain alone
_LINES_PER_UNKNOWN = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """A record as the estimator sees it: its spectra, and the speed at which it was taken, rad/s."""

    spectra: PeriodSpectra
    speed: float

    def between(self, low_hz: float, high_hz: float) -> Experiment:
        """Return the lines of a band."""
        f = self.spectra.frequency_hz
        return replace(self, spectra=self.spectra.lines((f >= low_hz) & (f <= high_hz)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Point:
    """Numbers by the names of the model, and delays in samples."""

    theta: Mapping[str, float]
    delays: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Noise:
    """Noise of one period's residuals, from between the excited lines: C(k) = Σ_j s_j(k) g_j(k) g_j(k)ᴴ, g_j a sensor's
    unit vector or the response to a held force or voltage. s_j is white, and where the lines ask for it has parts
    s/(1 + (w/w_p)²) beside, of first-order low passes; all s by Fisher scoring (Pintelon and Schoukens 2012, ch. 10,
    12).
    """

    # (n_parts,): variance of one period's spectrum: white ones of sensors, of disturbances, then coloured
    levels: Array
    colours: tuple[tuple[int, float], ...]  # source and w_p, rad/s, of each coloured part
    covariance: Complex  # (n_lines, n_y, n_y) at the excited lines, of one period

    def at(self, omega: Array) -> Array:
        """Return the variance of each source at angular frequencies, (n_lines, n_sources)."""
        return _of_sources(self.levels, *_parts(omega, self.levels.size - len(self.colours), self.colours))

    def sd(self, period: int, rate_hz: float) -> Array:
        """Return the rms of each source in samples of SI units: its lines of a period up to half the rate, summed."""
        omega = 2.0 * np.pi * rate_hz * np.arange(1, period // 2 + 1) / period
        return np.asarray(np.sqrt(self.at(omega).mean(axis=0) * period))


def residuals(spectra: PeriodSpectra, H: Complex) -> Complex:
    """Return Y_p - H U_p, (n_periods, n_lines, n_y)."""
    return np.asarray(spectra.Y - np.einsum("kyu,pku->pky", H, spectra.U))


def fit_noise(between: Between, response_between: Sampled, sampled: Sampled, before: Noise | None = None) -> Noise:
    """Return the noise at a model: levels by maximum likelihood between the lines (`response_between`), covariance at
    each line (`sampled`); `before`: at a model nearby.
    """
    e = between.Y - (response_between.transfer() @ between.U[:, :, None])[:, :, 0]
    g, omega = sources(response_between), response_between.omega  # (n_between, n_y, n_sources)
    n, colours = g.shape[2], () if before is None else before.colours
    power = np.real(np.einsum("kij,kij->kj", g.conj(), g))
    pulled = np.abs(np.einsum("kis,ki->ks", g.conj(), e)) ** 2 / np.maximum(power, 1e-300) ** 2
    alone = np.maximum(np.median(pulled, axis=0) / 2.0, 1e-300)
    levels = alone if before is None else before.levels
    while True:
        of, shape = _parts(omega, n, colours)
        levels, information = _levels(g, e, levels, _LEAST * alone[of], of, shape)
        more = _colours_asked(g, e, omega, levels, information, of, shape) if len(colours) < _MOST_COLOURS else ()
        if not more:
            break
        levels = np.concatenate([levels, levels[[j for j, _ in more]]])
        colours = (*colours, *more)
    at_lines = _of_sources(levels, *_parts(sampled.omega, n, colours))
    return Noise(levels=levels, colours=colours, covariance=source_covariance(sources(sampled), at_lines))


def _parts(omega: Array, n: int, colours: Sequence[tuple[int, float]]) -> tuple[NDArray[np.intp], Array]:
    """Return the source of each part of the noise, white ones first, and its spectrum over its level, (n_lines,
    n_parts).
    """
    low = [1.0 / (1.0 + (omega / pole) ** 2) for _, pole in colours]
    return np.array([*range(n), *(j for j, _ in colours)]), np.column_stack([np.ones((omega.size, n)), *low])


def _of_sources(levels: Array, of: NDArray[np.intp], shape: Array) -> Array:
    """Return the variance of each source by those of its parts, (n_lines, n_sources)."""
    return np.asarray((shape * levels) @ (of[:, None] == np.arange(of.max() + 1)))


def _seen(g: Complex, e: Complex, levels: Array) -> tuple[Array, Array]:
    """Return |gᴴ C⁻¹ e|² (n_lines, n_sources), and |gᴴ C⁻¹ g|² (n_lines, n_sources, n_sources) of sources."""
    back = np.linalg.solve(source_covariance(g, levels), np.concatenate([g, e[:, :, None]], axis=2))
    seen = np.abs(np.conj(np.swapaxes(g, 1, 2)) @ back) ** 2
    return seen[:, :, -1], seen[:, :, :-1]


def _levels(
    g: Complex, e: Complex, levels: Array, least: Array, of: NDArray[np.intp], shape: Array
) -> tuple[Array, Array]:
    """Return the levels of the parts of the noise by Fisher scoring of their logarithms, and the information of the
    levels themselves.
    """
    for _ in range(_NOISE_STEPS):
        power, products = _seen(g, e, _of_sources(levels, of, shape))
        own = np.sqrt(np.einsum("kss->ks", products))
        score = np.sum(shape * (power - own)[:, of], axis=0)
        information = np.einsum("kp,kpq,kq->pq", shape, products[:, of][:, :, of], shape, optimize=True)
        of_logs = information * np.outer(levels, levels)
        step = least_squares(of_logs + 1e-9 * np.diag(np.diag(of_logs)), levels * score)
        step = np.clip(step, -2.0, 2.0)
        levels = np.maximum(levels * np.exp(step), least)
        if float(np.max(np.abs(step) * (levels > 2.0 * least))) < _NOISE_SETTLED:
            break
    return levels, information


def _colours_asked(
    g: Complex, e: Complex, omega: Array, levels: Array, information: Array, of: NDArray[np.intp], shape: Array
) -> tuple[tuple[int, float], ...]:
    """Return a coloured part of each source whose score at level zero stands out; lines of hum count little."""
    order = np.sort(omega)
    if order.size < 2 * _COLOURED_LINES:
        return ()
    poles = np.geomspace(order[_COLOURED_LINES], order[-1], _POLES)
    _, low = _parts(omega, 0, [(0, x) for x in poles.tolist()])
    power, products = _seen(g, e, _of_sources(levels, of, shape))
    own, asked = np.sqrt(np.einsum("kss->ks", products)), []
    inverse = np.linalg.pinv(information * np.outer(levels, levels), rcond=1e-9)  # of logarithms, which have no unit
    for j in range(g.shape[2]):
        score = low.T @ (np.minimum(power[:, j], _CLIPPED * own[:, j]) - own[:, j])
        cross = low.T @ (products[:, j][:, of] * shape * levels)
        left = (low**2).T @ products[:, j, j] - np.einsum("cp,pq,cq->c", cross, inverse, cross)
        z = score / np.sqrt(np.maximum(left, _OWN_PART * ((low**2).T @ products[:, j, j])))
        k = int(np.argmax(z))
        if z[k] > _COLOURED:
            asked.append((j, float(poles[k])))
    return tuple(asked)


def sources(sampled: Sampled) -> Complex:
    """Return what each source does to the outputs, (n_lines, n_y, n_sources): sensors, then disturbances."""
    g = sampled.disturbed()
    unit = np.broadcast_to(np.eye(g.shape[1], dtype=complex), (g.shape[0], g.shape[1], g.shape[1]))
    return np.concatenate([unit, g], axis=2)


def source_covariance(g: Complex, levels: Array) -> Complex:
    """Return the covariance of outputs by sources with variances (n_lines, n_sources), (n_lines, n_y, n_y)."""
    return np.asarray((g * levels[:, None, :]) @ np.conj(np.swapaxes(g, 1, 2)))


def feedback(spectra: PeriodSpectra, H: Complex, H_between: Complex, *, measured: bool) -> Complex | None:
    """Return Q(k), what goes with the residuals in the inputs, (n_lines, n_u, n_y); None: too few lines.

    With U = R - K Y the inputs hold Q e = -(I + K H)⁻¹ K e; K, or for inputs `measured` themselves (no commands) Q,
    follows between the lines, constant with a slope over as many as its rows have unknowns, three equations for each.
    """
    spectrum_between = spectra.between
    at, n_u, n_y = spectrum_between.frequency_hz, spectrum_between.U.shape[1], spectrum_between.Y.shape[1]
    y = spectrum_between.Y - (H_between @ spectrum_between.U[:, :, None])[:, :, 0] if measured else spectrum_between.Y
    window = _LINES_PER_UNKNOWN * 2 * n_y
    if window > at.size:
        return None
    size = np.sqrt(np.mean(np.abs(y) ** 2, axis=0))
    if not np.all(size > 0.0):
        return None
    centres = np.unique(
        np.r_[np.arange(window // 2, at.size - window // 2, max(1, window // 4)), at.size - window // 2 - 1]
    )
    K = np.empty((centres.size, n_u, n_y), dtype=complex)
    for j, c in enumerate(centres):
        near = slice(c - window // 2, c - window // 2 + window)
        run = (at[near] - at[c]) / np.ptp(at[near])
        x = y[near] / size
        solution = np.linalg.lstsq(np.hstack([x, x * run[:, None]]), -spectrum_between.U[near], rcond=1e-10)[0]
        K[j] = (solution[:n_y] / size[:, None]).T
    lines = spectra.frequency_hz
    every = np.stack([np.interp(lines, at[centres], x) for x in K.reshape(centres.size, -1).T], axis=1)
    smooth: Complex = np.asarray(every.reshape(lines.size, n_u, n_y), dtype=np.complex128)
    return np.asarray(-smooth) if measured else closed(smooth, H)


def closed(K: Complex, H: Complex) -> Complex:
    """Return -(I + K H)⁻¹ K."""
    return np.asarray(-np.linalg.solve(np.eye(K.shape[1]) + K @ H, K))


def rough_covariance(spectra: PeriodSpectra, H: Complex, relative: float) -> Complex:
    """Return variances of the mean residual without a noise model, (n_lines, n_y, n_y): scatter between periods, and a
    relative error of the model, which makes the criterion smooth far from its minimum.
    """
    e = residuals(spectra, H)
    level = np.sqrt(smoothed(np.abs(spectra.mean_y) ** 2, 2))
    variance = spectra.scatter_of(e) / spectra.n_periods + (relative * level) ** 2
    return np.asarray(variance[:, :, None] * np.eye(e.shape[2]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weight:
    """How residuals of one experiment count: whitening (n_lines, n_y, n_y), and Q of the feedback."""

    whiten: Complex
    back: Complex | None = None
    noise: Noise | None = None


def sampled(experiment: Experiment, model: RotorModel, at: Point, *, between: bool = False) -> Sampled:
    """Return the model at the speed of an experiment, at its lines or between them."""
    spectra = experiment.spectra
    omega = 2.0 * np.pi * spectra.between.frequency_hz if between else spectra.omega
    return at_lines(model, at, omega, experiment.speed, spectra.rate_hz)


def at_lines(model: RotorModel, at: Point, omega: Array, speed: float, rate_hz: float) -> Sampled:
    """Return the model at a speed and angular frequencies in rad/s."""
    return Sampled(
        space=model.at_speed(speed).matrices(at.theta), omega=omega, rate_hz=rate_hz, delays=at.delays, held=model.held,
    )  # fmt: skip


def rough_weight(experiment: Experiment, model: RotorModel, at: Point, relative: float) -> Weight:
    """Return weights by scatter and a relative error of the model."""
    H = sampled(experiment, model, at).transfer()
    variance = np.real(np.diagonal(rough_covariance(experiment.spectra, H, relative), axis1=1, axis2=2))
    return Weight(whiten=(np.eye(variance.shape[1]) / np.sqrt(variance)[:, :, None]).astype(np.complex128))


def noise_weight(experiment: Experiment, model: RotorModel, at: Point, before: Weight | None = None) -> Weight:
    """Return weights by the noise model, with the feedback; `before`: those at a point nearby."""
    at_lines, spectra = sampled(experiment, model, at), experiment.spectra
    between, H = sampled(experiment, model, at, between=True), at_lines.transfer()
    noise = fit_noise(spectra.between, between, at_lines, None if before is None else before.noise)
    factor = np.linalg.cholesky(noise.covariance / spectra.n_periods)
    back = feedback(spectra, H, between.transfer(), measured=not all(at_lines.held))
    return Weight(whiten=np.linalg.inv(factor).astype(np.complex128), back=back, noise=noise)


@dataclass(frozen=True, kw_only=True, eq=False)
class Likelihood:
    """The criterion over several experiments, as `ambid.estimation.search.Problem`. Under feedback the likelihood's
    slope is that of H (U - Q e): without it weak excitation is biased.
    """

    unknowns: Unknowns
    base: Point  # what does not move
    experiments: Sequence[Experiment]
    weights: Sequence[Weight]

    def point(self, v: Array) -> Point:
        """Return the numbers at a vector."""
        theta, delays = self.unknowns.unpack(v, self.base.theta, self.base.delays)
        return Point(theta=theta, delays=delays)

    def pack(self, at: Point) -> Array:
        """Return the vector of numbers."""
        return self.unknowns.pack(at.theta, at.delays)

    def residuals(self, v: Array) -> list[Complex]:
        """Return the whitened mean residuals of each experiment, (n_lines, n_y)."""
        at = self.point(v)
        return [
            _whitened(w, e.spectra.mean_y - _applied(sampled(e, self.unknowns.model, at).transfer(), e.spectra.mean_u))
            for e, w in zip(self.experiments, self.weights, strict=True)
        ]

    def cost(self, theta: Array) -> float:
        """Return the sum of squares of whitened residuals and priors."""
        if not np.all(np.isfinite(theta)) or np.any(np.abs(theta[: len(self.unknowns.logs)]) > _FAR):
            return np.inf
        with np.errstate(all="ignore"):
            try:
                parts = [2.0 * float(np.sum(np.abs(e) ** 2)) for e in self.residuals(theta)]
            except np.linalg.LinAlgError:
                return np.inf
        total = sum(parts) + float(np.sum(self.unknowns.priors(theta)[1] ** 2))
        return total if np.isfinite(total) else np.inf

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of slopes and residuals."""
        return triangle_of([*self.rows(theta, corrected=False), self._prior_rows(theta)])

    def rows(self, v: Array, *, corrected: bool) -> list[Array]:
        """Return [J | r] of each experiment; `corrected`: slopes are those at inputs freed of what feedback put in."""
        at, model = self.point(v), self.unknowns.model
        names, chain = self.unknowns.chain(v)
        n_d = chain.shape[0] - len(names)
        blocks = []
        for e, w in zip(self.experiments, self.weights, strict=True):
            response, turned = sampled(e, model, at), model.at_speed(e.speed)
            mean = e.spectra.mean_u
            left = e.spectra.mean_y - _applied(response.transfer(), mean)
            if corrected and w.back is not None:
                mean = mean - _applied(w.back, left)
            of_turned = {p.name for p in turned.parameters}  # a record at rest shows no gyroscopic term
            columns = [k for k, name in enumerate(names) if name in of_turned]
            steps = [turned.derivative(at.theta, names[k]) for k in columns]
            moved = chain[[*columns, *range(len(names), len(names) + n_d)]]
            slopes = w.whiten @ (response.slopes(mean, steps, n_d) @ moved)
            r = _whitened(w, left)
            block = np.concatenate([slopes, r[:, :, None]], axis=2).reshape(-1, chain.shape[1] + 1)
            blocks.append(_ROOT_2 * np.concatenate([block.real, block.imag]))
        return blocks

    def _prior_rows(self, v: Array) -> Array:
        slopes, left = self.unknowns.priors(v)
        return np.column_stack([slopes, left])

    def corrected(self, v: Array) -> tuple[Array, Array, float]:
        """Return the vector where the likelihood's slope vanishes, the triangle of [J | r] there, and the squared
        length of the last full Gauss-Newton step, in standard deviations.
        """
        length = np.inf
        for k in range(_CORRECTIONS):
            R = triangle_of([*self.rows(v, corrected=True), self._prior_rows(v)])
            axes = directions(R[:, :-1])
            length = axes.explain(R[:, -1])
            if length < _SETTLED or k == _CORRECTIONS - 1:
                break
            moved = v + axes.solve(R[:, -1]) * min(1.0, 10.0 / np.sqrt(length))
            if not np.isfinite(self.cost(moved)):
                break
            v = moved
        return v, R, length

    @property
    def n_real(self) -> int:
        """Number of real residuals."""
        return sum(2 * e.spectra.mean_y.size for e in self.experiments)


def minimise(
    problem: Likelihood, at: Point, *, most: int = 40, tolerance: float = 1e-6, damping: float = 1e-3
) -> tuple[Point, Found]:
    """Search from a point; return where it ended."""
    end = search(problem, problem.pack(at), most=most, tolerance=tolerance, damping=damping, settled=1e-3, longest=1.0)
    return problem.point(end.theta), end


def _applied(H: Complex, U: Complex) -> Complex:
    return np.asarray((H @ U[:, :, None])[:, :, 0])


def _whitened(w: Weight, e: Complex) -> Complex:
    return _applied(w.whiten, e)
