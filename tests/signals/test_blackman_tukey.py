"""Blackman-Tukey spectra: density, variance, degrees of freedom as promised."""

import numpy as np
import pytest
from scipy.signal import freqz, lfilter

from ambid.errors import RecordError
from ambid.signals.spectra import blackman_tukey, power_spectrum


def test_density_integrates_to_the_variance():
    x = np.random.default_rng(0).standard_normal(20_000) * 3.0 + 5.0
    s = blackman_tukey(x, 50.0)
    assert np.trapezoid(s.density, s.frequency_hz) == pytest.approx(x.var(), rel=0.02)
    assert s.frequency_hz[-1] == pytest.approx(25.0, rel=0.01)


@pytest.mark.parametrize(
    "estimate", [lambda x: blackman_tukey(x, 100.0, lags=64), lambda x: power_spectrum(x, 100.0, segment=256)]
)
def test_intervals_hold_the_true_density(estimate):
    inside, ratio = [], []
    for seed in range(60):
        x = lfilter([1.0], [1.0, -0.5], np.random.default_rng(seed).standard_normal(4000))
        s = estimate(x)
        truth = 2 / 100.0 * np.abs(freqz([1.0], [1.0, -0.5], 2 * np.pi * s.frequency_hz / 100.0)[1]) ** 2
        low, high = s.confidence()
        inner = slice(4, -4)
        inside.append((low <= truth)[inner] & (truth <= high)[inner])
        ratio.append((s.density / truth)[inner])
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)
    assert np.var(ratio, axis=0).mean() == pytest.approx(1 / s.n_effective, rel=0.15)


def test_lags_must_fit():
    with pytest.raises(RecordError, match="lags"):
        blackman_tukey(np.ones(100), 1.0, lags=60)
