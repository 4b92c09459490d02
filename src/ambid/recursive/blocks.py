"""Three first-order blocks followed while the bearing works (thesis fig. 5.8, eq. 2.8-2.15), from filtered signals.

Voltage, current and position go through one filter each, the same, so that it cancels; then through the state-variable
filters of two regressions; recursive instrumental variables or least squares give the blocks, batch by batch.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from math import ceil, exp, isfinite
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.bearing.blocks import ThreeBlocks, blocks_of, three_blocks
from ambid.errors import EstimationError
from ambid.recursive.blocks_regression import N_ROW, N_STATE, Linearisation, Sums
from ambid.recursive.estimator import check_channels
from ambid.recursive.streaming import ScalarKalman, StreamingFilter

_WARM_UP = 4000  # samples, from which scales, means and the start are found
_BATCH = 256  # samples, at least
_CORNER = 3.0  # of the default filter, over the pole of the coil
_FORGOTTEN = 4.0  # time constants after which a filter has forgotten how it began
_DOUBT = 1e-3  # probability under which a start is not of first order
_POOR = 0.5  # fit under which the blocks are of no use
_LONGEST_WAIT = 4  # warm-ups that are given to that


class OnlineThreeBlocks:
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
    batch_s : float, optional
        Length of a batch, s: after it the noise has forgotten itself. At least 256 samples.

    Attributes
    ----------
    n_used, n_rejected : int
        Samples that were taken in, and those that held a value that is not finite: after one, filters begin anew.

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
        batch_s: float | None = None,
    ) -> None:
        check_channels("three blocks", rate_hz, 1)
        if memory_s is not None and not memory_s * rate_hz >= 4 * _BATCH:
            raise EstimationError(
                f"three blocks: a memory of {memory_s} s is {memory_s * rate_hz:.3g} samples; at least {4 * _BATCH} "
                "are wanted. Give a longer one, or None"
            )
        if isinstance(warm_up, bool) or not isinstance(warm_up, int) or warm_up < 200:
            raise EstimationError(f"three blocks: a warm-up of {warm_up!r} samples; give a whole number from 200 up")
        if batch_s is not None and not 0 < batch_s * rate_hz < 1e6:
            raise EstimationError(f"three blocks: a batch of {batch_s} s; give a positive time under 1e6 samples")
        self._dt, self._memory_s, self._prefilter = 1.0 / rate_hz, memory_s, prefilter
        self._with_reference, self._instruments = with_reference, instruments
        self._safe, self._given = open_loop or with_reference, start
        self._batch = max(_BATCH, 0 if batch_s is None else ceil(batch_s * rate_hz))
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
                "three blocks: a reference is given exactly where with_reference=True was said. Say so, or leave it out"
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
        behind = abs(theta[1] - self._at.a) > 3 * sd[1] or abs(theta[3] - self._at.b) > 3 * sd[3]
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

    def copy(self) -> Self:
        """Return an independent estimator in the same state.

        Returns
        -------
        OnlineThreeBlocks
        """
        return deepcopy(self)

    def _remarks(self, fit: Mapping[str, float]) -> tuple[str, ...]:
        out = []
        if not self._instruments:
            out.append(
                "recursive least squares: noise of current and position is in the regressors and biases the blocks. "
                "Use instruments where no feedback is at work or a reference is known"
            )
        if self._quiet:
            out.append(
                f"too little moved the blocks for {self._quiet * self._dt:.3g} s: nothing is forgotten meanwhile, and "
                "the numbers are mostly from before"
            )
        if self._start_doubt < _DOUBT:
            out.append(
                f"where the start comes from, no blocks of first order were seen (p = {self._start_doubt:.2g}): "
                "take the numbers as a rough guide, and the grey-box model for the parameters"
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
        self._block_rows(one, row, error, self._state, self._constants, False)
        self.n_used += 1
        self._filled += 1
        if self._filled == self._batch:
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
        """Begin the filters anew after a gap; while warming up, the warm-up."""
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
                raise EstimationError("a signal stands still, or the coil is not stable")
        except EstimationError as why:
            self._why = f"the first {seen.shape[0]} samples do not tell a start ({why})"
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
        from ambid.recursive._kernels import block_rows

        slowest = 1.0 / (_WARM_UP * self._dt)
        f = min(max(abs(c), slowest), 3.0 / self._dt)
        self._at = Linearisation(
            ka=ka, a=a, kb=kb, b=b, off_i=0.0, kc=kc, c=c, off_x=0.0, size_a=a, size_b=b, f=f
        )  # fmt: skip
        if self._prefilter is None:
            self._prefilter = ScalarKalman(1.0 / self._dt, q=(_CORNER * a) ** 2, r=1.0)
        self._filter = self._prefilter.anew(4)
        self._wait = min(ceil(_FORGOTTEN / (min(a, b, f) * self._dt)), _LONGEST_WAIT * _WARM_UP)
        self._fresh, self._skip, self._filled = True, self._wait, 0
        self._rows, self._state, self._block_rows = np.empty((self._batch, N_ROW)), np.zeros(N_STATE), block_rows
        factor = 1.0 if self._memory_s is None else exp(-self._dt / self._memory_s)
        longest = np.inf if self._memory_s is None else self._memory_s
        stretch = min(_FORGOTTEN / min(a, b, f), longest) / (self._batch * self._dt)
        self._sums = Sums(
            factor**self._batch, factor ** np.arange(self._batch - 1.0, -1.0, -1.0), ceil(min(stretch, 1e9))
        )
        self._theta = self._at.theta
        self._constants = self._at.constants(self._dt, least_squares=not self._instruments)

    def _run(self, block: Array, errors: Array) -> None:
        columns = block if block.shape[1] == 4 else block[:, [0, 1, 2, 0]]
        signals = np.ascontiguousarray((columns - self._mean) / self._scale)
        self._filter.run(signals, signals)
        done = 0
        while done < block.shape[0]:
            n = min(block.shape[0] - done, self._batch - self._filled)
            if self._skip:
                n = min(n, self._skip)
            rows, part = self._rows[self._filled : self._filled + n], errors[done : done + n]
            self._block_rows(signals[done : done + n], rows, part, self._state, self._constants, self._fresh)
            self._fresh = False
            done += n
            if self._skip:
                self._skip -= n
                part[:] = np.nan
                continue
            part *= self._scale[1:3]
            self._filled += n
            if self._filled == self._batch:
                self._digest()

    def _digest(self) -> None:
        """Use a batch: sums, coefficients, and the point of linearisation for the next."""
        self._filled = 0
        assert self._at is not None
        starving = self._sums.add(self._rows, self._theta)
        self._quiet = self._quiet + self._batch if starving else 0
        self._theta = self._sums.solve() or self._theta
        if self._sums.enough and not starving:
            sd = np.sqrt(np.maximum(np.diag(self._sums.covariance()), 0.0))
            self._at, keep = self._at.moved(np.concatenate(self._theta), sd, self._dt)
            if self._memory_s is None:  # with forgetting, what was linearised elsewhere goes by itself
                self._sums.discount(keep)
            self._constants = self._at.constants(self._dt, least_squares=not self._instruments)
