"""Slips of commissioning that leave a sound fit: a channel in another unit than its column says.

A factor on one channel, or on time, is an exact symmetry of the model (`ambid.physics.sensor_errors`): only sizes can
tell. Usual ranges, wide enough for micro-bearings and turbines, together leave a factor of 1000 hardly any room; what a
rig says is one more, narrow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.bearing.multistart import Signals
from ambid.estimation.estimate import Check
from ambid.physics.linear_model import LinearModel, Parameter, model
from ambid.physics.sensor_errors import CHANNELS, unit_powers
from ambid.settings.caller import setting

_UNITS = dict(zip(CHANNELS, ("V", "A", "m", "s"), strict=True))
_SIGNALS = {  # powers of gains of `CHANNELS`
    "voltage": (1, 0, 0, 0),
    "current": (0, 1, 0, 0),
    "position": (0, 0, 1, 0),
    "rate": (0, 0, 0, -1),
}
_HIGH = 0.999
_EXACT = 0.1  # power of ten within which a rig's value is a thousand times another
_NAMED = 0.5  # half width, as a power of ten, of the range around what a rig says
# Of squared half widths: what a rarer slip costs, within which two are both named, and what a slip has to gain.
_RARE, _ALIKE, _GAIN = 2.0, 1.2, 1.8
_FACTORS = {  # what a value is multiplied by when its unit is mistaken, for every channel
    1e3: "a thousand times too large (values in m{unit} read as {unit})",
    1e-3: "a thousand times too small (values in {unit} read as m{unit})",
    1e6: "a million times too large (values in u{unit} read as {unit})",
    1e-6: "a million times too small (values in {unit} read as u{unit})",
}
_LENGTHS = {  # and for a position
    1 / 0.0254: "39.4 times too large (values in inches read as m)",
    180 / np.pi: "57.3 times too large (degrees of a lever read as radians)",
    1 / 25.4e-6: "39 370 times too large (values in mil read as m)",
    0.0254e3: "25.4 times too large",
}
_TIMES = {  # and for time, of which the sampling rate may be a wrong number too
    1e3: "a thousand times too large (times in ms read as s, or a rate in kHz read as Hz)",
    1e-3: "a thousand times too small (times in s read as ms)",
    10.0: "ten times too large (the sampling rate is ten times what was said)",
    0.1: "ten times too small (the sampling rate is a tenth of what was said)",
    1e6: "a million times too large (times in us read as s, or a rate in MHz read as Hz)",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """A size of a bench: a product of powers of parameters and of signals' largest values."""

    name: str
    of: Mapping[str, float]  # exponents of parameters in SI, largest voltage, current and travel, and rate
    unit: str
    usual: tuple[float, float]
    possible: tuple[float, float]
    source: str


# Usual: of micro-bearings of a few grams to turbines of several tons. The presets, the benches that the thesis names
# (sec. 1.4, ch. 4 to 6) and the measured levitation lie inside, most near the middle.
SIZES = (
    Size(name="coil resistance", of={"R": 1}, unit="ohm", usual=(0.02, 300.0), possible=(1e-4, 1e5),
         source="0.1 ohm for coils of 50 A, 100 ohm for those of 50 mA"),
    Size(name="coil inductance", of={"L": 1}, unit="H", usual=(1e-5, 10.0), possible=(1e-7, 1e3),
         source="60 mH in thesis table 4.1, 0.12 H for the measured levitation; of flat micro-coils some 0.1 mH"),
    Size(name="largest current", of={"current": 1}, unit="A", usual=(3e-3, 300.0), possible=(1e-6, 1e4),
         source="from the noise of a small sensor to the amplifiers of turbines"),
    Size(name="largest voltage", of={"voltage": 1}, unit="V", usual=(0.02, 2000.0), possible=(1e-5, 1e5),
         source="supplies of 5 V to 600 V; an excitation is a part of them"),
    Size(name="travel", of={"position": 1}, unit="m", usual=(3e-7, 0.03), possible=(1e-9, 1.0),
         source="air gaps of 0.1 to 1 mm, of which a record uses a part; 20 mm for balls under a magnet"),
    Size(name="mass", of={"m": 1}, unit="kg", usual=(3e-4, 3e4), possible=(1e-5, 1e6),
         source="from micro-bearings to turbines"),
    Size(name="force-current factor", of={"k_i": 1}, unit="N/A", usual=(0.01, 1e4), possible=(1e-5, 1e6),
         source="1 N/A for a ball, 61 N/A in thesis eq. 1.6, some 1000 N/A for rotors of tons"),
    Size(name="bias current over gap, k_x/k_i", of={"k_x": 1, "k_i": -1}, unit="A/m", usual=(5.0, 3e5),
         possible=(1e-3, 1e8), source="k_x/k_i = -i0/x0 (thesis eq. 1.6: 2460 A/m; 95 A/m for a ball at 10 mm)"),
    Size(name="acceleration per current, k_i/m", of={"k_i": 1, "m": -1}, unit="m/s^2/A", usual=(0.01, 1e4),
         possible=(1e-5, 1e7), source="2 g/i0 for one magnet against gravity (theory.md sec. 1)"),
    Size(name="coil time constant, L/R", of={"L": 1, "R": -1}, unit="s", usual=(2e-5, 5.0), possible=(1e-7, 1e3),
         source="47 ms in thesis eq. 4.10, 28 ms for the measured levitation; 0.2 ms for micro-coils"),
    Size(name="bias stiffness over mass as a frequency, sqrt(-k_x/m)/(2 pi)", of={"k_x": 0.5, "m": -0.5}, unit="Hz",
         usual=(0.2, 1000.0), possible=(0.01, 1e5),
         source="sqrt(g/gap)/(2 pi) for a magnet that carries the weight: 7 Hz at 10 mm, 50 Hz at 0.1 mm (theory.md "
         "sec. 1); stiff spindles some 100 Hz"),
    Size(name="sampling rate", of={"rate": 1}, unit="Hz", usual=(50.0, 5e6), possible=(1.0, 1e9),
         source="100 Hz for coils at rest to MHz of recorders; loops close at 1 to 20 kHz"),
    Size(name="acceleration, k_i i/m", of={"k_i": 1, "m": -1, "current": 1}, unit="m/s^2", usual=(0.01, 1e4),
         possible=(1e-4, 1e6), source="from a hundredth of the weight to the largest force of a magnet, some 100 g"),
    Size(name="power", of={"voltage": 1, "current": 1}, unit="V A", usual=(1e-4, 1e6), possible=(1e-10, 1e9),
         source="largest voltage and current together"),
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class UnitSlip:
    """A factor on one channel that would bring every size back to where it usually is."""

    channel: str
    factor: float  # values are too large by this
    text: str


def check_units(
    values: Mapping[str, float], parameters: Sequence[Parameter], signals: Signals, plant: LinearModel | None = None
) -> Check:
    """Check that the sizes of parameters (SI, all free where a rig's value is to count as evidence) and of the record's
    `signals` are those of a bench, else name the slip of a unit; `plant`: default one-axis.
    """
    plant = model("one-axis") if plant is None else plant
    if values.get("L", np.inf) * signals.rate_hz < values.get("R", 0.0):  # within a sample L is not seen
        values = {name: value for name, value in values.items() if name != "L"}
    sizes, largest = [*SIZES, *_said(parameters)], _seen(signals, plant)
    logs = np.array([_log(size, {**values, **largest}) for size in sizes])
    low, high = (np.log10([size.usual[j] for size in sizes]) for j in (0, 1))
    far = (logs - (low + high) / 2) / ((high - low) / 2)
    odd = [j for j in np.flatnonzero(~(np.abs(far) <= 1.0)) if np.isfinite(far[j])]
    if not odd:
        return Check(passed=True, values={"unusual": 0.0}, detail="all sizes are typical of magnetic bearings")
    powers, none = {**unit_powers(plant), **_SIGNALS}, (0,) * len(CHANNELS)  # none: of what the plant does not have
    moves = np.array([sum(e * np.array(powers.get(k, none)) for k, e in size.of.items()) for size in sizes])
    slips = _slips(far, moves / ((high - low) / 2)[:, None], [c for c in CHANNELS if c in largest or c == "time"])
    factors: dict[str, float] = {}
    for slip in slips:
        factors.setdefault(f"{slip.channel}_factor", slip.factor)
    wrong = _mistaken_values(parameters, values) if all(sizes[j].source == "rig" for j in odd) else []
    if wrong:  # a mass that is a thousand times off is a rate that is ten times off as well
        wrong += [f"Or {slip.channel} is {slip.text}" for slip in slips if slip.channel == "time"]
        late = {name: factor for name, factor in factors.items() if name == "time_factor"}
        return Check(passed=False, values={**late, "unusual": float(len(odd))}, detail=". ".join(wrong))
    worst = max(odd, key=lambda j: abs(far[j]))
    what = f"{sizes[worst].name} = {10 ** logs[worst]:.3g} {sizes[worst].unit}"
    what += f" is unusual (usually {sizes[worst].usual[0]:.3g} to {sizes[worst].usual[1]:.3g})"
    if slips:
        words = ", or ".join(f"{slip.channel} is {slip.text}" for slip in slips)
        return Check(
            passed=False,
            values={**factors, "unusual": float(len(odd))},
            detail=f"{what}. All sizes are typical if {words}. Correct the unit in the record's header, or give "
            + (setting("rate_hz") if slips[0].channel == "time" else f"channels.{slips[0].channel}.gain"),
        )
    return Check(
        passed=_inside(sizes, logs),
        values={"unusual": float(len(odd))},
        detail=f"{what}, and no wrong unit of one channel explains it. Check units, calibration and sampling rate",
    )


def possible(values: Mapping[str, float], signals: Signals, plant: LinearModel) -> bool:
    """Return whether a bench of these sizes can exist; arguments as of `check_units`."""
    numbers = {**values, **_seen(signals, plant)}
    return _inside(SIZES, [_log(size, numbers) for size in SIZES])


def _inside(sizes: Sequence[Size], logs: Sequence[float] | Array) -> bool:
    both = zip(sizes, logs, strict=True)
    return all(s.possible[0] <= 10**x <= s.possible[1] for s, x in both if np.isfinite(x))


def _seen(signals: Signals, plant: LinearModel) -> dict[str, float]:
    """Largest voltage and current, travel, and rate, as far as the model has them."""
    columns = dict(zip((*plant.inputs, *plant.outputs), np.column_stack([signals.u, signals.y]).T, strict=True))
    sizes = {role: _largest(x) for role, x in columns.items()} | {"rate": signals.rate_hz}
    if "position" in columns:
        sizes["position"] = 2.0 * _largest(columns["position"] - np.median(columns["position"]))
    return sizes


def _mistaken_values(parameters: Sequence[Parameter], values: Mapping[str, float]) -> list[str]:
    """Say which of a rig's values are a power of thousand off what the record alone gives, `values` in SI."""
    lines = []
    for p in parameters:
        alone = values.get(p.name, 0.0)
        if p.role == "free" or not p.value or not alone:
            continue
        decades = float(np.log10(abs(p.value / alone)))
        thousands = round(decades / 3.0)
        if thousands and abs(decades - 3.0 * thousands) < _EXACT:
            lines.append(
                f"{p.name} = {p.value:.4g} {p.unit} in the rig is about 10^{3 * thousands} times the value from the "
                f"data ({alone:.4g} {p.unit}). Correct its unit in the rig"
            )
    return lines


def _largest(signal: Array) -> float:
    """The size that a thousandth of the samples exceeds: a glitch is none of the bench's."""
    return float(np.quantile(np.abs(signal), _HIGH))


def _log(size: Size, values: Mapping[str, float]) -> float:
    """Logarithm of a size; not a number where it does not apply."""
    if "k_x" in size.of and len(size.of) > 1 and values.get("k_x", 0.0) >= 0:
        return float("nan")  # a spring outweighs the magnet, and says nothing of bias and gap
    factors = [abs(values.get(name, 0.0)) for name in size.of]
    if not all(factors):
        return float("nan")
    turns = np.log10(2.0 * np.pi) if size.unit == "Hz" and "rate" not in size.of else 0.0
    return float(np.dot(list(size.of.values()), np.log10(factors)) - turns)


def _said(parameters: Sequence[Parameter]) -> list[Size]:
    """What a rig says of parameters, as sizes of a narrow range."""
    sizes = []
    for p in parameters:
        if p.role != "free" and p.value and p.name != "c":
            wide = 10 ** max(_NAMED, 3.0 * np.log10(1.0 + (p.sd or 0.0) / abs(p.value)))
            usual = (abs(p.value) / wide, abs(p.value) * wide)
            sizes.append(
                Size(name=p.name, of={p.name: 1}, unit=p.unit, usual=usual, possible=(0.0, np.inf), source="rig")
            )
    return sizes


def _slips(far: Array, moves: Array, channels: Sequence[str]) -> list[UnitSlip]:
    """The likeliest factors on one channel, or time, that make every size usual, and those nearly as likely; `far`
    (n,): distances from the middles of the ranges in half widths; `moves` (n, 4): what a power of ten moves.
    """
    applies, slips = np.isfinite(far), []
    most = float(np.sum(far[applies] ** 2)) - _GAIN
    for j, (channel, unit) in enumerate(_UNITS.items()):
        if channel not in channels:
            continue
        own = _TIMES if channel == "time" else {**_FACTORS, **(_LENGTHS if channel == "position" else {})}
        for factor, text in own.items():
            after = (far - moves[:, j] * np.log10(factor))[applies]
            if np.all(np.abs(after) <= 1.0):
                rare = 0.0 if factor in (1e3, 1e-3) and channel != "time" else _RARE
                words = text.format(unit=unit)
                slips.append((float(np.sum(after**2)) + rare, UnitSlip(channel=channel, factor=factor, text=words)))
    slips = sorted((f for f in slips if f[0] < most), key=lambda f: f[0])
    return [slip for score, slip in slips if score < slips[0][0] + _ALIKE]
