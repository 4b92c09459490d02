"""The coil's own methods know what they do not stand."""

import numpy as np
import pytest

from ambid.bearing.coil import coil_least_squares


def test_a_warning_stands_until_the_record_is_said_to_be_open_loop():
    rng = np.random.default_rng(4)
    voltage = np.repeat(rng.choice([-1.0, 1.0], 400), 10)
    alpha, gain = np.exp(-860 / 1e4), 550 / 860 * (1 - np.exp(-860 / 1e4))
    current = np.zeros(voltage.size)
    for k in range(voltage.size - 1):
        current[k + 1] = alpha * current[k] + gain * voltage[k]
    current += 1e-3 * rng.standard_normal(current.size)
    assert "open_loop" in (coil_least_squares(voltage, current, 1e4).warning or "")
    told = coil_least_squares(voltage, current, 1e4, open_loop=True)
    assert told.warning is None
    assert pytest.approx(550, rel=0.01) == told.b
