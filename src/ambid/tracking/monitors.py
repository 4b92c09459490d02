"""Monitors of the evidence: what recent data inform, whether the model error is acceptable, whether something jumped.

Without information there is no update, and what is published is marked stale: QR gathers triangles in an exponential
window, whose standard deviations, all others unknown, say what data tell now. The error's level has hysteresis (thesis
figs 3.1 and 5.8). A change is found by a generalised likelihood ratio of windows against the estimate from before them,
so that quiet statistics are exactly chi-squared (Basseville & Nikiforov 1993, ch. 7).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError, counted
from ambid.recursive.lines import Event
from ambid.recursive.square_root_kernels import deviations
from ambid.tracking.evidence import Evidence
from ambid.tracking.kernels import absorb, fold, watch


class ErrorLevel:
    """Root mean square of the normalised innovations over `window_blocks`, before which nothing is judged. It is too
    large (`above`) from `limit` on, until it comes down to `release`; `n_blocks`: blocks used.
    """

    def __init__(self, limit: float, release: float, window_blocks: int) -> None:
        self.limit, self.release = limit, release
        self.above, self.n_blocks = False, 0
        self._squares, self._weights = [0.0] * window_blocks, [0.0] * window_blocks
        self._square = self._weight = 0.0

    @property
    def error(self) -> float:
        """Present level, 1 as at identification; NaN before the first block."""
        return math.sqrt(max(self._square, 0.0) / self._weight) if self._weight else math.nan

    def update(self, evidence: Evidence, estimate: Array) -> float:
        """Take in a block, judged at `estimate` (p,), the numbers in use; return the level. One that is not finite
        changes nothing.
        """
        square, weight = evidence.loss(estimate), evidence.n_samples * evidence.n_outputs
        if not math.isfinite(square) or weight <= 0:
            return self.error
        at = self.n_blocks % len(self._squares)
        self._square += square - self._squares[at]
        self._weight += weight - self._weights[at]
        self._squares[at], self._weights[at] = square, float(weight)
        self.n_blocks += 1
        if at + 1 == len(self._squares):  # differences of sums gather rounding: sum anew once a window
            self._square, self._weight = math.fsum(self._squares), math.fsum(self._weights)
        level = self.error
        if self.n_blocks >= len(self._squares):
            self.above = level > self.release if self.above else level >= self.limit
        return level

    def restart(self) -> None:
        """Forget the blocks, as after the numbers in use were changed."""
        n = len(self._squares)
        self._squares, self._weights = [0.0] * n, [0.0] * n
        self._square = self._weight = 0.0
        self.above, self.n_blocks = False, 0


_RIDGE = 1e-3  # the numbers are of order one: one that nothing shows has a standard deviation of a thousand
_FREEZE, _THAW = 0.02, 0.05  # times the rate at identification
_WORSE = 1.5  # accuracy over `enough` at which a number is no longer fresh: hysteresis
_NOTHING = 1e-100  # entries of a triangle under this become zero: the smallest numbers take long to compute with
_FILLED = 0.5  # part of the window that has to be filled before anything is judged


class ExcitationMonitor:
    """Tell fresh parameters from frozen ones. A parameter's information rate is 1/(sd² window), sd the marginal
    (relative) standard deviation by the exponential window alone, offsets and all other numbers unknown. It freezes
    below a 50th and thaws above a 20th of the rate at identification, unless the window gives it better than
    `enough` (relative): fresh.

    `names`: all numbers of the evidence; `block_s`, `window_s`: a block and the window's time constant, s; `fresh`: of
    each parameter, all at the start; `sd`: (p,) by the window alone (about a thousand: nothing); `duration_s`: of its
    data.
    """

    def __init__(
        self,
        names: Sequence[str],
        *,
        reference_rate: Mapping[str, float],
        held: Sequence[str] = (),
        block_s: float,
        window_s: float = 1.0,
        enough: float = 0.01,
    ) -> None:
        self.names, p = tuple(names), len(names)
        self._judged = tuple(name for name in self.names if name in reference_rate)
        self._held = np.array([self.names.index(name) for name in held], dtype=np.int64)
        self._at = tuple(self.names.index(name) for name in self._judged)
        self._parameter = np.array([name in reference_rate for name in self.names])
        self._reference = np.array([reference_rate.get(name, 0.0) for name in self.names])
        information = np.inf if enough == 0.0 else enough**-2.0
        # information, and rate of it, below both of which a frozen number stays so, and a fresh one freezes
        self._limits = (information, _THAW * self._reference), (information / _WORSE**2, _FREEZE * self._reference)
        self._block, self._window, self._decay = block_s, window_s, math.exp(-block_s / window_s)
        self._keep = math.sqrt(self._decay)
        self.duration_s = 0.0
        self._R, self._rows = np.zeros((p, p)), np.zeros((p, p))
        # the ridge stands for what would be known otherwise, with all numbers free to move
        self._ridge, self._F, self._none = np.eye(p) / _RIDGE**2, np.empty((p, p)), np.zeros(p)
        self._scratch = np.ones(p, dtype=np.bool_), np.zeros(p, dtype=np.bool_), 1.0, np.zeros((p + 2, p))
        self._fresh = np.ones(p, dtype=np.bool_)
        self._known, self._rate = self._limits[1]
        self.sd = np.full(p, 1.0 / _RIDGE)

    @property
    def fresh(self) -> Mapping[str, bool]:  # noqa: D102
        return MappingProxyType({n: bool(self._fresh[i]) for n, i in zip(self._judged, self._at, strict=True)})

    def update(self, evidence: Evidence, t: float) -> tuple[Event, ...]:
        """Take in a block. `t`: its end, s of record. Returns ``frozen`` and ``thawed``, with the reason."""
        J, duration = evidence.J, self.duration_s * self._decay + self._block
        if J.shape != self._R.shape or not math.isfinite(J.sum()):
            raise EstimationError(
                f"the block at sample {evidence.first} is not finite or has other parameters. Omit it"
            )
        self._rows[:] = J.T
        if self._held.size:
            self._rows[self._held] = 0.0
        self._R *= self._keep
        self._R[np.abs(self._R) < _NOTHING] = 0.0
        fold(self._R, self._rows, len(self.names), 1)
        self._F[:] = self._ridge
        absorb(self._none, self._F, self._R, self._none, self._none, *self._scratch)
        deviations(self._F, self.sd)
        self.duration_s = duration
        if duration < _FILLED * self._window:
            return ()
        low = 1.0 / (self.sd * self.sd) < np.minimum(self._known, self._rate * duration)
        changed = self._parameter & (low == self._fresh)
        return self._events(t, changed) if changed.any() else ()

    def _events(self, t: float, changed: NDArray[np.bool_]) -> tuple[Event, ...]:
        """Turn the flags that change, and say why."""
        events = []
        for j in np.flatnonzero(changed):
            name, thawed = self.names[j], not self._fresh[j]
            sd, reference = float(self.sd[j]), float(self._reference[j])
            rate = 1.0 / (sd * sd * self.duration_s)
            part = rate / reference if reference > 0 else math.inf
            text = f"the last {self._window:g} s alone determine {name} to {100 * sd:.3g} %"
            if sd > 0.5 / _RIDGE:
                text = f"the last {self._window:g} s contain no information on {name}"
            events.append(
                Event(
                    kind="thawed" if thawed else "frozen",
                    t=t,
                    why=f"{text}, {100 * part:.2g} % of the information rate at identification",
                    parameter=name,
                    values={"sd": sd, "rate": rate, "reference_rate": reference},
                )
            )
        self._fresh = self._fresh ^ changed
        self._known, self._rate = (np.where(self._fresh, b, a) for a, b in zip(*self._limits, strict=True))
        return tuple(events)


_FEWEST = 4  # blocks of the longest window, at least
# Alarms in a quiet hour over tests in that hour times the tail of one test: neighbouring windows and hypotheses share
# their data. Counted in simulations of 1e6 blocks for six to eleven numbers; it grows slowly towards one with the
# threshold and is taken larger than what was found.
_INDEPENDENT = 0.7
_PASSED = 0.03  # share of quiet statistics above the point by which overdispersion is learned, as in the kernels
_GAIN, _NOISE_GAIN = 0.002, 2e-4  # per test, per block: of learning overdispersion and noise level
_TESTS: dict[int, tuple[Literal["number", "all", "noise"], int]] = {1: ("number", 0), 2: ("all", -2), 3: ("noise", -1)}
_RAISED = 1.5  # level of the unexplained part, over its usual one, from which no number is named
_WITHIN = 6.0  # variance of a walk of many steps about its mean, over a step's and their number
_SLOW, _DRIFTS = 16, 9.0  # blocks of a window, and statistic of a number in it, from which it may have begun to drift
_MARGIN = 9.2  # by which statistics of rivals differ by chance in one of a hundred cases
_SETTLE_NOISE = 25.0  # blocks after which the noise level is learned slower and slower while settling


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """A change that chance does not explain."""

    # one number moved; or something that no one of them explains: several at once, noise, a disturbance
    kind: Literal["moved", "unexplained"]
    # which test gave it: that of one number; of all together, or of one where it does not explain the window; of what
    # no number explains alone, so that there is no sign of the numbers having moved
    by: Literal["number", "all", "noise"]
    parameter: str | None  # which one moved
    # samples of the stream: first of the window in which the change shows best, and first after it. The change
    # happened in its first block, or in one of the first few if the window is long.
    onset: int
    end: int
    blocks: int  # length of that window
    # estimated move of `parameter` and its standard deviation, in the units of the tracked numbers; 0 if unexplained
    size: float
    sd: float
    # of the test that gave the alarm, over its overdispersion; chi-squared with one degree of freedom if `parameter`
    # moved or the noise did, with p if the statistic is that of all numbers together
    statistic: float
    threshold: float
    # other numbers, each with its statistic, that explain the window nearly as well: the name is not sure where there
    # are any. All that come close where the alarm is unexplained.
    rivals: tuple[tuple[str, float], ...]
    runner_up: tuple[str, float] | None  # second best number and its statistic
    joint: float  # statistic of all numbers together over the window
    noise: float  # what no number explains in the window per degree of freedom, over its usual level: 1 in quiet times

    @property
    def why(self) -> str:
        """The alarm in one line."""
        window = f"{counted(self.blocks, 'block')} from sample {self.onset}"
        if self.parameter is None:
            what = f"noise at {self.noise:.2f} of its usual level, all parameters together at {self.joint:.0f}"
            return (
                f"no single parameter explains {window}: {what} (statistic {self.statistic:.0f}, limit "
                f"{self.threshold:.0f})"
            )
        doubt = f"; {', '.join(n for n, _ in self.rivals)} would explain it nearly as well" if self.rivals else ""
        move = f"{self.parameter} changed by {100 * self.size:+.3g} % (sd {100 * self.sd:.2g} %)"
        return f"{move} in {window} (statistic {self.statistic:.0f}, limit {self.threshold:.0f}){doubt}"


class ChangeDetector:
    r"""Watch for a jump of one of the tracked numbers.

    For a window with triangle (J, r) and q, covariance P from before it, :math:`\rho = r + J(q - at)` has covariance
    :math:`M = I + J P J^T`; a jump δ of number j gives it the mean :math:`-J e_j δ`. :math:`T_j = (a_j^T M^{-1} ρ)^2 /
    (a_j^T M^{-1} a_j)`, :math:`a_j = J e_j`, is twice the gain in log-likelihood, chi-squared with one degree of
    freedom in quiet times. Windows are 1, 2, 3, 4, 6, 8, 12, 16, ... blocks; those of 3 and 4 times 2^n are looked at
    every 2^n. For what no one number explains: :math:`ρ^T M^{-1} ρ` (chi-squared, p), and the unexplained innovations
    against their level.

    Statistics are divided by their overdispersion, at least 1, for an imperfect model: learned for each window and
    number in quiet times (the point that three in a hundred pass, in bounded steps, so that no change is learned away),
    or a window's unexplained part per degree of freedom where larger (rising noise looks like no parameter). Without
    several times as many rows a block (samples times outputs) as numbers the second guard is not there.

    `names`: all numbers of the evidence; `joints`: causes that move several of them, each with the direction (p,);
    `block_s`, `longest_s`: a block and the longest window, s; `false_alarms_per_hour`: in quiet running with Gaussian
    evidence; `drift`: (p,); `walking`: (p,), that part of it which blurs a window; `suspected`: (p,), which
    numbers seem to have begun to drift; `threshold`: of T_j; `windows`: lengths, blocks; `overdispersion`: where
    learning starts, then (n_windows, n_hypotheses + 2), the last two all numbers together and the unexplained part;
    `noise`: its usual level per degree of freedom. May be set again any time.
    """

    def __init__(
        self,
        names: Sequence[str],
        *,
        block_s: float,
        hypotheses: Sequence[str] | None = None,
        joints: Mapping[str, Array] | None = None,
        false_alarms_per_hour: float = 0.05,
        longest_s: float = 0.5,
        overdispersion: float = 1.0,
        settle_s: float = 0.0,
    ) -> None:
        self.names = tuple(names)
        joints = joints or {}
        self.hypotheses = (*(self.names if hypotheses is None else hypotheses), *joints)
        p, tests, longest = len(self.names), len(self.hypotheses) + 2, max(_FEWEST, round(longest_s / block_s))
        levels = 1 + max(int(math.log2(longest / 3)), 0)
        lengths = [1, 2, 3, 4] + [m << level for level in range(1, levels) for m in (3, 4)]
        self.windows = tuple(n for n in lengths if n <= longest)
        per_block = 4.0 + sum(0.5**level for level in range(1, levels) for m in (3, 4) if m << level <= longest)
        hourly = 3600.0 / block_s * per_block * tests * _INDEPENDENT
        self._marks = _marks(tests, p, min(false_alarms_per_hour / hourly, 0.01))
        self.threshold = float(self._marks[0, 0])
        self._toward = np.array(
            [joints[h] if h in joints else [float(n == h) for n in self.names] for h in self.hypotheses]
        ).reshape(-1, p)
        self._long = np.array([n >= _SLOW for n in self.windows] + [False] * (len(lengths) - len(self.windows)))
        self.suspected = np.zeros(p, dtype=np.bool_)
        self._bases, self._notes = np.zeros((4 * levels, p, p + 1)), np.zeros((4 * levels, 4))
        self._counts, self._blocks, self._point = np.zeros(levels, dtype=np.int64), 0, np.zeros(p)
        self._history = np.zeros((longest + 2, p, p + 1))
        self._learned = np.full((len(lengths), tests), math.log(overdispersion))
        self.drift, self.walking = np.zeros(p), np.zeros(p)
        self.noise, self._longest = overdispersion, longest
        self._wait = 0  # blocks until statistics are quiet again
        self._scratch = np.zeros((p, p + 1)), np.zeros((p + 1, p)), np.zeros((p, p)), np.zeros((p, p + 1))
        self._found = np.zeros((len(lengths), 10 + tests))
        self._settle, self._seen, self._from = round(settle_s / block_s), 0, -1

    @property
    def overdispersion(self) -> Array:  # noqa: D102
        return np.asarray(np.exp(self._learned[: len(self.windows)]))

    def update(self, evidence: Evidence, estimate: Array, covariance: Array) -> Alarm | None:
        """Take in a block; `estimate` (p,), `covariance` (p, p): predicted for it from all data before. Returns a
        change as long as a window passes its threshold: until `restart`, or until the estimate has followed.
        """
        if evidence.first < self._from:
            return None
        p = len(self.names)
        if not self._blocks:
            self._point = evidence.at
        slot = self._counts[0] % 4
        base, before = self._bases[slot], self._history[self._blocks % len(self._history)]
        base[:, :p], base[:, p] = evidence.J, evidence.residual(self._point)
        before[:, :p], before[:, p] = covariance, estimate - self._point
        note = self._notes[slot]
        note[:] = evidence.rest, evidence.freedom, evidence.first, self._blocks
        if not math.isfinite(base.sum() + before.sum() + note[0]):
            raise EstimationError(f"a value of the block at sample {evidence.first} is not finite. Omit the block")
        self._counts[0] += 1
        self._blocks += 1
        settling, calm = self._seen < self._settle, self._wait <= 0
        self._seen += 1
        self._found[:, 0] = self._found[:, 10:] = 0.0
        passed = watch(
            self._bases, self._notes, self._counts, self._history, self._learned, self._marks, self._toward,
            self.drift, self.walking / _WITHIN, self._longest, (-1.0 if settling else _GAIN) if calm else 0.0,
            self.noise, *self._scratch, self._found,
        )  # fmt: skip
        drifts = self._found[self._long, 10 : 10 + len(self.hypotheses)].max(axis=0, initial=0.0) > _DRIFTS
        self.suspected = np.any(self._toward[drifts], axis=0)
        if passed and not settling:
            self._wait = self._longest
            return self._alarm(evidence.last)
        if not calm:
            self._wait -= 1
        elif evidence.freedom:
            gain = max(1.0 / (self._seen + _SETTLE_NOISE), _NOISE_GAIN) if settling else _NOISE_GAIN
            middle = self.noise * (1.0 - 2.0 / (9.0 * evidence.freedom)) ** 3
            self.noise *= math.exp(gain if evidence.rest / evidence.freedom > middle else -gain)
        return None

    def restart(self, from_sample: int) -> None:
        """Forget windows, as after a change that was handled, not what was learned; blocks before `from_sample` are not
        looked at.
        """
        self._counts[:], self._blocks = 0, 0
        self._wait = 0
        self._from = from_sample

    def _kind(self, row: Array) -> int:
        """Which test an alarm comes from: 1 of one number, 2 of all together, 3 of what no number explains."""
        (one, joint, rest), (top, together, left, noise) = self._marks[0, [0, -2, -1]], row[[4, 7, 8, 9]]
        if top <= one:
            return 2 if together > joint else 3
        # the one number stands for the change if what it leaves is chance or less than what it explains; where the
        # unexplained part rose as well, this is the transient of a change, or none that it could name
        clean = left <= rest or noise < _RAISED
        return 1 if clean and together - top < max(joint, top) else 2

    def _order(self, row: Array) -> float:
        """How much a window shows: one that names a number comes before one that cannot."""
        one, joint, rest = self._marks[0, [0, -2, -1]]
        return float(row[4] / one + 1e9 if self._kind(row) == 1 else max(row[7] / joint, row[8] / rest))

    def _alarm(self, end: int) -> Alarm:
        """Put the window that shows most into words."""
        row = max(self._found[self._found[:, 0] > 0.0], key=self._order)
        code, (n, onset, best, top, size, sd, joint, rest, noise) = self._kind(row), row[1:10].tolist()
        ranked = sorted(zip(self.hypotheses, row[10:].tolist(), strict=False), key=lambda item: -item[1])
        moved = code == 1
        others = tuple((name, value) for name, value in ranked if not moved or name != self.hypotheses[int(best)])
        by, place = _TESTS[code]
        return Alarm(
            kind="moved" if moved else "unexplained",
            by=by,
            parameter=self.hypotheses[int(best)] if moved else None,
            onset=int(onset),
            end=end,
            blocks=int(n),
            size=size if moved else 0.0,
            sd=sd if moved else 0.0,
            statistic={"number": top, "all": joint, "noise": rest}[by],
            threshold=float(self._marks[0, place]),
            rivals=tuple((name, value) for name, value in others if value > top - _MARGIN and value > 1.0),
            runner_up=others[0] if others else None,
            joint=joint,
            noise=noise,
        )


def _marks(tests: int, p: int, alpha: float) -> Array:
    """Return thresholds of tail `alpha`, and the points that few quiet statistics pass, shape (2, tests)."""
    from scipy.special import chdtri

    marks = np.empty((2, tests))
    for row, tail in enumerate((alpha, _PASSED)):
        marks[row] = chdtri(1, tail)
        marks[row, -2] = chdtri(p, tail)
    return marks
