"""Modal fit of synchronous responses while the speed W changes: poles s_r common to all, by variable projection.

A force exp(j angle) on a pole gives b exp(j angle), b' = (s - jW) b + 1; at an acceleration W' that is steady over the
pole's memory, with D = jW - s,

b = ∫₀^∞ exp(-D u + j W' u²/2) du = √π/(2q) w(jD/(2q)),   q² = -j W'/2,   w the Faddeeva function,

1/D at constant speed. Gyroscopic terms move the pole with the speed: with c = 1 - d Im s/dW the response is that of a
fixed pole, the distances to it over c, at the acceleration W'/c; c is known a priori as 1 ± 0.15.

Unbalance is minus the second derivative of exp(j angle): its response is that of the pole beside 1 and jW, exactly. So
the response of a loop to unbalance and run-out together is a sum of the b of all poles, free and conjugate, and of
derivatives of exp(j angle) for what lies outside the range. Every column is averaged over a block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ambid.arrays import Array, Complex
from ambid.rotor.passage import Passage
from ambid.signals.orders import blocks_around

_SERIES = 2e-3  # |W'|/|D|² up to which a series replaces the Faddeeva function
_GAUSS = ((-0.7745966692414834, 5.0 / 18.0), (0.0, 8.0 / 18.0), (0.7745966692414834, 5.0 / 18.0))
_BEYOND = 4  # derivatives of exp(j angle), from none on
_DAMPINGS = np.array([0.003, 0.01, 0.03, 0.1, 0.2, 0.4])  # ratios that are tried
_TRIED = 80  # frequencies that are tried
_REACH = 1.3  # of the highest speed, up to which poles are sought
_THIN = 800  # blocks that a trial looks at, and twice as many at most
_RIDGE = 1e-9  # of the columns of a pole that is tried
_STEPS = 40
_STILL = 1e-9  # relative change of the sum of squares
_MOVES = 0.15  # prior standard deviation of c
_FLOOR = 1e-6  # of the largest amplitude
_AROUND = 30  # blocks on either side that show the noise
_RANK = 1e-10  # of the largest singular value of the columns


def answers(s: complex | Complex, speed: Array, acceleration: Array) -> tuple[Complex, Complex, Complex]:
    """Return b, its derivative by s, and that by the logarithm of the acceleration, (n,), or of several s (m, n)."""
    D = 1j * speed - s
    small = np.abs(acceleration) <= _SERIES * np.abs(D) ** 2
    b, slope, bend = 1.0 / D, 1.0 / D**2, 2.0 / D**3
    x = 1j * acceleration / D**2  # ∫ uᵐ exp(-Du) (1 + jW'u²/2 + …) du
    series = 1.0 + x * (1.0 + 3.0 * x * (1.0 + 5.0 * x * (1.0 + 7.0 * x)))
    steeper = 1.0 + 3.0 * x * (1.0 + 5.0 * x * (1.0 + 7.0 * x * (1.0 + 9.0 * x)))
    bent = 1.0 + 6.0 * x * (1.0 + 7.5 * x * (1.0 + 28.0 / 3.0 * x))
    b, slope, bend = b * series, slope * steeper, bend * bent
    if not small.all():
        from scipy.special import wofz

        fast = ~small
        steady = np.broadcast_to(acceleration, D.shape)[fast]
        q = np.sqrt(-0.5j * steady)
        b[fast] = 0.5 * np.sqrt(np.pi) / q * wofz(0.5j * D[fast] / q)
        slope[fast] = (D[fast] * b[fast] - 1.0) / (1j * steady)
        bend[fast] = (D[fast] * slope[fast] - b[fast]) / (1j * steady)
    return b.astype(np.complex128), slope.astype(np.complex128), 0.5j * acceleration * bend


@dataclass(frozen=True, kw_only=True, eq=False)
class Course:
    """What is fitted of one passage."""

    speed: Array  # (n,), rad/s
    acceleration: Array
    half: Array  # half the length of each block, s
    amplitude: Complex  # (n, n_roles)
    sd: Array  # (n, n_roles), of real and imaginary part

    @classmethod
    def of(cls, passage: Passage) -> Course:
        """Return what is fitted of a passage: its synchronous amplitudes."""
        orders = passage.orders
        amplitude, sd = orders.of(1)
        half = 0.5 * (orders.stop - orders.first).astype(np.float64) / orders.rate_hz
        return cls(
            speed=orders.speed, acceleration=orders.acceleration, half=half, amplitude=amplitude,
            sd=np.maximum(sd, _FLOOR * np.abs(amplitude).max(axis=0)),
        )  # fmt: skip

    @property
    def floor(self) -> Array:
        """Least standard deviation, (n_roles,)."""
        return np.asarray(_FLOOR * np.abs(self.amplitude).max(axis=0))

    @cached_property
    def _points(self) -> list[tuple[float, Array]]:
        return [(weight, self.speed + at * self.half * self.acceleration) for at, weight in _GAUSS]

    def pole(self, s: complex, moving: float) -> Complex:
        """Return what a pole answers, and its derivatives by s and c, averaged over the blocks, (3, n)."""
        parts = [weight * np.array(answers(s, w, self.acceleration / moving)) for weight, w in self._points]
        return np.asarray(sum(parts) / np.array([1.0, 1.0, -moving])[:, None])

    def beyond(self, top: float) -> Complex:
        """Return derivatives of exp(j angle) over that, from none on, averaged, (n, _BEYOND)."""
        return np.asarray(sum(c * derivatives(w / top, self.acceleration / top**2) for c, w in self._points))


def derivatives(speed: Array, acceleration: Array | float = 0.0) -> Complex:
    """Return the derivatives of exp(j angle) over that, from none on, (n, _BEYOND)."""
    first = 1j * speed
    return np.column_stack(
        [np.ones(speed.size), first, first**2 + 1j * acceleration, first**3 - 3.0 * speed * acceleration]
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ModalFit:
    """Poles, and of every passage and role what the columns weigh."""

    poles: Complex  # (n_poles,), positive imaginary part, as the speed passes them
    moving: Array  # (n_poles,), c of each
    courses: tuple[Course, ...]
    top: float  # rad/s, by which derivatives are scaled
    weights: tuple[Complex, ...]  # of each passage (n_columns, n_roles): poles, conjugate poles, derivatives
    cost: float  # sum of squares of the residuals over their standard deviations
    J: Array  # (n_residuals, 3 n_poles), of those by real and imaginary part and c of each pole

    @property
    def size(self) -> int:
        """Number of real residuals."""
        return int(sum(2 * c.amplitude.size for c in self.courses))

    @property
    def freedom(self) -> int:
        """Real residuals less numbers that are fitted."""
        columns = 2 * self.poles.size + _BEYOND
        return self.size - 2 * self.poles.size - int(sum(2 * columns * c.amplitude.shape[1] for c in self.courses))

    @property
    def misfit(self) -> float:
        """Mean square of the residuals over their variance."""
        return self.cost / max(self.freedom, 1)

    @property
    def covariance(self) -> Array:
        """Of real and imaginary part and c of each pole, (3 n_poles, 3 n_poles), with a misfit above 1 counted in."""
        if not self.poles.size:
            return np.zeros((0, 0))
        size = np.linalg.norm(self.J, axis=0)
        inverse = np.linalg.pinv((self.J / size).T @ (self.J / size), rcond=1e-12, hermitian=True)
        return np.asarray(inverse / np.outer(size, size) * max(self.misfit, 1.0))

    def blocks(self, r: int) -> float:
        """Return in how many blocks of a passage a pole stands out, at most."""
        power = [np.abs(c.pole(complex(self.poles[r]), float(self.moving[r]))[0]) ** 2 for c in self.courses]
        return max(float(p.sum() ** 2 / (p**2).sum()) for p in power)

    def columns(self, poles: Complex, speed: Array) -> Complex:
        """Return the columns of the response at constant speeds, (n, n_columns)."""
        jw = 1j * speed[:, None]
        return np.hstack([1.0 / (jw - poles), 1.0 / (jw - np.conj(poles)), derivatives(speed / self.top)])

    def response(self, speed: Array, course: int = 0) -> Complex:
        """Return the response at constant speeds, (n, n_roles)."""
        return np.asarray(self.columns(self.poles, speed) @ self.weights[course])

    def drawn(self, rng: np.random.Generator, speed: Array, n: int, course: int = 0) -> list[Complex]:
        """Return `n` responses at constant speeds as they may be by the uncertainty of poles and weights."""
        c, size = self.courses[course], np.sqrt(max(self.misfit, 1.0))
        values, vectors = np.linalg.eigh(self.covariance)
        even = rng.standard_normal((n, values.size))
        even -= even.mean(axis=0)
        U, _, Vh = np.linalg.svd(even, full_matrices=False)  # with exactly the covariance, however few they are
        steps = np.sqrt(n) * U @ Vh * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        basis, up, down = _basis(c, self.poles, self.moving, self.top)
        parts = []
        for k in range(c.amplitude.shape[1]):
            inverse = np.linalg.pinv(basis / c.sd[:, k, None], rcond=_RANK)
            own = self.weights[course][:, k]
            slopes = inverse @ (_slopes(own, up, down) / c.sd[:, k, None])
            root = np.linalg.cholesky(inverse @ inverse.conj().T + 1e-12 * np.diag(np.abs(own) ** 2 + 1e-300))
            noise = root @ (rng.standard_normal((own.size, n)) + 1j * rng.standard_normal((own.size, n)))
            parts.append(own[:, None] - slopes @ steps.T + size * noise)
        at = [self.columns(self.poles + step[0::3] + 1j * step[1::3], speed) for step in steps]
        return [np.column_stack([x @ part[:, i] for part in parts]) for i, x in enumerate(at)]


def _slopes(own: Complex, up: Sequence[Complex], down: Sequence[Complex]) -> Complex:
    """Return the derivatives of a response by real and imaginary part and c of each pole, (n, 3 n_poles)."""
    n, slopes = len(up), []
    for r in range(n):
        one, other = own[r] * up[r], own[n + r] * down[r]
        slopes += [one[1] + other[1], 1j * (one[1] - other[1]), one[2] + other[2]]
    return np.column_stack(slopes) if slopes else np.zeros((0, 0), dtype=np.complex128)


def _basis(c: Course, poles: Complex, moving: Array, top: float) -> tuple[Complex, list[Complex], list[Complex]]:
    """Return all columns (n, n_columns), and what `Course.pole` says of poles and conjugate poles."""
    up, down = ([c.pole(complex(x), float(m)) for x, m in zip(g, moving, strict=True)] for g in (poles, np.conj(poles)))
    return np.column_stack([*(x[0] for x in (*up, *down)), c.beyond(top)]), up, down


def _solve(basis: Complex, target: Complex) -> tuple[Complex, Complex]:
    """Return weights by least squares, and an orthonormal basis."""
    size = np.linalg.norm(basis, axis=0)
    Q, R = np.linalg.qr(basis / size)
    U, values, Vh = np.linalg.svd(R)
    keep = values > _RANK * values[0]
    weights = (Vh[keep].conj().T / values[keep]) @ (U[:, keep].conj().T @ (Q.conj().T @ target))
    return (weights.T / size).T, Q


def fitted(courses: Sequence[Course], poles: Complex, moving: Array | None = None, *, steps: int = _STEPS) -> ModalFit:
    """Return the fit of some poles, from where they are given, by Gauss-Newton with damping (Kaufman 1975)."""
    top = max(float(c.speed.max()) for c in courses)
    damping = 1e-3
    fit, left = _projected(courses, poles, np.ones(poles.size) if moving is None else moving, top)
    for _ in range(steps if poles.size else 0):
        H, g = fit.J.T @ fit.J, fit.J.T @ left
        before = fit.cost
        while damping < 1e8 and fit.cost >= before:
            step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
            moved = _inside(fit.poles + step[0::3] + 1j * step[1::3], fit.poles, top)
            trial = _projected(courses, moved, np.clip(fit.moving + step[2::3], 0.5, 2.0), top)
            damping *= 5.0
            if trial[0].cost < before:
                (fit, left), damping = trial, max(0.04 * damping, 1e-9)
        if fit.cost > before * (1.0 - _STILL):
            break
    return fit


def _inside(poles: Complex, before: Complex, top: float) -> Complex:
    """Return poles that stay stable and oscillate, at most half the way to where they would not."""
    real = np.where(poles.real < 0.5 * before.real, poles.real, 0.5 * before.real)
    imag = np.where(poles.imag > 0.5 * before.imag, poles.imag, 0.5 * before.imag)
    real = np.maximum(real, -2.0 * np.maximum(imag, 0.02 * top))
    return np.asarray(real + 1j * np.minimum(imag, 2.0 * top))


def _projected(courses: Sequence[Course], poles: Complex, moving: Array, top: float) -> tuple[ModalFit, Array]:
    """Return the fit with all that is linear solved, and its residuals as real numbers."""
    weights, left, J = [], [], [np.zeros((0, 3 * poles.size), dtype=np.complex128)]
    for c in courses:
        basis, up, down = _basis(c, poles, moving, top)
        own = np.empty((basis.shape[1], c.amplitude.shape[1]), dtype=np.complex128)
        for k in range(c.amplitude.shape[1]):
            scaled, target = basis / c.sd[:, k, None], c.amplitude[:, k] / c.sd[:, k]
            own[:, k], Q = _solve(scaled, target)
            left.append(target - scaled @ own[:, k])
            if poles.size:
                s = _slopes(own[:, k], up, down) / c.sd[:, k, None]
                J.append(-(s - Q @ (Q.conj().T @ s)))
        weights.append(own)
    residual, slope = np.concatenate(left), np.vstack(J)
    prior = np.kron(np.eye(poles.size), [0.0, 0.0, 1.0 / _MOVES])
    real = np.concatenate([residual.real, residual.imag, (moving - 1.0) / _MOVES])
    fit = ModalFit(
        poles=poles, moving=moving, courses=tuple(courses), top=top, weights=tuple(weights),
        cost=float(real @ real), J=np.vstack([slope.real, slope.imag, prior]),
    )  # fmt: skip
    return fit, real


def reweighted(fit: ModalFit) -> ModalFit:
    """Return the fit with the noise that its own residuals show, smoothed over blocks: it is known better than by
    differences, which take neighbours for alike.
    """
    courses = []
    for c, own in zip(fit.courses, fit.weights, strict=True):
        n, length = c.speed.size, c.half[:, None]
        power = 0.5 * np.abs(c.amplitude - _basis(c, fit.poles, fit.moving, fit.top)[0] @ own) ** 2 * length
        mean = np.array([power[a:b].mean(axis=0) for a, b in blocks_around(c.speed, _AROUND)])
        lost = 1.0 - (own.shape[0] + fit.poles.size / own.shape[1]) / n
        courses.append(replace(c, sd=np.maximum(np.sqrt(mean / length / max(lost, 0.1)), c.floor)))
    return fitted(courses, fit.poles, fit.moving)


def with_another(fit: ModalFit) -> ModalFit:
    """Return the fit with one more pole, from where on a grid it explains most, roughly: in the middle of the blocks,
    the roles weighted alike.
    """
    prepared = []
    for c, own in zip(fit.courses, fit.weights, strict=True):
        some = slice(None, None, 1 + c.speed.size // _THIN)
        basis = _basis(c, fit.poles, fit.moving, fit.top)[0][some]
        level = np.median(c.sd, axis=0)
        weight = (level / c.sd[some]).mean(axis=1)[:, None]
        scaled = basis * weight
        Q = np.linalg.qr(scaled / np.linalg.norm(scaled, axis=0))[0]
        left = (c.amplitude[some] - basis @ own) * weight / level
        prepared.append((c.speed[some], c.acceleration[some], weight, Q, left))
    omega, zeta = np.linspace(min(float(c.speed.min()) for c in fit.courses), _REACH * fit.top, _TRIED), _DAMPINGS
    tried = np.outer(omega, -zeta + 1j * np.sqrt(1.0 - zeta**2)).ravel()
    gain = np.zeros(tried.size)
    for speed, acceleration, weight, Q, left in prepared:
        pair = [answers(x[:, None], speed, acceleration)[0] for x in (tried, tried.conj())]
        new = np.stack(pair, axis=-1) * weight
        new -= Q @ (Q.conj().T @ new)
        new /= np.linalg.norm(new, axis=1, keepdims=True)
        along = new.conj().transpose(0, 2, 1)
        own, both = along @ left, along @ new + _RIDGE * np.eye(2)
        gain += np.einsum("gck,gck->g", own.conj(), np.linalg.solve(both, own)).real
    return fitted(fit.courses, np.append(fit.poles, tried[int(np.argmax(gain))]), np.append(fit.moving, 1.0))
