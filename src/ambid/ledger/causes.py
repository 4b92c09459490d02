"""Why parameters of a bearing changed: which cause the changes of an axis' parameters together speak for."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.ledger.history import History
from ambid.ledger.rules import Rule
from ambid.ledger.trends import FEW, WINDOW, level_of, values_of
from ambid.physics.linear_model import model
from ambid.physics.sensor_errors import CHANNELS, SensorError, error_moves, unit_powers

_BESIDE = 15  # values on each side of a change, from which its cause is judged
_CLEAR = 6.0  # by which chi-squared a cause must be likelier than the next
_MOVED = 3.0  # standard deviations from which a parameter has moved
_RULED_OUT = 3  # causes that are named as none
_FAR = 0.7  # logarithmic change beyond which a pattern, which is linear, says nothing

_NAMES = ("m", "k_x", "k_i", "R", "L")
_CAUSES: Mapping[str, tuple[str, str, str]] = {  # what changes, and what is said of a step and of a drift
    "coil": ("the coil's resistance", "stepped: look at contacts", "the coil warms or corrodes"),
    "flux": ("the magnet's bias flux", "stepped: cracked or demagnetised", "the magnet ages: bias flux"),
    "gap": ("the air gap", "stepped: rotor or stator moved", "the air gap changes: wear or growth"),
    "position": ("the position sensor's gain", "stepped: exchanged or damaged", "the position sensor's gain drifts"),
    "current": ("the current sensor's gain", "stepped: exchanged or damaged", "the current sensor's gain drifts"),
    "voltage": ("the voltage's scale", "stepped: supply or amplifier", "the voltage's scale drifts"),
    "mass": ("the rotor's mass", "stepped: a part was exchanged or lost", "the rotor's mass changes"),
    "side": (
        "a stiffness beside the magnet's",
        "stepped: seal, coupling, contact",
        "a stiffness beside the magnet's changes",
    ),
    "iron": ("the coil's own inductance", "stepped: leads or iron", "the coil's own inductance changes: leads or iron"),
    "position lag": ("the position's delay", "stepped: filter or sampling", "the position's delay drifts"),
    "current lag": ("the current's delay", "stepped: filter or sampling", "the current's delay drifts"),
    "voltage lag": ("the voltage's delay", "stepped: filter, sampling or amplifier", "the voltage's delay drifts"),
}
_BENCH = {  # powers of `_NAMES` with which parameters follow what changes on the bench (docs/monitoring.md)
    "coil": (0, 0, 0, 1, 0),
    "flux": (0, 2, 1, 0, 0),
    "gap": (0, -3, -2, 0, -1),
    "mass": (1, 0, 0, 0, 0),
    "side": (0, 1, 0, 0, 0),
    "iron": (0, 0, 0, 0, 1),
}
_LIKE = 0.15  # of a change, to which a pattern holds
_CALM = (0.01, 0.01, 0.01, 0.03, 0.01)  # relative changes that tell nothing; R follows the weather


def cause_of(h: History, name: str, rule: Rule, kind: str, at: float, end: float) -> str:
    """Say what the changes of an axis' parameters together speak for."""
    axis = name.rpartition(".")[0]
    places, change, spread, level = [], [], [], {}
    for j, own in enumerate(_NAMES):
        s = h.measured.get(f"{axis}.{own}" if axis else own) or (h.measured.get(own) if own == "m" else None)
        v = None if s is None else values_of(h, s, rule.since)
        if v is None:
            continue
        n = int(np.searchsorted(v.t, at if kind == "step" else math.inf))
        last = int(np.searchsorted(v.t, end, side="right"))
        before = v[slice(max(0, n - _BESIDE), n)] if kind == "step" else v[slice(0, min(WINDOW, last // 2))]
        after = v[slice(n, min(last, n + _BESIDE))] if kind == "step" else v[slice(max(0, last - _BESIDE), last)]
        if min(before.t.size, after.t.size) < FEW:
            continue
        (a, a_sd), (b, b_sd) = level_of(before), level_of(after)
        if a * b <= 0:
            return "the cause is not clear: a parameter changed its sign"
        places.append(j)
        level[own] = a
        change.append(math.log(b / a))
        spread.append(math.hypot(a_sd / a, b_sd / b))
    if len(places) < 2:
        return "the cause is not clear: too few other parameters were measured"
    if not axis and "m" not in level and "m" in h.series and np.isfinite(h.series["m"].value).any():
        level["m"] = float(np.nanmedian(h.series["m"].value))
    patterns = [
        *_patterns(mass=0 in places, coil=(f"{axis}.L" if axis else "L") in h.series),
        *_lags([_NAMES[j] for j in places], level),
    ]
    seen = _Seen(np.array(places, dtype=int), np.array(change), np.array(spread))
    return _likeliest(seen, [(cause, v[places]) for cause, v in patterns], step=kind == "step")


@dataclass(frozen=True, slots=True)
class _Seen:
    """What parameters did: places in `_NAMES`, logarithmic changes, their standard deviations."""

    places: Any
    change: Array
    spread: Array

    @property
    def var(self) -> Array:
        """Variances beyond which a change tells something."""
        return np.asarray(self.spread**2 + np.array(_CALM)[self.places] ** 2, dtype=float)

    def misfit(self, v: Array) -> float:
        """Return chi-squared of a pattern, its size fitted; the tolerance is a share of the change."""
        var = self.var
        for _ in range(3):
            size = (v @ (self.change / var)) / (v @ (v / var))
            var = self.var + (_LIKE * size * v) ** 2
        return float(np.sum((self.change - size * v) ** 2 / var))


def _patterns(*, mass: bool, coil: bool) -> Iterator[tuple[str, Array]]:
    """Yield causes and the powers of `_NAMES` that they have.

    Where the mass is held (not `mass`), a cause that would move it moves the others, between two limits: as before
    where a coil's induced voltage fixes k_i, and as ratios to the mass where the motion does.
    """
    powers = unit_powers(model("one-axis"))
    sensors = {c: [powers[name][CHANNELS.index(c)] for name in _NAMES] for c in ("position", "current", "voltage")}
    for cause, powers_ in {**_BENCH, **sensors}.items():
        own = np.array(powers_, dtype=float)
        if mass or coil or not own[0]:
            yield cause, own
        if not mass and own[0]:
            yield cause, own - own[0] * np.array([1.0, 1.0, 1.0, 0.0, 0.0])


def _lags(free: Sequence[str], level: Mapping[str, float]) -> Iterator[tuple[str, Array]]:
    """Yield how delays of the signals move the `free` parameters of a bearing at its `level`, by `error_moves`."""
    plant = model("one-axis")
    theta = {p.name: level.get(p.name, p.default) for p in plant.parameters}
    if None in theta.values():
        return
    errors = [SensorError(kind="lag", channel=c) for c in ("position", "current", "voltage")]
    moves = error_moves(plant, {k: float(x or 0.0) for k, x in theta.items()}, errors, free=free)
    for error, column in zip(errors, moves.T, strict=True):
        own = np.zeros(len(_NAMES))
        own[[_NAMES.index(name) for name in free]] = column / np.max(np.abs(column))
        yield f"{error.channel} lag", own


def _likeliest(seen: _Seen, patterns: Sequence[tuple[str, Array]], *, step: bool) -> str:
    """Say which cause the changes speak for; where one parameter moved alone, also which would have moved others."""
    from scipy.stats import chi2

    misfit: dict[str, float] = {}
    for cause, v in patterns:
        if v.any():
            misfit[cause] = min(seen.misfit(v), misfit.get(cause, math.inf))
    order = sorted(misfit, key=lambda cause: misfit[cause])
    near: list[str] = []
    if chi2.sf(misfit[order[0]], seen.places.size - 1) >= 0.01:
        near = [c for c in order if misfit[c] < misfit[order[0]] + _CLEAR]
    says = [f"{_CAUSES[c][0]} {_CAUSES[c][1]}" if step else _CAUSES[c][2] for c in near]
    moved = np.flatnonzero(np.abs(seen.change) > _MOVED * np.sqrt(seen.var))
    if moved.size == 1:
        name = _NAMES[seen.places[moved[0]]]
        alone = f"{name} alone of {', '.join(_NAMES[j] for j in seen.places)} moved"
        could = _either(says) or "no single cause that is known does that: two at once, or a wrong record"
        return f"{could}; {alone}{_ruled_out(seen, patterns, int(moved[0]), near)}"
    return _either(says) or "the cause is not clear: no single one fits the changes of all parameters"


def _either(says: Sequence[str]) -> str:
    return says[0] if len(says) == 1 else f"the cause is not clear: {' or '.join(says[:3])}" if says else ""


def _ruled_out(seen: _Seen, patterns: Sequence[tuple[str, Array]], k: int, near: Sequence[str]) -> str:
    """Say which causes would have moved another parameter than the one at `k` too, and by how much."""
    against: dict[str, tuple[float, str]] = {}
    for cause, v in patterns:
        if cause in near or not v[k] or abs(v[k]) < 0.1 * np.max(np.abs(v)):
            continue
        due = seen.change[k] * v / v[k]
        off = np.abs(due - seen.change) / np.sqrt(seen.var + (_LIKE * due) ** 2)
        j = int(np.argmax(np.where(np.arange(v.size) == k, 0.0, off)))
        if abs(due[j]) > _FAR:
            continue
        text = f"{_CAUSES[cause][0]} (would move {_NAMES[seen.places[j]]} by {100 * math.expm1(due[j]):+.2g} %)"
        if cause not in against or off[j] < against[cause][0]:
            against[cause] = float(off[j]), text
    texts = [text for _, text in against.values()][:_RULED_OUT]
    return f", which rules out {', '.join(texts)}" if texts else ""
