"""Three first-order blocks followed while the bearing works (thesis fig. 5.8, eq. 2.8-2.15), from filtered signals.

Voltage, current and position go through one filter each, the same, so that it cancels; then through the state-variable
filters of two regressions; recursive instrumental variables or least squares give the blocks, batch by batch.

i = K_a/(s + a) V + K_b/(s + b) x + constant is linearised in its poles; (s + c) x = K_c i + constant is divided by
s + f, which turns the derivative into x - f/(s + f) x. The voltage is held over a sample, current and position are
straight lines between samples: exact, and nothing is differentiated. Sums over batches take the place of a recursion by
samples: covariance over both equations, doubt of the first order and the weight of what was linearised elsewhere all
come from them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import ceil, exp, expm1, isfinite

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.bearing.blocks import ThreeBlocks, blocks_of, three_blocks
from ambid.errors import EstimationError
from ambid.estimation.uncertainty import p_text
from ambid.recursive.estimator import Copied, check_channels, kernels
from ambid.recursive.streaming import ScalarKalman, StreamingFilter

_WARM_UP = 4000  # samples, from which scales, means and the start are found
_BATCH = 256  # samples
_CORNER = 3.0  # of the default filter, over the pole of the coil
_FORGOTTEN = 4.0  # time constants after which a filter has forgotten how it began
_DOUBT = 1e-3  # probability under which a start is not of first order
_POOR = 0.5  # fit under which the blocks are of no use
_LONGEST_WAIT = 4  # warm-ups that are given to that
N_ROW = 21  # columns of a row, see `block_rows` of blocks_kernels.py
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


class OnlineThreeBlocks(Copied):
    """The three blocks of `ambid.bearing.blocks.three_blocks`, sample by sample or in blocks of samples.

    The first samples (`warm_up`) are kept: they give means, scales and, without `start`, the off-line estimate from
    which the regressions are linearised; computing that once takes some tenths of a second. From then on memory is
    constant. The filters follow the estimated poles at fixed counts of samples, so that splitting the stream in another
    way does not change any number. With `memory_s`, standard deviations are those of blocks that stand still: the lag
    behind a drift, about memory_s times its speed, comes on top. Where too little moves the blocks, nothing is
    forgotten and the result says so.

    Instruments are what the reference, or in open loop the voltage, makes of current and position through the present
    blocks: no noise of current and position reaches them. Without them (``instruments=False``, the thesis's recursive
    least squares) noise of the position biases TFb, and noise of both TFc; white noise little, slow noise much.

    Parameters
    ----------
    rate_hz : float
        Sampling rate in Hz.
    memory_s : float, optional
        Time constant of exponential forgetting, s; None: nothing is forgotten.
    prefilter : StreamingFilter, optional
        Put on every signal alike: a `ScalarKalman` or a `PassiveLowpass`. By default the stationary Kalman-Bucy filter
        whose gain is three times the pole of the coil. High corners lose nothing; low ones lose what tells the coil.
    with_reference : bool
        Whether `update` is given the outer excitation of a loop.
    open_loop : bool
        Say that no feedback is at work.
    instruments : bool
    start : ThreeBlocks, optional
        An estimate from off-line.
    warm_up : int
        Samples, at least 200.

    Attributes
    ----------
    n_used, n_rejected : int
        Samples that were taken in, and those that held a value that is not finite: after one, filters begin again.

    Raises
    ------
    EstimationError
        If a number is out of range.
    """

    def __init__(
        self,
        rate_hz: float,
        *,
        memory_s: float | None = None,
        prefilter: StreamingFilter | None = None,
        with_reference: bool = False,
        open_loop: bool = False,
        instruments: bool = True,
        start: ThreeBlocks | None = None,
        warm_up: int = _WARM_UP,
    ) -> None:
        check_channels("three blocks", rate_hz, 1)
        if memory_s is not None and not memory_s * rate_hz >= 4 * _BATCH:
            raise EstimationError(
                f"three blocks: a memory of {memory_s} s is {memory_s * rate_hz:.3g} samples; at least "
                f"{4 * _BATCH} are needed. Give a longer one, or None"
            )
        if isinstance(warm_up, bool) or not isinstance(warm_up, int) or warm_up < 200:
            raise EstimationError(f"three blocks: a warm-up of {warm_up!r} samples; give a whole number from 200 up")
        self._dt, self._memory_s, self._prefilter = 1.0 / rate_hz, memory_s, prefilter
        self._with_reference, self._instruments = with_reference, instruments
        self._safe, self._given = open_loop or with_reference, start
        self._waiting = np.empty((warm_up, 4 if with_reference else 3))
        self._n_waiting = 0
        self._why = "still warming up"
        self._at: Linearisation | None = None
        self._filter: StreamingFilter
        self._wait, self._start_doubt = 0, 1.0
        self.n_used = self.n_rejected = self._quiet = 0

    def update(
        self, voltage: ArrayLike, current: ArrayLike, position: ArrayLike, reference: ArrayLike | None = None
    ) -> Array:
        """Take in one sample or a block.

        Parameters
        ----------
        voltage, current, position : array_like, shape () or (n_samples,)
            In V, A and m. The voltage is held over a sample.
        reference : array_like, shape () or (n_samples,), optional
            Outer excitation of the loop, wanted where `with_reference` was said.

        Returns
        -------
        ndarray, shape (2,) or (n_samples, 2)
            Errors of the filtered current in A and of the equation of the position in m at the coefficients of the
            batch before; NaN while warming up, after a sample that was rejected, and for it.

        Raises
        ------
        EstimationError
            If shapes do not fit, or a reference is missing or not wanted.
        """
        if (reference is not None) != self._with_reference:
            raise EstimationError(
                "three blocks: a reference needs with_reference=True, and the other way round. Give both or neither"
            )
        if self._at is not None and isinstance(voltage, float) and isinstance(current, float):
            found = self._update_one(voltage, current, position, voltage if reference is None else reference)
            if found is not None:
                return found
        signals = (voltage, current, position) if reference is None else (voltage, current, position, reference)
        try:
            given = np.array(signals, dtype=np.float64)
        except ValueError:
            raise EstimationError("three blocks: signals of different lengths; give as many samples of each") from None
        if given.ndim > 2:
            raise EstimationError(f"three blocks: signals of shape {given.shape[1:]}; give numbers or (n_samples,)")
        block = np.ascontiguousarray(given.reshape(given.shape[0], -1).T)
        errors = np.full((block.shape[0], 2), np.nan)
        good = np.asarray(np.isfinite(block).all(axis=1))
        if good.all():
            self._take(block, errors)
        else:
            self._take_parts(block, good, errors)
        return errors[0] if given.ndim == 1 else errors

    def result(self) -> ThreeBlocks:
        """Return the blocks as they are now.

        Returns
        -------
        ThreeBlocks

        Raises
        ------
        EstimationError
            If too few samples were seen.
        """
        if self._at is None or not self._sums.enough:
            why = self._why if self._at is None else "too few batches for standard deviations"
            raise EstimationError(f"three blocks: no estimate after {self.n_used} samples: {why}. Give more samples")
        keep = np.array([0, 1, 2, 3, 5, 6])
        theta = np.concatenate(self._theta) * self._at.units
        v, i, x = self._scale[:3]
        unit = np.array([i / v, 1.0, i / x, 1.0, x / i, 1.0])
        both = unit * self._at.units[keep]
        covariance = self._sums.covariance()[np.ix_(keep, keep)] * np.outer(both, both)
        sd = np.sqrt(np.diag(covariance))
        behind = bool((np.abs(theta - self._at.at)[[1, 3]] > 3 * sd[[1, 3]]).any())
        fit = self._sums.fit()
        return blocks_of(
            theta[keep] * unit,
            covariance,
            self._dt,
            fit=fit,
            doubt=self._sums.doubt(),
            settled=not behind,
            safe=self._safe,
            remarks=self._remarks(fit),
        )

    def _remarks(self, fit: Mapping[str, float]) -> tuple[str, ...]:
        out = []
        if not self._instruments:
            out.append(
                "recursive least squares: noise of current and position biases the blocks. Use instruments if "
                "there is no feedback or a reference is known"
            )
        if self._quiet:
            out.append(
                f"the blocks were hardly excited for {self._quiet * self._dt:.3g} s: nothing is forgotten "
                "meanwhile, and the values are mostly from before"
            )
        if self._start_doubt < _DOUBT:
            out.append(
                f"at the start the blocks were not of first order ({p_text(self._start_doubt)}): use the values as "
                "a rough guide only, and the grey-box model for the parameters"
            )
        out += [
            f"the blocks explain little of the {name} (fit {part:.2g}): do not use them"
            for name, part in fit.items()
            if part < _POOR
        ]
        return tuple(out)

    def _update_one(self, v: float, i: float, x: ArrayLike, d: ArrayLike) -> Array | None:
        """One sample without the checks of a block; None where it needs them."""
        if not (isinstance(x, float) and isinstance(d, float) and isfinite(v + i + x + d)) or self._skip:
            return None
        one, m, g = self._one, self._offsets, self._spans
        one[0, 0], one[0, 1], one[0, 2] = (v - m[0]) / g[0], (i - m[1]) / g[1], (x - m[2]) / g[2]
        one[0, 3] = (d - m[3]) / g[3]
        self._filter.run(one, one)
        row, error = self._rows[self._filled : self._filled + 1], np.empty((1, 2))
        kernels("blocks").block_rows(one, row, error, self._state, self._constants, False)
        self.n_used += 1
        self._filled += 1
        if self._filled == _BATCH:
            self._digest()
        return (error * self._scale[1:3])[0]

    def _take_parts(self, block: Array, good: NDArray[np.bool_], errors: Array) -> None:
        edges = np.flatnonzero(np.diff(good)) + 1
        for first, last in zip([0, *edges], [*edges, good.size], strict=True):
            if good[first]:
                self._take(block[first:last], errors[first:last])
            else:
                self.n_rejected += int(last - first)
                self._forget()

    def _take(self, block: Array, errors: Array) -> None:
        self.n_used += block.shape[0]
        if self._at is None:
            n = min(block.shape[0], self._waiting.shape[0] - self._n_waiting)
            self._waiting[self._n_waiting : self._n_waiting + n] = block[:n]
            self._n_waiting += n
            if self._n_waiting < self._waiting.shape[0]:
                return
            self._begin()
            if n < block.shape[0]:
                self.n_used -= block.shape[0] - n
                self._take(block[n:], errors[n:])
            return
        self._run(block, errors)

    def _forget(self) -> None:
        """Begin the filters again after a gap; while warming up, the warm-up."""
        self._n_waiting = 0
        if self._at is not None:
            self._filter = self._filter.anew(4)
            self._fresh, self._skip = True, self._wait

    def _begin(self) -> None:
        """Find scales and the point of linearisation in the warm-up, then use its samples."""
        seen, self._n_waiting = self._waiting, 0
        mean, scale = seen.mean(axis=0), seen.std(axis=0)
        try:
            start = self._given
            if start is None:
                start = three_blocks(
                    seen[:, 0],
                    seen[:, 1],
                    seen[:, 2],
                    1.0 / self._dt,
                    reference=seen[:, 3] if self._with_reference else None,
                    open_loop=self._safe,
                )
            blocks = [start.blocks[name] for name in "abc"]
            self._start_doubt = min(start.first_order.values(), default=1.0)
            if not (scale > 0).all() or min(blocks[0].pole, blocks[1].pole) <= 0:
                raise EstimationError("a signal is constant, or the coil is not stable")
        except EstimationError as why:
            self._why = f"the first {seen.shape[0]} samples give no starting values ({why})"
            return
        drive = 3 if self._with_reference else 0
        self._mean, self._scale = (np.append(x[:3], x[drive]) for x in (mean, scale))
        self._offsets, self._spans, self._one = self._mean.tolist(), self._scale.tolist(), np.empty((1, 4))
        v, i, x = self._spans[:3]
        ka, kb, kc = blocks[0].gain * v / i, blocks[1].gain * x / i, blocks[2].gain * i / x
        self._set_up(ka, blocks[0].pole, kb, blocks[1].pole, kc, blocks[2].pole)
        self._run(seen, np.empty((seen.shape[0], 2)))
        self._waiting = np.empty((0, 0))

    def _set_up(self, ka: float, a: float, kb: float, b: float, kc: float, c: float) -> None:
        slowest = 1.0 / (_WARM_UP * self._dt)
        f = min(max(abs(c), slowest), 3.0 / self._dt)
        self._at = Linearisation(
            at=np.array([ka, a, kb, b, 0.0, kc, c, 0.0]), units=np.array([a, a, b, b, 1.0, f, f, 1.0])
        )
        if self._prefilter is None:
            self._prefilter = ScalarKalman(1.0 / self._dt, q=(_CORNER * a) ** 2, r=1.0)
        self._filter = self._prefilter.anew(4)
        self._wait = min(ceil(_FORGOTTEN / (min(a, b, f) * self._dt)), _LONGEST_WAIT * _WARM_UP)
        self._fresh, self._skip, self._filled = True, self._wait, 0
        self._rows, self._state = np.empty((_BATCH, N_ROW)), np.zeros(N_STATE)
        factor = 1.0 if self._memory_s is None else exp(-self._dt / self._memory_s)
        longest = np.inf if self._memory_s is None else self._memory_s
        stretch = min(_FORGOTTEN / min(a, b, f), longest) / (_BATCH * self._dt)
        self._sums = Sums(factor**_BATCH, factor ** np.arange(_BATCH - 1.0, -1.0, -1.0), ceil(min(stretch, 1e9)))
        self._theta = self._at.theta
        self._constants = self._at.constants(self._dt, least_squares=not self._instruments)

    def _run(self, block: Array, errors: Array) -> None:
        columns = block if block.shape[1] == 4 else block[:, [0, 1, 2, 0]]
        signals = np.ascontiguousarray((columns - self._mean) / self._scale)
        self._filter.run(signals, signals)
        done = 0
        while done < block.shape[0]:
            n = min(block.shape[0] - done, _BATCH - self._filled)
            if self._skip:
                n = min(n, self._skip)
            rows, part = self._rows[self._filled : self._filled + n], errors[done : done + n]
            kernels("blocks").block_rows(
                signals[done : done + n], rows, part, self._state, self._constants, self._fresh
            )
            self._fresh = False
            done += n
            if self._skip:
                self._skip -= n
                part[:] = np.nan
                continue
            part *= self._scale[1:3]
            self._filled += n
            if self._filled == _BATCH:
                self._digest()

    def _digest(self) -> None:
        """Use a batch: sums, coefficients, and the point of linearisation for the next."""
        self._filled = 0
        assert self._at is not None
        starving = self._sums.add(self._rows, self._theta)
        self._quiet = self._quiet + _BATCH if starving else 0
        self._theta = self._sums.solve() or self._theta
        if self._sums.enough and not starving:
            sd = np.sqrt(np.maximum(np.diag(self._sums.covariance()), 0.0))
            self._at, keep = self._at.moved(np.concatenate(self._theta), sd, self._dt)
            if self._memory_s is None:  # with forgetting, what was linearised elsewhere goes by itself
                self._sums.discount(keep)
            self._constants = self._at.constants(self._dt, least_squares=not self._instruments)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearisation:
    """Where the regressions are linearised, in scaled signals."""

    # (8,), K_a, a, K_b, b and a constant, K_c, c and a constant; gains in 1/s, poles in rad/s
    at: Array
    # (8,), by which the coefficients are measured; that of K_c is the pole by which the equation of the position is
    # divided, rad/s
    units: Array

    @property
    def theta(self) -> tuple[Array, Array]:
        """Coefficients of the two regressions, shapes (5,) and (3,)."""
        whole = self.at / self.units
        return whole[:5], whole[5:]

    def constants(self, dt: float, *, least_squares: bool) -> Array:
        """Numbers that the compiled filters want, shape (27,); the regressors may be their own instruments."""
        _, a, kb, b, _, kc, c, _ = self.at.tolist()
        f = float(self.units[5])
        in_loop = b + c > 0 and b * c > kb * kc
        # instruments have to be bounded: an unstable loop is opened, and a block that runs away is turned round
        c, back = (c, kb) if in_loop else (abs(c), 0.0)
        lags = [_lag(p, dt) for p in (a, b, f, c)]
        loop = 1.0 / (1.0 - kc * lags[3][1] * back * lags[1][1])
        filters = [lags[0][0], -expm1(-a * dt) / a, *lags[0][1:], *lags[1], *lags[2], *lags[3]]
        return np.array([*filters, *self.at, *self.units[[0, 2, 5]], back, loop, float(least_squares)])

    def moved(self, theta: Array, sd: Array, dt: float) -> tuple[Linearisation, float]:
        """Go to new estimates (8,), as far as their standard deviations let filter with them.

        Returns also what weight is left to what was linearised here: a step d of a pole p leaves an error of d²/(2 p).
        """
        now, spread = theta * self.units, sd * self.units
        new, keep = self.at.copy(), 1.0
        new[[4, 7]] = now[[4, 7]]
        for k in (0, 2):  # gain and pole of the two blocks of the current
            pole, goal = float(self.at[k + 1]), float(now[k + 1])
            if spread[k + 1] < _ADOPTED * abs(goal) and 0 < goal * dt < 20:
                new[k : k + 2] += (now[k : k + 2] - self.at[k : k + 2]) / max(1.0, 2 * abs(goal - pole) / pole)
                left = (new[k + 1] - pole) ** 2 / (2 * pole) / (_CURVED * spread[k + 1])
                keep = min(keep, float(1.0 / (1.0 + left**2)))
        if spread[5] < _ADOPTED * abs(now[5]):
            new[5:7] = now[5:7]
        return replace(self, at=new), keep


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
