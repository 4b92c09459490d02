"""What people read of calibration: a line where nothing is said of it, a column where it is."""

from dataclasses import replace

import pytest

import ambid
from ambid.job import presentation
from ambid.report.parameters import ParameterRow, calibration_lines
from tests.estimation.test_calibration import SD, rig_of


@pytest.fixture(scope="module")
def record():
    return ambid.simulate("thesis", duration=0.3, seed=2)


def words(estimate):
    return " ".join(estimate.summary().split())


def test_without_a_word_on_calibration_a_line_says_what_one_per_cent_would_do(record):
    text = words(ambid.identify(record))
    assert "identified" in text
    assert "Intervals are from this record alone" in text
    assert "1 % of gain moves: voltage m, k_x, k_i, R, L +1 %; position m, k_x -2 %, k_i -1 %; current" in text
    assert "rate m -3 %, k_x, k_i, L -1 %. Give gain_sd and rate_sd in the rig" in text
    assert "with calibration" not in text


def test_where_all_is_said_a_column_takes_the_place_of_the_line(record):
    estimate = ambid.identify(record, rig_of(SD))
    L = estimate["L"]
    assert "with calibration" in words(estimate)
    assert ParameterRow(parameter=L).calibrated in words(estimate)
    assert calibration_lines(estimate) == []
    assert "<th>with calibration</th>" in presentation.page(estimate)
    frame = estimate.to_dataframe()
    assert frame["sd_calibrated"]["L"] == L.sd_calibrated
    assert (frame["ci95_calibrated_low"]["L"], frame["ci95_calibrated_high"]["L"]) == L.ci95_calibrated


def test_what_is_left_out_is_named(record):
    (line,) = calibration_lines(ambid.identify(record, rig_of({"voltage": 0.01, "position": 0.0, "rate": 0.0})))
    assert line.startswith("Some of the calibration is in no interval. 1 % of gain moves: current m, k_x +1 %")
    assert "voltage" not in line


def test_an_offset_moves_the_operating_point_alone(record):
    rig = rig_of(SD)
    offset = replace(rig, channels=tuple(replace(c, offset_sd=1e-3) for c in rig.channels if c.role == "current"))
    rig = replace(rig, channels=tuple(offset.channels[0] if c.role == "current" else c for c in rig.channels))
    estimate = ambid.identify(record, rig)
    assert estimate.calibration_sd == {**SD, "current.offset": 1e-3}
    assert calibration_lines(estimate) == ["An offset of current moves the operating point alone"]
    assert estimate["L"].sd_calibrated == ambid.identify(record, rig_of(SD))["L"].sd_calibrated


def test_what_is_hardly_moved_is_left_out_and_a_weighed_mass_is_a_scale_itself(record):
    """A weighed mass: a gain moves the others by parts of a per cent, and so does the mass, which is told beside it."""
    rig = rig_of({}, m={"role": "fixed", "value": 0.1})
    estimate = ambid.identify(record, rig)
    (line,) = calibration_lines(estimate)
    gains, _, mass = line.partition("moves: ")[2].partition("; m (fixed) ")
    assert " m" not in gains
    assert mass.startswith("k_x +1 %, k_i")
    heavier = ambid.identify(record, rig_of({}, m={"role": "fixed", "value": 0.1001}))
    for name in ("k_x", "k_i"):
        moved = heavier[name].value / estimate[name].value - 1.0
        assert estimate.calibration["m"][name] == pytest.approx(
            moved / 1e-3, abs=0.15
        )  # of the spectrum of the voltage alone
    assert "+0 %" not in line


def test_what_no_record_shows_is_left_out(record):
    """Of an inductance near zero the linear move is millions of per cent."""
    estimate = ambid.identify(record)
    far = replace(estimate, calibration={"voltage": {"R": 1.0, "L": -1.5e6}})
    assert "voltage R +1 %." in " ".join(calibration_lines(far))


def test_of_a_coil_alone_no_mass_is_to_be_weighed():
    record = ambid.simulate("thesis", duration=0.3, seed=2)
    columns = {name: record[name].values for name in ("voltage", "current")}
    rig = {
        "schema": "ambid.rig/1",
        "model": "coil",
        "channels": {name: {"column": name} for name in columns},
    }
    (line,) = calibration_lines(
        ambid.identify(columns, rig, rate_hz=record.rate_hz, units={"voltage": "V", "current": "A"})
    )
    assert "1 % of gain moves" in line
    assert "weigh" not in line
