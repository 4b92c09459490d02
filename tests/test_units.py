"""Units: each symbol against its definition, exactness of decimal factors, and refusals that help."""

import math

import numpy as np
import pytest

from ambid.errors import UnitError
from ambid.units import parse_unit


@pytest.mark.parametrize(
    ("text", "si", "scale"),
    [
        ("s", "s", 1), ("ms", "s", 1e-3), ("us", "s", 1e-6), ("µs", "s", 1e-6),
        ("V", "V", 1), ("mV", "V", 1e-3), ("uV", "V", 1e-6), ("kV", "V", 1e3),
        ("A", "A", 1), ("mA", "A", 1e-3), ("uA", "A", 1e-6),
        ("m", "m", 1), ("mm", "m", 1e-3), ("um", "m", 1e-6), ("μm", "m", 1e-6), ("nm", "m", 1e-9), ("cm", "m", 1e-2),
        ("N", "N", 1), ("mN", "N", 1e-3), ("kN", "N", 1e3), ("kg", "kg", 1), ("g", "kg", 1e-3), ("mg", "kg", 1e-6),
        ("H", "H", 1), ("mH", "H", 1e-3), ("uH", "H", 1e-6),
        ("ohm", "ohm", 1), ("Ω", "ohm", 1), ("mohm", "ohm", 1e-3), ("kΩ", "ohm", 1e3),
        ("Hz", "Hz", 1), ("kHz", "Hz", 1e3), ("rad/s", "rad/s", 1), ("rpm", "rad/s", 2 * math.pi / 60),
        ("Pa", "Pa", 1), ("GPa", "Pa", 1e9), ("N/mm^2", "Pa", 1e6), ("kg/m^3", "kg/m^3", 1),
        ("1", "1", 1), ("%", "1", 0.01), ("T", "T", 1), ("Wb", "Wb", 1),
        ("N/m", "N/m", 1), ("N/mm", "N/m", 1e3), ("N/um", "N/m", 1e6), ("N/A", "N/A", 1), ("N/mA", "N/A", 1e3),
        ("N s/m", "N s/m", 1), ("N·s/m", "N s/m", 1), ("N s / mm", "N s/m", 1e3),
        ("V/m", "V/m", 1), ("m/s", "m/s", 1), ("mm/s", "m/s", 1e-3), ("m/s^2", "m/s^2", 1), ("m/s²", "m/s^2", 1),
    ],
)  # fmt: skip
def test_symbol_has_its_si_unit_and_factor(text, si, scale):
    unit = parse_unit(text)
    assert unit.si == si
    assert unit.scale == pytest.approx(scale, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "same_as"),
    [
        ("kg/s", "N s/m"),  # damping
        ("V s/m", "N/A"),  # motional voltage per velocity is force per current
        ("V/A", "ohm"),
        ("Wb/A", "H"),
        ("V s", "Wb"),
        ("kg m/s^2", "N"),
        ("V/V", "1"),
        ("1/s", "Hz"),
    ],
)
def test_same_dimensions_are_the_same_kind(text, same_as):
    assert parse_unit(text).same_kind(parse_unit(same_as))
    assert parse_unit(text).scale == pytest.approx(parse_unit(same_as).scale, rel=1e-15)


def test_cycles_and_radians_are_not_converted_into_each_other():
    assert not parse_unit("Hz").same_kind(parse_unit("rad/s"))
    assert not parse_unit("Hz").same_kind(parse_unit("rpm"))


def test_si_name_of_an_uncommon_product_parses_to_itself():
    unit = parse_unit("mN/um^2")
    assert parse_unit(unit.si).si == unit.si
    assert parse_unit(unit.si).scale == 1.0
    assert unit.scale == pytest.approx(1e9)


def test_decimal_values_convert_to_the_decimal_they_name():
    assert parse_unit("g").to_si(60.54) == 0.06054
    assert parse_unit("mm").to_si(0.432) == 0.000432
    assert parse_unit("mH").to_si(59.6) == 0.0596
    assert parse_unit("kV").to_si(1.1) == 1100.0


def test_si_arrays_pass_untouched():
    x = np.array([1.0, np.pi])
    assert parse_unit("V").to_si(x) is x


@pytest.mark.parametrize(
    ("text", "nearest"),
    [("v", "V"), ("Ohm", "ohm"), ("Ns/m", "N s/m"), ("mh", "mH"), ("Newton/m", "N/m"), ("UM", "um")],
)
def test_unknown_unit_names_the_nearest(text, nearest):
    with pytest.raises(UnitError) as failure:
        parse_unit(text)
    assert repr(text) in str(failure.value)
    assert nearest in str(failure.value).split("nearest:")[1]


@pytest.mark.parametrize("text", ["", "  ", "m/", "/s", "N/m s", "m//s", "m^0", "m^x", "m^22"])
def test_unclear_unit_is_refused(text):
    with pytest.raises(UnitError):
        parse_unit(text)
