"""Offset, trend, low-pass, resampling, cutting, scaling and replacing samples."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.signals import cut, remove_trend, replace_samples, resample
from ambid.signals.conditioning import mean_to_next

RATE = 1000.0
T = np.arange(4000) / RATE


def sine(hz: float) -> np.ndarray:
    return np.sin(2 * np.pi * hz * T)


def test_the_record_given_is_not_changed(make):
    r = make(RATE, x=sine(5) + 3.0)
    before = r["x"].values.copy()
    remove_trend(r)
    np.testing.assert_array_equal(r["x"], before)
    assert r.history == ()


@pytest.mark.parametrize("degree", [0, 1, 3, 7])
def test_polynomial_trend_is_removed_exactly(make, degree):
    trend = np.polynomial.Polynomial(np.arange(1.0, degree + 2.0))(T)
    assert np.max(np.abs(remove_trend(make(RATE, x=trend), degree=degree)["x"])) < 1e-9 * np.max(np.abs(trend))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused_by_place(make, bad):
    x = sine(5).copy()
    x[17] = bad
    with pytest.raises(RecordError, match="sample 17"):
        remove_trend(make(RATE, x=x))


def test_cut_takes_from_inclusive_to_exclusive_on_the_records_clock(make):
    r = cut(make(RATE, x=T), 2.0, 3.0)
    assert (r.n_samples, r.start_s) == (1000, 2.0)
    np.testing.assert_array_equal(r["x"], T[2000:3000])
    again = cut(r, 2.5)
    np.testing.assert_array_equal(again["x"], T[2500:3000])
    np.testing.assert_allclose(again.time_s, again["x"], atol=1e-12)
    assert [s.name for s in again.history] == ["cut", "cut"]


@pytest.mark.parametrize("ends", [(-1.0, 2.0), (0.0, 5.0), (3.0, 2.0), (2.0, 2.0), (float("nan"), None)])
def test_cut_outside_or_empty_is_refused(make, ends):
    with pytest.raises(RecordError, match="cut"):
        cut(make(RATE, x=T), *ends)


def test_replacing_samples_of_a_line_restores_it_and_repairs_nan(make):
    x = 2.0 * T
    spoiled = x.copy()
    spoiled[[100, 101, 102, 2000]] = np.nan
    r = replace_samples(make(RATE, x=spoiled, y=spoiled), "x", [2000, 100, 101, 102, 101])
    np.testing.assert_allclose(r["x"], x, atol=1e-12)
    np.testing.assert_array_equal(r["y"], spoiled)
    assert r.history[0].settings["samples"] == 4
    assert r.history[0].settings["first_s"] == pytest.approx(0.1)


def test_replacing_at_the_ends_holds_the_nearest(make):
    r = replace_samples(make(RATE, x=T), "x", [0, 1, T.size - 1])
    assert (r["x"][0], r["x"][1], r["x"][-1]) == (T[2], T[2], T[-2])


@pytest.mark.parametrize("indices", [[-1], [4000], list(range(4000))])
def test_replacing_what_cannot_be_is_refused(make, indices):
    with pytest.raises(RecordError, match="replace"):
        replace_samples(make(RATE, x=T), "x", indices)


def test_replacing_nothing_adds_no_history(make):
    r = make(RATE, x=T)
    assert replace_samples(r, "x", []) is r


def test_an_unknown_channel_is_named(make):
    with pytest.raises(RecordError, match="'z'"):
        remove_trend(make(RATE, x=T), "z")


@pytest.mark.parametrize(("rate", "n"), [(500.0, 2000), (250.0, 1000), (400.0, 1600)])
def test_resampling_keeps_the_band_in_time_and_removes_what_would_alias(make, rate, n):
    r = resample(make(RATE, x=sine(20) + sine(450)), rate)
    assert (r.rate_hz, r.n_samples) == (rate, n)
    middle = slice(n // 8, -n // 8)
    assert np.max(np.abs(r["x"] - np.sin(2 * np.pi * 20 * r.time_s))[middle]) < 0.01
    assert r.history[0].settings["to_hz"] == rate


def test_resampling_keeps_a_constant(make):
    np.testing.assert_allclose(resample(make(RATE, x=np.full(3000, 7.0)), 300.0)["x"], 7.0, rtol=1e-12)


def test_a_record_that_is_asked_to_resample_sends_there(make):
    with pytest.raises(AttributeError, match=r"Write ambid\.signals\.resample"):
        _ = make(RATE, x=T).resample


def test_upsampling_is_refused(make):
    with pytest.raises(RecordError, match="adds samples but no information"):
        resample(make(RATE, x=sine(20)), 2000.0)


def test_resampling_to_an_irrational_ratio_is_refused(make):
    with pytest.raises(RecordError, match="fraction"):
        resample(make(RATE, x=sine(20)), 1000.0 / np.pi)


def test_the_mean_to_the_next_sample_is_that_of_a_polynomial(make):
    k = np.arange(12.0)
    record = mean_to_next(make(1.0, x=0.3 * k**4 - 2.0 * k**2 + k), "x")
    whole = 0.06 * k**5 - 2.0 / 3.0 * k**3 + 0.5 * k**2
    np.testing.assert_allclose(record["x"].values[3:-1], np.diff(whole)[3:], rtol=1e-12)
