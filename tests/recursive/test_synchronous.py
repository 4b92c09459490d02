"""A sinusoid of known angle through a spin-up, with spreads that hold."""

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.streaming import SynchronousFilter

RATE = 5000.0


def spin(n, first_hz, last_hz):
    return 2 * np.pi * np.cumsum(np.linspace(first_hz, last_hz, n)) / RATE


def test_amplitude_and_phase_of_a_steady_rotation():
    phase, rng = spin(10_000, 80.0, 80.0), np.random.default_rng(0)
    f = SynchronousFilter(RATE, memory_s=0.2)
    left = f.update(3.0 * np.cos(phase + 2.5) + 7.0 + 0.1 * rng.standard_normal(phase.size), phase)
    found = f.sinusoid()
    assert found.amplitude == pytest.approx(3.0, abs=4 * found.amplitude_sd)
    assert found.phase == pytest.approx(2.5, abs=4 * found.phase_sd)
    assert found.amplitude_sd < 0.02
    assert f.parts[0, 2] == pytest.approx(7.0, abs=0.05)
    assert left[5000:].mean() == pytest.approx(7.0, abs=0.01)  # the offset stays in the signal
    assert left[5000:].std() == pytest.approx(0.1, rel=0.06)


def test_through_a_spin_up_over_a_resonance():
    n, rng = 60_000, np.random.default_rng(1)
    phase = spin(n, 0.0, 250.0)  # 15 000 rpm
    w, w0 = np.linspace(0, 250, n), 120.0
    response = w**2 / (w0**2 - w**2 + 1j * 0.3 * w0 * w)  # runs through a resonance and turns by half a revolution
    signal = np.real(response * np.exp(1j * phase)) + 0.5
    f = SynchronousFilter(RATE, memory_s=0.05)
    found, wanted = [], []
    left = []
    for k in range(0, n, 1000):
        part = slice(k, k + 1000)
        left.append(f.update(signal[part] + 0.02 * rng.standard_normal(1000), phase[part]))
        if k > 10_000:
            s = f.sinusoid()
            found.append(s.amplitude * np.exp(1j * s.phase))
            wanted.append(response[k + 999])
    assert np.abs(np.array(found) - np.array(wanted)).max() < 0.12 * np.abs(response).max()
    removed = np.concatenate(left)[10_000:]
    assert removed.std() < 0.06 * signal[10_000:].std()


@pytest.mark.parametrize("colour", [0.0, 0.95])
def test_spread_of_walking_parts_holds(colour):
    n, memory, scores = 6000, 0.1, []
    N = memory * RATE
    phase = spin(n, 400.0, 400.0)
    # sharper noise than white: the density at 400 Hz is what counts
    density = 1.0 / np.abs(1 - colour * np.exp(-2j * np.pi * 400 / RATE)) ** 2
    for seed in range(120):
        rng = np.random.default_rng(seed)
        e = rng.standard_normal(n + 500)
        for k in range(1, e.size):
            e[k] += colour * e[k - 1]
        e = e[500:]
        steps = np.sqrt(2.0 * density) / N * rng.standard_normal((n, 2))
        parts = np.cumsum(steps, axis=0) + np.array([5.0, -3.0])
        f = SynchronousFilter(RATE, memory_s=memory)
        f.update(parts[:, 0] * np.cos(phase) + parts[:, 1] * np.sin(phase) + e, phase)
        scores.append((f.parts[0, :2] - parts[-1]) / np.sqrt(np.diag(f.covariance[0])[:2]))
    z = np.array(scores).ravel()
    assert 0.90 < np.mean(np.abs(z) < 1.96) < 0.985
    assert np.mean(z**2) == pytest.approx(1.0, abs=0.35)


def test_standstill_winds_nothing_up():
    f = SynchronousFilter(RATE, memory_s=0.05)
    rng = np.random.default_rng(2)
    f.update(2.0 * np.cos(spin(5000, 50, 50)) + 0.1 * rng.standard_normal(5000), spin(5000, 50, 50))
    before = f.sinusoid().amplitude
    for _ in range(40):
        f.update(2.0 + 0.1 * rng.standard_normal(5000), np.zeros(5000))
    P = f.covariance[0]
    assert np.linalg.eigvalsh(P).min() > 0
    assert np.trace(P) < 1e6
    assert before == pytest.approx(2.0, abs=0.1)
    assert np.isfinite(f.parts).all()
    f.update(2.0 * np.cos(spin(5000, 50, 50)) + 0.1 * rng.standard_normal(5000), spin(5000, 50, 50))
    assert f.sinusoid().amplitude == pytest.approx(2.0, abs=0.1)


def test_splitting_a_stream_changes_no_number_and_gaps_are_counted():
    phase, rng = spin(1200, 20, 60), np.random.default_rng(3)
    y = np.stack([np.cos(phase), np.sin(phase)], axis=1) + 0.1 * rng.standard_normal((1200, 2))
    y[200:220, 0] = np.nan
    phase[500] = np.nan
    whole = SynchronousFilter(RATE, memory_s=0.02, channels=2)
    singles, alone = whole.copy(), SynchronousFilter(RATE, memory_s=0.02)
    wanted = whole.update(y, phase)
    np.testing.assert_array_equal([singles.update(y[k], phase[k]) for k in range(1200)], wanted)
    np.testing.assert_array_equal(
        [alone.update(float(v), float(p)) for v, p in zip(y[:, 0], phase, strict=True)], wanted[:, 0]
    )
    assert whole.n_missing == singles.n_missing == 22
    assert np.isnan(wanted[200:220, 0]).all()
    assert np.isfinite(wanted[221:500]).all()


def test_nothing_is_claimed_before_the_noise_is_known():
    f = SynchronousFilter(RATE, memory_s=0.1)
    f.update(np.ones(3), np.array([0.0, 0.1, 0.2]))
    assert f.sinusoid().amplitude_sd == np.inf
    assert f.sinusoid().phase_sd == pytest.approx(np.pi / np.sqrt(3))


def test_refusals():
    with pytest.raises(EstimationError, match="memory"):
        SynchronousFilter(RATE, memory_s=1e-3)
    with pytest.raises(EstimationError, match="angles"):
        SynchronousFilter(RATE, memory_s=0.1).update(np.ones(5), np.ones(4))
