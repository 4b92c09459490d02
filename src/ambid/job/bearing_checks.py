"""What records of a nonlinear bearing must not be: the same data twice, one channel twice, the stage off, not held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from ambid.errors import EstimationError
from ambid.job.bearing_records import TakenRecord

if TYPE_CHECKING:
    from ambid.bearing.magnet.problem import BearingRecord

_SAME = 1e-9  # part of a channel's spread that another one leaves over, at or below which both are the same signal
_ROCKS = 0.25  # spread of a held position over that of the moving ones from which it is told


def checked_together(taken: Sequence[TakenRecord], second: TakenRecord | None) -> tuple[TakenRecord, ...]:
    """Check what shows only in values or between records.

    `taken`: to identify from; `second`: to judge on. Returns `taken`, with a warning where a held rotor moves.
    """
    for j, one in enumerate(taken):
        _refuse_senseless(one.record)
        for other in taken[:j]:
            if _overlap(one, other):
                raise EstimationError(
                    f"{other.record.name} and {one.record.name} hold the same samples; they would count twice. "
                    "Leave one out"
                )
    for one in taken:
        if second is not None and _overlap(one, second):
            raise EstimationError(
                f"{second.record.name}, to judge on, holds samples that the estimate is fitted to; errors there say "
                "nothing about others. Give another record, or leave --validate out"
            )
    moving = max((float(t.record.y[:, 0].std()) for t in taken if not t.record.held), default=0.0)
    return tuple(_told(t, moving) for t in taken)


def _refuse_senseless(record: BearingRecord) -> None:
    import numpy as np

    if np.all(record.loose > 0.0):
        raise EstimationError(
            f"{record.name}: every voltage is at or below off_below, where the stage is off; none would be known. "
            "Correct --off-below or magnet.off_below (in V)"
        )
    channels = {"voltage": record.u, "position": record.y[:, 0], "current": record.y[:, 1]}
    if record.held:
        del channels["position"]
    names = list(channels)
    unit = {name: (x - x.mean()) / x.std() for name, x in channels.items()}
    for j, one in enumerate(names):
        for other in names[:j]:
            a, b = unit[one], unit[other]
            if np.std(a - np.sign(a @ b) * b) <= _SAME:
                raise EstimationError(
                    f"{record.name}: {other} and {one} are one signal but for scale and offset; nothing can be told "
                    f"from that. Correct channels.{other}.column or channels.{one}.column"
                )


def _overlap(a: TakenRecord, b: TakenRecord) -> bool:
    """Whether both come from one file and one stretch of its time."""
    if a.remembered["sha256"] is None or a.remembered["sha256"] != b.remembered["sha256"]:
        return False
    ends = [t.start_s + t.record.u.size / t.record.rate_hz for t in (a, b)]
    half = 0.5 / a.record.rate_hz
    return max(a.start_s, b.start_s) + half < min(ends)


def _told(one: TakenRecord, moving: float) -> TakenRecord:
    rocks = float(one.record.y[:, 0].std())
    if not one.record.held or rocks <= _ROCKS * moving:
        return one
    said = (
        f"{one.record.name}: the rotor is said to be held, but its position scatters by {1e6 * rocks:.3g} um, "
        f"{rocks / moving:.0%} of what it does where it moves; R and L are biased if that is motion"
    )
    return replace(one, warnings=(*one.warnings, said))
