"""Units at the edges: text such as ``"mH"`` or ``"N s/m"`` becomes an SI unit and a factor.

Inside `ambid` everything is SI. A unit text is a product of symbols with at most one power each and one factor after
each slash: ``N/m``, ``N s/m``, ``m/s^2``. Radians are kept as a unit of their own, so that ``rpm`` and ``rad/s`` are
angular speeds and ``Hz`` and ``kHz`` are cycles per second: the two kinds are not converted into each other, because a
factor 2 pi slipped in silently is the very mistake that units are there to stop.
"""

from __future__ import annotations

import difflib
import math
import re
import unicodedata
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from ambid.errors import UnitError

UNKNOWN = "?"
"""Unit of a channel whose header names none, or none that is known; using it is an error until it is declared."""

_Powers = tuple[int, int, int, int, int]  # of kg, m, s, A, rad

_BASE: dict[str, tuple[float, _Powers]] = {
    "1": (1.0, (0, 0, 0, 0, 0)),
    "%": (0.01, (0, 0, 0, 0, 0)),
    "g": (1e-3, (1, 0, 0, 0, 0)),
    "m": (1.0, (0, 1, 0, 0, 0)),
    "s": (1.0, (0, 0, 1, 0, 0)),
    "A": (1.0, (0, 0, 0, 1, 0)),
    "rad": (1.0, (0, 0, 0, 0, 1)),
    "deg": (math.pi / 180, (0, 0, 0, 0, 1)),
    "rpm": (math.pi / 30, (0, 0, -1, 0, 1)),
    "Hz": (1.0, (0, 0, -1, 0, 0)),
    "N": (1.0, (1, 1, -2, 0, 0)),
    "V": (1.0, (1, 2, -3, -1, 0)),
    "W": (1.0, (1, 2, -3, 0, 0)),
    "Pa": (1.0, (1, -1, -2, 0, 0)),
    "ohm": (1.0, (1, 2, -3, -2, 0)),
    "H": (1.0, (1, 2, -2, -2, 0)),
    "Wb": (1.0, (1, 2, -2, -1, 0)),
    "T": (1.0, (1, 0, -2, -1, 0)),
}
_PREFIX = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3}
_UNPREFIXED = {"1", "%", "rpm", "deg", "rad"}

_ATOMS: dict[str, tuple[float, _Powers]] = dict(_BASE) | {
    prefix + symbol: (factor * scale, powers)
    for symbol, (scale, powers) in _BASE.items()
    if symbol not in _UNPREFIXED
    for prefix, factor in _PREFIX.items()
}
_ATOMS |= {
    "MHz": (1e6, _BASE["Hz"][1]),
    "Mohm": (1e6, _BASE["ohm"][1]),
    "MPa": (1e6, _BASE["Pa"][1]),
    "GPa": (1e9, _BASE["Pa"][1]),
    "cm": (1e-2, (0, 1, 0, 0, 0)),
    "mil": (25.4e-6, (0, 1, 0, 0, 0)),
    "kg": (1.0, (1, 0, 0, 0, 0)),
    "mg": (1e-6, (1, 0, 0, 0, 0)),
}
# A power of ten that is exact in decimal must not carry the rounding of two binary factors.
_ATOMS = {
    symbol: (float(f"{scale:.15g}") if symbol not in {"rpm", "deg"} else scale, p)
    for symbol, (scale, p) in _ATOMS.items()
}

# fmt: off
_SUGGESTED = (
    "s", "ms", "us", "V", "mV", "uV", "kV", "A", "mA", "uA", "m", "mm", "um", "nm",
    "N", "mN", "kN", "kg", "g", "H", "mH", "uH", "ohm", "mohm", "kohm",
    "Hz", "kHz", "rpm", "1", "%", "T", "mT", "Wb", "Pa", "GPa",
)
# fmt: on
_KNOWN_COMPOUNDS = (
    "rad/s",
    "m/s",
    "m/s^2",
    "N/m",
    "N/mm",
    "N/um",
    "N/A",
    "N s/m",
    "V/m",
    "A/V",
    "V s/m",
    "kg m^2",
    "kg/m^3",
    "H/m",
)
_SI_NAMES: dict[_Powers, str] = {
    powers: symbol for symbol, (scale, powers) in _BASE.items() if scale == 1.0 and symbol != "rad"
} | {(1, 0, 0, 0, 0): "kg", (0, 0, 0, 0, 1): "rad"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """A unit of measurement."""

    symbol: str  # as it was written, in plain letters: ``"um"`` for ``"µm"``
    si: str  # the SI unit of the same kind. Two units are of one kind exactly if their `si` are equal.
    scale: float  # value in `si` of one `symbol`

    def same_kind(self, other: Unit) -> bool:
        """Tell whether a value in another unit can be expressed in this one.

        `other`: the other unit. Returns true if both have the same SI unit.
        """
        return self.si == other.si

    @overload
    def to_si(self, x: float) -> float: ...
    @overload
    def to_si(self, x: NDArray[np.float64]) -> NDArray[np.float64]: ...
    def to_si(self, x: float | NDArray[np.float64]) -> float | NDArray[np.float64]:
        """Convert a value in this unit to SI.

        `x`: in this unit. Returns in `si`; `x` itself where the scale is 1, so that SI data pass bit for bit.
        """
        if self.scale == 1.0:
            return x
        if self.scale < 1.0 and (inverse := round(1.0 / self.scale)) * self.scale == 1.0:
            return x / inverse  # 60.54 g is 0.06054 kg exactly as decimals, not 0.06054000000000001
        return x * self.scale

    def of_si(self, x: Any, si: str) -> Any:
        """Return values in SI units `si` in this unit; UnitError where that is of another kind."""
        if parse_unit(si).si != self.si:
            raise UnitError(f"[{si}] cannot be told in [{self.symbol}]. Give a unit of the same kind")
        return x / self.scale


@lru_cache(maxsize=256)
def parse_unit(text: str) -> Unit:
    """Read a unit.

    `text`: such as ``"mH"``, ``"µm"``, ``"N s/m"``, ``"m/s^2"``, ``"1"``, ``"%"``. Returns with its SI unit and factor.
    ``rpm`` becomes rad/s (factor pi/30); ``Hz`` stays Hz.
    """
    plain = _plain(text)
    if not plain:
        raise UnitError("a unit is empty; write the unit, or [1] for a plain number")
    scale, powers = 1.0, [0, 0, 0, 0, 0]
    for sign, factors in zip((1, *[-1] * plain.count("/")), plain.split("/"), strict=True):
        symbols = factors.split()
        if not symbols or (sign < 0 and len(symbols) > 1):
            raise UnitError(
                f"the unit {text!r} is not clear; write one factor after each slash, as in [N s/m] or [m/s^2]"
            )
        for symbol in symbols:
            factor, exponents, power = _factor(symbol, text)
            scale = scale * factor**power if sign > 0 else scale / factor**power
            powers = [p + sign * power * e for p, e in zip(powers, exponents, strict=True)]
    return Unit(symbol=plain, si=_si_name(powers), scale=float(scale))


def known_units() -> tuple[str, ...]:
    """Return the unit symbols that are suggested to a user, simple ones first.

    Returns the simple symbols and the compounds that bearings need; other prefixes and products are read too.
    """
    return (*_SUGGESTED, *_KNOWN_COMPOUNDS)


def _plain(text: str) -> str:
    """Write µ, Ω, ², ·, ㎜ in plain letters and single spaces."""
    text = re.sub("[\u3300-\u33ff]", lambda x: unicodedata.normalize("NFKC", x[0]), text)
    for fancy, letters in (("µ", "u"), ("μ", "u"), ("Ω", "ohm"), ("Ω", "ohm"), ("²", "^2"), ("·", " "), ("*", " ")):
        text = text.replace(fancy, letters)
    return re.sub(r"\s*/\s*", "/", " ".join(text.split()))


def _factor(symbol: str, text: str) -> tuple[float, _Powers, int]:
    """Look one factor such as ``s^2`` up: its scale, its exponents and its power."""
    base, _, power = symbol.partition("^")
    if base in _ATOMS and (not power or re.fullmatch(r"-?[1-9]", power)):
        return (*_ATOMS[base], int(power or 1))
    raise UnitError(f"unit {text!r} is unknown; nearest: {nearest_unit(text)}. Write one of these")


def nearest_unit(text: str) -> str:
    """Name the known units whose spelling is nearest.

    `text`: what was written. Returns up to three symbols, comma-separated.
    """
    wanted = _plain(text).lower()
    by_closeness = sorted(known_units(), key=lambda u: -difflib.SequenceMatcher(None, wanted, u.lower()).ratio())
    return ", ".join(by_closeness[:3])


def _si_name(powers: list[int]) -> str:
    """Name an SI unit from its exponents of kg, m, s, A, rad."""
    key = (powers[0], powers[1], powers[2], powers[3], powers[4])
    if key in _SI_NAMES:
        return _SI_NAMES[key]
    for compound in _KNOWN_COMPOUNDS:
        if _compound_powers(compound) == key:
            return compound
    above = [_power_text(s, p) for s, p in zip(("kg", "m", "s", "A", "rad"), powers, strict=True) if p > 0]
    below = [_power_text(s, -p) for s, p in zip(("kg", "m", "s", "A", "rad"), powers, strict=True) if p < 0]
    return "/".join([" ".join(above) or "1", *below])


def _power_text(symbol: str, power: int) -> str:
    return symbol if power == 1 else f"{symbol}^{power}"


@lru_cache(maxsize=64)
def _compound_powers(compound: str) -> _Powers:
    """Return the exponents of a compound that is SI itself; an impossible key for one that is not (N/mm)."""
    total, scale = [0, 0, 0, 0, 0], 1.0
    for sign, factors in zip((1, -1), compound.split("/"), strict=False):
        for symbol in factors.split():
            factor, exponents, power = _factor(symbol, compound)
            scale *= factor ** (sign * power)
            total = [t + sign * power * e for t, e in zip(total, exponents, strict=True)]
    return (total[0], total[1], total[2], total[3], total[4]) if scale == 1.0 else (99, 99, 99, 99, 99)
