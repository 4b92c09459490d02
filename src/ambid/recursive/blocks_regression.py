"""The two regressions of the three blocks, linearised: constants of the compiled filters, sums, covariance, doubt.

i = K_a/(s + a) V + K_b/(s + b) x + constant is linearised in its poles; (s + c) x = K_c i + constant is divided by
s + f, which turns the derivative into x - f/(s + f) x. The voltage is held over a sample, current and position are
straight lines between samples: exact, and nothing is differentiated.

Sums over batches take the place of a recursion by samples: covariance over both equations, doubt of the first order and
the weight of what was linearised elsewhere all come from them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import exp, expm1

import numpy as np

from ambid.arrays import Array

N_ROW = 21  # columns of a row, see `ambid.recursive._kernels.block_rows`
N_STATE = 21
CURRENT, POSITION = slice(0, 5), slice(6, 9)  # regressors; their targets follow
_INSTRUMENTS = (np.array([10, 11, 12, 13, 14, 18, 19, 20]), np.array([15, 16, 17, 18, 19, 20]))
_REGRESSORS = (slice(0, 6), slice(6, 10))  # with the target last
_OWN = (5, 3)
_SPARE = 3
_ADOPTED = 0.3  # part of a pole that its standard deviation may be, for the filters to follow the estimate
_LEAST_BATCHES = 8
_STRETCHES = 32  # kept apart
_WIND_UP = 16.0  # part of the best variance of a coefficient beyond which nothing is forgotten
_PATIENCE = 8.0  # memory of the scatter over that of the coefficients
_RECENT = 16  # batches over which the fit is averaged
_CURVED = 0.1  # standard deviations by which curvature may move a pole before what is linearised elsewhere counts less
_UNUSED_BATCHES = 2  # at the start, whose errors are those of the start


@dataclass(frozen=True, slots=True, kw_only=True)
class Linearisation:
    """Where the regressions are linearised, in scaled signals."""

    ka: float  # gains in 1/s, poles in rad/s, constants
    a: float
    kb: float
    b: float
    off_i: float
    kc: float
    c: float
    off_x: float
    size_a: float  # magnitudes in rad/s by which gain and pole of the two blocks of the current are measured
    size_b: float
    f: float  # pole by which the equation of the position is divided, rad/s; also its magnitude

    @property
    def theta(self) -> tuple[Array, Array]:
        """Coefficients of the two regressions, shapes (5,) and (3,)."""
        a, b, f = self.size_a, self.size_b, self.f
        return (
            np.array([self.ka / a, self.a / a, self.kb / b, self.b / b, self.off_i]),
            np.array([self.kc / f, self.c / f, self.off_x]),
        )

    @property
    def units(self) -> Array:
        """Of the eight coefficients, shape (8,)."""
        a, b, f = self.size_a, self.size_b, self.f
        return np.array([a, a, b, b, 1.0, f, f, 1.0])

    def constants(self, dt: float, *, least_squares: bool) -> Array:
        """Numbers that the compiled filters want.

        `dt`: sampling period, s; `least_squares`: whether the regressors are their own instruments. Returns (27,).
        """
        in_loop = self.b + self.c > 0 and self.b * self.c > self.kb * self.kc
        # instruments have to be bounded: an unstable loop is opened, and a block that runs away is turned round
        c, back = (self.c, self.kb) if in_loop else (abs(self.c), 0.0)
        lags = [_lag(p, dt) for p in (self.a, self.b, self.f, c)]
        loop = 1.0 / (1.0 - self.kc * lags[3][1] * back * lags[1][1])
        hold = -expm1(-self.a * dt) / self.a
        filters = [lags[0][0], hold, *lags[0][1:], *lags[1], *lags[2], *lags[3]]
        here = [self.ka, self.a, self.kb, self.b, self.off_i, self.kc, self.c, self.off_x]
        return np.array([*filters, *here, self.size_a, self.size_b, self.f, back, loop, float(least_squares)])

    def moved(self, theta: Array, sd: Array, dt: float) -> tuple[Linearisation, float]:
        """Go to new estimates, as far as they are known well enough to filter with.

        `theta`, `sd`: (8,), coefficients of both regressions, and standard deviations; `dt`: sampling period, s.
        Returns weight that is left to what was linearised here: a step d of a pole p leaves an error of d²/(2 p).
        """
        ka, a, kb, b, off_i, kc, c, off_x = (theta * self.units).tolist()
        sd = sd * self.units
        new, keep = replace(self, off_i=off_i, off_x=off_x), 1.0
        if sd[1] < _ADOPTED * abs(a) and 0 < a * dt < 20:
            step = max(1.0, 2 * abs(a - self.a) / self.a)
            new = replace(new, ka=self.ka + (ka - self.ka) / step, a=self.a + (a - self.a) / step)
            keep = min(keep, _weight(new.a - self.a, self.a, sd[1]))
        if sd[3] < _ADOPTED * abs(b) and 0 < b * dt < 20:
            step = max(1.0, 2 * abs(b - self.b) / self.b)
            new = replace(new, kb=self.kb + (kb - self.kb) / step, b=self.b + (b - self.b) / step)
            keep = min(keep, _weight(new.b - self.b, self.b, sd[3]))
        if sd[5] < _ADOPTED * abs(kc):
            new = replace(new, kc=kc, c=c)
        return new, keep


def _weight(step: float, pole: float, sd: float) -> float:
    return float(1.0 / (1.0 + (step * step / (2 * pole) / (_CURVED * sd)) ** 2))


def _lag(pole: float, dt: float) -> tuple[float, float, float]:
    """1/(s + pole) of a signal that is straight between samples: decay, weight of the new and of the old sample."""
    z = pole * dt
    alpha = exp(-z)
    if z < 1e-3:  # series: the closed form loses digits
        return alpha, dt * (0.5 - z / 6 + z * z / 24), dt * (0.5 - z / 3 + z * z / 8)
    new = (1 + expm1(-z) / z) / pole
    return alpha, new, -expm1(-z) / pole - new


class Sums:
    """Weighted sums of a stream of batches: information of both equations, and the scatter of their scores.

    The covariance comes from the scatter of the scores' sums over stretches of several batches, so that noise may have
    any colour that dies out within a stretch. Stretches double in length up to `stretch`, so that there are some from
    the beginning and long ones later (Alexopoulos and Seila 1998, batch means).

    `factor`: weight of a batch over that of the next; `weights`: (batch,), of the samples within a batch; `stretch`:
    batches after which the noise has forgotten itself.

    `moments`: instruments times regressors and target.
    """

    def __init__(self, factor: float, weights: Array, stretch: int) -> None:
        self._factor, self._weights, self._stretch = factor, weights, stretch
        self.moments = (np.zeros((8, 6)), np.zeros((6, 4)))
        self._scores = np.zeros((_STRETCHES, 14))  # of the latest stretches, the last one open
        self._closed, self._length, self._open = 0, 1, 0
        self._scatter = np.zeros((14, 14))  # of older ones
        self._all = self._some = self._older = 0.0
        self._batches = 0
        self._energy, self._best = np.zeros((2, 4)), np.full(8, np.inf)

    @property
    def enough(self) -> bool:
        """Whether there are batches enough to speak of a covariance."""
        return self._batches >= _LEAST_BATCHES

    def add(self, rows: Array, theta: tuple[Array, Array]) -> bool:
        """Take in one batch.

        `rows`: (batch, 21). Returns whether the sums tell some coefficient so little that nothing was forgotten.
        """
        fresh = [
            (rows[:, z] * self._weights[:, None]).T @ rows[:, part]
            for z, part in zip(_INSTRUMENTS, _REGRESSORS, strict=True)
        ]
        self._batches += 1
        starving = self._starving()
        if not starving:
            self.discount(self._factor, self._factor ** (1.0 / _PATIENCE))
        self._energy *= min(self._factor, 1.0 - 1.0 / _RECENT)
        scores = []
        for k, (now, at, part) in enumerate(zip(fresh, theta, _REGRESSORS, strict=True)):
            regressors = rows[:, part]
            self.moments[k][:] += now
            scores.append(now[:, -1] - now[:, :-1] @ at)
            y = regressors[:, -1]
            e = y - regressors[:, :-1] @ at
            self._energy[k] += e @ e, y @ y, y.sum(), y.size
        self._all += 1.0
        if self._batches > _UNUSED_BATCHES:
            self._some += 1.0
            self._score(np.concatenate(scores) * np.sqrt(self._all / (self._all + 1.0)))
        return starving

    def discount(self, keep: float, keep_scatter: float | None = None) -> None:
        """Give all that was seen so far less weight.

        `keep`: 0 < keep <= 1.
        """
        if keep == 1.0:
            return
        slow = keep if keep_scatter is None else keep_scatter
        for moments in self.moments:
            moments *= keep
        self._scores *= slow
        self._scatter *= slow**2
        self._all, self._some, self._older = keep**2 * self._all, slow**2 * self._some, slow**2 * self._older

    def _starving(self) -> bool:
        """Whether the sums tell some coefficient so much less than they once did that nothing more may be forgotten."""
        if self._factor == 1.0 or not self.enough:
            return False
        spread = np.concatenate([np.abs(np.diag(inverse)) for inverse in self._inverses()])
        self._best = np.minimum(self._best, spread)
        return bool((spread > _WIND_UP * self._best).any())

    def _score(self, score: Array) -> None:
        self._scores[self._closed] += score
        self._open += 1
        if self._open < self._length:
            return
        self._closed, self._open = self._closed + 1, 0
        if self._closed < _STRETCHES:
            return
        half = _STRETCHES // 2
        if 2 * self._length <= self._stretch:
            self._scores[:half] = self._scores[::2] + self._scores[1::2]
            self._length *= 2
        else:
            old = self._scores[:half]
            self._scatter += old.T @ old
            self._older += half
            self._scores[:half] = self._scores[half:]
        self._scores[half:] = 0.0
        self._closed = half

    def solve(self) -> tuple[Array, Array] | None:
        """Return the coefficients that make the instruments' sums zero.

        Returns none if the sums are singular.
        """
        electric, mechanic = self.moments
        try:
            return (
                np.asarray(np.linalg.solve(electric[:5, :5], electric[:5, 5]), dtype=np.float64),
                np.asarray(np.linalg.solve(mechanic[:3, :3], mechanic[:3, 3]), dtype=np.float64),
            )
        except np.linalg.LinAlgError:
            return None

    def covariance(self) -> Array:
        """Return the covariance of the eight coefficients.

        Returns (8, 8).
        """
        whole = np.zeros((8, 14))
        for rows, columns, inverse in zip((slice(0, 5), slice(5, 8)), (0, 8), self._inverses(), strict=True):
            whole[rows, columns : columns + inverse.shape[0]] = inverse
        out = whole @ self._scaled_scatter() @ whole.T
        return np.asarray((out + out.T) / 2)

    def doubt(self) -> dict[str, float]:
        """Return how probable first-order blocks are, by what the spare instruments show (Sargan, Hotelling).

        Returns ``current``, ``position``.
        """
        from scipy.stats import f

        scatter, out = self._scaled_scatter(), {}
        n = self._older + self._closed
        for k, (name, inverse) in enumerate(zip(("current", "position"), self._inverses(), strict=True)):
            own, moments = _OWN[k], self.moments[k]
            part = slice(8 * k, 8 * k + own + _SPARE)
            left = moments[:, -1] - moments[:, :-1] @ (inverse @ moments[:own, -1])
            keep = np.hstack([-moments[own:, :-1] @ inverse, np.eye(_SPARE)])
            square = float(
                left[own:] @ np.linalg.lstsq(keep @ scatter[part, part] @ keep.T, left[own:], rcond=1e-12)[0]
            )
            out[name] = float(f.sf(square * max(n - _SPARE, 1.0) / (_SPARE * n), _SPARE, max(n - _SPARE, 1.0)))
        return out

    def fit(self) -> dict[str, float]:
        """Return 1 - |error|/|signal| over the last batches, with the coefficients from before each.

        Returns ``current``, ``position``.
        """
        out = {}
        for k, name in enumerate(("current", "position")):
            e, y, total, n = self._energy[k]
            out[name] = float(1 - np.sqrt(e / max(y - total * total / n, 1e-300)))
        return out

    def _inverses(self) -> tuple[Array, Array]:
        electric, mechanic = self.moments
        return np.asarray(np.linalg.inv(electric[:5, :5])), np.asarray(np.linalg.inv(mechanic[:3, :3]))

    def _scaled_scatter(self) -> Array:
        recent = self._scores[: self._closed + 1]
        return np.asarray((self._scatter + recent.T @ recent) * (self._all / self._some))
