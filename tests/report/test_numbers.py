"""Numbers for people: matching digits, sensible prefixes, nothing lost."""

import math

import numpy as np
import pytest

from ambid.report.numbers import prefixed, quantity, si_text, sized
from ambid.units import parse_unit

CASES = [
    (0.0596, 1.2e-4, "H", "59.60 ± 0.12 mH"),
    (-128665.0, 71.0, "N/m", "-128.665 ± 0.071 kN/m"),
    (4.0078, 0.0168, "kg", "4.008 ± 0.017 kg"),
    (0.06054, 0.0, "kg", "60.54 g"),
    (1.25, 0.00996, "ohm", "1.250 ± 0.010 ohm"),
    (0.0, 1.2, "N s/m", "0.0 ± 1.2 N s/m"),
    (0.0, 0.0, "N s/m", "0 N s/m"),
    (587.2, 1174.0, "N/m", "0.6 ± 1.2 kN/m"),
    (-1.2, 35.0, "N/A", "-1 ± 35 N/A"),
    (-0.2, 35.0, "N/A", "0 ± 35 N/A"),
    (1e-5, 1e150, "H", "1e-14 ± 1e+141 GH"),
    (3.9e-12, 0.09, "H", "3.9e-09 ± 90 mH"),
    (1e-5, math.inf, "H", "10 ± inf uH"),
]


@pytest.mark.parametrize(("value", "sd", "unit", "text"), CASES)
def test_value_and_sd_have_matching_digits(value, sd, unit, text):
    assert quantity(value, sd, unit).text == text


@pytest.mark.parametrize("seed", range(5))
def test_what_is_shown_is_the_value_within_a_tenth_of_its_sd(seed):
    rng = np.random.default_rng(seed)
    for _ in range(200):
        unit = str(rng.choice(["kg", "N/m", "N/A", "ohm", "H", "N s/m"]))
        value = float(rng.choice([-1, 1]) * 10 ** rng.uniform(-6, 6))
        sd = abs(value) * 10 ** rng.uniform(-5, 0.5)
        q = quantity(value, sd, unit, ci95=(value - 1.96 * sd, value + 1.96 * sd))
        scale = parse_unit(q.unit).scale  # the program's own units read what it writes
        assert parse_unit(q.unit).si == parse_unit(unit).si
        # two digits of the sd: at most half a unit of the second one off
        assert abs(float(q.value) * scale - value) <= 0.051 * sd
        assert float(q.sd) * scale == pytest.approx(sd, rel=0.051)
        assert float(q.low) < float(q.value) < float(q.high)
        assert len(q.value.partition(".")[2]) == len(q.sd.partition(".")[2]) == len(q.low.partition(".")[2])
        assert abs(float(q.si.split()[0]) - value) <= 0.51 * sd


@pytest.mark.parametrize(
    ("size", "unit", "expected"),
    [(0.1, "kg", "g"), (1e-4, "kg", "mg"), (12.0, "kg", "kg"), (999.0, "Hz", "Hz"), (1000.0, "Hz", "kHz"),
     (0.0, "V", "V"), (1e-8, "m", "nm"), (1e-12, "m", "nm"), (1e4, "1", "1"), (1e5, "rad/s", "rad/s"),
     (2e6, "N/m", "MN/m")],
)  # fmt: skip
def test_prefixes(size, unit, expected):
    assert prefixed(size, unit)[1] == expected


def test_one_number_with_three_digits():
    assert sized(1.0393e-7, "m") == "104 nm"
    assert sized(9.9996e-4, "s") == "1 ms"
    assert si_text(-1.28665e5, 3, "N/m") == "-128665 N/m"
    assert si_text(-1.28665e7, 3, "N/m") == "-1.29e7 N/m"
