"""No number is published before data that came after it speak for it: validation gate, probation, rollback.

A candidate is compared with the accepted numbers on later evidence. Their difference in loss is normal, with mean and
variance known from the triangle and the candidate's covariance: what chance may do is told from what it may not.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dposv

from ambid.arrays import Array
from ambid.errors import EstimationError, counted
from ambid.recursive.lines import Event
from ambid.tracking.evidence import Evidence, EvidenceSum

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
    def values(self) -> Mapping[str, float]:
        """All of it, for an event."""
        return {
            "blocks": float(self.blocks),
            "gain": self.gain,
            "separation": self.separation,
            "sd": self.sd,
            "misfit": self.misfit,
            "claim": self.claim,
            "scale": self.scale,
        }


class Gate:
    """Hold the accepted numbers; let others pass only if later data agree.

    A candidate passes if it predicts the later blocks no worse than the accepted numbers do, but for what chance allows
    (`level` of the normal distribution of the difference; twice that distance for one that claims nothing new, as the
    recursion proposes such every few blocks), and if its own residual is no larger than chance allows
    (`level` of chi-squared). Where it claims to be another number (by its covariance and that of the accepted) and the
    later data cannot tell the two apart, it waits, and is refused after `longest` blocks. After acceptance the numbers
    before it are kept on trial for `probation` blocks: if they predict better than chance allows, the gate goes back.

    `names`: the p numbers; `start`: (p,), accepted at the start; `covariance`: (p, p), of them; `t`: time of the start,
    s; `kept`: accepted numbers kept to go back to, the present ones included; `level`: probability that a right
    candidate is refused by one of the two tests; `overdispersion`: of quiet statistics, 1 or more; may be set anew at
    any time.

    `last`: numbers behind the last decision.
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
        blocks: int = 4,
        longest: int = 200,
        probation: int = 200,
        level: float = 0.005,
        back: float = 1e-4,
        overdispersion: float = 1.0,
    ) -> None:
        from scipy.special import chdtri, ndtri

        if not (kept >= 2 and 1 <= blocks <= longest and probation >= 0 and 0 < level < 0.5 and 0 < back < 0.5):
            raise EstimationError("gate: kept >= 2, 1 <= blocks <= longest, levels between 0 and 0.5. Correct them")
        self.names, self.overdispersion = tuple(names), overdispersion
        self.last: Comparison | None = None
        self._apart, self._blocks, self._longest, self._probation = apart_s, blocks, longest, probation
        p = len(self.names)
        self._unit = np.eye(p)
        self._z, self._z_back, self._misfit = float(-ndtri(level)), float(-ndtri(back)), float(chdtri(p, level))
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
        """Offer numbers; from now on `judge` has to be given each block that comes, and none from before.

        `candidate`: (p,); `covariance`: (p, p); `t`: when it was formed, s of record; `why`: reason for the change.
        Returns refusal of the candidate that was waiting, if one was: the newer one takes its place.
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

    def judge(self, evidence: Evidence, t: float) -> Event | None:
        """Take in a block that came after the candidate was formed.

        `t`: its end, s of record. Returns ``accepted``, ``refused``, or ``reverted`` by probation; None while there is
        nothing to decide.
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
        if not self._trial.add(evidence) or self._trial.blocks < self._blocks:
            return None
        new, old = self._candidate, self.accepted
        seen = self.last = self._compare(self._trial, new, old)
        z = self._z * math.sqrt(seen.scale)
        claims = seen.claim > self._misfit
        if claims and seen.separation < (2 * z) ** 2:
            if self._trial.blocks < self._longest:
                return None
            return self._refuse(t, seen, "later data do not distinguish it from the accepted values")
        if seen.misfit > self._misfit * seen.scale:
            return self._refuse(t, seen, f"its own lack of fit exceeds {self._misfit * seen.scale:.3g}")
        # what claims nothing new comes every few blocks: it is refused only where chance is out of the question
        allowance = max(0.0, (1 if claims else 2) * self._z * seen.sd - seen.separation)
        if seen.gain < -allowance:
            return self._refuse(t, seen, f"the accepted values predict better, by more than {allowance:.3g}")
        return self._accept(new, t, f"{new.why}: {seen.text}", seen)

    def accept(self, t: float) -> Event:
        """Accept the waiting candidate unjudged, as the operator may order; probation follows all the same.

        `t`: s of record. Returns ``accepted``, or ``refused`` if none waits.
        """
        if self._candidate is None:
            return Event(kind="refused", t=t, why="no candidate is waiting for acceptance")
        return self._accept(
            self._candidate, t, f"{self._candidate.why}: accepted without validation, by operator order", None
        )

    def revert(self, t: float | None = None, why: str = "by order") -> Event:
        """Go back to the numbers accepted before; a waiting candidate is dropped.

        `t`: s of record; by default when the present numbers were accepted. Returns ``reverted``, or ``refused`` if
        there are no earlier ones.
        """
        left = self.accepted
        t = left.t if t is None else t
        if len(self._history) < 2:
            return Event(kind="refused", t=t, why="there are no earlier values to return to")
        return self._return(self._history[-2], t, why)

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
        seen = self._compare(self._watched, self.accepted, self._before)
        if -seen.gain > self._z_back * seen.sd:
            self.last, goal = seen, self._before
            return self._return(goal, t, f"the earlier values predict better ({seen.text})")
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

    def _accept(self, new: Accepted, t: float, why: str, seen: Comparison | None) -> Event:
        """Put the candidate in force, and the numbers before it on trial."""
        moved = new.values - self.accepted.values
        if self._before is None:
            self._before = self.accepted if self._probation else None
            self._watched.clear(new.values)
            self._next = self._blocks
        else:  # the trial goes on against the older numbers: a chain of small steps does not escape it
            self._watched.move(new.values)
        refined = seen is not None and seen.claim <= self._misfit
        kept = self._history
        if refined and len(kept) > 1 and kept[-1].refined and kept[-1].t - kept[-2].t < self._apart:
            kept.pop()
        kept.append(Accepted(values=new.values, covariance=new.covariance, t=t, why=new.why, refined=refined))
        self._candidate = None
        values = dict(zip(self.names, moved.tolist(), strict=True)) if seen is None else dict(seen.values)
        return Event(kind="accepted", t=t, why=why, values=values)

    def _refuse(self, t: float, seen: Comparison, why: str) -> Event:
        """Drop the candidate."""
        reason = "" if self._candidate is None else f"{self._candidate.why}: "
        self._candidate = None
        return Event(kind="refused", t=t, why=f"{reason}{why} ({seen.text})", values=dict(seen.values))

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
    known = covariance.diagonal() <= 0.0
    if known.any():
        if d[known].any():
            return math.inf
        d, covariance = d[~known], covariance[np.ix_(~known, ~known)]
    A = covariance.copy(order="F")
    A.ravel("K")[:: d.size + 1] *= 1.0 + _REGULAR
    _, solved, failed = dposv(A, d, overwrite_a=True)
    return math.inf if failed else float(d @ solved)
