"""Modes of simulated structures: found, known as well as is said, and none that are not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.mode_starts import excited_band, spectra
from ambid.blackbox.modes import _Window, find_modes
from ambid.errors import EstimationError
from ambid.estimation.modes import mac
from tests.blackbox.sweeps import RATE, io, structure, sweep

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


# A rotor in magnets as a short sweep sees it: a suspension mode that is passed at once, a damped mode of the loop, and
# bending modes that are larger by far.
ROTOR = ((14.0, 0.006), (52.0, 0.06), (118.0, 0.012), (166.0, 0.012), (221.0, 0.01), (290.0, 0.008))


def rotor(modes, noise, seed):
    """Eight seconds of a sweep in white noise, `noise` times as large as the motion."""
    rng, u = np.random.default_rng(seed), sweep(8.0)
    y, _ = structure(modes, u, rng, noise=0.0)
    return io(y + noise * y.std() * rng.standard_normal(y.shape), u)


def check_modes(modal, modes):
    assert frequencies(modal) == pytest.approx([f for f, _ in modes], rel=5e-3)
    for m, (f, damping) in zip(modal.modes, modes, strict=True):
        assert abs(m.frequency_hz.value - f) < 4 * m.frequency_hz.sd < 2 * damping * f
        assert abs(m.damping.value - damping) < 4 * m.damping.sd < 2 * damping


@pytest.mark.parametrize("seed", [20, 21, 22])
def test_a_mode_that_the_sweep_passes_as_smoothly_as_leakage_is_found(seed):
    check_modes(find_modes(rotor(ROTOR, 0.05, seed)), ROTOR)


@pytest.mark.parametrize("seed", [23, 24])
def test_modes_that_noise_covers_line_by_line_are_found(seed):
    check_modes(find_modes(rotor(ROTOR[2:], 0.8, seed)), ROTOR[2:])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_the_input_does_not_cause_is_no_mode_where_the_sweep_is_smooth(seed):
    """Resonances that nobody excites on purpose, and lines of the mains, steady and wandering."""
    rng, u = np.random.default_rng(seed), sweep(16.0)
    y, _ = structure(((9.0, 0.006), (18.0, 0.006), (60.0, 0.003)), rng.standard_normal(u.size), rng)
    for line in (16.7, 49.98):
        wander = np.cumsum(rng.standard_normal(u.size)) * 1e-4
        y += y.std() * rng.uniform(0.1, 3.0, 6) * np.sin(2 * np.pi * line * np.arange(u.size) / RATE + wander)[:, None]
    assert find_modes(io(y, u)).modes == ()


def test_a_mode_sixty_decibels_below_the_largest_is_found():
    rng, u = np.random.default_rng(50), sweep(8.0)
    modes = ((35.0, 0.01), (90.0, 0.006), (210.0, 0.005), (330.0, 0.004))
    y, _ = structure(modes, u, rng, noise=1e-4, inputs=np.array([1.0, 1.0, 1e-3, 1.0, 1.0]))
    check_modes(find_modes(io(y, u)), modes)


def test_ten_modes_are_ten():
    rng, u = np.random.default_rng(51), sweep(16.0)
    at = (21.0, 33.0, 47.0, 62.0, 66.0, 110.0, 158.0, 220.0, 223.0, 390.0)
    modes = tuple(zip(at, rng.uniform(0.004, 0.01, 10), strict=True))
    y, _ = structure(modes, u, rng, quadratic=0.01)
    check_modes(find_modes(io(y, u)), modes)


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
