"""Frequency response from periodic excitation: period and lines, transients, distortion, several inputs, loops."""

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.errors import EstimationError
from ambid.signals import find_period, multisine
from ambid.signals.periodic_response import excited_lines, frf_periodic
from tests.signals.frf_benches import A, B, Loop, inside, mimo, mimo_response, one_period, response, steady

N = 512
ODD = np.arange(1, 160, 2)


def plant(x):
    return lfilter(B, A, x)


def with_gaps(rng):
    """Return odd lines of which each group of four lacks one at random, and the lines left out."""
    groups = ODD.reshape(-1, 4)
    out = groups[np.arange(len(groups)), rng.integers(0, 4, len(groups))]
    return np.setdiff1d(ODD, out), out


def test_without_noise_the_response_is_exact():
    x = one_period(np.random.default_rng(1), ODD, N)
    frf = frf_periodic(np.tile(x, 3), steady(plant, x, 3), 1.0)
    assert frf.details["period"] == N
    assert frf.details["lines"] == tuple(ODD)
    assert frf.G[:, 0, 0] == pytest.approx(response(B, A, frf.frequency_hz), rel=1e-10)
    assert np.all(frf.sd < 1e-9)


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("periods", [1.2, 2, 7.3])
def test_the_period_is_found(noise, periods):
    rng = np.random.default_rng(2)
    x = np.resize(multisine(700, 1.0, amplitude=1.0, band=(0.0, 0.1), amplitude_is="rms", seed=3), int(700 * periods))
    assert find_period(x + noise * rng.standard_normal(x.size)) == pytest.approx(700, abs=0 if noise == 0 else 1)


def test_no_period_is_invented():
    rng = np.random.default_rng(3)
    for x in (rng.standard_normal(3000), lfilter([1.0], [1.0, -0.98], rng.standard_normal(3000)), np.arange(500.0)):
        with pytest.raises(EstimationError, match="no period"):
            find_period(x)


def test_hum_among_odd_lines_is_left_out_and_named():
    rng = np.random.default_rng(5)
    hum = 0.05 * np.sin(2 * np.pi * 100 / N * np.arange(2 * N))
    x = one_period(rng, ODD, N)
    frf = frf_periodic(np.tile(x, 2) + hum, steady(plant, x, 2) + 0.01 * rng.standard_normal(2 * N), 1.0, period=N)
    assert frf.details["lines"] == tuple(ODD)
    assert any("lines 100 are excited" in w for w in frf.warnings)


def test_a_transient_is_reported_and_dropped_only_when_asked():
    rng = np.random.default_rng(6)
    x = one_period(rng, ODD, N)
    slow = ([0.1], [1.0, -0.995])
    y = lfilter(*slow, np.tile(x, 6)) + 0.002 * rng.standard_normal(6 * N)
    asked = {"period": N, "lines": ODD}
    kept = frf_periodic(np.tile(x, 6), y, 1.0, **asked)
    dropped = frf_periodic(np.tile(x, 6), y, 1.0, **asked, drop_periods="auto")
    assert any("transient" in w for w in kept.warnings)
    assert kept.details["dropped_periods"] == (0,)
    assert dropped.details["dropped_periods"][0] >= 1
    assert any("not used" in w for w in dropped.warnings)
    truth = response(*slow, kept.frequency_hz)
    worse, better = (np.abs(f.G[:, 0, 0] - truth).max() for f in (kept, dropped))
    assert better < 0.2 * worse
    assert not any("transient" in w for w in frf_periodic(np.tile(x, 6), quiet_output(rng, x), 1.0, **asked).warnings)


def quiet_output(rng, x):
    return steady(plant, x, 6) + 0.05 * lfilter([1.0], [1.0, -0.9], rng.standard_normal(6 * len(x)))


def test_leading_samples_that_do_not_fill_a_period_are_named():
    x = np.tile(one_period(np.random.default_rng(7), ODD, N), 4)
    frf = frf_periodic(x[100:], x[100:] + 1e-3 * np.random.default_rng(8).standard_normal(x.size - 100), 1.0)
    assert any("the first 412 samples" in w for w in frf.warnings)


def test_cubic_distortion_has_the_level_of_theory():
    """y = G(x + a x³): the best linear gain is 1 + 3aσ²; the rest has the autocorrelation 6a² R³ (Gaussian x)."""
    rng = np.random.default_rng(9)
    lines, a, M = np.arange(1, 120), 0.1, 40
    x = [one_period(rng, lines, N) for _ in range(M)]
    u = [np.tile(s, 2) for s in x]
    y = [np.tile(s + a * s**3, 2) + 0.01 * rng.standard_normal(2 * N) for s in x]
    frf = frf_periodic(u, y, 1.0, lines=lines)
    correlation = np.real(np.fft.ifft(np.abs(np.fft.fft(x[0])) ** 2)) / N
    theory = np.real(np.fft.fft(6 * a**2 * correlation**3))[lines] / N  # power of the two-sided line
    level = M * frf.distortion_variance[:, 0, 0] * np.abs(np.fft.fft(x[0])[lines] / N) ** 2
    assert np.mean(frf.G[:, 0, 0].real) == pytest.approx(1 + 3 * a, rel=0.01)
    assert np.sum(level) == pytest.approx(np.sum(theory), rel=0.06)
    assert np.median(frf.distortion_sd / frf.noise_sd) > 3


def test_one_realisation_shows_distortion_at_the_lines_left_out():
    rng = np.random.default_rng(10)
    lines, _ = with_gaps(rng)
    x = one_period(rng, lines, N)
    noise = 0.003 * rng.standard_normal(4 * N)

    def levels(b2, b3):
        y = np.tile(x + b2 * x**2 + b3 * x**3, 4) + noise
        return frf_periodic(np.tile(x, 4), y, 1.0)

    neither, even, odd = levels(0, 0), levels(0.1, 0), levels(0, 0.1)

    def ratios(frf):
        d = frf.details["distortions"]
        rms = [np.sqrt(np.mean(v**2)) for v in (d.even, d.even_noise, d.odd, d.odd_noise)]
        return rms[0] / rms[1], rms[2] / rms[3]

    assert ratios(neither) == pytest.approx((1, 1), abs=0.25)
    assert ratios(even)[0] > 20
    assert ratios(even)[1] == pytest.approx(1, abs=0.25)
    assert ratios(odd)[0] == pytest.approx(1, abs=0.25)
    assert ratios(odd)[1] > 10
    # Even distortion does not disturb odd lines; odd distortion does, and the stated variance holds it.
    assert np.median(even.sd / even.noise_sd) < 2
    assert np.median(odd.sd / odd.noise_sd) > 10
    gain = 1 + 3 * 0.1
    assert np.sqrt(np.mean(np.abs(odd.G - gain) ** 2)) == pytest.approx(np.sqrt(np.mean(odd.sd**2)), rel=0.35)


def test_even_distortion_has_the_level_of_theory():
    rng = np.random.default_rng(11)
    x = [one_period(rng, ODD, N) for _ in range(30)]
    frf = frf_periodic([*x], [s + 0.1 * s**2 for s in x], 1.0, period=N, lines=ODD, open_loop=True)
    d = frf.details["distortions"]
    correlation = np.real(np.fft.ifft(np.abs(np.fft.fft(x[0])) ** 2)) / N
    theory = np.real(np.fft.fft(2 * 0.1**2 * correlation**2))[2:158:2] / N * 2  # rms² of a real line
    assert np.sum(d.even**2) == pytest.approx(np.sum(theory), rel=0.1)


def test_one_realisation_without_free_lines_says_what_its_variance_lacks():
    rng = np.random.default_rng(12)
    x = one_period(rng, np.arange(1, 160), N)
    y = steady(plant, x, 3) + 0.1 * rng.standard_normal(3 * N)
    frf = frf_periodic(np.tile(x, 3), y, 1.0)
    assert any("without the nonlinear distortion" in w for w in frf.warnings)
    assert np.array_equal(frf.covariance, frf.noise_covariance)
    with pytest.raises(EstimationError, match="gives no variance"):
        frf_periodic(x, y[:N], 1.0, period=N, lines=np.arange(1, 160))


def test_orthogonal_experiments_tell_inputs_apart_and_equal_ones_are_refused():
    rng = np.random.default_rng(13)
    x = np.stack([one_period(rng, ODD, N), one_period(rng, ODD, N)], axis=1)
    pairs = [x, x * np.array([1.0, -1.0])]
    frf = frf_periodic([np.tile(p, (3, 1)) for p in pairs], [steady(mimo, p, 3) for p in pairs], 1.0, period=N)
    assert pytest.approx(mimo_response(frf.frequency_hz), rel=1e-9, abs=1e-10) == frf.G
    with pytest.raises(EstimationError, match="move together"):
        frf_periodic([np.tile(x, (3, 1))] * 2, [steady(mimo, x, 3)] * 2, 1.0, period=N)
    with pytest.raises(EstimationError, match="3 experiments with 2 inputs"):
        frf_periodic([np.tile(x, (3, 1))] * 3, [steady(mimo, x, 3)] * 3, 1.0, period=N)


def test_a_loop_needs_the_reference_where_its_noise_is_as_large_as_the_excitation():
    rng = np.random.default_rng(14)
    r = [np.tile(one_period(rng, ODD, N), 3) for _ in range(100)]
    io = [Loop().run(s, 2.0 * rng.standard_normal(3 * N)) for s in r]
    u, y = [u for u, _ in io], [y for _, y in io]
    asked = {"period": N, "lines": ODD, "drop_periods": 1}
    direct, joint = (frf_periodic(u, y, 1.0, r=x, **asked) for x in (None, r))
    truth = response(Loop.b, Loop.a, joint.frequency_hz)[:, None, None]
    off = [np.mean(np.abs(np.mean((f.G - truth) / truth))) for f in (direct, joint)]
    assert off[0] > 0.2
    assert off[1] < 0.05
    assert any("less than 10 dB above their noise" in w for w in direct.warnings)
    assert inside(joint, truth) > 0.9 > 0.6 > inside(direct, truth)


def test_one_dropped_period_is_spoken_of_as_one():
    rng = np.random.default_rng(16)
    x = np.tile(one_period(rng, ODD, N), 6)
    y = x + 0.01 * rng.standard_normal(x.size)
    y[: N // 4] += 5.0
    told = frf_periodic(x, y, 1.0, period=N, lines=ODD, drop_periods="auto").warnings
    assert any("the first period holds a transient and is not used" in w for w in told)


def test_remedies_name_the_options_of_the_command():
    rng = np.random.default_rng(17)
    x = one_period(rng, np.arange(1, 160), N)
    with pytest.raises(EstimationError, match="method='local'"):
        frf_periodic(x, x + 0.1 * rng.standard_normal(N), 1.0, period=N, lines=np.arange(1, 160))
    with pytest.raises(EstimationError, match="method='local'"):
        frf_periodic([np.stack([x, -x], axis=1)] * 3, [x] * 3, 1.0, period=N)
    with pytest.raises(EstimationError, match=r"local or the random method \(method\)"):
        find_period(rng.standard_normal(400))
    xs = [one_period(rng, np.arange(1, 160), N) for _ in range(3)]
    ys = [x + 0.1 * rng.standard_normal(N) for x in xs]
    assert any("(reference)" in w and "open_loop=True" in w for w in frf_periodic(xs, ys, 1.0, period=N).warnings)
    flat = {"inputs": ["coil"], "outputs": ["gap"], "period": N}
    with pytest.raises(EstimationError, match="output 'gap' is constant"):
        frf_periodic(x, np.ones(N), 1.0, **flat)


def test_a_line_far_above_the_others_does_not_hide_them():
    """A designed excitation may have one line 13 dB above the next; what lies 13 dB below all of them is noise."""
    lines = list(range(3, 40, 2))
    power = np.full(60, 0.01)
    power[lines] = 0.2
    power[7] = 8.0
    mean, noise = np.sqrt(power)[None, :, None] + 0j, np.full(60, 1e-4)
    assert excited_lines(mean, noise)[0].tolist() == [7]  # as of a sine with harmonics
    assert excited_lines(mean, noise, least=10)[0].tolist() == lines
