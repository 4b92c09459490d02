"""The supervised tracker: what follows the parameters, what watches it, and who decides (thesis figs 3.1 and 5.8).

Evidence is judged before use: did something jump, does it inform? Only what later data confirm is published; the
operator's flags stand above all, and every decision is an event with its reason.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.recursive.lines import Choice, Event, State, TrackedValue
from ambid.tracking.diagnosis import LONGEST_S, Diagnosis
from ambid.tracking.evidence import Evidence, RecentSamples, Samples
from ambid.tracking.gate import Accepted, Operator, Publication, beside, published
from ambid.tracking.monitors import ErrorLevel, ExcitationMonitor
from ambid.tracking.numbers import TrackedNumbers
from ambid.tracking.recovery import begin
from ambid.tracking.rpem import Memory, PhysicalRpem

SILENT_S = 1.0  # without evidence, after which the published numbers are stale; sooner if there never was any
_RELEASE = 0.8  # part of the limit under which the error has to fall to be acceptable again
_LEVEL_S = 0.1  # over which the error is taken


class Supervisor:
    """Tracks the parameters of a bench by `rpem`, the working estimate, and decides what is published; `limit`:
    acceptable error, in multiples of that at identification; `t0`: time of sample 0, s of record; `listener`: called
    with each event.
    """

    def __init__(
        self,
        rpem: PhysicalRpem,
        *,
        limit: float = 1.5,
        operator: Operator | None = None,
        t0: float = 0.0,
        listener: Callable[[Event], None] = lambda _: None,
    ) -> None:
        numbers, block_s = rpem.numbers, rpem.block_s
        self.rpem, self.operator, self._t0 = rpem, operator or Operator(), t0
        self._rate = numbers.rate_hz
        own, sd = numbers.places("parameter"), np.sqrt(np.diag(numbers.covariance))
        self._excitation = ExcitationMonitor(
            numbers.names,
            reference_rate={numbers.names[j]: 1.0 / (sd[j] ** 2 * numbers.information_s) for j in own},
            held=[numbers.names[j] for j in numbers.places("gain")],
            block_s=block_s,
            window_s=max(1.0, 4 * block_s),
        )
        self.level = ErrorLevel(limit, max(_RELEASE * limit, min(1.1, limit)), max(2, round(_LEVEL_S / block_s)))
        self._tell = listener
        self.publication = Publication(rpem, self.operator, listener, t0)
        self.diagnosis = Diagnosis(rpem, self.publication, listener, t0=t0)
        self._silent, self._heard, self._deaf_s = False, 0, 0.0  # no evidence since when: sample, and s
        self._spoken = False  # whether there has been any
        self._fresh = dict(self._excitation.fresh)  # as of the last time that it changed
        # what the parameters were made of
        self._shown: tuple[Accepted, dict[str, bool], bool, Array] | None = None
        self._begun = np.zeros((3, 0, numbers.start.size))  # drifts that may have begun
        self._parameters: dict[str, TrackedValue] = {}

    @property
    def state(self) -> State:
        """What the tracker does at present."""
        if self.operator.holding:
            return "hold"
        beyond = self.level.above and self.level.error > self.level.limit * self.diagnosis.noise**0.5
        if self.diagnosis.doubted or beyond:
            return "changed"
        return "frozen" if self._silent or not any(self._fresh.values()) else "tracking"

    @property
    def parameters(self) -> dict[str, TrackedValue]:
        """Published physical parameters, SI; stale where they are not informed, or known to be no longer right."""
        source = (self.publication.accepted, self._fresh, self._trusted(), self._begun)
        if self._shown is None or any(a is not b for a, b in zip(self._shown, source, strict=True)):
            accepted, fresh, trusted, (ways, ends, spread) = self._shown = source
            # where a drift is not followed yet, three standard deviations hold the far end of where it may be
            variance = accepted.covariance.diagonal()
            far = np.minimum(np.abs(ends - accepted.values), ways) + 2.0 * np.sqrt(spread)
            more = np.diag(((far / 3.0) ** 2 - variance).max(axis=0, initial=0.0))
            accepted = replace(accepted, covariance=accepted.covariance + more)
            now = {name: one and trusted for name, one in fresh.items()}
            self._parameters = published(self.rpem.numbers, accepted, "parameter", now)
        return dict(self._parameters)

    @property
    def extra(self) -> dict[str, TrackedValue]:
        """Published numbers beside the parameters: gains of sensors once they are found to have changed, unbalance."""
        return beside(self.rpem.numbers, self.publication.accepted, self.rpem.filter.active, stale=not self._trusted())

    @property
    def choices(self) -> dict[str, Choice]:
        """What the orders of an operator would put in force now."""
        return {
            name: Choice(t=goal.t, parameters=published(self.rpem.numbers, goal, "parameter", self._fresh))
            for name, goal in self.publication.goals(self._now, searching=self.diagnosis.searching).items()
        }

    @property
    def error(self) -> float:
        """Model error, 1 as at identification, and so before the first block; NaN where none tells of the present."""
        if self._deaf_s > max(_LEVEL_S, 2.0 * self.rpem.block_s):
            return float("nan")
        return self.level.error if self._spoken else 1.0

    def begin(self, first: int) -> None:
        """Say where the stream begins, before anything of it comes. `first`: number of the first sample."""
        self._heard = first
        self.diagnosis.restart(first)

    def _trusted(self) -> bool:
        return not (self._silent or self.diagnosis.doubted)

    def feed(self, samples: Samples, first: int, *, restart: bool = False) -> Array:
        """Take in finite samples from number `first` on (`restart`: some are missing before); return the working
        predictor's innovations (n_samples, n_outputs), SI.
        """
        if restart or first != self.rpem.stream.sample:
            rpem = self.rpem
            gap_s = max(first - rpem.stream.sample, 0) / self._rate
            if gap_s > rpem.block_s:
                rpem.filter.walk(rpem.drift.variance, gap_s)
                if gap_s > LONGEST_S:  # whatever happened in it did not happen before it
                    rpem.drift.restart()
                    self.diagnosis.forget(first)
            self.diagnosis.restart(first)
        errors = np.empty_like(samples.y)
        k, n = 0, samples.y.shape[0]
        while k < n:
            part = samples.part(k) if k else samples
            n_taken, innovations, evidence = self.rpem.stream.feed(part)
            errors[k : k + n_taken] = innovations
            self.diagnosis.keep(part.part(0, n_taken), first + k + n_taken)
            k += n_taken
            self.rpem.n_used += n_taken
            if evidence is not None:
                self._take(evidence)
            elif n_taken == 0:
                raise ValueError(
                    f"sample {first + k} is not finite; the guard of the stream omits such samples. Omit it"
                )
        return np.asarray(errors * self.rpem.numbers.problem.scales.output)

    def wait(self, sample: int) -> None:
        """Let time pass up to number `sample`: without samples, or with those on which the predictor only settles."""
        missing = sample > self.rpem.stream.sample
        self._deaf_s = (sample - self._heard) / self._rate
        if not missing and self._deaf_s <= self.rpem.block_s:
            return
        t = self._t0 + sample / self._rate
        settling_s = self.rpem.stream.settling_samples / self._rate
        most_s = SILENT_S if self._spoken else min(SILENT_S, max(_LEVEL_S, 2.0 * settling_s))
        if not self._silent and self._deaf_s >= most_s:
            self._silent = True
            why = (
                f"the predictor has not settled for {most_s:.3g} s: after each interruption it needs {settling_s:.3g} s"
            )
            self._tell(Event(kind="frozen", t=t, why=f"no usable sample for {most_s:.3g} s" if missing else why))
        self._obey(t)

    def order(self, flag: str) -> None:
        """Set a flag of the operator; of two orders before the next block the first counts."""
        self.publication.order(flag, self._now)

    @property
    def _now(self) -> float:
        return self._t0 + self.rpem.stream.sample / self._rate

    def _take(self, evidence: Evidence) -> None:
        """Judge a block, use it, and judge the outcome of it."""
        rpem, t = self.rpem, self._t0 + evidence.last / self._rate
        if self._silent:
            self._silent = False
            without_s = (evidence.first - self._heard) / self._rate
            self._tell(Event(kind="thawed", t=t, why=f"the data are informative again after {without_s:.3g} s"))
        self._heard, self._deaf_s, self._spoken = evidence.last, 0.0, True
        events = self._excitation.update(evidence, t)
        for event in events:
            self._tell(event)
        if events:
            self._activate()
        rpem.predict()
        usable = self.diagnosis.look(evidence, t)
        if usable:
            rpem.absorb(evidence)
            accepted = self.publication.accepted
            confirmed = self.publication.judge(evidence, t)
            if confirmed or (self.diagnosis.settling and self.publication.accepted is not accepted):
                self.diagnosis.settling = False
                self.level.restart()
            begun = rpem.begun()
            self._begun = self._begun if begun is None else begun
        if self.diagnosis.renewed:
            self._activate()
        if usable or self.diagnosis.doubted:  # a knock that is set aside is no error of the model
            before = self.level.above
            error = self.level.update(evidence, self.publication.accepted.values)
            explained = self.diagnosis.doubted or self.diagnosis.settling or self.diagnosis.noise > 1.0
            if self.level.above and not (before or explained):
                why = f"the error is {error:.2f} times that at identification, above the limit of {self.level.limit:g}"
                self._tell(Event(kind="disturbed", t=t, why=why, values={"error": error, "detected": t}))
        self._obey(t)

    def _obey(self, t: float) -> None:
        if self.operator.waiting and self.publication.obey(t, searching=self.diagnosis.searching):
            self.level.restart()

    def _activate(self) -> None:
        """Let the recursion move what the data inform."""
        names, active = self.rpem.numbers.names, self.rpem.filter.active
        self._fresh = dict(self._excitation.fresh)
        for name, fresh in self._fresh.items():
            active[names.index(name)] = fresh


_BLOCKS = 240  # after as many the walks of the numbers have been adapted once
_QUIET = 0.01  # of the innovations' standard deviation


def warm_up(numbers: TrackedNumbers, memory: Memory = "auto") -> None:
    """Track a rotor at rest, and search a change in it, so that what is compiled or loaded late is there when samples
    come. Its noise is far below the bench's: as large as that, without the bench's motion, it is a change.
    """
    supervisor = Supervisor(PhysicalRpem(numbers, memory=memory))
    rpem, before = supervisor.rpem, supervisor.rpem.filter.copy()
    n, n_u = _BLOCKS * rpem.block_samples, len(numbers.problem.model.inputs)
    sizes = np.concatenate(
        [np.zeros(n_u), _QUIET * np.sqrt(np.diag(numbers.innovation_covariance)) * numbers.problem.scales.output]
    )
    values = numbers.point + sizes * np.random.default_rng(0).standard_normal((n, sizes.size))
    samples = Samples(
        u=np.ascontiguousarray(values[:, :n_u]),
        y=np.ascontiguousarray(values[:, n_u:]),
        forcing=np.zeros((n, 2)) if numbers.synchronous else None,
    )
    supervisor.feed(samples, 0)
    recent = RecentSamples(n)
    recent.add(samples, n)
    nothing = Event(kind="disturbed", t=0.0, why="")
    name = numbers.names[int(numbers.places("parameter")[0])]
    history = [(rpem.stream.latest, before)] if rpem.stream.latest is not None else []
    if history:
        begin(rpem, history, nothing, onset=0, suspects=(name,), size=0.1).attempt(rpem, recent)
