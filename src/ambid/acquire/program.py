"""Excitations by name as a controller can play them: a square wave, a shift register, or a table over and over."""

from __future__ import annotations

import math

import numpy as np

from ambid.acquire.device import Program
from ambid.acquire.playing import FULL, MASKS, Played, amplitude_counts, elements_of, expected, period_ticks, played
from ambid.acquire.protocol.table import table
from ambid.acquire.scales import TABLE_LENGTH
from ambid.acquire.settings import ControllerSettings
from ambid.errors import DeviceError
from ambid.rig.rig import Rig

__all__ = [
    "NAMES",
    "Played",
    "amplitude_counts",
    "elements_of",
    "expected",
    "period_ticks",
    "played",
    "program",
]

NAMES = ("steps", "prbs", "multisine", "schroeder")
"""Excitations that a controller can play."""

_INSTEAD = {"chirp": "multisine", "gaussian": "prbs"}
_LONGEST_HOLD = 65_535
_PERIODS = 4  # of an excitation in a record, where nothing else decides: enough to tell noise from signal
_HALF_POWER = 0.44  # a PRBS has half its power density at this, over the time of an element
_HIGHEST = 0.4  # of the rate of a table's elements: the holding between them leaves less of what is above
_CREST_ROUNDS = 100
_SHORTEST_TABLE = 8


def program(
    name: str,
    *,
    amplitude_v: float,
    band: tuple[float, float] | None = None,
    rate_hz: float,
    seconds: float,
    seed: int = 0,
    table_length: int = TABLE_LENGTH,
) -> Program:
    """Make an excitation for a controller.

    `name`: ``steps``, ``prbs``, ``multisine`` or ``schroeder``, as `ambid.signals.excitation` knows them;
    `amplitude_v`: peak at the coil, V; `rate_hz`: ticks in one second; `seed`: phases of a multisine, where the
    register of a PRBS starts; `table_length`: elements of the controller's table. Returns played until it is ended.
    """
    _check(name, amplitude_v, band, rate_hz, seconds)
    ticks = round(seconds * rate_hz)
    if name == "steps":
        return _steps(amplitude_v, band, ticks)
    if name == "prbs":
        return _prbs(amplitude_v, band, rate_hz, ticks, seed)
    return _multisine(name, amplitude_v, band, rate_hz, ticks, seed, table_length)


def _check(name: str, amplitude_v: float, band: tuple[float, float] | None, rate_hz: float, seconds: float) -> None:
    if name in _INSTEAD:
        raise DeviceError(
            f"excitation {name!r} cannot be played by a controller, which has a square wave, a shift register and a"
            f" short table. The nearest is {_INSTEAD[name]!r} in the same band; give that"
        )
    if name not in NAMES:
        raise DeviceError(f"excitation {name!r} is unknown; a controller plays {', '.join(NAMES)}. Give one of them")
    if not (math.isfinite(amplitude_v) and amplitude_v > 0.0):
        raise DeviceError(f"excitation amplitude {amplitude_v} V; it must be a positive number. Give another")
    if not (math.isfinite(seconds) and seconds * rate_hz >= 2.0):
        raise DeviceError(f"an excitation of {seconds:g} s at {rate_hz:g} Hz has no two ticks. Give more seconds")
    if band is not None and not 0.0 <= band[0] < band[1] <= rate_hz / 2.0:
        raise DeviceError(
            f"excitation band {band[0]:g} to {band[1]:g} Hz; at {rate_hz:g} Hz it must lie between 0 and"
            f" {rate_hz / 2:g} Hz, low end first. Give another"
        )


def _steps(amplitude_v: float, band: tuple[float, float] | None, ticks: int) -> Program:
    """Four periods of a square wave in the record, or as many more as keep a step within the controller's counter."""
    if band is not None:
        raise DeviceError("excitation 'steps' has no band. Leave the band out, or choose 'prbs' for steps in a band")
    edges = max(2 * _PERIODS, 2 * math.ceil(ticks / (2 * _LONGEST_HOLD)))
    return Program(kind="step", amplitude=amplitude_v, hold=max(1, ticks // edges), length=2)


def _prbs(amplitude_v: float, band: tuple[float, float] | None, rate_hz: float, ticks: int, seed: int) -> Program:
    """Half its power density at the top of the band, a line at its bottom or under."""
    low, high = band if band is not None else (0.0, _HALF_POWER * rate_hz)
    hold = min(max(1, int(_HALF_POWER * rate_hz / high + 1e-9)), _LONGEST_HOLD)
    least, most = min(MASKS), max(MASKS)
    if low > 0.0:
        bits = max(least, math.ceil(math.log2(rate_hz / (hold * low) + 1.0) - 1e-9))
        if bits > most:
            raise DeviceError(
                f"a prbs from {low:g} to {high:g} Hz needs a register of {bits} bits; the controller has {most}. With"
                f" that top it begins at {rate_hz / (hold * (2**most - 1)):.3g} Hz; raise the low or lower the high end"
            )
    else:
        bits = min(max(least, int(math.log2(ticks / (_PERIODS * hold) + 1.0))), most)
    if (period := (2**bits - 1) * hold) > ticks:
        raise DeviceError(
            f"a prbs from {low:g} to {high:g} Hz has a period of {period / rate_hz:.4g} s, longer than the record of"
            f" {ticks / rate_hz:.4g} s. Record longer, or raise the low end of the band"
        )
    start = int(np.random.default_rng(seed).integers(1, 2**bits))
    return Program(kind="prbs", amplitude=amplitude_v, hold=hold, length=bits, seed=start)


def _multisine(
    name: str,
    amplitude_v: float,
    band: tuple[float, float] | None,
    rate_hz: float,
    ticks: int,
    seed: int,
    table_length: int,
) -> Program:
    """The longest table of which four periods fit into the record, held only as far as its lowest line needs it."""
    from ambid.signals.excitations import multisine

    low, high = band if band is not None else (0.0, rate_hz / 5.0)
    hold = max(1, math.ceil(rate_hz / (table_length * low) - 1e-9)) if low > 0.0 else 1
    top = rate_hz / 2.0 if hold == 1 else _HIGHEST * rate_hz / hold
    if high > top * (1 + 1e-9):
        raise DeviceError(
            f"a {name} from {low:g} to {high:g} Hz does not fit into a table of {table_length} elements: from"
            f" {low:g} Hz it goes to {top:.4g} Hz, and to {high:g} Hz it begins at"
            f" {_lowest(high, rate_hz, table_length):.4g} Hz. Narrow the band, or choose 'prbs'"
        )
    length = min(table_length, ticks // (_PERIODS * hold))
    if length < _SHORTEST_TABLE or (low > 0.0 and hold * length * low < rate_hz * (1 - 1e-9)):
        needed = _PERIODS * max(1.0 / low if low else 0.0, _SHORTEST_TABLE / rate_hz)
        raise DeviceError(
            f"a {name} from {low:g} Hz needs {needed:.4g} s for {_PERIODS} periods; the record has"
            f" {ticks / rate_hz:.4g} s. Record longer, or raise the low end of the band"
        )
    x = multisine(
        length,
        rate_hz / hold,
        amplitude=float(FULL),
        band=(low, high),
        phases="random" if name == "multisine" else "schroeder",
        crest_iterations=_CREST_ROUNDS if name == "multisine" else 0,
        seed=seed,
    )
    table = tuple(int(v) for v in np.rint(x))
    return Program(kind="table", amplitude=amplitude_v, hold=hold, length=length, table=table)


def _lowest(high: float, rate_hz: float, table_length: int) -> float:
    """Lowest line of a table whose elements are fast enough for a highest one, Hz."""
    hold = max(1, int(_HIGHEST * rate_hz / high + 1e-9))
    return rate_hz / (hold * table_length)


def counts_of(program: Program, rig: Rig, settings: ControllerSettings) -> dict[str, int]:
    """Return the fields of the message ``excitation``.

    `program`: amplitude in V; `rig`: with the calibration of its voltage; `settings`: of the device. Returns without
    ``id``.
    """
    amplitude = 0
    if program.kind != "none":
        amplitude = amplitude_counts(program, rig, settings.duty_bias, (settings.duty_low, settings.duty_high))
    return {
        "kind": table().value("kind", program.kind),
        "amplitude": amplitude,
        "hold": program.hold,
        "length": program.length,
        "cycles": program.cycles,
        "seed": program.seed,
    }
