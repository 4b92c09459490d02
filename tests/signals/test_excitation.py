"""Excitations: exact properties of their spectra, amplitudes and correlations."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import AmbidError
from ambid.signals import EXCITATIONS, crest_factor, excitation, multisine, persistent_excitation
from ambid.signals.excitations import chirp, gaussian, prbs, schroeder_phases, steps

RATE = 1000.0


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def power(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.fft.rfftfreq(x.size, 1 / RATE), np.abs(np.fft.rfft(x)) ** 2


@pytest.mark.parametrize("bits", [2, 5, 8, 11])
@pytest.mark.parametrize("hold", [1, 3])
def test_prbs_is_of_maximum_length(bits, hold):
    length = 2**bits - 1
    ticks = prbs(2 * length * hold, RATE, amplitude=2.0, bits=bits, hold=hold)[::hold] / 2.0
    np.testing.assert_array_equal(ticks[:length], ticks[length:])
    one = ticks[:length]
    assert set(one) == {-1.0, 1.0}
    assert abs(one.sum()) == 1.0
    correlation = [np.dot(one, np.roll(one, k)) for k in range(length)]
    assert correlation[0] == length
    np.testing.assert_allclose(correlation[1:], -1.0, atol=1e-9)


def test_prbs_by_default_does_not_repeat_and_its_seed_chooses_the_start():
    x = prbs(1000, RATE, amplitude=1.0)
    full = np.correlate(x, x, "full")[x.size :]
    assert np.max(full) < 0.2 * x.size
    np.testing.assert_array_equal(x, prbs(1000, RATE, amplitude=1.0, seed=0))
    assert not np.array_equal(x, prbs(1000, RATE, amplitude=1.0, seed=1))


@pytest.mark.parametrize("n_lines", [20, 50, 200, 800])
def test_schroeder_phases_keep_the_crest_factor_of_a_flat_spectrum_low(n_lines):
    x = multisine(8000, RATE, amplitude=1.0, band=(0.125, 0.125 * n_lines), phases="schroeder")
    assert crest_factor(x) < 1.8


def test_schroeder_phases_of_equal_lines_are_the_known_parabola():
    k = np.arange(1, 8)
    np.testing.assert_allclose(schroeder_phases(np.ones(7)), -np.pi * k * (k - 1) / 7, atol=1e-12)


@pytest.mark.parametrize("phases", ["random", "schroeder"])
def test_iterations_lower_the_crest_factor_and_leave_the_lines_alone(phases):
    settings = {"amplitude": 1.0, "band": (1.0, 200.0), "phases": phases, "amplitude_is": "rms"}
    plain, better = multisine(4000, RATE, **settings), multisine(4000, RATE, crest_iterations=100, **settings)
    assert crest_factor(better) < 0.9 * crest_factor(plain)
    assert crest_factor(better) < 2.0
    np.testing.assert_allclose(power(better)[1], power(plain)[1], atol=1e-9 * power(plain)[1].max())


@pytest.mark.parametrize("shape", ["flat", "pink"])
@pytest.mark.parametrize("lines", ["all", "odd"])
def test_multisine_has_exactly_its_lines(shape, lines):
    x = multisine(4000, RATE, amplitude=3.0, band=(5.0, 100.0), shape=shape, lines=lines, periods=4, seed=7)
    np.testing.assert_array_equal(x[:1000], x[3000:])
    frequency, p = power(x[:1000])
    wanted = (frequency >= 5.0) & (frequency <= 100.0)
    if lines == "odd":
        wanted &= np.arange(frequency.size) % 2 == 1
    assert np.max(p[~wanted]) < 1e-18 * np.max(p)
    level = p[wanted] * (frequency[wanted] if shape == "pink" else 1.0)
    np.testing.assert_allclose(level, level[0], rtol=1e-9)
    assert np.max(np.abs(x)) == pytest.approx(3.0)


def test_multisine_band_ends_are_lines_in_spite_of_round_off():
    # 0.1 Hz spacing: 0.3/0.1 is not 3 in binary.
    frequency, p = power(multisine(10000, RATE, amplitude=1.0, band=(0.3, 0.7)))
    np.testing.assert_allclose(frequency[p > 1e-9 * p.max()], [0.3, 0.4, 0.5, 0.6, 0.7])


def test_chirp_sweeps_its_band():
    from scipy.signal import hilbert

    x = chirp(10000, RATE, amplitude=2.0, band=(20.0, 200.0))
    turns = np.diff(np.unwrap(np.angle(hilbert(x)))) / (2 * np.pi) * RATE
    middle = 5000
    assert np.mean(turns[middle - 50 : middle + 50]) == pytest.approx(110.0, rel=0.01)
    assert np.mean(turns[300:350]) < 30.0
    assert np.mean(turns[-350:-300]) > 180.0
    assert x[0] == 0.0


def test_gaussian_is_gaussian_and_confined_to_its_band():
    x = gaussian(50000, RATE, amplitude=0.3, band=(50.0, 150.0), seed=2)
    frequency, p = power(x)
    outside = (frequency < 50.0) | (frequency > 150.0)
    assert p[outside].sum() < 1e-20 * p.sum()
    assert rms(x) == pytest.approx(0.3)
    # 10 000 independent samples: the sd of the fourth moment is sqrt(96/10000).
    assert np.mean((x / rms(x)) ** 4) == pytest.approx(3.0, abs=4 * np.sqrt(96 / 10000))


def test_white_gaussian_is_white():
    x = gaussian(20000, RATE, amplitude=1.0, seed=3)
    r = [np.dot(x[k:], x[: x.size - k]) / x.size for k in range(1, 20)]
    assert np.max(np.abs(r)) < 4.5 / np.sqrt(x.size)


def test_steps_run_through_their_levels():
    x = steps(1000, RATE, amplitude=5.0)
    np.testing.assert_array_equal(x[::125], [0, 5, 0, -5, 0, 5, 0, -5])
    assert np.count_nonzero(np.diff(x)) == 7


@pytest.mark.parametrize("name", EXCITATIONS)
def test_amplitude_means_what_it_says_and_the_seed_repeats(name):
    def make(seed: int) -> np.ndarray:
        return excitation(name, 4000, RATE, amplitude=0.7, seed=seed)

    x = make(5)
    assert x.shape == (4000,)
    assert (rms(x) if name == "gaussian" else np.max(np.abs(x))) == pytest.approx(0.7)
    np.testing.assert_array_equal(x, make(5))
    assert np.array_equal(x, make(6)) == (name in ("steps", "chirp", "schroeder"))


def test_generator_as_seed_is_used_up():
    rng = np.random.default_rng(1)
    first, second = (excitation("gaussian", 100, RATE, amplitude=1.0, seed=rng) for _ in range(2))
    assert not np.array_equal(first, second)


def test_prbs_in_a_band_is_half_down_at_its_top_and_reaches_its_bottom():
    x = excitation("prbs", 20000, RATE, amplitude=1.0, band=(0.5, 44.0))
    assert np.min(np.diff(np.flatnonzero(np.diff(x)))) == 10  # ticks of 0.44·1000/44 samples
    period = (2**8 - 1) * 10  # 2^8 - 1 is the first length with lines at 0.5 Hz or nearer
    np.testing.assert_array_equal(x[:5000], x[period : period + 5000])


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("multisin", {}, "Did you mean 'multisine'"),
        ("xyz", {}, "steps, chirp, prbs"),
        ("steps", {"band": (1.0, 2.0)}, "no band"),
        ("multisine", {"band": (100.0, 10.0)}, "low end first"),
        ("multisine", {"band": (1.0, 600.0)}, "half the rate"),
        ("multisine", {"band": (1.01, 1.02)}, "Widen"),
        ("gaussian", {"band": (1.01, 1.02)}, "Widen"),
        ("gaussian", {"amplitude": -1.0}, "positive"),
    ],
)
def test_settings_that_cannot_be_are_refused_with_the_remedy(name, settings, message):
    with pytest.raises(AmbidError, match=message):
        excitation(name, 4000, RATE, **{"amplitude": 1.0, **settings})


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"periods": 3}, "divide"), ({"phases": "zero"}, "phases"), ({"amplitude_is": "top"}, "rms")],
)
def test_settings_of_a_multisine_that_cannot_be_are_refused(settings, message):
    with pytest.raises(AmbidError, match=message):
        multisine(4000, RATE, **{"amplitude": 1.0, "band": (1.0, 9.0), **settings})


def test_crest_factors_of_known_signals():
    t = np.arange(1000) / RATE
    assert crest_factor(np.sin(2 * np.pi * 10 * t)) == pytest.approx(np.sqrt(2.0))
    assert crest_factor(prbs(100, RATE, amplitude=3.0)) == pytest.approx(1.0)
    with pytest.raises(AmbidError, match="zero"):
        crest_factor(np.zeros(5))


@pytest.mark.parametrize("k", [1, 3, 8])
def test_a_sum_of_k_sines_excites_order_2k(k):
    t = np.arange(3000) / RATE
    u = 4.0 + sum(np.sin(2 * np.pi * f * t + f) for f in np.linspace(31.0, 390.0, k))
    assert persistent_excitation(u, 30).order == 2 * k


def test_persistent_excitation_of_the_limiting_cases():
    assert persistent_excitation(np.full(100, 3.0), 5).order == 0
    # A period of 15 ticks has the lines 1 to 7 beside its mean.
    assert persistent_excitation(prbs(3000, RATE, amplitude=1.0, bits=4), 30).order == 14
    white = persistent_excitation(gaussian(50000, RATE, amplitude=2.0), 30)
    assert white.order == white.asked == 30
    assert 0.9 < white.smallest <= white.largest < 1.1
    low = gaussian(50000, RATE, amplitude=2.0, band=(0.0, 20.0))
    assert persistent_excitation(low, 30, tolerance=1e-3).order < 6


@pytest.mark.parametrize("order", [0, 60])
def test_persistent_excitation_needs_a_fitting_order(order):
    with pytest.raises(AmbidError, match="order"):
        persistent_excitation(np.arange(100.0), order)
