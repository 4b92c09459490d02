"""Frequency response by local polynomials: leakage, resonance, several inputs, loops, smooth excitation."""

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.errors import EstimationError
from ambid.signals.excitations import chirp
from ambid.signals.frf import frf_local, frf_random
from tests.signals.frf_benches import A, B, Loop, inside, mimo, mimo_response, response

POLE = np.exp((-0.01 + 1j) * 0.6)  # damping ratio 0.01
RESONANT = ([0.0, 0.1], np.poly([POLE, POLE.conj()]).real)


def test_the_resonance_is_resolved_where_averaging_leaks():
    rng = np.random.default_rng(1)
    u = rng.standard_normal(4096)
    y = lfilter(*RESONANT, u) + 0.003 * rng.standard_normal(4096)

    def error(frf):
        near = frf.between(0.085, 0.106)
        return np.sqrt(np.mean(np.abs(near.G[:, 0, 0] - response(*RESONANT, near.frequency_hz)) ** 2))

    best_of_welch = min(error(frf_random(u, y, 1.0, segment=s)) for s in (256, 512, 1024))
    assert error(frf_local(u, y, 1.0)) < 0.8 * best_of_welch


def test_leakage_is_not_noise():
    """Without noise, an averaged spectrum leaves its leakage as error; local polynomials leave little."""
    rng = np.random.default_rng(2)
    u = rng.standard_normal(2048)
    y = lfilter(B, A, u)
    local, averaged = frf_local(u, y, 1.0), frf_random(u, y, 1.0, segment=256)
    off = [np.sqrt(np.mean(np.abs(f.G[:, 0, 0] - response(B, A, f.frequency_hz)) ** 2)) for f in (local, averaged)]
    assert off[0] < 1e-5
    assert off[1] > 1e-3


def test_initial_conditions_do_not_matter():
    rng = np.random.default_rng(3)
    u = rng.standard_normal(2048)
    b, a = [0.0, 0.05], [1.0, -0.97]
    y, free = lfilter(b, a, u), lfilter([50.0], a, np.eye(1, 2048)[0])
    at_rest, moving = (frf_local(u, s, 1.0) for s in (y, y + free))
    truth = response(b, a, at_rest.frequency_hz)[:, None, None]
    assert np.median(np.abs(moving.G - truth) / np.abs(truth)) < 1e-2
    assert np.median(np.abs(moving.G - at_rest.G) / np.abs(truth)) < 1e-2


def test_the_noise_spectrum_is_found_with_several_inputs():
    rng = np.random.default_rng(4)
    u = rng.standard_normal((6000, 2)) @ np.array([[1.0, 0.8], [0.0, 0.6]])
    y = mimo(u) + 0.2 * rng.standard_normal((6000, 2))
    frf = frf_local(u, y, 1.0, band=(0.01, 0.4))
    assert 0.93 < inside(frf, mimo_response(frf.frequency_hz)) < 0.97
    assert frf.frequency_hz[0] >= 0.01
    assert frf.frequency_hz[-1] <= 0.4


def test_feedback_biases_the_plain_fit_and_not_the_joint_one():
    rng = np.random.default_rng(5)
    r = rng.standard_normal(20_000)
    u, y = Loop().run(r, 0.4 * rng.standard_normal(20_000))
    direct, joint = (frf_local(u, y, 1.0, r=x, free=40) for x in (None, r))
    truth = response(Loop.b, Loop.a, joint.frequency_hz)[:, None, None]
    off = [np.median(np.abs(np.mean((f.G - truth) / np.abs(truth)))) for f in (direct, joint)]
    assert off[0] > 0.15
    assert off[1] < 0.03
    assert inside(direct, truth) < 0.7
    assert inside(joint, truth) > 0.92
    assert any("give the reference r" in w for w in direct.warnings)
    assert frf_local(u, y, 1.0, open_loop=True).warnings == ()


def test_several_references_serve_one_input():
    rng = np.random.default_rng(6)
    r = rng.standard_normal((8000, 2)) * np.array([1.0, 1e-6])
    u, y = Loop().run(r[:, 0] + 1e6 * r[:, 1], 0.2 * rng.standard_normal(8000))
    frf = frf_local(u, y, 1.0, r=r)
    assert 0.92 < inside(frf, response(Loop.b, Loop.a, frf.frequency_hz)[:, None, None]) < 0.98


def test_excitation_that_is_too_smooth_or_absent_is_refused():
    rng = np.random.default_rng(7)
    step = np.r_[np.zeros(1), np.ones(999)]
    with pytest.raises(EstimationError, match="too smooth"):
        frf_local(step, lfilter(B, A, step) + 0.01 * rng.standard_normal(1000), 1.0)
    banded = chirp(1000, 1.0, amplitude=1.0, band=(0.05, 0.1))
    frf = frf_local(banded, lfilter(B, A, banded), 1.0, band=(0.06, 0.09), open_loop=True)
    assert np.abs(frf.G[:, 0, 0] - response(B, A, frf.frequency_hz)).max() < 0.05
    with pytest.raises(EstimationError, match="lines in the record"):
        frf_local(rng.standard_normal(20), rng.standard_normal(20), 1.0)
    with pytest.raises(EstimationError, match="as many lines as signals"):
        frf_local(rng.standard_normal(200), rng.standard_normal(200), 1.0, free=0)
    with pytest.raises(EstimationError, match="no line between"):
        frf_local(rng.standard_normal(200), rng.standard_normal(200), 1.0, band=(0.6, 0.7))
