"""Offset, trend, low-pass, resampling, cutting, scaling and replacing samples."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.signals import cut, lowpass, remove_trend, replace_samples

RATE = 1000.0
T = np.arange(4000) / RATE


def sine(hz: float) -> np.ndarray:
    return np.sin(2 * np.pi * hz * T)


def test_the_record_given_is_not_changed(make):
    r = make(RATE, x=sine(5) + 3.0)
    before = r["x"].values.copy()
    for step in (remove_trend, lambda q: lowpass(q, 50.0)):
        step(r)
    np.testing.assert_array_equal(r["x"], before)
    assert r.history == ()


@pytest.mark.parametrize("degree", [0, 1, 3, 7])
def test_polynomial_trend_is_removed_exactly(make, degree):
    trend = np.polynomial.Polynomial(np.arange(1.0, degree + 2.0))(T)
    assert np.max(np.abs(remove_trend(make(RATE, x=trend), degree=degree)["x"])) < 1e-9 * np.max(np.abs(trend))


def test_lowpass_shifts_nothing_in_the_passband_and_halves_at_the_cutoff(make):
    r = lowpass(make(RATE, a=sine(10), b=sine(100), c=sine(350)), 100.0)
    middle = slice(500, -500)
    assert np.max(np.abs(r["a"] - sine(10))[middle]) < 1e-6
    assert np.max(np.abs(r["b"] - 0.5 * sine(100))[middle]) < 1e-3
    assert np.max(np.abs(r["c"])[middle]) < 1e-4


def test_lowpass_of_all_channels_leaves_their_linear_relation(make):
    # y = 3 u(t-2): filtering both alike must keep the relation (away from the ends).
    u = np.random.default_rng(1).standard_normal(T.size)
    r = lowpass(make(RATE, u=u, y=3.0 * np.roll(u, 2)), 80.0)
    assert np.max(np.abs(r["y"][202:-200] - 3.0 * r["u"][200:-202])) < 1e-9


@pytest.mark.parametrize("settings", [{"cutoff_hz": 500.0}, {"cutoff_hz": 0.0}, {"cutoff_hz": 50.0, "order": 13}])
def test_lowpass_refuses_what_it_cannot_do(make, settings):
    with pytest.raises(RecordError, match="must"):
        lowpass(make(RATE, x=sine(5)), **settings)


def test_lowpass_refuses_a_record_shorter_than_its_memory(make):
    with pytest.raises(RecordError, match="too few"):
        lowpass(make(RATE, x=np.zeros(30)), 10.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused_by_place(make, bad):
    x = sine(5).copy()
    x[17] = bad
    with pytest.raises(RecordError, match="sample 17"):
        lowpass(make(RATE, x=x), 50.0)


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
