"""The controller's law in plain whole numbers, as firmware/amb_daq/control.h says it: what a record must have."""

import numpy as np


def within(value, largest):
    return min(max(value, -largest), largest)


def pulse_widths(position, current, excitation, settings):
    """Return the pulse width that follows from what was sampled, tick by tick from the start of the loop on."""
    integral = derivative = last = 0
    out = []
    s = settings
    for k, (x, i, u) in enumerate(zip(position, current, excitation, strict=True)):
        error = s.setpoint - x
        derivative = (derivative * s.pole + 0x8000) >> 16
        if k:
            derivative -= s.kd * (x - last)
        derivative, last = within(derivative, 1 << 28), x
        total = within(s.kp * error + (integral >> 4) + derivative - s.kc * (i - s.current_rest), (1 << 26) - 1)
        wanted = total + 4096 * (s.duty_bias + u)
        if wanted > 4096 * s.duty_high:
            duty, growing = s.duty_high, s.ki * error <= 0
        elif wanted < 4096 * s.duty_low:
            duty, growing = s.duty_low, s.ki * error >= 0
        else:
            duty, growing = (wanted + 2048) >> 12, True
        if growing:
            integral = within(integral + s.ki * error, 1 << 27)
        out.append(duty)
    return np.array(out)
