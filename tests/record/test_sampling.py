"""Uniform sampling: the 1 % rule, and what the gap policies do to a signal that is known."""

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.record import read_record
from ambid.record.sampling import Table, sample_uniformly


def table(time, *columns):
    values = np.column_stack([time, *columns])
    return Table(
        where="r.csv", names=("time", *(f"c{j}" for j in range(len(columns)))), values=values, first_row=2, time=0
    )


T = 1e-3
N = 1000
GRID = np.arange(N) * T
RAMP = 3.0 * GRID + 1.0


def test_stamps_within_one_percent_pass():
    jitter = np.random.default_rng(0).uniform(-0.009, 0.009, N) * T  # intervals then differ by up to 2 %
    sampled = sample_uniformly(table(GRID + jitter, RAMP), None, "error")
    assert sampled.rate_hz == pytest.approx(1000.0, rel=1e-4)


def test_intervals_within_one_percent_pass_although_the_clock_drifts():
    steps = T * (1 + np.random.default_rng(0).uniform(-0.0095, 0.0095, N - 1))
    time = np.concatenate([[0.0], np.cumsum(steps)])
    assert np.abs(time - GRID).max() > 0.05 * T
    sample_uniformly(table(time, RAMP), None, "error")


@pytest.mark.parametrize("at", [1, 2, 500, N - 2, N - 1])
@pytest.mark.parametrize("shift", [0.03, -0.03])
def test_one_stamp_off_by_three_percent_is_named(at, shift):
    time = GRID.copy()
    time[at] += shift * T
    with pytest.raises(RecordError, match=f"row {at + 2}:"):
        sample_uniformly(table(time, RAMP), None, "error")


@pytest.mark.parametrize("at", [1, 500, N - 1])
def test_a_jump_is_named_where_it_is(at):
    time = GRID.copy()
    time[at:] += 10 * T
    with pytest.raises(RecordError, match=f"row {at + 2}: time advances by 11 samples"):
        sample_uniformly(table(time, RAMP), None, "error")


def test_rounded_stamps_pass_until_rounding_is_coarse():
    for digits, passes in ((7, True), (6, True), (4, False)):
        time = np.round(np.arange(N) * 0.25e-3, digits)
        if passes:
            assert sample_uniformly(table(time, RAMP), None, "error").rate_hz == pytest.approx(4000.0, rel=1e-5)
        else:
            with pytest.raises(RecordError, match="more digits"):
                sample_uniformly(table(time, RAMP), None, "error")


def test_interpolation_restores_a_straight_line_and_says_how_much():
    ramp = RAMP.copy()
    ramp[[5, 6, 7, 400]] = [np.nan, np.inf, np.nan, np.nan]
    sampled = sample_uniformly(table(GRID, ramp, RAMP), None, "interpolate")
    np.testing.assert_allclose(sampled.values[:, 1], RAMP, rtol=1e-14)
    (step,) = sampled.steps
    assert step.name == "gaps_interpolated"
    assert dict(step.settings) == {"values": 4, "longest": 3}


def test_interpolation_inserts_the_samples_that_time_skips():
    keep = np.ones(N, bool)
    keep[[100, 101, 102, 700]] = False
    sampled = sample_uniformly(table(GRID[keep], RAMP[keep]), None, "interpolate")
    assert sampled.values.shape[0] == N
    assert sampled.rate_hz == 1000.0
    np.testing.assert_allclose(sampled.values, np.column_stack([GRID, RAMP]), rtol=1e-12)
    assert dict(sampled.steps[0].settings) == {"rows": 4, "places": 2}


def test_interpolation_refuses_what_it_would_have_to_invent():
    for k, end in ((0, "first"), (N - 1, "last")):
        ramp = RAMP.copy()
        ramp[k] = np.nan
        with pytest.raises(RecordError, match=f"'c0': the {end} value"):
            sample_uniformly(table(GRID, ramp), None, "interpolate")
    half = GRID.copy()
    half[50:] += 2.5 * T
    with pytest.raises(RecordError, match=r"row 52: time jumps by 3.5 samples"):
        sample_uniformly(table(half, RAMP), None, "interpolate")
    far = GRID.copy()
    far[50:] += 5000 * T
    with pytest.raises(RecordError, match="too much to interpolate"):
        sample_uniformly(table(far, RAMP), None, "interpolate")


def test_cut_keeps_the_longest_stretch_at_its_own_time():
    ramp, time = RAMP.copy(), GRID.copy()
    ramp[[50, 300]] = np.nan
    time[800:] += 2.5 * T
    sampled = sample_uniformly(table(time, ramp), None, "cut")
    np.testing.assert_array_equal(sampled.values[:, 1], RAMP[301:800])
    assert sampled.start_s == GRID[301]
    assert dict(sampled.steps[0].settings) == {"first": 301, "kept": 499, "dropped": 501}


def test_cut_without_time_knows_when_its_stretch_began(tmp_path):
    rows = ["", *map(str, range(30))]
    rows[0] = "x"
    path = tmp_path / "r.csv"
    path.write_text("voltage [V]\n" + "\n".join(rows) + "\n")
    r = read_record(path, rate_hz=100.0, gaps="cut")
    assert r.start_s == 0.01
    np.testing.assert_array_equal(r["voltage"], np.arange(30.0))
    assert [s.name for s in r.history] == ["read", "gaps_cut"]


def test_cut_leaves_a_sound_record_alone():
    jitter = np.random.default_rng(0).uniform(-0.009, 0.009, N) * T
    sampled = sample_uniformly(table(GRID + jitter, RAMP), None, "cut")
    assert sampled.values.shape[0] == N
    assert sampled.steps == ()


def test_cut_refuses_when_too_little_is_left():
    ramp = RAMP.copy()
    ramp[::5] = np.nan
    with pytest.raises(RecordError, match="4 rows of data in its longest stretch"):
        sample_uniformly(table(GRID, ramp), None, "cut")
    with pytest.raises(RecordError, match="no row without"):
        sample_uniformly(table(GRID, np.full(N, np.nan)), None, "cut")
