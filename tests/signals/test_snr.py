"""Signal-to-noise ratio and spectra against known noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import freqz, lfilter

from ambid.errors import AmbidError, RecordError
from ambid.signals import multisine, power_spectrum, snr
from ambid.signals.excitations import gaussian

RATE = 10000.0
N = 20000


def noisy(clean: np.ndarray, db: float, seed: int = 0) -> np.ndarray:
    sd = np.std(clean) * 10 ** (-db / 20)
    return clean + sd * np.random.default_rng(seed).standard_normal(clean.size)


PLANTS = {"coil": ([0, 0.1], [1, -0.9]), "resonant": ([0, 0.1, 0.05], [1, -1.6, 0.8])}


@pytest.mark.parametrize("db", [40.0, 20.0, 10.0])
@pytest.mark.parametrize("plant", PLANTS)
def test_the_ratio_is_found_within_1_db(make, plant, db):
    period = N // 10
    u = multisine(N, RATE, amplitude=1.0, band=(5.0, 2000.0), periods=10, seed=1)
    clean = np.tile(lfilter(*PLANTS[plant], u)[-period:], 10)
    r = make(RATE, u=u, y=noisy(clean, db) + 3.0)
    found = snr(r, "y", inputs="u", order=40)
    assert found.db == pytest.approx(db, abs=1.0)
    assert found.noise_sd == pytest.approx(np.std(clean) * 10 ** (-db / 20), rel=0.12)


@pytest.mark.parametrize("db", [40.0, 20.0, 10.0])
def test_default_method_on_an_unpredictable_input(make, db):
    u = gaussian(N, RATE, amplitude=1.0, seed=1)
    r = make(RATE, u=u, y=noisy(lfilter(*PLANTS["coil"], u), db))
    assert snr(r, "y", inputs=["u"], order=60).db == pytest.approx(db, abs=1.0)
    alone = snr(r, "y")
    assert alone.db < db + 0.5
    assert "lower bound" in alone.method


@pytest.mark.parametrize("db", [40.0, 20.0, 10.0])
def test_a_sine_needs_no_input(make, db):
    r = make(RATE, y=noisy(np.sin(2 * np.pi * 50 * np.arange(N) / RATE), db))
    assert snr(r, "y", order=200).db == pytest.approx(db, abs=1.0)


def test_limiting_cases(make):
    rng = np.random.default_rng(1)
    r = make(RATE, dead=np.ones(N), noise=rng.standard_normal(N), clean=np.tile(rng.standard_normal(100), 200))
    assert snr(r, "dead").db == -np.inf
    assert snr(r, "noise").db < -20.0
    assert snr(r, "clean", order=100).db > 200.0
    assert "SNR" in str(snr(r, "noise"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"inputs": "y"}, "own inputs"),
        ({"inputs": "nothing"}, "no channel"),
        ({"order": 20000}, "too few"),
    ],
)
def test_what_cannot_be_done_is_refused(make, settings, message):
    with pytest.raises(AmbidError, match=message):
        snr(make(RATE, y=np.random.default_rng(1).standard_normal(N)), "y", **settings)


def test_power_spectrum_integrates_to_the_variance():
    x = 3.0 * np.random.default_rng(1).standard_normal(N)
    s = power_spectrum(x, RATE)
    assert np.trapezoid(s.density, s.frequency_hz) == pytest.approx(9.0, rel=0.03)
    assert np.median(s.density) == pytest.approx(9.0 / (RATE / 2), rel=0.1)
    assert s.n_segments == 15


@pytest.mark.parametrize("segment", [4, N + 1])
def test_segments_that_do_not_fit_are_refused(segment):
    x = np.random.default_rng(1).standard_normal(N)
    with pytest.raises(RecordError, match="segment"):
        power_spectrum(x, RATE, segment=segment)


def test_intervals_hold_the_true_density():
    inside, ratio = [], []
    for seed in range(60):
        x = lfilter([1.0], [1.0, -0.5], np.random.default_rng(seed).standard_normal(4000))
        s = power_spectrum(x, 100.0, segment=256)
        truth = 2 / 100.0 * np.abs(freqz([1.0], [1.0, -0.5], 2 * np.pi * s.frequency_hz / 100.0)[1]) ** 2
        low, high = s.confidence()
        inner = slice(4, -4)
        inside.append((low <= truth)[inner] & (truth <= high)[inner])
        ratio.append((s.density / truth)[inner])
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)
    assert np.var(ratio, axis=0).mean() == pytest.approx(1 / s.n_effective, rel=0.15)
