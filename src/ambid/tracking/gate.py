"""From the working estimate to the published one: candidates, their validation, and the operator's orders.

Only what later data confirmed, or the operator ordered, is published; decisions are told with reasons. The difference
in loss between candidate and accepted numbers on later evidence is normal, mean and variance known from triangle and
covariance. Acceptance is followed by a probation, which may go back.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dposv

from ambid.arrays import Array
from ambid.errors import EstimationError, counted, nearest
from ambid.recursive.lines import Event, TrackedValue
from ambid.tracking.evidence import Evidence, EvidenceSum
from ambid.tracking.numbers import Kind, TrackedNumbers, amplitude_and_phase
from ambid.tracking.rpem import PhysicalRpem

_FAR = 9.0  # squares of standard deviations, beyond which a number that moved is another, and not better known
_BLOCKS = 4  # after the candidate, before it is judged
_LEVEL, _BACK = 0.005, 1e-4  # at which one of two tests refuses a right candidate, and at which one goes back
_REGULAR = 1e-10  # of a correlation matrix: what keeps one without an inverse regular


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Accepted:
    """Numbers that were accepted."""

    values: Array  # (p,)
    covariance: Array  # (p, p)
    t: float  # when, s of record
    why: str
    refined: bool = False  # whether they say the same as those before, only better, by the covariances of both


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Candidate q against rival numbers a on evidence (J, r at q): what the gate decides on."""

    blocks: int
    gain: float  # loss of the rival less loss of the candidate: twice the gain in log-likelihood
    # |J (q - a)|², the gain to be expected if the candidate is the truth (minus that if the rival is)
    separation: float
    sd: float  # standard deviation of the gain if the candidate is right up to its covariance
    # whitened square of the candidate's own residual: chi-squared with p degrees of freedom if it is right
    misfit: float
    # square of q - a over the sum of both covariances: whether the candidate says that something is not as accepted
    claim: float
    scale: float  # overdispersion by which these are to be judged, 1 or more

    @property
    def text(self) -> str:
        """The reason in numbers, one line."""
        return (
            f"over {counted(self.blocks, 'block')}: gain {self.gain:.3g} (expected {self.separation:.3g}, "
            f"sd {self.sd:.3g}), lack of fit {self.misfit:.3g}"
        )

    @property
    def values(self) -> dict[str, float]:
        """All of it, for an event."""
        return {name: float(x) for name, x in asdict(self).items()}


class Gate:
    """Hold the accepted numbers; let others pass only if later data agree.

    A candidate passes if it predicts later blocks no worse than the accepted numbers but for chance (0.5 % of the
    normal distribution of the difference; twice that distance for one that claims nothing new), and if its own residual
    is within chance (0.5 % of chi-squared). One that claims to be another number, which data cannot yet tell, waits,
    and is refused after `longest` blocks. For `probation` blocks the gate goes back if the numbers before predict
    better than chance.

    `start`, `covariance`: (p,), (p, p), accepted at time `t`, s; `kept`: accepted numbers to go back to, the present
    ones included; `overdispersion`: of quiet statistics, 1 or more, may be set anew; `last`: numbers behind the last
    decision.
    """

    def __init__(
        self,
        names: Sequence[str],
        *,
        start: ArrayLike,
        covariance: ArrayLike,
        t: float = 0.0,
        kept: int = 8,
        apart_s: float = 1.0,
        longest: int = 200,
        probation: int = 200,
        overdispersion: float = 1.0,
    ) -> None:
        from scipy.special import chdtri, ndtri

        self.names, self.overdispersion = tuple(names), overdispersion
        self.last: Comparison | None = None
        self._apart, self._longest, self._probation = apart_s, longest, probation
        p = len(self.names)
        self._unit = np.eye(p)
        self._z, self._z_back, self._misfit = float(-ndtri(_LEVEL)), float(-ndtri(_BACK)), float(chdtri(p, _LEVEL))
        values, P = self._checked(start, covariance)
        self._history: deque[Accepted] = deque([Accepted(values=values, covariance=P, t=t, why="at the start")], kept)
        self._candidate: Accepted | None = None
        self._trial, self._watched = EvidenceSum(p), EvidenceSum(p)
        self._before: Accepted | None = None  # numbers on trial against the present ones
        self._next = 0

    @property
    def accepted(self) -> Accepted:
        """The numbers in force."""
        return self._history[-1]

    @property
    def history(self) -> tuple[Accepted, ...]:
        """Those that can be gone back to, the oldest first, and the present ones."""
        return tuple(self._history)

    @property
    def pending(self) -> bool:
        """Whether a candidate waits for its decision."""
        return self._candidate is not None

    @property
    def on_probation(self) -> bool:
        """Whether earlier numbers are still on trial against the present ones."""
        return self._before is not None

    def propose(self, candidate: ArrayLike, covariance: ArrayLike, t: float, why: str) -> Event | None:
        """Offer numbers formed at `t` (s of record) for the reason `why`; from now on `judge` has to be given each
        block that comes, none from before. Returns the refusal of a candidate that waited: the newer takes its place.
        """
        values, P = self._checked(candidate, covariance)
        earlier, n = self._candidate, self._trial.blocks
        self._candidate = Accepted(values=values, covariance=P, t=t, why=why)
        self._trial.clear(values)
        if earlier is None:
            return None
        return Event(
            kind="refused", t=t, why=f"replaced by a newer candidate after {counted(n, 'block')}: {earlier.why}"
        )

    def restart(self) -> None:
        """Drop the candidate and end the probation: data from before a change say nothing of what holds now."""
        self._candidate = self._before = None

    def doubt(self) -> Array:
        """Let the band of numbers on probation that claim to be others hold those before, too; return how far they
        moved, (p,).
        """
        now, before = self.accepted, self._before or self.accepted
        moved = now.values - before.values
        moved = np.where(moved**2 > _FAR * before.covariance.diagonal(), moved, 0.0)
        if moved.any():
            self._history[-1] = replace(now, covariance=now.covariance + np.diag(moved**2))
        return moved

    def judge(self, evidence: Evidence, t: float) -> Event | None:
        """Take in a block, ended at `t` (s of record), from after the candidate was formed: ``accepted``, ``refused``,
        or ``reverted`` by probation; None while there is nothing to decide.
        """
        if self._candidate is None and self._before is None:
            return None
        if not math.isfinite(evidence.rest):
            return None
        back = self._judge_probation(evidence, t)
        if back is not None:
            return back
        if self._candidate is None:
            return None
        if not self._trial.add(evidence) or self._trial.blocks < _BLOCKS:
            return None
        new, old = self._candidate, self.accepted
        comparison = self.last = self._compare(self._trial, new, old)
        z = self._z * math.sqrt(comparison.scale)
        claims = comparison.claim > self._misfit
        if claims and comparison.separation < (2 * z) ** 2:
            if self._trial.blocks < self._longest:
                return None
            return self._refuse(t, comparison, "later data do not distinguish it from the accepted values")
        if comparison.misfit > self._misfit * comparison.scale:
            return self._refuse(t, comparison, f"its own lack of fit exceeds {self._misfit * comparison.scale:.3g}")
        # what claims nothing new comes every few blocks: it is refused only where chance is out of the question
        allowance = max(0.0, (1 if claims else 2) * self._z * comparison.sd - comparison.separation)
        if comparison.gain < -allowance:
            return self._refuse(t, comparison, f"the accepted values predict better, by more than {allowance:.3g}")
        return self._accept(new, t, f"{new.why}: {comparison.text}", comparison)

    def accept(self, t: float) -> Event:
        """Accept the waiting candidate unjudged at `t` (s of record), as the operator may order, probation following
        all the same: ``accepted``, or ``refused`` if none waits.
        """
        if self._candidate is None:
            return Event(kind="refused", t=t, why="no candidate is waiting for acceptance")
        return self._accept(
            self._candidate, t, f"{self._candidate.why}: accepted without validation, by operator order", None
        )

    def revert(self, t: float | None = None, why: str = "by order", goal: Accepted | None = None) -> Event:
        """Go back to numbers in force before, `goal` or the ones accepted last, dropping a candidate; `t`: s of record,
        default when the present ones were accepted. Returns ``reverted``, or ``refused`` if there are no earlier ones.
        """
        left = self.accepted
        t = left.t if t is None else t
        if goal is None and len(self._history) < 2:
            return Event(kind="refused", t=t, why="there are no earlier values to return to")
        return self._return(self._history[-2] if goal is None else goal, t, why)

    def _return(self, goal: Accepted, t: float, why: str) -> Event:
        """Put earlier numbers in force again."""
        left = self.accepted
        while self._history and self._history[-1].t >= goal.t and self._history[-1] is not goal:
            self._history.pop()
        if not self._history or self._history[-1] is not goal:
            self._history.append(goal)
        self._candidate = self._before = None
        return Event(
            kind="reverted",
            t=t,
            why=f"{why}: from the values of {left.t:.3f} s back to those of {self.accepted.t:.3f} s",
            values=dict(zip(self.names, self.accepted.values.tolist(), strict=True)),
        )

    def _judge_probation(self, evidence: Evidence, t: float) -> Event | None:
        """Go back if the earlier numbers predict better than chance allows; looked at each time the blocks double."""
        if self._before is None:
            return None
        self._watched.add(evidence)
        n = self._watched.blocks
        if n < self._next and n < self._probation:
            return None
        self._next = 2 * n
        comparison = self._compare(self._watched, self.accepted, self._before)
        if -comparison.gain > self._z_back * comparison.sd:
            self.last, goal = comparison, self._before
            return self._return(goal, t, f"the earlier values predict better ({comparison.text})")
        if n >= self._probation:
            self._before = None
        return None

    def _compare(self, data: EvidenceSum, new: Accepted, old: Accepted) -> Comparison:
        """Compare two sets of numbers on evidence held at the first of them."""
        J, rho, moved = data.T[:, :-1], data.T[:, -1], new.values - old.values
        apart = J @ moved
        separation, slope = float(apart @ apart), J.T @ apart
        variance = separation + max(float(slope @ new.covariance @ slope), 0.0)
        scale = max(self.overdispersion, data.rest / data.freedom if data.freedom else 1.0)
        return Comparison(
            blocks=data.blocks,
            gain=separation - 2.0 * float(apart @ rho),
            separation=separation,
            sd=2.0 * math.sqrt(variance * scale),
            misfit=_squared_length(rho, self._unit + J @ new.covariance @ J.T),
            claim=_squared_length(moved, new.covariance + old.covariance),
            scale=scale,
        )

    def _accept(self, new: Accepted, t: float, why: str, comparison: Comparison | None) -> Event:
        """Put the candidate in force, and the numbers before it on trial."""
        moved = new.values - self.accepted.values
        if self._before is None:
            self._before = self.accepted if self._probation else None
            self._watched.clear(new.values)
            self._next = _BLOCKS
        else:  # the trial goes on against the older numbers: a chain of small steps does not escape it
            self._watched.move(new.values)
        refined = comparison is not None and comparison.claim <= self._misfit
        history = self._history
        if refined and len(history) > 1 and history[-1].refined and history[-1].t - history[-2].t < self._apart:
            history.pop()
        history.append(Accepted(values=new.values, covariance=new.covariance, t=t, why=new.why, refined=refined))
        self._candidate = None
        values = dict(zip(self.names, moved.tolist(), strict=True)) if comparison is None else comparison.values
        return Event(kind="accepted", t=t, why=why, values=values)

    def _refuse(self, t: float, comparison: Comparison, why: str) -> Event:
        """Drop the candidate."""
        reason = "" if self._candidate is None else f"{self._candidate.why}: "
        self._candidate = None
        return Event(kind="refused", t=t, why=f"{reason}{why} ({comparison.text})", values=comparison.values)

    def _checked(self, values: ArrayLike, covariance: ArrayLike) -> tuple[Array, Array]:
        """Return copies, or refuse them."""
        q, P, p = np.array(values, dtype=float), np.array(covariance, dtype=float), len(self.names)
        if q.shape != (p,) or P.shape != (p, p) or not (np.isfinite(q).all() and np.isfinite(P).all()):
            raise EstimationError(
                f"gate: {p} finite values and their ({p}, {p}) covariance are needed, got {q.shape}. Correct them"
            )
        return q, P


def _squared_length(d: Array, covariance: Array) -> float:
    """Return d^T covariance^-1 d; infinite where d moves a number without variance or no covariance is given."""
    certain = covariance.diagonal() <= 0.0
    if certain.any():
        if d[certain].any():
            return math.inf
        d, covariance = d[~certain], covariance[np.ix_(~certain, ~certain)]
    A = covariance.copy(order="F")
    A.ravel("K")[:: d.size + 1] *= 1.0 + _REGULAR
    _, solved, failed = dposv(A, d, overwrite_a=True)
    return math.inf if failed else float(d @ solved)


Flag = Literal["track", "hold", "accept", "revert"]
Order = Literal["accept", "revert"]
_FLAGS: tuple[str, ...] = get_args(Flag)


class Operator:
    """Flags of the operator, to be set from any thread; begins in ``track``. In ``hold`` the published
    numbers stay; ``accept`` (the candidate, now and unjudged) and ``revert`` (to the numbers before) are orders,
    carried out once.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._hold = False
        self._order: Order | None = None

    @property
    def holding(self) -> bool:
        """Whether the published numbers are to stay as they are."""
        with self._lock:
            return self._hold

    @property
    def waiting(self) -> Order | None:
        """The order that was not taken yet."""
        with self._lock:
            return self._order

    def set(self, flag: str, t: float = 0.0, why: str = "") -> Event:
        """Set a flag. `t`: time of the stream, s; `why`: the operator's reason, for the log."""
        if flag not in _FLAGS:
            raise EstimationError(
                f"operator flag {flag!r} is unknown; known: {', '.join(_FLAGS)}.{nearest(flag, _FLAGS)}"
            )
        with self._lock:
            if flag == "accept" or flag == "revert":
                if self._order not in (None, flag):
                    raise EstimationError(f"operator: {self._order!r} is still pending. Give {flag!r} after that")
                self._order = "accept" if flag == "accept" else "revert"
                what = f"operator orders {flag}"
            else:
                same = self._hold == (flag == "hold")
                self._hold = flag == "hold"
                what = f"operator sets {flag}" + (" (already so)" if same else "")
        return Event(kind="operator", t=t, why=f"{what}: {why}" if why else what)

    def take(self) -> Order | None:
        """Return the order that waits, if any: it is done now and waits no longer."""
        with self._lock:
            order, self._order = self._order, None
        return order


def published(
    numbers: TrackedNumbers, accepted: Accepted, kind: Kind, fresh: Mapping[str, bool]
) -> dict[str, TrackedValue]:
    """Return the accepted numbers of one kind, SI."""
    sd = np.sqrt(np.diag(accepted.covariance) + numbers.bias_sd**2) * numbers.magnitude
    values = accepted.values * numbers.magnitude
    return {
        numbers.names[j]: TrackedValue(
            value=float(values[j]), sd=float(sd[j]), stale=not fresh.get(numbers.names[j], True)
        )
        for j in numbers.places(kind)
    }


def beside(
    numbers: TrackedNumbers, accepted: Accepted, active: NDArray[np.bool_], *, stale: bool = False
) -> dict[str, TrackedValue]:
    """Return what is tracked beside the parameters, SI: gains of sensors found changed, and unbalance in kg m, phase in
    rad. `active`: numbers the recursion may move; `stale`: whether no longer informed, or known to be no longer right.
    """
    gains = tuple(numbers.names[j] for j in numbers.places("gain") if active[j])
    if not gains and not numbers.synchronous:
        return {}
    values = published(numbers, accepted, "gain", dict.fromkeys(gains, not stale))
    values = {name: values[name] for name in gains}
    if not numbers.synchronous:
        return values
    at = numbers.places("unbalance")
    size = numbers.magnitude[at]
    a, b = (accepted.values[at] * size).tolist()
    amplitude, sd, phase, phase_sd = amplitude_and_phase(
        a, b, accepted.covariance[np.ix_(at, at)] * np.outer(size, size)
    )
    return {
        **values,
        "unbalance": TrackedValue(value=amplitude, sd=sd, stale=stale),
        "unbalance_phase": TrackedValue(value=phase, sd=phase_sd, stale=stale),
    }


# Numbers that describe the noise are seen through the innovations alone: over short blocks the squares of what they
# explain are up to half as large again as chi-squared has it (as in the estimate of a root near one)
_SHORT_BLOCKS = 1.5


class Publication:
    """The published numbers of a tracker, first those that `rpem`, the working estimate, starts from at `t0`, s of
    record. `unconfirmed`: found again after a change, not yet confirmed by later data; `updates`: times that they
    moved.
    """

    def __init__(self, rpem: PhysicalRpem, operator: Operator, tell: Callable[[Event], None], t0: float) -> None:
        numbers = rpem.numbers
        self._rpem, self._operator, self._tell = rpem, operator, tell
        self.gate = Gate(
            numbers.names,
            start=numbers.start,
            covariance=numbers.covariance,
            t=t0,
            overdispersion=numbers.overdispersion,
        )
        self._own = numbers.places("parameter", "gain")
        self.unconfirmed, self.updates = False, 0
        self._held = False
        self._undo: list[Accepted] = []  # what was in force before each accept of the operator

    @property
    def accepted(self) -> Accepted:
        """Published numbers."""
        return self.gate.accepted

    def restart(self) -> Array:
        """Drop what waits: data from before a change say nothing of what holds now. Return how far the numbers that are
        on probation have moved, (p,): they may have been taken for what goes on.
        """
        moved = self.gate.doubt()
        self.gate.restart()
        return moved

    def propose(self, t: float, why: str) -> None:
        """Offer the working estimate. `t`: s of record."""
        refused = self.gate.propose(self._rpem.filter.q, self._rpem.filter.covariance, t, why)
        if refused is not None and self.unconfirmed:
            self._tell(refused)

    def judge(self, evidence: Evidence, t: float) -> bool:
        """Decide on the candidate with one more block, already taken in, ended at `t` (s of record); offer the next.
        Returns whether numbers that were found again have been confirmed.
        """
        if self._operator.holding:
            self._held = True
            return False
        if self._held:  # what waited since before the hold is old by now
            self._held = False
            self.gate.restart()
        confirmed = False
        if self.gate.pending or self.gate.on_probation:
            self.gate.overdispersion = _SHORT_BLOCKS * max(self._rpem.noise, 1.0)
            before = self.accepted
            event = self.gate.judge(evidence, t)
            if event is not None:
                confirmed = self._decided(event, before)
        if not self.gate.pending:
            self.propose(t, "the recursion continued")
        return confirmed

    def _decided(self, event: Event, before: Accepted) -> bool:
        if event.kind != "accepted":
            self._tell(event)
            if event.kind == "reverted":
                self._rpem.filter.set(self.accepted.values, self.accepted.covariance)
                self._rpem.move_to(self.accepted.values)
            return False
        self.updates += not np.array_equal(self.accepted.values[self._own], before.values[self._own])
        if not self.unconfirmed:
            return False
        self._tell(event)
        self.unconfirmed = False
        return True

    def goals(self, t: float, *, searching: bool) -> dict[Order, Accepted]:
        """Return what each order would put in force at `t`, s of record; one that would be refused is left out."""
        goals = dict[Order, Accepted]()
        if not searching:
            now = self._rpem.filter
            goals["accept"] = Accepted(values=now.q, covariance=now.covariance, t=t, why="the present estimate")
        undone = self._undone()
        if undone is not None or len(self.gate.history) > 1:
            goals["revert"] = self.gate.history[-2] if undone is None else undone
        return goals

    def _undone(self) -> Accepted | None:
        """Return what was in force before the last accept of the operator that still is to be undone."""
        while self._undo and self._undo[-1] is self.accepted:
            self._undo.pop()
        return self._undo[-1] if self._undo else None

    def obey(self, t: float, *, searching: bool) -> bool:
        """Carry out the operator's orders at `t` (s of record); `searching`: the working estimate is that from before a
        change. Returns whether something else is published now.
        """
        order = self._operator.take()
        if order is None:
            return False
        before = self.accepted
        if order == "accept" and searching:
            why = "a change was found but not its new value; there is nothing to accept"
            self._tell(Event(kind="refused", t=t, why=why))
        elif order == "accept":
            self.gate.restart()
            self.propose(t, "the present estimate")
            self._undo.append(before)
            self._tell(self.gate.accept(t))
            self.unconfirmed = False
        else:
            self._tell(self.gate.revert(t, "by order of the operator", self._undone()))
            self._tell(self._operator.set("hold", t, "after going back, until the operator sets track"))
        changed = self.accepted is not before
        self.updates += changed
        return changed

    def order(self, flag: str, t: float) -> None:
        """Take a flag of the operator; of two orders before the next block the first counts. `t`: s of record."""
        try:
            self._tell(self._operator.set(flag, t))
        except EstimationError as waiting:
            self._tell(Event(kind="refused", t=t, why=str(waiting)))
