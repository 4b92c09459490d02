"""What people read of calibration: what scales that nothing is said of would move, in a line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from ambid.estimation.estimate import Estimate
from ambid.report.numbers import sized
from ambid.report.text import names_words

if TYPE_CHECKING:
    from ambid.rotor.estimate import RotorEstimate

_FELT = 0.05  # per cent


def calibration_lines(estimate: Estimate | RotorEstimate) -> list[str]:
    """Say what 1 % of each scale would move that the rig says nothing of; channels of one kind together."""
    e, stated = estimate, estimate.calibration_sd
    kinds, worst = dict[str, dict[str, float]](), dict[str, tuple[float, str]]()  # channels of a kind; by bearing
    for source, moves in e.calibration.items():
        bearing, dot, _ = source.partition(".")
        if source in stated or (dot and any(name.startswith(f"{bearing}.z") for name in stated)):
            continue
        if dot:
            name, x = max(_shown(moves).items(), key=lambda item: abs(item[1]), default=("", 0.0))
            worst[bearing] = max(worst.get(bearing, (0.0, "")), (abs(x), f"{source} {name} {_per_cent(x)}"))
            continue
        kind = kinds.setdefault(source.rpartition("_")[2].rstrip("0123456789"), dict.fromkeys(moves, 0.0))
        for name, x in moves.items():
            kind[name] += x
    words = [f"{kind} {moved}" for kind, moves in kinds.items() if (moved := _grouped(_shown(moves)))]
    planes = [text for x, text in worst.values() if x >= _FELT]
    first = "Some of the calibration is in no interval. " if stated else "Intervals are from this record alone. "
    lines = list[str]()
    if words:
        lines.append(f"{first}1 % of gain moves: {'; '.join(words)}. Give gain_sd and rate_sd in the rig")
    if planes:
        span = e.plant.span(e.numbers)  # type: ignore[union-attr]  # only rotors have planes
        off = f"{sized(0.01 * span, 'm')} along the shaft moves most: {'; '.join(planes)}"
        lines.append(f"{'' if words else first}{off}. Give z_sd or z_sensor_sd")
    offsets = [name.removesuffix(".offset") for name in stated if name.endswith(".offset")]
    return [*lines, *([f"An offset of {names_words(offsets)} moves the operating point alone"] if offsets else [])]


def _shown(moves: Mapping[str, float]) -> dict[str, float]:
    """Return what is shown of the numbers that move: frequencies of modes alone."""
    return {n: x for n, x in moves.items() if not n.startswith(("mode", "gyro")) or n.endswith(".omega")}


def _grouped(moves: Mapping[str, float]) -> str:
    """Return names by how far they move, those of all axes as one where they move alike."""
    groups, short = dict[str, dict[str, None]](), {name: name.rpartition(".")[2] for name in moves}
    for name, x in moves.items():
        by, alike = _per_cent(x), {_per_cent(y) for other, y in moves.items() if short[other] == short[name]}
        if abs(x) >= _FELT:
            groups.setdefault(by, {})[short[name] if len(alike) == 1 else name] = None
    return ", ".join(f"{', '.join(names)} {by}" for by, names in groups.items())


def _per_cent(x: float) -> str:
    return f"{x:+.1f}".removesuffix(".0") + " %"
