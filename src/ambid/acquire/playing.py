"""Excitations tick by tick, exactly as a controller plays them, and what is in them.

How each is played is defined in the comments of ``protocol/messages.toml``; the firmware and this file keep to that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.acquire.device import Program
from ambid.acquire.scales import scale_of, who
from ambid.arrays import Array
from ambid.errors import DeviceError
from ambid.rig.rig import Rig

MASKS = dict(enumerate((3, 3, 5, 3, 3, 0x1D, 0x11, 9, 5, 0x53, 0x1B, 0x443, 3), start=3))
"""Feedback of a register of so many bits: the bits whose parity comes in at its top; all of greatest length."""

FULL = 127
"""Element of a table that is the amplitude."""


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
    """Return the elements of one cycle.

    `program`: the excitation. Returns (n_elements,), 1 and -1 for steps and PRBS, -127 to 127 for a table, one 0 for
    none.
    """
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
    """Return the amplitude of an excitation in counts of pulse width.

    Where the voltage falls as the pulse gets wider, the excitation at the coil has the other sign.

    `program`: the excitation; `rig`: with a calibration of the voltage; `duty_bias`: pulse width at rest, counts;
    `duty`: least and largest pulse width, counts. Returns at least 1.
    """
    step = abs(scale_of(rig, "voltage").slope(duty_bias))
    exact = program.amplitude / step
    counts = round(min(exact, 1e9))
    room = min(duty_bias - duty[0], duty[1] - duty_bias)
    if not 1 <= counts <= room:
        raise DeviceError(
            f"{who(rig)}: an excitation of {program.amplitude:.4g} V is {exact:.3g} counts of pulse width; about rest"
            f" at {duty_bias} counts there is room for 1 to {room}, {step:.3g} to {step * room:.4g} V. Give another"
        )
    return counts


@dataclass(frozen=True, slots=True, kw_only=True)
class Played:
    """What is in an excitation as it is really played."""

    period: int  # of the whole excitation, ticks
    rms_v: float  # V
    peak_v: float
    frequency_hz: Array  # (n_lines,), Hz, lines up to half the rate; without 0
    line_v: Array  # (n_lines,), V, peak of each line

    def share(self, band: tuple[float, float]) -> float:
        """Return the share of the power that lies in a band.

        `band`: hz, ends included. Returns 0 to 1.
        """
        inside = (self.frequency_hz >= band[0] * (1 - 1e-9)) & (self.frequency_hz <= band[1] * (1 + 1e-9))
        power = self.line_v**2
        return float(power[inside].sum() / power.sum())


def period_ticks(program: Program) -> int:
    """Return the period of an excitation.

    `program`: the excitation. Returns ticks; 0 where it has none.
    """
    n = {"none": 0, "step": 2, "prbs": 2**program.length - 1, "table": program.length}[program.kind]
    return int(n) * program.hold


def played(program: Program, rate_hz: float, *, counts: int | None = None, volts_per_count: float = 1.0) -> Played:
    """Return what is in one period of an excitation.

    `program`: the excitation; `rate_hz`: ticks in one second; `counts`: amplitude in counts: with its rounding to
    counts; `volts_per_count`: only with `counts`: V per count of pulse width. Returns rms, peak and lines.
    """
    period = period_ticks(program)
    if period == 0:
        raise DeviceError("an excitation of kind 'none' plays nothing. Give one of " + "steps, prbs, multisine")
    x = expected(program, period, counts=counts) * (1.0 if counts is None else volts_per_count)
    lines = np.fft.rfft(x) / period
    size = 2.0 * np.abs(lines[1:])
    if period % 2 == 0:
        size[-1] /= 2.0
    return Played(
        period=period,
        rms_v=float(np.sqrt(np.mean(x**2))),
        peak_v=float(np.abs(x).max()),
        frequency_hz=np.arange(1, lines.size) * rate_hz / period,
        line_v=size,
    )
