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


def test_each_kind_is_right_where_its_noise_is():
    rng = np.random.default_rng(3)
    clean = rng.standard_normal(200_000)
    y = lfilter(B, A, clean)
    at_y, at_u = 0.5 * rng.standard_normal(y.size), 0.5 * rng.standard_normal(y.size)

    def gain(u, y, **options):
        frf = frf_random(u, y, 1.0, segment=512, **options)
        return np.median(frf.magnitude[:, 0, 0] / np.abs(response(B, A, frf.frequency_hz)))

    assert gain(clean, y + at_y, kind="h1") == pytest.approx(1.0, abs=0.01)
    assert gain(clean + at_u, y, kind="h2") == pytest.approx(1.0, abs=0.01)
    assert gain(clean + at_u, y + at_y, kind="hv", noise_ratio=1.0) == pytest.approx(1.0, abs=0.01)
    assert gain(clean + at_u, y, kind="h1") == pytest.approx(1 / 1.25, abs=0.01)
    assert gain(clean, y + at_y, kind="h2") > 1.2


def test_hv_without_a_noise_ratio_is_the_geometric_mean_and_says_what_it_takes():
    rng = np.random.default_rng(4)
    u = rng.standard_normal(5000)
    y = lfilter(B, A, u) + 0.4 * rng.standard_normal(5000)
    h1, h2, hv = (frf_random(u, y, 1.0, kind=k, open_loop=True) for k in ("h1", "h2", "hv"))
    assert hv.magnitude == pytest.approx(np.sqrt(h1.magnitude * h2.magnitude), rel=1e-9)
    assert any("same noise share" in w for w in hv.warnings)
    assert h1.warnings == ()


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
    h2 = frf_random(u, mimo(u), 1.0, segment=512, kind="h2")
    assert np.median(np.abs(h2.G - mimo_response(h2.frequency_hz))) < 0.01
    with pytest.raises(EstimationError, match="dependent"):
        frf_random(np.stack([u[:, 0], 2 * u[:, 0]], axis=1), y, 1.0)
    with pytest.raises(EstimationError, match="H2 with 1 outputs"):
        frf_random(u, y[:, 0], 1.0, kind="h2")


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


def test_total_least_squares_with_several_inputs():
    rng = np.random.default_rng(12)
    u = rng.standard_normal((60_000, 2)) @ np.array([[1.0, 0.5], [0.0, 0.8]])
    y = mimo(u) + 0.2 * rng.standard_normal(u.shape)
    noisy = u + 0.2 * rng.standard_normal(u.shape)
    hv = frf_random(noisy, y, 1.0, segment=512, kind="hv", noise_ratio=1.0)
    h1 = frf_random(noisy, y, 1.0, segment=512)
    truth = mimo_response(hv.frequency_hz)
    assert 0.93 < inside(hv, truth) < 0.975
    assert inside(h1, truth) < 0.88


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


def test_options_that_contradict_each_other_are_refused():
    x = np.random.default_rng(15).standard_normal((2000, 2))
    with pytest.raises(EstimationError, match="which replaces it"):
        frf_random(x[:, 0], x[:, 1], 1.0, r=x[:, 0], kind="hv")
    with pytest.raises(EstimationError, match="noise_ratio"):
        frf_random(x[:, 0], x[:, 1], 1.0, noise_ratio=1.0)
    with pytest.raises(EstimationError, match="kind 'h3'"):
        frf_random(x[:, 0], x[:, 1], 1.0, kind="h3")


@pytest.mark.parametrize("method", ["random", "local"])
def test_bad_columns_are_called_by_their_names(method):
    u = np.random.default_rng(20).standard_normal((4096, 2))
    names = {"inputs": ["coil", "shaker"], "outputs": ["gap"], "method": method}
    with pytest.raises(EstimationError, match="input 'shaker' is constant"):
        frequency_response(u * [1.0, 0.0], u[:, 0], 1.0, **names)
    with pytest.raises(EstimationError, match="output 'gap' is not finite at sample 7"):
        frequency_response(u, np.where(np.arange(4096) == 7, np.nan, u[:, 0]), 1.0, **names)
