"""The noun of a measured frequency response, and the choice of its method."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import f as f_distribution

from ambid.errors import EstimationError
from ambid.signals import FrequencyResponse, frequency_response, power_spectrum
from tests.signals.frf_benches import A, B, one_period


def measured(**changes):
    values = {
        "frequency_hz": np.array([1.0, 2.0, 3.0]),
        "G": np.array([1.0, 2.0j, -3.0])[:, None, None],
        "covariance": np.array([0.04, 0.09, 0.16], dtype=complex)[:, None, None],
        "method": "made up",
        "inputs": ("u1",),
        "outputs": ("y1",),
        "rate_hz": 100.0,
        "degrees_of_freedom": 6.0,
    }
    return FrequencyResponse(**(values | changes))


def test_the_standard_deviation_is_the_root_of_the_variance():
    assert measured().sd.ravel() == pytest.approx([0.2, 0.3, 0.4])


def test_the_confidence_circle_is_that_of_the_f_distribution():
    for nu in (2.0, 6.0, 31.5):
        expected = np.sqrt(f_distribution.ppf(0.9, 2, nu))
        assert measured(degrees_of_freedom=nu).confidence_radius(0.9).ravel() == pytest.approx(
            expected * np.array([0.2, 0.3, 0.4])
        )
    known = measured(degrees_of_freedom=np.inf).confidence_radius(0.95)
    assert known.ravel()[0] == pytest.approx(0.2 * np.sqrt(-np.log(0.05)))


def test_distortion_is_what_noise_leaves_and_its_floor_is_seen():
    frf = measured(noise_covariance=np.array([0.03, 0.09, 0.25], dtype=complex)[:, None, None])
    assert frf.distortion_variance.ravel() == pytest.approx([0.01, 0.0, -0.09])
    assert frf.distortion_sd.ravel() == pytest.approx([0.1, 0.0, 0.0])
    assert measured().distortion_sd is None


def test_a_band_keeps_everything_at_its_lines():
    part = measured(degrees_of_freedom=np.array([4.0, 5.0, 6.0]), coherence=np.array([[0.1], [0.2], [0.3]])).between(
        2, 9
    )
    assert part.frequency_hz.tolist() == [2.0, 3.0]
    assert part.degrees_of_freedom.tolist() == [5.0, 6.0]
    assert part.coherence.ravel().tolist() == [0.2, 0.3]
    with pytest.raises(EstimationError, match="between 7 and 9 Hz"):
        part.between(7, 9)


def test_wrong_shapes_are_refused_and_values_frozen():
    with pytest.raises(EstimationError, match="covariance has shape"):
        measured(covariance=np.zeros((3, 2, 2), dtype=complex))
    with pytest.raises(EstimationError, match="rising"):
        measured(frequency_hz=np.array([1.0, 1.0, 2.0]))
    with pytest.raises(FrozenInstanceError):
        measured().method = "another"


def test_auto_takes_what_the_excitation_allows():
    rng = np.random.default_rng(1)
    noise = rng.standard_normal(2000)
    periodic = np.tile(one_period(rng, np.arange(1, 60), 400), 5)
    for u, expected in ((noise, "local"), (periodic, "periodic")):
        y = lfilter(B, A, u) + 0.1 * rng.standard_normal(2000)
        assert frequency_response(u, y, 100.0).method.startswith(expected)
        assert frequency_response(u, y, 100.0, method="random", segment=200).method.startswith("H1")
    with pytest.raises(EstimationError, match="one record"):
        frequency_response([noise, noise], [noise, noise], 100.0, method="local")
    with pytest.raises(EstimationError, match="must be 'auto'"):
        frequency_response(noise, noise, 100.0, method="fft")


@pytest.mark.parametrize("method", ["periodic", "random", "local"])
def test_all_methods_share_a_contract(method):
    rng = np.random.default_rng(2)
    u = np.tile(one_period(rng, np.arange(1, 60), 400), 5)
    u[400:] += 0.1 * rng.standard_normal(1600)
    y = lfilter(B, A, u) + 0.1 * rng.standard_normal(2000) + 5.0  # an offset
    kept = u.copy(), y.copy()
    options = {
        "method": method,
        "inputs": ["i"],
        "outputs": ["x"],
        "units": {"i": "A", "x": "m"},
        "hold": "band-limited",
    }
    options |= {"period": 400} if method == "periodic" else {"segment": 200} if method == "random" else {}
    one, two = (frequency_response(u, y, 100.0, **options) for _ in range(2))
    assert np.array_equal(u, kept[0])
    assert np.array_equal(y, kept[1])
    assert np.array_equal(one.G, two.G)
    assert np.array_equal(one.covariance, two.covariance)
    assert np.all(np.linalg.eigvalsh(one.covariance) >= 0)
    assert (one.inputs, one.outputs, one.hold, one.units["x"]) == (("i",), ("x",), "band-limited", "m")
    # Units: the response and its deviation scale with them.
    scaled = frequency_response(1e-6 * u, 1e3 * y, 100.0, **options)
    assert pytest.approx(1e9 * one.G, rel=1e-6) == scaled.G
    assert scaled.sd == pytest.approx(1e9 * one.sd, rel=1e-6)
    # An offset is estimated, not part of the response.
    assert pytest.approx(one.G, rel=1e-6) == frequency_response(u + 3.0, y - 9.0, 100.0, **options).G


@pytest.mark.parametrize("method", ["periodic", "random", "local"])
def test_all_methods_refuse_what_is_not_data(method):
    x = np.random.default_rng(3).standard_normal(800)
    bad = x.copy()
    bad[17] = np.nan
    for u, y, message in (
        (bad, x, "not finite at sample 17"),
        (x, np.ones(800), "constant"),
        (x, x[:-1], "799 samples"),
    ):
        with pytest.raises(EstimationError, match=message):
            frequency_response(u, y, 1.0, method=method)
    with pytest.raises(EstimationError, match="rate"):
        frequency_response(x, x, 0.0, method=method)


def test_the_density_has_the_confidence_that_it_states():
    rng = np.random.default_rng(4)
    inside, relative = [], []
    for _ in range(100):
        spectrum = power_spectrum(lfilter([1.0], [1.0, -0.5], rng.standard_normal(4096)), 1.0, segment=256)
        w = np.exp(-2j * np.pi * spectrum.frequency_hz)
        truth = 2 / np.abs(1 - 0.5 * w) ** 2
        low, high = spectrum.confidence(0.9)
        inside.append(np.mean((low < truth)[2:-2] & (truth < high)[2:-2]))
        relative.append((spectrum.density / truth)[2:-2])
    assert 0.88 < np.mean(inside) < 0.92
    assert np.std(relative) * np.sqrt(spectrum.n_effective) == pytest.approx(1.0, abs=0.05)
    assert spectrum.n_effective < spectrum.n_segments
