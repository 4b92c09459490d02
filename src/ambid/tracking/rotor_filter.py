"""A rotor's numbers from one block of periods to the next: an extended Kalman filter on the likelihood of its spectra.

Numbers that age (force factors, stiffnesses, resistances, modes) are forgotten: P becomes D P D a block, D = exp(T/2M)
for them, 1 for geometry and mass, M the memory (Jazwinski 1970, sec. 8.12); of several, the predictions' likelihood
says which is published. After a change (`ambid.tracking.monitors.ChangeDetector`) those are released and the blocks
since fitted again, however far it jumped, unexplained ones left out; gains in likelihood tell which numbers jumped.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import triangle_of
from ambid.recursive.lines import Event
from ambid.rotor.likelihood import Experiment, Likelihood, Point, Weight, sampled
from ambid.rotor.unknowns import Unknowns
from ambid.tracking.evidence import Evidence
from ambid.tracking.monitors import Alarm, ChangeDetector

_MEMORIES = (np.inf, 60.0, 20.0, 6.0)  # blocks
_SCORED = 0.9  # by which the score of a memory fades from block to block
_RELEASED = 0.3  # standard deviation of a jump, relative
_STEPS, _SETTLED, _LONGEST = 12, 1e-3, 0.5  # of the search for a jump; squared sd; relative
_SHIFTS = np.geomspace(1e-3, 0.06, 16)  # of a mode's frequency, relative
_WINDOW = 4  # blocks of the longest window
_FAR = 6.0  # standard deviations of what no numbers explain, from which a block is left out
_LEAST = 0.1  # relative excess of that from which it matters
_TAIL, _REST = 1e-6, 2e-3  # of a jump by chance; share of a jump's statistic that others may leave over
_UNEXPLAINED = 3  # blocks in a row after which it is said


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class State:
    """Numbers over their sizes, with covariance."""

    q: Array
    P: Array


@dataclass(slots=True, kw_only=True, eq=False)
class _Memory:
    """One filter of the bank."""

    blocks: float
    state: State
    score: float = 0.0

    def predicted(self, ages: Array) -> State:
        grow = np.where(ages, np.exp(0.5 / self.blocks), 1.0)
        return replace(self.state, P=self.state.P * np.outer(grow, grow))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block:
    """Some periods of a record as one measurement."""

    experiment: Experiment
    first: int  # samples of the record: first <= k < last
    last: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """What a block said."""

    error: float  # rms of the whitened residuals before it was used
    used: bool
    settled: bool  # whether the numbers explain the data
    events: tuple[Event, ...] = ()


@dataclass(slots=True, kw_only=True, eq=False)
class RotorFilter:
    """Follow a rotor through blocks; `ages`: whether each of `unknowns.names` moves; `weight`: of a block; `memory`: in
    blocks, None: found from the data.
    """

    unknowns: Unknowns
    base: Point
    weight: Weight
    start: State
    ages: Array
    block_s: float
    t0: float
    rate_hz: float
    memory: float | None = None
    _bank: list[_Memory] = field(init=False)
    _detector: ChangeDetector = field(init=False)
    _recent: deque[tuple[Block, State]] = field(init=False)
    _since: int | None = field(init=False, default=None)  # sample from which a change is looked into
    _before: State = field(init=False)  # as predicted for that
    _doubt: int = field(init=False, default=0)  # blocks that were left out since
    _open: tuple[str, ...] = field(init=False, default=())  # numbers that jumped and are not confirmed yet

    def __post_init__(self) -> None:
        """Begin at the start."""
        memories = _MEMORIES if self.memory is None else (self.memory,)
        self._bank = [_Memory(blocks=m, state=self.start) for m in memories]
        names = self.unknowns.names
        self._detector = ChangeDetector(
            names, block_s=self.block_s, hypotheses=[n for n, on in zip(names, self.ages, strict=True) if on],
            longest_s=_WINDOW * self.block_s,
        )  # fmt: skip
        self._before = self.start
        self._recent = deque(maxlen=_WINDOW + 1)

    @property
    def best(self) -> _Memory:
        """The memory whose predictions are likeliest."""
        return max(self._bank, key=lambda m: m.score)

    @property
    def point(self) -> Point:
        """Published numbers by name."""
        return self._problem(None).point(self.best.state.q)

    def sd(self) -> Mapping[str, float]:
        """Return the standard deviations of all numbers, SI."""
        names, P = self.covariance()
        return dict(zip(names, np.sqrt(np.diag(P)).tolist(), strict=True))

    def covariance(self) -> tuple[tuple[str, ...], Array]:
        """Return the names of all numbers and their covariance, SI."""
        names, chain = self.unknowns.chain(self.best.state.q)
        chain = chain[: len(names)]
        return tuple(names), chain @ self.best.state.P @ chain.T

    def take(self, block: Block) -> Step:
        """Take in a block."""
        predicted = self.best.predicted(self.ages)
        evidence = self._evidence(block, predicted.q)
        error = float(np.sqrt((evidence.rest + evidence.r @ evidence.r) / (evidence.freedom + evidence.r.size)))
        self._recent.append((block, predicted))
        alarm = self._detector.update(evidence, predicted.q, predicted.P)
        if self._since is not None:
            return self._changed([block], error, None)
        if alarm is not None:
            window = [(b, state) for b, state in self._recent if b.last > alarm.onset] or [self._recent[-1]]
            self._since, self._before = window[0][0].first, window[0][1]
            return self._changed([b for b, _ in window], error, alarm)
        events = self._confirmed(block)
        if evidence.rest > self._limit(evidence):  # it counts less where noise is larger than at the start
            root = np.sqrt(evidence.rest / evidence.freedom)
            evidence = replace(evidence, J=evidence.J / root, r=evidence.r / root)
        for m in self._bank:  # each memory is scored by how well it predicted the block
            prior = m.predicted(self.ages)
            left, M = evidence.residual(prior.q), _spread(evidence.J, prior.P)
            m.state = _updated(prior, evidence.J, left)
            m.score = _SCORED * m.score - 0.5 * float(left @ np.linalg.solve(M, left) + np.linalg.slogdet(M)[1])
        return Step(error=error, used=True, settled=True, events=events)

    def _limit(self, evidence: Evidence) -> float:
        """Return up to what the unexplained part of a block is noise as usual."""
        far = max(_LEAST, _FAR * np.sqrt(2.0 / evidence.freedom))
        return float(self._detector.noise * evidence.freedom * (1.0 + far))

    def _confirmed(self, block: Block) -> tuple[Event, ...]:
        """Say that numbers which jumped explain a further block."""
        names, self._open = self._open, ()
        t = self.time(block.last)
        return tuple(Event(kind="accepted", parameter=n, t=t, why=f"{n} explains one more block") for n in names)

    def _changed(self, window: Sequence[Block], error: float, alarm: Alarm | None) -> Step:
        """Fit blocks since a change with the numbers that age released, and say which of them jumped."""
        before, last = self._before, window[-1]
        fitted, explained = self._fit(window, before, self.ages)
        if last not in explained:
            if explained:  # what came before it is explained: it is the first of the change
                self._since, self._before = last.first, self._recent[-1][1]
            fitted, explained = self._fit([last], self._before, self.ages, self._near(last, self._before.q))
        if not explained:
            return self._unexplained(last, error)
        before = self._before
        names, statistics = self._named(explained, fitted, before)
        again, again_fits = self._fit(explained, before, np.array([n in names for n in self.unknowns.names]), fitted.q)
        fitted = again if again_fits else fitted
        events = self._told(names, statistics, fitted, before)
        if not names:  # something else than a number made the alarm
            why = "a disturbance has passed: no number changed" if self._doubt else ""
            if alarm is not None and alarm.by == "noise":
                self._detector.noise *= alarm.noise
                if alarm.noise > 1.0:
                    why = (
                        f"noise is {alarm.noise:.2f} times as much as before (variance), with the numbers as they were"
                    )
            event = Event(kind="disturbed", t=self.time(last.last), why=why)
            events = (event,) if why else self._confirmed(last)
        for m in self._bank:
            m.state = fitted
        self._since, self._doubt, self._open = None, 0, names
        self._detector.restart(last.last)
        self._recent.clear()
        return Step(error=error, used=True, settled=True, events=events)

    def _unexplained(self, block: Block, error: float) -> Step:
        """Leave a block out that no numbers explain."""
        self._doubt += 1
        n, t = block.last - block.first, self.time(block.last)
        why = "no values of the numbers that age explain this block: a change within it, or a disturbance"
        events = [Event(kind="rejected", t=t, why=why, samples=n)]
        if self._doubt == _UNEXPLAINED:
            why = f"{self._doubt} blocks in a row do not fit the model whichever of its numbers move. Identify again"
            events.append(Event(kind="disturbed", t=t, why=why))
        return Step(error=error, used=False, settled=False, events=tuple(events))

    def _told(self, names: Sequence[str], statistics: Array, after: State, before: State) -> tuple[Event, ...]:
        now, then = (self._problem(None).point(s.q).theta for s in (after, before))
        assert self._since is not None
        events, t = [], self.time(self._since)
        sds = np.sqrt(np.diag(before.P) + np.diag(after.P))
        for name, statistic in zip(names, statistics.tolist(), strict=True):
            size, sd = now[name] / then[name] - 1.0, float(sds[self.unknowns.names.index(name)])
            why = f"{name} changed by {100.0 * size:+.3g} % (sd {100.0 * sd:.2g} %) in the block from {t:.4g} s"
            values = {"before": then[name], "after": now[name], "statistic": statistic}
            events.append(Event(kind="change", parameter=name, t=t, why=why, values=values))
        return tuple(events)

    def _near(self, block: Block, q: Array) -> Array:
        """Return a point from which modes that moved farther than they are wide are found: one frequency at a time."""
        problem, q = self._problem(block), q.copy()
        for k in [j for j, n in enumerate(self.unknowns.names) if self.ages[j] and n.endswith(".omega")] * 2:
            tried = q[k] + np.concatenate([[0.0], _SHIFTS, -_SHIFTS])
            costs = [problem.cost(np.where(np.arange(q.size) == k, x, q)) for x in tried]
            q[k] = tried[int(np.argmin(costs))]
        return q

    def _fit(
        self, blocks: Sequence[Block], before: State, released: Array, near: Array | None = None
    ) -> tuple[State, list[Block]]:
        """Fit blocks in turn from a state with some numbers released, the first from `near`; return those explained."""
        state = replace(before, P=before.P + np.diag(np.where(released, _RELEASED**2, 0.0)))
        explained: list[Block] = []
        for block in blocks:
            prior, q = state, state.q if near is None or explained else near
            evidence = self._evidence(block, q)
            for _ in range(_STEPS):
                new = _updated(prior, evidence.J, evidence.residual(prior.q))
                step = new.q - q
                far = float(np.max(np.abs(step)))
                q = q + step * min(1.0, _LONGEST / far) if far > 0.0 else q
                evidence = self._evidence(block, q)
                if float(step @ np.linalg.solve(new.P, step)) < _SETTLED:
                    break
            if evidence.rest <= self._limit(evidence):
                state = _updated(prior, evidence.J, evidence.residual(prior.q))
                explained.append(block)
        return state, explained

    def _named(self, blocks: Sequence[Block], after: State, before: State) -> tuple[tuple[str, ...], Array]:
        """Return the numbers whose jumps explain blocks, the one that explains most first, and their statistics."""
        from scipy.special import chdtri

        evidences = [self._evidence(b, after.q) for b in blocks]
        J = np.concatenate([e.J for e in evidences])
        root = np.linalg.cholesky(_spread(J, before.P))
        left = np.linalg.solve(root, np.concatenate([e.residual(before.q) for e in evidences]))
        A, places = np.linalg.solve(root, J), np.flatnonzero(self.ages).tolist()
        noise = max(self._detector.noise, 1.0)
        whole = _explained(A[:, places], left) / noise
        places_taken: list[int] = []
        gains: list[float] = []
        so_far = 0.0
        while len(places_taken) < len(places):
            missing = len(places) - len(places_taken)
            if whole - so_far <= max(float(chdtri(missing, _TAIL)), _REST * whole):
                break
            tried = {k: _explained(A[:, [*places_taken, k]], left) / noise for k in places if k not in places_taken}
            best = max(tried, key=lambda k: tried[k])
            gains.append(tried[best] - so_far)
            places_taken, so_far = [*places_taken, best], tried[best]
        return tuple(self.unknowns.names[k] for k in places_taken), np.array(gains)

    def _problem(self, block: Block | None) -> Likelihood:
        experiments = [] if block is None else [block.experiment]
        return Likelihood(
            unknowns=self.unknowns, base=self.base, experiments=experiments, weights=[self.weight] * len(experiments)
        )

    def _evidence(self, block: Block, q: Array) -> Evidence:
        """Return the evidence of a block at a point, transients between its ends taken out; slopes are of residuals."""
        problem = self._problem(block)
        (rows,) = problem.rows(q, corrected=True)
        added = self.weight.whiten @ sampled(block.experiment, self.unknowns.model, problem.point(q)).transients()
        n, p = added.shape[2], q.size
        added = added.reshape(-1, n)
        ends = np.concatenate([added.real, added.imag])
        R = triangle_of([np.column_stack([ends / np.linalg.norm(ends, axis=0), rows])])[n:, n:]
        return Evidence(
            names=self.unknowns.names, at=q, J=-R[:p, :p], r=R[:p, p], rest=float(R[p, p] ** 2), first=block.first,
            n_samples=rows.shape[0] - n, n_outputs=1, last=block.last,
        )  # fmt: skip

    def time(self, sample: int) -> float:
        """Return the seconds at a sample."""
        return self.t0 + sample / self.rate_hz


def _spread(J: Array, P: Array) -> Array:
    """Return the covariance of residuals of which J is the slope."""
    return np.asarray(np.eye(J.shape[0]) + J @ P @ J.T)


def _updated(prior: State, J: Array, left: Array) -> State:
    """Return a state after residuals, Joseph's form."""
    gain = np.linalg.solve(_spread(J, prior.P), J @ prior.P).T
    keep = np.eye(prior.q.size) - gain @ J
    return State(q=prior.q - gain @ left, P=keep @ prior.P @ keep.T + gain @ gain.T)


def _explained(A: Array, left: Array) -> float:
    """Return how much of squares the columns of A explain."""
    solution = np.linalg.lstsq(A, left, rcond=1e-12)[0]
    return float(left @ left - np.sum((left - A @ solution) ** 2))
