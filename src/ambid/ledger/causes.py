"""Why parameters of a bearing changed: which cause the changes of an axis' parameters together speak for."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.ledger.history import History
from ambid.ledger.rules import Rule
from ambid.ledger.trends import FEW, WINDOW, level_of, values_of
from ambid.physics.linear_model import model
from ambid.physics.sensor_errors import CHANNELS, unit_powers

_BESIDE = 15  # values on each side of a change, from which its cause is judged
_CLEAR = 6.0  # by which chi-squared a cause must be likelier than the next

_NAMES = ("m", "k_x", "k_i", "R", "L")
_CAUSES: Mapping[str, tuple[str, str]] = {  # what is said of a step and of a drift
    "coil": ("the coil's resistance stepped: look at contacts", "the coil warms or corrodes"),
    "flux": ("the magnet's bias flux stepped: cracked or demagnetised", "the magnet ages: bias flux"),
    "gap": ("the air gap stepped: rotor or stator moved", "the air gap changes: wear or growth"),
    "position": ("the position sensor's gain stepped: exchanged or damaged", "the position sensor's gain drifts"),
    "current": ("the current sensor's gain stepped: exchanged or damaged", "the current sensor's gain drifts"),
    "voltage": ("the voltage's scale stepped: supply or amplifier", "the voltage's scale drifts"),
    "mass": ("the rotor's mass stepped: a part was exchanged or lost", "the rotor's mass changes"),
}
_BENCH = {  # powers of `_NAMES` with which parameters follow what changes on the bench (docs/monitoring.md)
    "coil": (0, 0, 0, 1, 0),
    "flux": (0, 2, 1, 0, 0),
    "gap": (0, -3, -2, 0, -1),
    "mass": (1, 0, 0, 0, 0),
}
_LIKE = 0.15  # of a change, to which a pattern holds
_CALM = (0.01, 0.01, 0.01, 0.03, 0.01)  # relative changes that tell nothing; R follows the weather


def cause_of(h: History, name: str, rule: Rule, kind: str, at: float, end: float) -> str:
    """Say what the changes of an axis' parameters together speak for."""
    axis = name.rpartition(".")[0]
    places, change, spread = [], [], []
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
        change.append(math.log(b / a))
        spread.append(math.hypot(a_sd / a, b_sd / b))
    coil = f"{axis}.L" in h.series if axis else "L" in h.series
    return _likeliest(np.array(places, dtype=int), np.array(change), np.array(spread), kind, coil)


def _patterns(*, mass: bool, coil: bool) -> Iterator[tuple[str, Array]]:
    """Yield causes and the powers of `_NAMES` that they have.

    Where the mass is held (not `mass`), a cause that would move it moves the others, between two limits: as before
    where a coil's induced voltage fixes k_i, and as ratios to the mass where the motion does.
    """
    powers = unit_powers(model("one-axis"))
    sensors = {c: [powers[name][CHANNELS.index(c)] for name in _NAMES] for c in ("position", "current", "voltage")}
    for cause in _CAUSES:
        own = np.array({**_BENCH, **sensors}[cause], dtype=float)
        if mass or coil or not own[0]:
            yield cause, own
        if not mass and own[0]:
            yield cause, own - own[0] * np.array([1.0, 1.0, 1.0, 0.0, 0.0])


def _likeliest(places: Any, change: Array, spread: Array, kind: str, coil: bool) -> str:
    """Say which cause the logarithmic changes of the parameters at `places` of `_NAMES` speak for."""
    from scipy.stats import chi2

    if places.size < 2:
        return "the cause is not clear: too few other parameters were measured"
    misfit: dict[str, float] = {}
    for cause, powers in _patterns(mass=0 in places, coil=coil):
        v = powers[places]
        if not v.any():
            continue
        var = spread**2 + np.array(_CALM)[places] ** 2
        for _ in range(3):  # the tolerance is a share of the change
            size = (v @ (change / var)) / (v @ (v / var))
            var = spread**2 + np.array(_CALM)[places] ** 2 + (_LIKE * size * v) ** 2
        chi = float(np.sum((change - size * v) ** 2 / var))
        misfit[cause] = min(chi, misfit.get(cause, chi))
    order = sorted(misfit, key=lambda cause: misfit[cause])
    if chi2.sf(misfit[order[0]], places.size - 1) < 0.01:
        return "the cause is not clear: no single one fits the changes of all parameters"
    near = [_CAUSES[c][kind != "step"] for c in order if misfit[c] < misfit[order[0]] + _CLEAR]
    return near[0] if len(near) == 1 else f"the cause is not clear: {' or '.join(near[:3])}"
