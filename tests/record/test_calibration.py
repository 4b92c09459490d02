"""Calibration: a line is exact, a table passes through its points, and nothing is made up outside it."""

import numpy as np
import pytest

from ambid.errors import RecordError, UnitError
from ambid.record import Channel, read_record
from ambid.record.calibration import Calibration, read_calibration_table
from tests.measured import ABSENT, MAGLEV

DATA = MAGLEV


def channel(values, unit="1"):
    return Channel(name="duty", unit=unit, values=np.asarray(values, dtype=float), source_unit=unit)


def table(tmp_path, text):
    path = tmp_path / "table.csv"
    path.write_text(text)
    return path


POINTS = "duty [%],voltage [mV]\n0,100\n50,5000\n100,7000\n"


def test_gain_and_offset():
    out = Calibration(unit_in="V", unit_out="m", gain=2.5e-4, offset=-1e-3).apply(channel([0.0, 4.0], "V"))
    np.testing.assert_allclose(out.values, [-1e-3, 0.0], atol=1e-18)
    assert (out.unit, out.name) == ("m", "duty")


def test_table_passes_through_its_points_and_is_straight_between(tmp_path):
    c = read_calibration_table(table(tmp_path, POINTS))
    assert (c.unit_in, c.unit_out) == ("1", "V")
    np.testing.assert_allclose(c.apply(channel([0, 0.25, 0.5, 0.75, 1])).values, [0.1, 2.55, 5.0, 6.0, 7.0], rtol=1e-14)


def test_falling_table_is_the_same_map(tmp_path):
    falling = "duty [%],voltage [mV]\n100,7000\n50,5000\n0,100\n"
    x = channel(np.linspace(0, 1, 33))
    rising = read_calibration_table(table(tmp_path, POINTS)).apply(x).values
    np.testing.assert_array_equal(read_calibration_table(table(tmp_path, falling)).apply(x).values, rising)


def test_outside_the_table_is_refused_or_extrapolated_on_request(tmp_path):
    path = table(tmp_path, POINTS)
    x = channel([0.5, 1.1, -0.1])
    with pytest.raises(
        RecordError, match=r"'duty', sample 1: 1.1 \[1\] is outside .*2 samples in all.*extrapolate = true"
    ):
        read_calibration_table(path).apply(x)
    np.testing.assert_allclose(
        read_calibration_table(path, extrapolate=True).apply(x).values, [5.0, 7.4, -0.88], rtol=1e-14
    )


def test_rounding_at_the_edge_is_not_outside(tmp_path):
    out = read_calibration_table(table(tmp_path, POINTS)).apply(channel([1.0 + 1e-12]))
    assert out.values[0] == pytest.approx(7.0, rel=1e-10)


def test_wrong_unit_is_refused(tmp_path):
    with pytest.raises(UnitError, match=r"\[A\].*begins with \[1\]"):
        read_calibration_table(table(tmp_path, POINTS)).apply(channel([0.5], "A"))
    with pytest.raises(UnitError, match=r"\[A\].*is for \[V\]"):
        Calibration(unit_in="V", unit_out="m").apply(channel([0.5], "A"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("duty [1],voltage [V]\n0,0\n0.5,1\n0.4,2\n", "row 4: column 'duty' goes from 0.5 to 0.4"),
        ("duty [1],voltage [V]\n0,0\n0,1\n1,2\n", "row 3"),
        ("duty [1],voltage [V]\n1,0\n0.5,1\n0.5,2\n", "row 4"),
        ("duty [1],voltage [V]\n0,0\n", "at least 2"),
        ("duty [1]\n0\n1\n", "1 columns"),
        ("duty [1],voltage [V],x [m]\n0,0,0\n1,1,1\n", "3 columns"),
        ("duty,voltage [V]\n0,0\n1,1\n", "'duty' has no unit"),
        ("duty [1],voltage [volt]\n0,0\n1,1\n", "'voltage': unit 'volt'"),
        ("duty [1],voltage [V]\n0,0\n1,x\n", "row 3, column 'voltage': 'x'"),
        ("", "0 bytes"),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, said):
    with pytest.raises(RecordError, match=said):
        read_calibration_table(table(tmp_path, text))


def test_history_can_repeat_the_calibration(tmp_path):
    c = read_calibration_table(table(tmp_path, POINTS))
    s = c.step("duty").settings
    again = Calibration(unit_in=s["from"], unit_out=s["to"], raw=np.array(s["raw"]), out=np.array(s["out"]))
    x = channel(np.linspace(0, 1, 11))
    np.testing.assert_array_equal(again.apply(x).values, c.apply(x).values)
    line = Calibration(unit_in="1", unit_out="V", gain=12.0, offset=0.5).step("duty").settings
    assert (line["gain"], line["offset"], line["channel"]) == (12.0, 0.5, "duty")


@pytest.mark.skipif(not DATA.exists(), reason=ABSENT)
def test_measured_duty_becomes_the_voltage_that_drives_the_measured_current():
    c = read_calibration_table(DATA / "duty_to_voltage.csv")
    r = read_record(DATA / "levitate_stairs_a.csv")
    voltage = c.apply(r.channel("duty_upper")).values[2000:]
    # No inductance matters in the mean: u = R i, with R = 4.17 ohm measured beside the bench.
    assert voltage.mean() / r["current_upper"][2000:].mean() == pytest.approx(4.17, rel=0.07)
