"""Silverbox (electronic Duffing oscillator): best linear approximation, noise and distortion from the record alone."""

import numpy as np
import pytest

from ambid.signals import find_period
from ambid.signals.frf import frf_local
from ambid.signals.periodic_response import frf_periodic
from tests.measured import ABSENT, BENCHMARKS

SILVERBOX = BENCHMARKS / "silverbox.csv"
pytestmark = pytest.mark.skipif(not SILVERBOX.is_file(), reason=ABSENT)
MULTISINES = 40_500  # the growing noise, the "arrow", ends before; the whole periods begin after


@pytest.fixture(scope="module")
def record():
    time, u, y = np.loadtxt(SILVERBOX, delimiter=",", skiprows=1).T
    return 1.0 / (time[1] - time[0]), u, y


@pytest.fixture(scope="module")
def experiments(record):
    _, u, _ = record
    level = np.median(u[MULTISINES:])
    for _ in range(2):  # the excitation's median is not that of the rests between
        driven = np.abs(u - level) > 0.02 * np.max(np.abs(u[MULTISINES:] - level))
        busy = np.convolve(driven, np.ones(50), mode="same") > 0
        level = np.median(u[MULTISINES:][~busy[MULTISINES:]])
    edges = np.flatnonzero(np.diff(busy[MULTISINES:].astype(int), prepend=0, append=0)) + MULTISINES
    both = zip(edges[::2], edges[1::2], strict=True)
    # half of what the window adds at either end, and the filter's ringing after the last sample, are left out
    return [slice(a + 25, b - 45) for a, b in both if b - a > 8000]


@pytest.fixture(scope="module")
def measured(record, experiments):
    rate, u, y = record
    return frf_periodic([u[s] for s in experiments], [y[s] for s in experiments], rate, open_loop=True)


def test_ten_realisations_of_an_odd_multisine_are_found(record, experiments, measured):
    _, u, _ = record
    assert len(experiments) == 10
    assert {find_period(u[s]) for s in experiments} == {8192}
    assert measured.details["lines"] == tuple(range(1, 2685, 2))
    # 150 Hz is three times the mains: it is in the measured input at a line that the excitation leaves out
    assert any("even lines 2014 " in w for w in measured.warnings)
    assert sum("samples precede the 1 whole periods" in w for w in measured.warnings) == 10


def test_the_resonance_is_near_70_hz_and_the_gain_one(measured):
    gain = measured.magnitude[:, 0, 0]
    assert measured.frequency_hz[np.argmax(gain)] == pytest.approx(70.0, abs=2.0)
    assert 8.0 < gain.max() < 14.0
    assert np.mean(measured.between(1.0, 10.0).G).real == pytest.approx(0.98, abs=0.03)
    beyond = measured.between(180.0, 200.0)
    assert np.all(np.abs(np.abs(np.angle(beyond.G)) - np.pi) < 0.1)  # a second-order system


def test_distortion_lies_far_above_the_noise_and_is_largest_at_resonance(record, experiments, measured):
    _, _, y = record
    # The excitation repeats its first 400 samples; what then differs after the transient is noise.
    repeats = [y[s][8192 + 200 :] - y[s][200 : len(y[s]) - 8192] for s in experiments]
    noise = np.sqrt(np.mean(np.concatenate(repeats) ** 2) / 8192)  # rms of a line: half the difference, two of N
    levels = measured.details["distortions"]
    total = np.sqrt(10.0) * measured.sd[:, 0, 0] * np.interp(measured.frequency_hz, *input_level(measured, levels))
    near = (measured.frequency_hz > 60) & (measured.frequency_hz < 80)
    low = measured.frequency_hz < 30
    assert np.sqrt(np.mean(total[near] ** 2)) > 30 * noise
    assert np.sqrt(np.mean(total[near] ** 2)) > 10 * np.sqrt(np.mean(total[low] ** 2))
    # The spring hardens with the cube of the position: odd distortion above even.
    even = levels.even[(levels.even_hz > 60) & (levels.even_hz < 80)]
    assert np.sqrt(np.mean(total[near] ** 2)) > 4 * np.sqrt(np.mean(even**2))


def input_level(measured, levels):
    return measured.frequency_hz, levels.signal[:, 0] / measured.magnitude[:, 0, 0]


def test_local_polynomials_agree_with_the_periods(record, experiments, measured):
    rate, u, y = record
    whole = slice(experiments[0].start, experiments[-1].stop)
    local = frf_local(u[whole], y[whole], rate, band=(5.0, 190.0), free=60, open_loop=True)
    at = measured.between(6.0, 189.0)
    between = np.interp(at.frequency_hz, local.frequency_hz, local.G[:, 0, 0])
    sd = np.interp(at.frequency_hz, local.frequency_hz, local.sd[:, 0, 0])
    apart = np.abs(between - at.G[:, 0, 0]) / np.hypot(sd, at.sd[:, 0, 0])
    assert np.median(apart) < 1.5
