"""The supervised tracker: what follows the parameters, what watches it, and who decides (thesis figs 3.1 and 5.8).

Each block's evidence is judged before it is used: does it show that something jumped, does it inform the parameters at
all? What the recursion makes of it is published only after later data have confirmed it. The operator's flags stand
above all. Every decision is an event with its reason.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.track.evidence import Evidence
from ambid.track.lines import Event, State, TrackedValue
from ambid.track.physical.parameter_filter import ParameterFilter
from ambid.track.physical.rpem import PhysicalRpem
from ambid.track.physical.signals import RecentSamples, Samples
from ambid.track.supervise.change import Alarm, ChangeDetector
from ambid.track.supervise.excitation import ExcitationMonitor
from ambid.track.supervise.gate import Gate
from ambid.track.supervise.level import ErrorLevel
from ambid.track.supervise.log import DecisionLog
from ambid.track.supervise.operator import Operator
from ambid.track.supervise.published import beside, published
from ambid.track.supervise.recovery import Recovered, Recovery, begin

Array = NDArray[np.float64]

LONGEST_S = 0.5  # window of change detection
_RELEASE = 0.8  # part of the limit under which the error has to fall to be acceptable again
_LEVEL_S = 0.1  # over which the error is taken
_SETTLE_S = 1.0  # in which the detector learns how imperfect the model is, where the start estimate says that it is
_ATTEMPTS = 5
_BENCH = ("parameter", "gain")  # kinds of numbers that describe the bench
_DISTURBED = ("offset", "unbalance")  # kinds of numbers that may jump without anything being wrong with the bench
_TELLING = 3  # blocks after which a disturbance that looks like a fault is taken for what it looks like most
_STRAY = 3.0  # moves by which such a number is widened
# Numbers that describe the noise are seen through the innovations alone: over short blocks the squares of what they
# explain are up to half as large again as chi-squared has it (as in the estimate of a root near one)
_SHORT_BLOCKS = 1.5


class Supervisor:
    """Tracks the parameters of a bench and decides what is published.

    Parameters
    ----------
    rpem : PhysicalRpem
    limit : float
        Acceptable error, in multiples of that at identification.
    operator : Operator, optional
    false_alarms_per_hour : float
    t0 : float
        Time of sample 0, s of record.
    listener : callable, optional
        Called with each event.

    Attributes
    ----------
    rpem : PhysicalRpem
        The working estimate.
    gate : Gate
        The published one.
    level : ErrorLevel
    log : DecisionLog
    operator : Operator
    updates : int
        Times that the published numbers moved.
    changes : list of Event
        Changes found, the name being that of the number which explains the data after it.
    update_s : float
        Computing time of the slowest search after a change, s.
    """

    def __init__(
        self,
        rpem: PhysicalRpem,
        *,
        limit: float = 1.5,
        operator: Operator | None = None,
        false_alarms_per_hour: float = 0.05,
        t0: float = 0.0,
        listener: Callable[[Event], None] | None = None,
    ) -> None:
        numbers, block_s = rpem.numbers, rpem.block_s
        self.rpem, self.operator, self._t0 = rpem, operator or Operator(), t0
        self._rate = numbers.rate_hz
        own, kinds = numbers.places("parameter"), np.array(numbers.kinds)
        sd = np.sqrt(np.diag(numbers.covariance))
        imperfect = numbers.overdispersion
        self._detector = ChangeDetector(
            numbers.names,
            hypotheses=[n for n, kind in zip(numbers.names, kinds, strict=True) if kind != "noise"],
            block_s=block_s,
            false_alarms_per_hour=false_alarms_per_hour,
            longest_s=LONGEST_S,
            overdispersion=imperfect,
            settle_s=_SETTLE_S if imperfect > 1.0 else 0.0,
        )
        self._excitation = ExcitationMonitor(
            numbers.names,
            reference_rate={numbers.names[j]: 1.0 / (sd[j] ** 2 * numbers.information_s) for j in own},
            held=[n for n, kind in zip(numbers.names, kinds, strict=True) if kind == "gain"],
            block_s=block_s,
            window_s=max(1.0, 4 * block_s),
        )
        self.level = ErrorLevel(limit, max(_RELEASE * limit, min(1.1, limit)), max(2, round(_LEVEL_S / block_s)))
        self.gate = Gate(
            numbers.names, start=numbers.start, covariance=numbers.covariance, t=t0, overdispersion=imperfect
        )
        self.log = DecisionLog(listener=listener)
        self._recent = RecentSamples(round(2 * LONGEST_S * self._rate))
        self._history: deque[tuple[Evidence, ParameterFilter]] = deque(maxlen=round(LONGEST_S / block_s) + 4)
        self._recovery: Recovery | None = None
        self._unconfirmed = False  # found anew, not yet accepted
        self._values = numbers.start[numbers.places("parameter", "gain")]
        self.updates, self.update_s = 0, 0.0
        self.changes: list[Event] = []

    @property
    def state(self) -> State:
        """What the tracker does at present."""
        if self.operator.holding:
            return "hold"
        if self._recovery is not None or self._unconfirmed or self.level.above:
            return "changed"
        return "frozen" if not any(self._excitation.fresh.values()) else "tracking"

    @property
    def parameters(self) -> dict[str, TrackedValue]:
        """Published physical parameters, SI."""
        return published(self.rpem.numbers, self.gate.accepted, "parameter", self._excitation.fresh)

    @property
    def extra(self) -> dict[str, TrackedValue]:
        """Published numbers beside the parameters: gains of sensors once they are found to have changed, unbalance."""
        return beside(self.rpem.numbers, self.gate.accepted, self.rpem.filter.active)

    def feed(self, samples: Samples, first: int, *, restart: bool = False) -> Array:
        """Take in consecutive samples.

        Parameters
        ----------
        samples : Samples
            All finite.
        first : int
            Number of the first one.
        restart : bool
            Samples are missing before it.

        Returns
        -------
        ndarray, shape (n_samples, n_outputs), SI
            Innovations of the working predictor.

        Raises
        ------
        ValueError
            If a sample is not finite.
        """
        if restart or first != self.rpem.stream.sample:
            self.rpem.stream.restart(first)
            self._recent.clear()
        errors = np.empty_like(samples.y)
        k, n = 0, samples.y.shape[0]
        while k < n:
            part = samples.part(k)
            used, found, evidence = self.rpem.stream.feed(part)
            errors[k : k + used] = found
            self._recent.add(part.part(0, used), first + k + used)
            k += used
            self.rpem.n_used += used
            if evidence is not None:
                self._take(evidence)
            elif used == 0:
                raise ValueError(f"sample {first + k} is not finite; the guard of the stream leaves such samples out")
        return np.asarray(errors * self.rpem.numbers.problem.scales.output)

    def order(self, flag: str) -> None:
        """Set a flag of the operator.

        Parameters
        ----------
        flag : {"track", "hold", "accept", "revert"}
        """
        try:
            self.log.add(self.operator.set(flag, self._now))
        except EstimationError as waiting:  # of two orders in one block the first counts
            self.log.add(Event(kind="refused", t=self._now, why=str(waiting)))

    @property
    def _now(self) -> float:
        return self._t0 + self.rpem.stream.sample / self._rate

    def _take(self, evidence: Evidence) -> None:
        """Judge a block, use it, and judge what came of it."""
        rpem, t = self.rpem, self._t0 + evidence.last / self._rate
        for event in self._excitation.update(evidence, t):
            self.log.add(event)
        self._activate()
        rpem.predict()
        self._history.append((evidence, rpem.filter.copy()))
        self._watch_level(evidence, t)
        if self._recovery is not None:
            self._recover(evidence, t)
        else:
            self._detector.drift = rpem.drift.variance * rpem.block_s
            alarm = self._detector.update(evidence, rpem.filter.q, rpem.filter.covariance)
            if alarm is not None and not self._undecided(alarm):
                self._alarmed(alarm, t)
            if self._recovery is None:
                rpem.drift.add(evidence, rpem.filter, rpem.noise)
                rpem.filter.absorb(evidence, rpem.noise)
                rpem.follow_noise(evidence)
                rpem.refresh()
                self._judge(evidence, t)
        self._obey(t)

    def _watch_level(self, evidence: Evidence, t: float) -> None:
        """Follow the error of the published numbers, and say when it passes its limit."""
        before = self.level.above
        error = self.level.update(evidence, self.gate.accepted.values)
        if self.level.above and not before:
            why = f"the error is {error:.2f} times that at identification, over the limit of {self.level.limit:g}"
            self.log.add(Event(kind="disturbed", t=t, why=why, values={"error": error, "detected": t}))

    def _activate(self) -> None:
        """Let the recursion move what the data inform."""
        names, active = self.rpem.numbers.names, self.rpem.filter.active
        for name, fresh in self._excitation.fresh.items():
            active[names.index(name)] = fresh

    def _undecided(self, alarm: Alarm) -> bool:
        """Wait another block or two where a disturbance and a fault of the bench explain the first ones alike."""
        doubtful = self._kind(alarm.parameter) in _DISTURBED and any(self._kind(n) in _BENCH for n, _ in alarm.rivals)
        return doubtful and alarm.blocks < _TELLING

    def _alarmed(self, alarm: Alarm, t: float) -> None:
        """Begin to deal with a change."""
        numbers, rpem = self.rpem.numbers, self.rpem
        kind = self._kind(alarm.parameter)
        moved = kind in _BENCH
        event = Event(
            kind="change" if moved else "disturbed",
            t=self._t0 + alarm.onset / self._rate,
            why=alarm.why,
            parameter=alarm.parameter,
            values={"statistic": alarm.statistic, "threshold": alarm.threshold, "detected": t},
        )
        self.log.add(event)
        if kind in _DISTURBED and alarm.parameter is not None:
            rpem.filter.widen(numbers.names.index(alarm.parameter), _STRAY * abs(alarm.size))
            self._detector.restart(rpem.stream.sample)
            self.gate.restart()
            return
        if alarm.by == "noise":
            if alarm.blocks >= _TELLING:
                rpem.noise_level = max(rpem.noise_level, alarm.noise)
            self._detector.restart(rpem.stream.sample)
            return
        if moved:
            self.changes.append(event)
        likely = [n for n, _ in alarm.rivals if self._kind(n) in _BENCH]
        if moved and alarm.parameter is not None:
            suspects = (alarm.parameter, *likely[:2])
        else:  # a fault of one thing is likelier than of several at once
            suspects = tuple(n for n in numbers.names if self._kind(n) in _BENCH)
        self.gate.restart()
        self._recovery = begin(rpem, self._history, event, onset=alarm.onset, suspects=suspects, size=alarm.size)

    def _kind(self, name: str | None) -> str | None:
        numbers = self.rpem.numbers
        return None if name is None else numbers.kinds[numbers.names.index(name)]

    def _recover(self, evidence: Evidence, t: float) -> None:
        """Search once enough samples have come; go on from what is found."""
        assert self._recovery is not None
        if evidence.last < self._recovery.ready:
            return
        found = self._recovery.attempt(self.rpem, self._recent)
        if found is not None:
            self._adopt(found, t)
        elif self._recovery.attempts >= _ATTEMPTS:
            self._give_up(t)

    def _adopt(self, found: Recovered, t: float) -> None:
        """Go on with numbers that were found anew, as a candidate for publication."""
        rpem, refined = self.rpem, found.refined
        rpem.filter, rpem.stream = refined.filter, refined.stream
        rpem.n_linearised += refined.iterations
        self.update_s = max(self.update_s, found.computing_s)
        names = ", ".join(found.moved)
        self._name(found, t)
        self._fresh_start(t)
        why = f"{names} found anew from the samples after the change in {found.computing_s * 1e3:.1f} ms"
        self._propose(t, why)
        self._unconfirmed = True

    def _name(self, found: Recovered, t: float) -> None:
        """Say which number moved where the alarm has not, or has named another: more data are there now."""
        assert self._recovery is not None
        rpem, before = self.rpem, self._recovery.before
        places = [rpem.numbers.names.index(name) for name in found.moved]
        moves = [abs(rpem.filter.q[j] - before.q[j]) / rpem.filter.sd[j] for j in places]
        name = found.moved[int(np.argmax(moves))]
        told = self._recovery.event
        if told.kind == "change" and told.parameter == name:
            return
        what = f"the data after it are explained by {', '.join(found.moved)}"
        event = Event(
            kind="change", t=told.t, parameter=name, why=f"{what}; {told.why}", values={**told.values, "named": t}
        )
        if told.kind == "change":
            self.changes[-1] = event
        else:
            self.changes.append(event)
        self.log.add(event)

    def _give_up(self, t: float) -> None:
        """Let the recursion find what no search has found: all parameters are unknown again."""
        rpem = self.rpem
        for place in rpem.numbers.places("parameter"):
            rpem.filter.widen(int(place), 0.3)
        self.log.add(
            Event(
                kind="disturbed", t=t, why="nothing explains the data after the change; all parameters are found anew"
            )
        )
        self._fresh_start(t)
        self._unconfirmed = True

    def _fresh_start(self, t: float) -> None:
        del t
        self._recovery = None
        self._history.clear()
        self.rpem.drift.restart()
        self._detector.restart(self.rpem.stream.sample)

    def _propose(self, t: float, why: str) -> None:
        rpem = self.rpem
        refused = self.gate.propose(rpem.filter.q, rpem.filter.covariance, t, why)
        if refused is not None and self._unconfirmed:
            self.log.add(refused)

    def _judge(self, evidence: Evidence, t: float) -> None:
        """Let the gate decide on the candidate; propose the next."""
        if self.operator.holding:
            return
        self.gate.overdispersion = _SHORT_BLOCKS * max(self.rpem.noise, 1.0)
        event = self.gate.judge(evidence, t) if self.gate.pending or self.gate.on_probation else None
        if event is not None:
            self._decided(event)
        if not self.gate.pending:
            self._propose(t, "the recursion went on")

    def _decided(self, event: Event) -> None:
        if event.kind == "accepted":
            own = self.rpem.numbers.places("parameter", "gain")
            values = self.gate.accepted.values[own]
            self.updates += not np.array_equal(values, self._values)
            self._values = values
            if self._unconfirmed:
                self.log.add(event)
                self._unconfirmed = False
                self.level.restart()
            return
        self.log.add(event)
        if event.kind == "reverted":
            accepted = self.gate.accepted
            self.rpem.filter.set(accepted.values, accepted.covariance)
            self.rpem.move_to(accepted.values)

    def _obey(self, t: float) -> None:
        """Carry out what the operator ordered."""
        order = self.operator.take()
        if order == "accept":
            self._propose(t, "the present estimate")
            self._decided(self.gate.accept(t))
        elif order == "revert":
            self.log.add(self.gate.revert(t, "by order of the operator"))
            self.operator.set("hold", t)
