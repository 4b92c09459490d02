"""Numbers as people read them: value and standard deviation with matching digits, in a unit of a sensible size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from ambid.units import UNKNOWN

_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "u"), (1e-9, "n"))
_UNPREFIXED = ("1", "%", "rad", "deg", "rpm")
_LOST = 1e4  # standard deviation over value from which a number says nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """A number made ready for print."""

    # value, standard deviation (empty where it is zero) and the ends of the interval, all in `unit` and with the same
    # number of decimals
    value: str
    sd: str
    low: str
    high: str
    unit: str  # with its prefix, e.g. ``"mH"``.
    si: str  # the value in the SI unit, with as many digits as its uncertainty leaves

    @property
    def text(self) -> str:
        """Value ± sd and unit on one line."""
        spread = f" ± {self.sd}" if self.sd else ""
        return _with_unit(f"{self.value}{spread}", self.unit)


def quantity(value: float, sd: float, unit: str, *, ci95: tuple[float, float] | None = None) -> Quantity:
    """Make a number and its standard deviation ready for print: two digits of the sd, and as many decimals for all.

    `value`, `sd`: in `unit`; `sd` is 0 for a number that is known exactly; `unit`: SI unit; `ci95`: interval, in
    `unit`. Returns in the prefix in which the larger of value and sd lies between 1 and 1000.
    """
    lost = not math.isfinite(sd) or sd > _LOST * abs(value) > 0
    if sd == 0 or lost:  # known exactly, or not at all: digits of the value alone
        scale, shown_unit = prefixed(max(abs(value), sd if math.isfinite(sd) else 0.0), unit)
        spread = "" if sd == 0 else f"{sd / scale:.3g}" if math.isfinite(sd) else "inf"
        return Quantity(
            value=f"{value / scale:.6g}",
            sd=spread,
            low="",
            high="",
            unit=shown_unit,
            si=_with_unit(f"{value:.6g}", unit),
        )
    scale, shown_unit = prefixed(max(abs(value), sd), unit)
    decimals = 1 - math.floor(math.log10(sd / scale))
    if float(f"{sd / scale:.{max(decimals, 0)}f}") >= 10.0 ** (2 - decimals):
        decimals -= 1  # 0.0996 is 0.10 in two digits
    decimals = min(max(decimals, 0), 12)
    low, high = ci95 if ci95 is not None else (math.nan, math.nan)
    digits = 1 if value == 0 else math.floor(math.log10(abs(value) / scale)) + 1 + decimals
    return Quantity(
        value=_fixed(value / scale, decimals),
        sd=_fixed(sd / scale, decimals),
        low="" if ci95 is None else _fixed(low / scale, decimals),
        high="" if ci95 is None else _fixed(high / scale, decimals),
        unit=shown_unit,
        si=si_text(value, max(digits, 1), unit),
    )


def prefixed(size: float, unit: str) -> tuple[float, str]:
    """Choose the prefix in which a size lies between 1 and 1000.

    `size`: in `unit`; its sign does not matter; `unit`: SI unit. Returns `scale`: value in `unit` of one of the
    returned unit; `text`: the unit with its prefix; kilograms become grams below one.
    """
    first, rest = _first_symbol(unit)
    if size == 0 or not math.isfinite(size) or first in _UNPREFIXED:
        return 1.0, unit
    own = 1e3 if first == "kg" else 1.0
    symbol = "g" if first == "kg" else first
    for factor, prefix in _PREFIXES:
        if abs(size) * own >= factor * (1 - 1e-12) and not (symbol == "g" and factor > 1e3):
            return factor / own, f"{prefix}{symbol}{rest}"
    factor, prefix = _PREFIXES[-1]
    return factor / own, f"{prefix}{symbol}{rest}"


def si_text(value: float, digits: int, unit: str) -> str:
    """Write a value in its SI unit.

    `value`: in `unit`; `digits`: significant digits; `unit`: SI unit. Returns such as ``"-1.287e5 N/m"``.
    """
    size = math.floor(math.log10(abs(value))) if value else 0
    if -3 <= size <= 5:
        decimals = max(digits - 1 - size, 0)
        return _with_unit(f"{value:.{decimals}f}", unit)
    mantissa, exponent = f"{value:.{max(digits - 1, 0)}e}".split("e")
    return _with_unit(f"{mantissa}e{int(exponent)}", unit)


def sized(value: float, unit: str, digits: int = 3) -> str:
    """Write one number with a prefix, without uncertainty.

    `value`: in `unit`; `unit`: SI unit; `digits`: significant digits. Returns such as ``"104 nm"``.
    """
    scale, shown_unit = prefixed(float(f"{value:.{digits}g}"), unit)
    return _with_unit(f"{value / scale:.{digits}g}", shown_unit)


def response_unit(units: Mapping[str, str], output: str, source: str) -> str:
    """Return the unit of a response, such as ``"m/V"``; a name that is missing has an unknown unit."""
    above, below = str(units.get(output, UNKNOWN)), str(units.get(source, UNKNOWN))
    if above == below:
        return "1"
    if below == "1":
        return above
    return f"{above}/({below})" if set(below) & set(" /") else f"{above}/{below}"


def _with_unit(text: str, unit: str) -> str:
    """Put the unit behind a number; a plain number has none to show."""
    return text if unit in ("", "1") else f"{text} {unit}"


def _fixed(x: float, decimals: int) -> str:
    text = f"{x:.{decimals}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def _first_symbol(unit: str) -> tuple[str, str]:
    """Split ``"N s/m"`` into the symbol that takes the prefix and the rest."""
    for k, letter in enumerate(unit):
        if letter in " /^":
            return unit[:k], unit[k:]
    return unit, ""
