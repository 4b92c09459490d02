"""Modes of simulated structures: found, known as well as is said, and none that are not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.mode_starts import excited_band, spectra
from ambid.blackbox.modes import _Window, find_modes
from ambid.blackbox.operational import operational_modes
from ambid.errors import EstimationError
from ambid.estimation.modes import mac
from tests.blackbox.sweeps import io, structure, sweep

MODES = ((42.0, 0.004), (92.0, 0.003), (93.1, 0.004), (180.0, 0.006), (335.0, 0.003))  # two of them close together


@pytest.fixture(scope="module")
def record():
    """Eight seconds of a sweep with hum and a force that is a little quadratic."""
    rng, u = np.random.default_rng(3), sweep(8.0)
    y, shapes = structure(MODES, u, rng, hum=0.02, quadratic=0.02)
    return io(y, u), shapes


@pytest.fixture(scope="module")
def found(record):
    return find_modes(record[0])


def frequencies(modal):
    return [m.frequency_hz.value for m in modal.modes]


def test_all_modes_are_found_and_no_others(found):
    assert frequencies(found) == pytest.approx([f for f, _ in MODES], rel=1e-4)
    assert found.passed, found.reasons


def test_numbers_are_as_near_as_their_standard_deviations_say(found):
    for m, (f, damping) in zip(found.modes, MODES, strict=True):
        assert abs(m.frequency_hz.value - f) < 4 * m.frequency_hz.sd < 0.02 * damping * f * 4
        assert abs(m.damping.value - damping) < 4 * m.damping.sd < 0.02 * damping * 4
        assert m.identifiable


def test_shapes_are_those_of_the_structure(record, found):
    for k, m in enumerate(found.modes):
        shape = record[1][:, k] / record[1][np.argmax(np.abs(record[1][:, k])), k]
        assert [x.value for x in m.shape.values()] == pytest.approx(shape, abs=0.03)
        assert max(abs(x.value) for x in m.shape_quadrature.values()) < 0.03
    assert np.all(np.diag(mac(found.modes, found.modes)) > 0.999)


def test_a_delay_does_not_move_poles():
    rng, u = np.random.default_rng(4), sweep(8.0)
    y, _ = structure(MODES[3:], u, rng, delay=7, noise=0.01)
    late = find_modes(io(y, u))
    for m, (f, damping) in zip(late.modes, MODES[3:], strict=True):
        assert abs(m.frequency_hz.value - f) < 4 * m.frequency_hz.sd
        assert abs(m.damping.value - damping) < 4 * m.damping.sd


def test_the_number_of_modes_and_the_band_are_obeyed(record):
    two = find_modes(record[0], 2, band=(80.0, 200.0))
    assert len(two.modes) == 2
    assert all(80 < f < 200 for f in frequencies(two))
    many = find_modes(record[0], 4, band=(80.0, 200.0))
    assert len(many.modes) == 3
    assert not many.checks["modes_found"].passed


def test_noise_has_no_modes():
    rng, u = np.random.default_rng(5), sweep(8.0)
    nothing = find_modes(io(rng.standard_normal((u.size, 3)), u))
    assert (nothing.modes, nothing.status) == ((), "failed")
    assert not nothing.checks["modes_found"].passed


def test_a_resonance_that_wanders_is_one_mode_and_said_to_be_no_linear_one():
    rng, u, dt = np.random.default_rng(6), sweep(8.0), 1e-3
    q = v = 0.0
    y = np.empty((u.size, 3))
    for k, force in enumerate(u):  # a spring that hardens: the resonance bends over
        a = force - 2 * 0.003 * 600.0 * v - 600.0**2 * q * (1 + 5e6 * q**2)
        v += dt * a
        q += dt * v
        y[k] = a * np.array([1.0, 0.6, -0.3])
    y += 0.01 * y.std() * rng.standard_normal(y.shape)
    bent = find_modes(io(y, u), band=(50.0, 200.0))
    assert len(bent.modes) == 1
    assert not bent.checks["modes_fit"].passed
    assert bent.verdict.word == "caution"


def test_two_modes_within_a_bandwidth_are_two():
    rng, u = np.random.default_rng(12), sweep(8.0)
    y, _ = structure(((120.0, 0.003), (120.2, 0.003)), u, rng, quadratic=0.03)
    near = find_modes(io(y, u), band=(60.0, 200.0))
    assert len(near.modes) == 2
    for m, f in zip(near.modes, (120.0, 120.2), strict=True):
        assert abs(m.frequency_hz.value - f) < 4 * m.frequency_hz.sd < 0.1


def test_one_output_is_enough():
    rng, u = np.random.default_rng(7), sweep(8.0)
    y, _ = structure(((120.0, 0.004), (260.0, 0.005)), u, rng, n_outputs=1, noise=0.02)
    assert frequencies(find_modes(io(y, u))) == pytest.approx([120.0, 260.0], rel=1e-3)


def test_band_is_where_the_excitation_has_power():
    rng = np.random.default_rng(8)
    u = sweep(16.0, high=120.0) + 1e-3 * rng.standard_normal(16000)
    U = np.fft.rfft(u)[1:8000, None]
    low, high = excited_band(U, np.arange(1, 8000) / 16.0)
    assert low < 3.0
    assert high == pytest.approx(120.0, rel=0.1)


def test_white_excitation_has_no_border():
    U = np.fft.rfft(np.random.default_rng(9).standard_normal(16000))[1:8000, None]
    assert excited_band(U, np.arange(1, 8000) / 16.0) == (1 / 16, 7999 / 16)


def test_too_few_lines_and_a_silent_input_are_refused(record):
    data = record[0]
    with pytest.raises(EstimationError, match="lines of the record between 90 and 91 Hz"):
        find_modes(data, band=(90.0, 91.0))
    with pytest.raises(EstimationError, match="'current' does not move"):
        find_modes(replace(data, u=np.zeros_like(data.u)), band=(20.0, 400.0))


def test_gradient_of_the_projected_likelihood_is_exact(record):
    lines = spectra(record[0], (10.0, 400.0)).between(85.0, 100.0)
    window = _Window(lines, np.array([], dtype=complex))
    poles = 2 * np.pi * np.array([-0.3 + 92.1j, -0.4 + 93.0j])
    at, slopes = window.project(poles), window.slopes(poles)
    gradient = 2 * np.real(np.einsum("ajk,jk->a", slopes.conj(), at.e))
    for k, way in enumerate((1, 1j)):
        h = 1e-3 * lines.step * way * np.array([1.0, 0.0])
        up, down = (window.project(poles + s * h).cost for s in (1, -1))
        assert gradient[k] == pytest.approx((up - down) / 2e-3, rel=1e-5)


@pytest.fixture(scope="module")
def alone():
    """A minute of noise that nobody measured, with hum."""
    rng = np.random.default_rng(10)
    y, _ = structure(MODES[::4], rng.standard_normal(60000), rng, n_outputs=3, hum=0.3)
    return operational_modes(io(y))


def test_operational_modes_are_found_without_input(alone):
    for f, damping in MODES[::4]:
        m = min(alone.modes, key=lambda m: abs(m.frequency_hz.value - f))
        assert abs(m.frequency_hz.value - f) < 4 * m.frequency_hz.sd < 0.02 * f
        assert abs(m.damping.value - damping) < 4 * m.damping.sd < 4 * damping


def test_a_harmonic_is_no_mode(alone):
    lines = [m for m in alone.modes if min(abs(m.frequency_hz.value - x) for x in (50.0, 150.02)) < 0.1]
    assert lines
    assert not any(m.identifiable for m in lines)
    assert not alone.checks["modes_random"].passed


def test_operational_modes_want_a_band_of_lines():
    with pytest.raises(EstimationError, match="operational modes want"):
        operational_modes(io(np.random.default_rng(1).standard_normal((2000, 2))), band=(10.0, 12.0))
