"""What the controller (ATmega328P at 16 MHz, an Arduino Uno) can do, as far as a rig has to fit it.

A tick is a whole number of periods of the pulse width modulation, so that the inputs are always held at the same point
of a pulse.
"""

from __future__ import annotations

import math

from ambid.errors import DeviceError

CLOCK_HZ = 16_000_000
PWM_TOP = 800
"""Pulse width that is always on, counts."""
PWM_HZ = CLOCK_HZ / PWM_TOP
"""Frequency of the pulse width modulation, Hz."""
ADC_TOP = 1023
"""Largest value of the converter, counts."""
TABLE_LENGTH = 1000
"""Elements of the excitation table."""
BYTE_BITS = 11
"""Bit times that a byte may take on the line: ten, and one kept for answers."""
FASTEST_OUTPUT, SLOWEST_OUTPUT = 8, 20
"""Shortest and longest tick with which the output may be on, periods: a tick's work has to be done in time while
commands come, and a fault has to end in the safe state within 2 ms."""
LARGEST_GAIN = 2**19
"""Largest step number of a gain: no product can then overflow the controller's arithmetic."""
SHORTEST_PERIOD, LONGEST_PERIOD = 5, 20_000
"""Of a tick, in periods of the pulse width modulation."""
LIFTED_MS = 100
"""Inside its limits for so long after a start, the position counts from then on, ms."""
LAG_S = 175e-6
"""From the moment that a sample stands for to that from which its pulse width acts, at every rate, s."""


def period_of(rate_hz: float) -> int:
    """Return the tick of a rate.

    `rate_hz`: ticks in one second. Returns in periods of the pulse width modulation.
    """
    exact = PWM_HZ / rate_hz
    period = round(exact)
    if SHORTEST_PERIOD <= period <= LONGEST_PERIOD and math.isclose(exact, period, rel_tol=1e-9):
        return period
    near = sorted({_possible(math.ceil(exact)), _possible(math.floor(exact))}, reverse=True)
    raise DeviceError(
        f"daq.rate_hz is {rate_hz:g} Hz; a tick of the controller is a whole number of periods of {PWM_HZ:g} Hz,"
        f" {SHORTEST_PERIOD} to {LONGEST_PERIOD} of them. The nearest: give"
        f" {' or '.join(f'{PWM_HZ / n:.10g}' for n in near)} Hz"
    )


def nearest_rate(rate_hz: float, *, output: bool = False) -> float:
    """Return the rate that the controller can do and that is nearest by ratio.

    `rate_hz`: wanted rate, Hz; `output`: only rates with which the output may be on. Returns hz.
    """
    ends = (FASTEST_OUTPUT, SLOWEST_OUTPUT) if output else (SHORTEST_PERIOD, LONGEST_PERIOD)
    exact = PWM_HZ / rate_hz
    rates = [PWM_HZ / _possible(n, ends) for n in (math.floor(exact), math.ceil(exact))]
    return min(rates, key=lambda rate: abs(math.log(rate / rate_hz)))


def drives(period: int) -> bool:
    """Return whether the output may be on with ticks of that length.

    `period`: in periods of the pulse width modulation.
    """
    return FASTEST_OUTPUT <= period <= SLOWEST_OUTPUT


def output_rates() -> str:
    """Return the rates with which the output may be on, for messages.

    Returns such as ``1000 to 2500 Hz``.
    """
    return f"{PWM_HZ / SLOWEST_OUTPUT:g} to {PWM_HZ / FASTEST_OUTPUT:g} Hz"


def _possible(period: int, ends: tuple[int, int] = (SHORTEST_PERIOD, LONGEST_PERIOD)) -> int:
    return min(max(period, ends[0]), ends[1])
