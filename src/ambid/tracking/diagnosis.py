"""What a block shows that the estimate does not explain, and what is done about it.

A jumped number is searched in the samples since; a disturbance is given its freedom; else nothing is learned. A block
of much larger innovations is set aside: perhaps a knock. If that goes on unexplained, it is noise while plausible.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Literal

import numpy as np

from ambid.recursive.lines import Event
from ambid.tracking.evidence import Evidence, RecentSamples, Samples
from ambid.tracking.gate import Publication
from ambid.tracking.monitors import Alarm, ChangeDetector
from ambid.tracking.recovery import Recovered, Recovery, begin
from ambid.tracking.rpem import ParameterFilter, PhysicalRpem

WILD = 2.0  # times the usual variance of a block's innovations: far more than chance makes
_PERSISTENT = 3  # wild blocks on end, each with a fresh predictor: that is no knock
_BELIEVED = 25.0  # variance of the innovations over that at identification up to which it is taken as noise
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.1, 10.0  # until the next search while nothing is learned


def unexplained(evidence: Evidence) -> float:
    """Return the variance of what no number explains in a block: 1 as at identification, or if too short to tell."""
    return evidence.rest / evidence.freedom if evidence.freedom else 1.0


class Unexplained:
    """Keeps count of blocks that the model does not explain: `blocks` wild ones on end, whether it is `deaf` (learns
    nothing: the error is beyond believable noise), and `noise`, the variance taken over that at identification, 1 if it
    never rose.
    """

    def __init__(self) -> None:
        self.blocks, self.deaf, self.noise = 0, False, 1.0
        self._sum, self._wait = 0.0, _FIRST_WAIT_S
        self._again = 0.0

    @property
    def level(self) -> float:
        """Mean variance of the wild blocks but the first, in which it began."""
        return self._sum / max(self.blocks - 1, 1) if self.blocks else 1.0

    @property
    def persists(self) -> bool:
        """Whether it is no knock."""
        return self.blocks >= _PERSISTENT

    @property
    def believable(self) -> bool:
        """Whether it may be noise."""
        return self.level <= _BELIEVED

    def count(self, variance: float) -> None:
        """Count a wild block."""
        self.blocks += 1
        self._sum = variance if self.blocks <= 2 else self._sum + variance

    def close_ears(self, t: float) -> None:
        """Learn nothing until it is over, or until a search is due. `t`: s of record."""
        self.deaf = True
        self._again = t + self._wait
        self._wait = min(2.0 * self._wait, _LONGEST_WAIT_S)

    def search_due(self, t: float) -> bool:
        """Tell whether it is time to look again for a change that explains it. `t`: s of record."""
        return self.deaf and t >= self._again

    def over(self) -> None:
        """Begin again: the model explains the data again."""
        self.blocks, self._sum, self.deaf, self._wait = 0, 0.0, False, _FIRST_WAIT_S


LONGEST_S = 0.5  # window of change detection
_SETTLE_S = 1.0  # in which the detector learns how imperfect the model is, where the start estimate says that it is
_ATTEMPTS = 5
_BENCH = ("parameter", "gain")  # kinds of numbers that describe the bench
_DISTURBED = ("offset", "unbalance")  # kinds of numbers that may jump without anything being wrong with the bench
_SUDDEN = 16  # blocks of the longest window in which something unnamed is taken for a jump
_TELLING = 2  # further blocks that are waited for where the first ones leave open what it is
_ALIKE = 0.5  # of the best statistic: what explains so much of the first blocks of a jump is not ruled out by them
_WORTH = 1.25  # rise of the innovations' variance that is worth a word
_STRAY = 3.0  # moves by which such a number is widened
_UNKNOWN = 0.3  # relative standard deviation of a parameter of which nothing is known any more


class Diagnosis:
    """Watches the evidence of a working estimate, and deals with what it finds; `t0`: time of sample 0, s of record.
    `settling`: a disturbance is being learned; `renewed`: the last block put the estimate elsewhere; `changes`: each
    with the name of the number that explains the data after it; `update_s`: time of the slowest search after a change,
    s.
    """

    def __init__(
        self,
        rpem: PhysicalRpem,
        publication: Publication,
        tell: Callable[[Event], None],
        *,
        t0: float,
    ) -> None:
        numbers, imperfect = rpem.numbers, rpem.numbers.overdispersion
        self._rpem, self._publication, self._tell, self._t0 = rpem, publication, tell, t0
        kinds = {**dict(zip(numbers.names, numbers.kinds, strict=True)), **dict.fromkeys(numbers.joints, "parameter")}
        self._kinds = kinds
        self._bench = tuple(n for n, kind in kinds.items() if kind in _BENCH)
        self._detector = ChangeDetector(
            numbers.names,
            hypotheses=[n for n in numbers.names if kinds[n] != "noise"],
            joints={cause: numbers.direction(cause) for cause in numbers.joints},
            block_s=rpem.block_s,
            longest_s=LONGEST_S,
            overdispersion=imperfect,
            settle_s=_SETTLE_S if imperfect > 1.0 else 0.0,
        )
        self._recent = RecentSamples(round(2 * LONGEST_S * numbers.rate_hz))
        self._history: deque[tuple[Evidence, ParameterFilter]] = deque(maxlen=round(LONGEST_S / rpem.block_s) + 4)
        self._recovery: Recovery | None = None
        self.unexplained = Unexplained()
        self.settling = self.renewed = False
        self._waited = 0  # blocks, to see what an alarm is of
        self.changes: list[Event] = []
        self.update_s = 0.0

    @property
    def searching(self) -> bool:
        """Whether a change was found, and its new value was not."""
        return self._recovery is not None

    @property
    def doubted(self) -> bool:
        """Whether the published numbers are known to be no longer right, and better ones have not been confirmed."""
        return self._recovery is not None or self._publication.unconfirmed or self.unexplained.deaf

    @property
    def noise(self) -> float:
        """Variance of the noise over that at identification, as it was taken: 1 if it never rose."""
        return self.unexplained.noise

    def keep(self, samples: Samples, last: int) -> None:
        """Keep samples for a search; `last`: number of the sample after them."""
        self._recent.add(samples, last)

    def restart(self, sample: int) -> None:
        """Start the predictor again, as after a gap; a search waits for samples from `sample`, the next, on."""
        self._rpem.stream.restart(sample)
        self._recent.clear()
        if self._recovery is not None:
            self._recovery.restart(sample, self._rpem)

    def forget(self, sample: int) -> None:
        """Look for changes from a sample on, as after a long gap."""
        self._history.clear()
        self._detector.restart(sample)

    def look(self, evidence: Evidence, t: float) -> bool:
        """Judge a block before it is used, `t` its end in s of record: whether the recursion may learn from it."""
        rpem, self.renewed = self._rpem, False
        self._history.append((evidence, rpem.filter.copy()))
        if self._recovery is not None:
            self._recover(evidence, t)
            return False
        if self.unexplained.deaf:
            sample = self._rpem.stream.sample
            if unexplained(evidence) <= WILD * self._detector.noise:
                self.unexplained.over()
                self._detector.restart(sample)
                self._tell(Event(kind="thawed", t=t, why="the model explains the data again"))
            elif self.unexplained.search_due(t):
                why = "the model does not explain the data"
                self._search(Event(kind="disturbed", t=t, why=why, values={"detected": t}), sample, self._bench)
            return False
        self._detector.drift = rpem.drift.variance * rpem.block_s
        self._detector.walking = rpem.drift.risen * rpem.block_s
        alarm = self._detector.update(evidence, rpem.filter.q, rpem.filter.covariance)
        if alarm is not None:
            return False if self._undecided(alarm) else self._alarmed(alarm, evidence, t)
        rpem.drift.suspected |= self._detector.suspected
        self._waited = 0
        if self.unexplained.blocks and unexplained(evidence) <= WILD * self._detector.noise:
            self.unexplained.over()
        return True

    def _undecided(self, alarm: Alarm) -> bool:
        """Wait for another block where the first leave open what happened: a jump inside a block looks like many
        things. A disturbance and a fault of the bench that explain the first blocks alike get two.
        """
        if alarm.by == "noise":
            return False
        close = [name for name, _ in alarm.rivals]
        if alarm.runner_up is not None and alarm.runner_up[1] > _ALIKE * alarm.statistic:
            close.append(alarm.runner_up[0])
        suspects = [alarm.parameter] if alarm.parameter is not None else []
        mixed = len({self._kind(name) in _DISTURBED for name in (*suspects, *close)}) > 1
        self._waited += 1
        early = alarm.blocks == 1 or (alarm.blocks <= _TELLING + 1 and bool(alarm.rivals))
        return self._waited <= (_TELLING if mixed else int(early))

    def _kind(self, name: str | None) -> str | None:
        return None if name is None else self._kinds[name]

    def _alarmed(self, alarm: Alarm, evidence: Evidence, t: float) -> bool:
        """Begin to deal with an alarm; tell whether the block may be used."""
        self._waited = 0
        name, kind = alarm.parameter, self._kind(alarm.parameter)
        moved: Literal["change", "disturbed"] = "change" if kind in _BENCH else "disturbed"
        event = Event(
            kind=moved,
            t=self._t0 + alarm.onset / self._rpem.numbers.rate_hz,
            why=alarm.why,
            parameter=name,
            values={"statistic": alarm.statistic, "threshold": alarm.threshold, "detected": t},
        )
        if alarm.by == "noise":
            return self._noisy(alarm, event, unexplained(evidence))
        self._tell(event)
        self.unexplained.over()
        doubt = self._publication.restart() ** 2  # so much may have been taken for what goes on
        for filter_ in (self._rpem.filter, *(known for _, known in self._history)):
            filter_.walk(doubt)
        if name is not None and kind in _DISTURBED:
            self._rpem.filter.widen(self._rpem.numbers.direction(name), _STRAY * abs(alarm.size))
            self._rpem.drift.suspected |= self._rpem.numbers.direction(name) != 0.0  # it may go on as it has begun
            self._detector.restart(self._rpem.stream.sample)
            self.settling = True
            return alarm.blocks > 1  # in its own block the jump has a beginning: that says nothing of what holds now
        if alarm.kind != "moved" and alarm.blocks > _SUDDEN:  # nothing jumped: the recursion has to follow
            self._rpem.drift.suspected[:] = True
            self._detector.restart(self._rpem.stream.sample)
            return True
        suspects = self._bench  # a fault of one thing is likelier than of several at once
        if name is not None and kind in _BENCH:
            self.changes.append(event)
            if alarm.blocks > _SUDDEN:
                drift = self._rpem.drift
                if drift.adapts:  # it may go on as it has begun
                    faster = (alarm.size * self._rpem.numbers.direction(name)) ** 2
                    drift.variance = np.maximum(drift.variance, faster / (alarm.blocks * self._rpem.block_s))
            suspects = (name, *[n for n, _ in alarm.rivals if self._kind(n) in _BENCH][:2])
        self._search(event, alarm.onset, suspects, size=alarm.size, blocks=alarm.blocks)
        return False

    def _noisy(self, alarm: Alarm, event: Event, variance: float) -> bool:
        """Deal with innovations that no number explains; tell whether the block may be used."""
        usual, sample = self._detector.noise, self._rpem.stream.sample
        if variance <= WILD * usual:  # a little more, or less, than usual over many blocks
            if alarm.noise > _WORTH:
                self._tell(event)
            self._take_as_noise(usual * alarm.noise)
            return True
        self.unexplained.count(variance)
        if self.unexplained.blocks == 1:
            self._tell(event)
        if self.unexplained.persists:
            self._search(event, alarm.onset, self._bench)
        else:
            self.restart(sample)
            self._detector.restart(sample)
        return False

    def _take_as_noise(self, variance: float) -> None:
        """Go on with another noise level."""
        self._rpem.noise_level = variance
        self.unexplained.noise = max(variance, 1.0)
        self._detector.noise = variance
        self._detector.restart(self._rpem.stream.sample)

    def _search(
        self, event: Event, onset: int, suspects: tuple[str, ...], *, size: float = 0.0, blocks: int = 0
    ) -> None:
        self._recovery = begin(
            self._rpem, self._history, event, onset=onset, suspects=suspects, size=size, blocks=blocks
        )

    def _recover(self, evidence: Evidence, t: float) -> None:
        """Search once enough samples have come; go on from what is found."""
        assert self._recovery is not None
        if evidence.last < self._recovery.ready:
            return
        recovered = self._recovery.attempt(self._rpem, self._recent)
        if recovered is not None:
            self._adopt(recovered, t)
        elif self.unexplained.blocks:
            self._no_change(t)
        elif self._recovery.attempts >= _ATTEMPTS and unexplained(evidence) > WILD * self._detector.noise:
            self.unexplained.count(unexplained(evidence))
            self._no_change(t)
        elif self._recovery.attempts >= _ATTEMPTS:
            numbers = self._rpem.numbers
            for place in numbers.places("parameter"):  # the recursion has to find what no search has
                self._rpem.filter.widen(numbers.direction(numbers.names[place]), _UNKNOWN)
            why = "nothing explains the data after the change; all parameters are re-estimated"
            self._tell(Event(kind="disturbed", t=t, why=why))
            self._fresh_start()
            self._publication.unconfirmed = True

    def _adopt(self, recovered: Recovered, t: float) -> None:
        """Go on with numbers that were found again, as a candidate for publication."""
        rpem, refined = self._rpem, recovered.refined
        self.update_s = max(self.update_s, recovered.computing_s)
        if refined is None or not recovered.moved:  # it was a knock: nothing has moved
            self._fresh_start()
            return
        rpem.filter, rpem.stream = refined.filter, refined.stream
        rpem.n_linearised += refined.iterations
        self.unexplained.over()
        self._name(recovered, t)
        self._fresh_start()
        if all(self._kind(name) in _DISTURBED for name in recovered.moved):
            self.settling = True
            return
        why = f"{recovered.text} re-estimated from the samples after the change"
        self._publication.propose(t, why)
        self._publication.unconfirmed = self.renewed = True

    def _name(self, recovered: Recovered, t: float) -> None:
        """Say which number moved where the alarm has not, or has named another: more data are there now."""
        assert self._recovery is not None
        name, first = recovered.moved[0], self._recovery.event
        if recovered.together:
            rpem, before = self._rpem, self._recovery.before
            places = [rpem.numbers.names.index(name) for name in recovered.moved]
            moves = [abs(rpem.filter.q[j] - before.q[j]) / rpem.filter.sd[j] for j in places]
            name = recovered.moved[int(np.argmax(moves))]
        if first.kind == "change" and first.parameter == name:
            return
        disturbed = self._kind(name) in _DISTURBED
        what = f"a change of {recovered.text} explains the data that followed"
        event = Event(
            kind="disturbed" if disturbed else "change",
            t=first.t,
            parameter=name,
            why=f"{what}; at first: {first.why}",
            values={**first.values, "named": t},
        )
        if first.kind == "change":
            self.changes.pop()
        if not disturbed:
            self.changes.append(event)
        self._tell(event)

    def _no_change(self, t: float) -> None:
        """No change explains wild innovations: they are noise as long as that can be believed."""
        level, deaf = self.unexplained.level, self.unexplained.deaf
        size = f"the innovation variance is {level:.3g} times that at identification"
        self._fresh_start()
        if self.unexplained.believable and not deaf:
            self.unexplained.over()
            self._take_as_noise(level)
            self._tell(
                Event(kind="disturbed", t=t, why=f"{size}, and no change of a parameter explains it: treated as noise")
            )
            return
        if not deaf:
            self._tell(Event(kind="frozen", t=t, why=f"{size}: the model does not fit, and learning is suspended"))
        self.unexplained.close_ears(t)

    def _fresh_start(self) -> None:
        self._recovery = None
        self._history.clear()
        self._rpem.drift.restart()
        self._detector.restart(self._rpem.stream.sample)
