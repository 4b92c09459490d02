"""Excitations by name as a controller plays them: a square wave, a shift register, or a table over and over. The
comments of ``protocol/messages.toml`` define it tick by tick; the firmware and this file keep to that.
"""

from __future__ import annotations

import math

import numpy as np

from ambid.acquisition.device import AxesProgram, Program
from ambid.acquisition.protocol import table
from ambid.acquisition.scales import TABLE_LENGTH, scale_of, who
from ambid.acquisition.settings import ControllerSettings
from ambid.arrays import Array
from ambid.errors import DeviceError
from ambid.rig.rig import Rig

NAMES = ("steps", "prbs", "multisine", "schroeder")
"""Excitations that a controller can play."""

MASKS = dict(enumerate((3, 3, 5, 3, 3, 0x1D, 0x11, 9, 5, 0x53, 0x1B, 0x443, 3), start=3))
"""Feedback of a register of so many bits: the bits whose parity comes in at its top; all of greatest length."""

FULL = 127
"""Element of a table that is the amplitude."""

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
) -> Program:
    """Make an excitation that a controller plays until it is ended: ``steps``, ``prbs``, ``multisine`` or
    ``schroeder``, as `ambid.signals.excitation`, peak in V at the coil; `seed`: phases of a multisine, start of a PRBS.
    """
    _check(name, amplitude_v, band, rate_hz, seconds)
    ticks = round(seconds * rate_hz)
    if name == "steps":
        return _steps(amplitude_v, band, ticks)
    if name == "prbs":
        return _prbs(amplitude_v, band, rate_hz, ticks, seed)
    return _multisine(name, amplitude_v, band, rate_hz, ticks, seed)


def _check(name: str, amplitude_v: float, band: tuple[float, float] | None, rate_hz: float, seconds: float) -> None:
    if name in _INSTEAD:
        raise DeviceError(
            f"excitation {name!r} cannot be played by a controller, which has a square wave, a shift register and "
            f"a short table. The nearest is {_INSTEAD[name]!r} in the same band; give that"
        )
    if name not in NAMES:
        raise DeviceError(f"excitation {name!r} is unknown; a controller plays {', '.join(NAMES)}. Give one of them")
    if not (math.isfinite(amplitude_v) and amplitude_v > 0.0):
        raise DeviceError(f"excitation amplitude {amplitude_v} V; it must be a positive number. Give another")
    if not (math.isfinite(seconds) and seconds * rate_hz >= 2.0):
        raise DeviceError(
            f"an excitation of {seconds:g} s at {rate_hz:g} Hz has fewer than two ticks. Give more seconds"
        )
    if band is not None and not 0.0 <= band[0] < band[1] <= rate_hz / 2.0:
        raise DeviceError(
            f"excitation band {band[0]:g} to {band[1]:g} Hz; at {rate_hz:g} Hz it must lie between 0 and"
            f" {rate_hz / 2:g} Hz, low end first. Give another"
        )


def _steps(amplitude_v: float, band: tuple[float, float] | None, ticks: int) -> Program:
    """Four periods of a square wave in the record, or as many more as keep a step within the controller's counter."""
    if band is not None:
        raise DeviceError("excitation 'steps' has no band. Omit the band, or choose 'prbs' for steps in a band")
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
                f"a prbs from {low:g} to {high:g} Hz needs a register of {bits} bits; the controller has {most}. "
                f"For the same upper end it can start at {rate_hz / (hold * (2**most - 1)):.3g} Hz; raise the "
                "lower or reduce the upper end"
            )
    else:
        bits = min(max(least, int(math.log2(ticks / (_PERIODS * hold) + 1.0))), most)
    if (period := (2**bits - 1) * hold) > ticks:
        raise DeviceError(
            f"a prbs from {low:g} to {high:g} Hz has a period of {period / rate_hz:.4g} s, longer than the record "
            f"of {ticks / rate_hz:.4g} s. Record longer, or raise the lower end of the band"
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
) -> Program:
    """The longest table of which four periods fit into the record, held only as far as its lowest line needs it."""
    from ambid.signals.excitations import multisine

    low, high = band if band is not None else (0.0, rate_hz / 5.0)
    hold = max(1, math.ceil(rate_hz / (TABLE_LENGTH * low) - 1e-9)) if low > 0.0 else 1
    top = rate_hz / 2.0 if hold == 1 else _HIGHEST * rate_hz / hold
    if high > top * (1 + 1e-9):
        raise DeviceError(
            f"a {name} from {low:g} to {high:g} Hz does not fit into a table of {TABLE_LENGTH} elements: from "
            f"{low:g} Hz it reaches {top:.4g} Hz, and for {high:g} Hz it must start at "
            f"{_lowest(high, rate_hz):.4g} Hz. Narrow the band, or choose 'prbs'"
        )
    length = min(TABLE_LENGTH, ticks // (_PERIODS * hold))
    if length < _SHORTEST_TABLE or (low > 0.0 and hold * length * low < rate_hz * (1 - 1e-9)):
        needed = _PERIODS * max(1.0 / low if low else 0.0, _SHORTEST_TABLE / rate_hz)
        raise DeviceError(
            f"a {name} from {low:g} Hz needs {needed:.4g} s for {_PERIODS} periods; the record has "
            f"{ticks / rate_hz:.4g} s. Record longer, or raise the lower end of the band"
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


def _lowest(high: float, rate_hz: float) -> float:
    """Lowest line of a table whose elements are fast enough for a highest one, Hz."""
    hold = max(1, int(_HIGHEST * rate_hz / high + 1e-9))
    return rate_hz / (hold * TABLE_LENGTH)


def of_one_axis(program: Program | AxesProgram) -> Program:
    """Refuse a rotor's program where a controller drives one axis."""
    if isinstance(program, AxesProgram):
        raise DeviceError(f"{program}: this controller drives one axis. Give a Program")
    return program


def counts_of(program: Program, rig: Rig, settings: ControllerSettings) -> dict[str, int]:
    """Return the fields of the message ``excitation`` without ``id``, by the calibration of the rig's voltage."""
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


def expected(program: Program, n_ticks: int, *, counts: int | None = None) -> Array:
    """Return what the controller adds to its output, tick by tick.

    Parameters
    ----------
    program : Program
        The excitation.
    n_ticks : int
        Ticks from its beginning.
    counts : int, optional
        Amplitude in counts of pulse width: the result is then exactly what the controller adds, in whole counts.

    Returns
    -------
    ndarray, shape (n_ticks,), V; counts where `counts` is given
        0 after the last cycle.
    """
    elements = elements_of(program)
    if program.kind == "table":
        size = program.amplitude if counts is None else float(counts)
        exact = size * elements / FULL
        levels = exact if counts is None else np.trunc(exact + np.copysign(0.5, exact))
    else:
        levels = elements * (program.amplitude if counts is None else float(counts))
    at = np.arange(n_ticks) // program.hold
    out = levels[at % levels.size]
    return np.where((program.cycles == 0) | (at < program.cycles * levels.size), out, 0.0)


def elements_of(program: Program) -> Array:
    """Return the elements of one cycle: 1 and -1 for steps and PRBS, -127 to 127 for a table, one 0 for none."""
    if program.kind == "step":
        return np.array([1.0, -1.0])
    if program.kind == "table":
        return np.asarray(program.table[: program.length], dtype=np.float64)
    if program.kind == "none":
        return np.zeros(1)
    bits = program.length
    mask, state = MASKS.get(bits), program.seed & (2**bits - 1)
    if mask is None or state == 0:
        raise DeviceError(
            f"a register of {bits} bits that starts at {program.seed}; the controller has {min(MASKS)} to {max(MASKS)}"
            " bits, of which one at least is set at the start. Give another length or seed"
        )
    out = np.empty(2**bits - 1)
    for k in range(out.size):
        out[k] = 1.0 if state & 1 else -1.0
        state = state >> 1 | ((state & mask).bit_count() & 1) << (bits - 1)
    return out


def amplitude_counts(program: Program, rig: Rig, duty_bias: int, duty: tuple[int, int]) -> int:
    """Return the amplitude in counts of pulse width, at least 1, between the least and the largest `duty` about its
    bias.

    Where the voltage falls as the pulse gets wider, the excitation at the coil has the other sign.
    """
    step = abs(scale_of(rig, "voltage").slope(duty_bias))
    exact = program.amplitude / step
    counts = round(min(exact, 1e9))
    room = min(duty_bias - duty[0], duty[1] - duty_bias)
    if not 1 <= counts <= room:
        raise DeviceError(
            f"{who(rig)}: an excitation of {program.amplitude:.4g} V is {exact:.3g} counts of pulse width; about "
            f"rest at {duty_bias} counts 1 to {room} are possible, {step:.3g} to {step * room:.4g} V. Give another"
        )
    return counts


def period_ticks(program: Program | AxesProgram) -> int:
    """Return the period of an excitation in ticks; 0 where it has none."""
    if isinstance(program, AxesProgram):
        return len(program.wave)
    n = {"none": 0, "step": 2, "prbs": 2**program.length - 1, "table": program.length}[program.kind]
    return int(n) * program.hold
