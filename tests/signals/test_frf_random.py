"""Frequency response by averaged spectra: where the noise is, what overlap is worth, coherence, loops."""

import numpy as np
import pytest
from scipy.signal import csd, lfilter, welch

from ambid.errors import EstimationError
from ambid.signals import cross_spectra, frequency_response
from ambid.signals.frf import frf_random
from tests.signals.frf_benches import A, B, Loop, inside, mimo, mimo_loop, mimo_response, response


def test_cross_spectra_are_those_of_welch():
    rng = np.random.default_rng(1)
    z = rng.standard_normal((3000, 2)) @ np.array([[1.0, 0.5], [0.0, 2.0]]) + 7.0
    for segment in (256, 255):
        found = cross_spectra(z, 50.0, segment=segment)
        step = {"fs": 50.0, "nperseg": segment, "noverlap": int(0.5 * segment)}
        frequency, density = welch(z[:, 1], **step)
        assert found.frequency_hz == pytest.approx(frequency)
        assert found.density[:, 1, 1].real == pytest.approx(density)
        # scipy conjugates the first of the two
        assert found.density[:, 1, 0] == pytest.approx(csd(z[:, 0], z[:, 1], **step)[1])


def test_overlap_is_worth_what_welch_says():
    """Half-overlapped Hann segments have a correlation of 1/6: n = K/(1 + 2·(1 - 1/K)/36)."""
    z = np.random.default_rng(2).standard_normal((256 * 8 + 128, 1))
    found = cross_spectra(z, 1.0, segment=256)
    assert found.n_segments == 16
    assert found.n_effective == pytest.approx(16 / (1 + 2 * (15 / 16) / 36), rel=1e-3)
    assert found.lines_per_independent == pytest.approx(35 / 18, rel=1e-3)


def test_noise_at_the_input_biases_and_noise_at_the_output_does_not():
    rng = np.random.default_rng(3)
    clean = rng.standard_normal(200_000)
    y = lfilter(B, A, clean)

    def gain(u, y):
        frf = frf_random(u, y, 1.0, segment=512, open_loop=True)
        assert frf.warnings == ()
        return np.median(frf.magnitude[:, 0, 0] / np.abs(response(B, A, frf.frequency_hz)))

    assert gain(clean, y + 0.5 * rng.standard_normal(y.size)) == pytest.approx(1.0, abs=0.01)
    assert gain(clean + 0.5 * rng.standard_normal(y.size), y) == pytest.approx(1 / 1.25, abs=0.01)


def test_one_input_has_the_textbook_variance():
    rng = np.random.default_rng(5)
    u = rng.standard_normal(8000)
    frf = frf_random(u, lfilter(B, A, u) + 0.5 * rng.standard_normal(8000), 1.0, segment=256)
    n = frf.details["effective_averages"]
    expected = (1 - frf.coherence) / frf.coherence * np.abs(frf.G[:, :, 0]) ** 2 / (n - 1)
    assert frf.sd[:, :, 0] ** 2 == pytest.approx(expected, rel=1e-9)


def test_coherence_of_independent_signals_is_one_over_the_averages():
    rng = np.random.default_rng(6)
    frf = frf_random(rng.standard_normal(40_000), rng.standard_normal(40_000), 1.0, segment=1000)
    assert np.mean(frf.coherence) == pytest.approx(1 / frf.details["effective_averages"], rel=0.15)


def test_several_correlated_inputs_are_told_apart():
    rng = np.random.default_rng(7)
    u = rng.standard_normal((60_000, 2)) @ np.array([[1.0, 0.8], [0.0, 0.6]])
    y = mimo(u) + 0.2 * rng.standard_normal((60_000, 2))
    frf = frf_random(u, y, 1.0, segment=512)
    truth = mimo_response(frf.frequency_hz)
    assert 0.92 < inside(frf, truth) < 0.98
    with pytest.raises(EstimationError, match="dependent"):
        frf_random(np.stack([u[:, 0], 2 * u[:, 0]], axis=1), y, 1.0)


def test_feedback_biases_the_plain_ratio_and_not_the_joint_one():
    rng = np.random.default_rng(8)
    r = rng.standard_normal(100_000)
    u, y = Loop().run(r, 1.0 * rng.standard_normal(100_000))
    direct, joint = (frf_random(u, y, 1.0, r=x, segment=512) for x in (None, r))
    truth = response(Loop.b, Loop.a, joint.frequency_hz)[:, None, None]
    assert inside(direct, truth) < 0.1
    assert 0.9 < inside(joint, truth) < 0.98
    assert any("give the reference r" in w for w in direct.warnings)
    assert joint.warnings == ()
    assert "reference" in joint.method


def test_more_references_than_inputs_serve_together():
    rng = np.random.default_rng(9)
    r = rng.standard_normal((50_000, 2)) * np.array([1.0, 1e-6])  # the second in other units
    u, y = Loop().run(r[:, 0] + 1e6 * r[:, 1], 0.5 * rng.standard_normal(50_000))
    both = frf_random(u, y, 1.0, r=r, segment=512)
    one = frf_random(u, y, 1.0, r=r[:, 0], segment=512)
    truth = response(Loop.b, Loop.a, both.frequency_hz)[:, None, None]
    assert 0.9 < inside(both, truth) < 0.98
    assert np.median(both.sd / one.sd) < 0.85


def test_a_reference_that_does_not_reach_the_input_gives_a_warning():
    rng = np.random.default_rng(10)
    u, y = Loop().run(rng.standard_normal(5000), rng.standard_normal(5000))
    frf = frf_random(u, y, 1.0, r=rng.standard_normal(5000))
    assert any("less than 10 dB" in w for w in frf.warnings)


def test_too_few_averages_are_refused():
    x = np.random.default_rng(11).standard_normal(1000)
    with pytest.raises(EstimationError, match="averages are needed"):
        frf_random(x, x, 1.0, segment=800)


@pytest.mark.parametrize("method", ["random", "local"])
def test_a_loop_of_several_channels_is_opened_by_its_references(method):
    rng = np.random.default_rng(13)
    r = rng.standard_normal((10_000, 2))
    u, y = mimo_loop(r, 0.3 * rng.standard_normal(r.shape))
    options = {"segment": 256} if method == "random" else {"free": 20}
    frf = frequency_response(u, y, 1.0, r=r, method=method, **options)
    assert 0.925 < inside(frf, mimo_response(frf.frequency_hz)) < 0.975
    assert "reference" in frf.method


def test_leakage_of_short_segments_is_told():
    rng = np.random.default_rng(14)
    pole = np.exp((-0.01 + 1j) * 0.6)
    resonant = ([0.0, 0.1], np.poly([pole, pole.conj()]).real)

    def told(plant, segment):
        u = rng.standard_normal(16384)
        y = lfilter(*plant, u) + 0.05 * rng.standard_normal(u.size)
        return any("leakage" in w for w in frf_random(u, y, 1.0, segment=segment).warnings)

    assert sum(told(resonant, 128) for _ in range(10)) == 10
    u = rng.standard_normal(16384)
    short = frf_random(u, lfilter(*resonant, u), 1.0, segment=128).warnings
    assert any("method='local'" in w for w in short)
    assert any("(reference)" in w and "open_loop=True" in w for w in short)
    assert sum(told(resonant, 4096) for _ in range(10)) == 0
    assert sum(told((B, A), 512) for _ in range(10)) == 0


@pytest.mark.parametrize("method", ["random", "local"])
def test_bad_columns_are_called_by_their_names(method):
    u = np.random.default_rng(20).standard_normal((4096, 2))
    names = {"inputs": ["coil", "shaker"], "outputs": ["gap"], "method": method}
    with pytest.raises(EstimationError, match="input 'shaker' is constant"):
        frequency_response(u * [1.0, 0.0], u[:, 0], 1.0, **names)
    with pytest.raises(EstimationError, match="output 'gap' is not finite at sample 7"):
        frequency_response(u, np.where(np.arange(4096) == 7, np.nan, u[:, 0]), 1.0, **names)
