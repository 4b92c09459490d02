"""What the controller (ATmega328P at 16 MHz, an Arduino Uno) can do, as far as a rig has to fit it.

The tick is Timer2 cleared on compare, a whole number of periods of the pulse width modulation; it exists only where
one of the timer's prescalers divides that time into at most 256 exact steps.
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
LARGEST_GAIN = 2**20
"""Largest step number of a gain: no product can then overflow the controller's arithmetic."""
SHORTEST_PERIOD = 4
"""Shortest tick that the controller's work fits into, in periods of the pulse width modulation."""
LAG_S = 0.15e-3
"""From a tick to the pulse width that it orders: conversions, control law, then the next modulation period, s."""

_PRESCALERS = (1, 8, 32, 64, 128, 256, 1024)
_COMPARE = 256


def exact_period(period: int) -> bool:
    """Return whether the timer can make a tick of so many periods.

    Parameters
    ----------
    period : int
        Periods of the pulse width modulation.

    Returns
    -------
    bool
        True where prescaler * (compare + 1) is exactly that many clock cycles.
    """
    cycles = period * PWM_TOP
    return any(cycles % p == 0 and cycles // p <= _COMPARE for p in _PRESCALERS)


def possible_periods() -> tuple[int, ...]:
    """Return every tick that the controller can make.

    Returns
    -------
    tuple of int
        In periods of the pulse width modulation, rising.
    """
    longest = _COMPARE * _PRESCALERS[-1] // PWM_TOP
    return tuple(n for n in range(SHORTEST_PERIOD, longest + 1) if exact_period(n))


def period_of(rate_hz: float) -> int:
    """Return the tick of a rate.

    Parameters
    ----------
    rate_hz : float
        Ticks in one second.

    Returns
    -------
    int
        In periods of the pulse width modulation.

    Raises
    ------
    DeviceError
        If the controller has no such tick; the message names the nearest rates.
    """
    exact = PWM_HZ / rate_hz
    period = round(exact)
    if period in possible_periods() and math.isclose(exact, period, rel_tol=1e-9):
        return period
    rates = sorted(PWM_HZ / n for n in possible_periods())
    below, above = [r for r in rates if r < rate_hz], [r for r in rates if r > rate_hz]
    near = " or ".join(f"{r:.10g}" for r in (*below[-1:], *above[:1]))
    raise DeviceError(
        f"daq.rate_hz is {rate_hz:g} Hz; the controller has exact ticks of {rates[0]:.4g} to {rates[-1]:.4g} Hz, a"
        f" whole part of {PWM_HZ:g} Hz that its timer divides. The nearest are {near} Hz; give one of them"
    )


def nearest_rate(rate_hz: float) -> float:
    """Return the rate that the controller can do and that is nearest by ratio.

    Parameters
    ----------
    rate_hz : float
        Wanted rate, Hz.

    Returns
    -------
    float
        Hz.
    """
    return min((PWM_HZ / n for n in possible_periods()), key=lambda r: abs(math.log(r / rate_hz)))
