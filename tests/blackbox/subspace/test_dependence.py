"""Inputs that move together are refused, those that nearly do have honest spreads; records without noise are told."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.blackbox.data import IOData
from ambid.blackbox.subspace import cva, moesp, n4sid, pbsid
from ambid.errors import EstimationError

METHODS = {"n4sid": n4sid, "moesp": moesp, "cva": cva, "pbsid": pbsid}


@pytest.fixture(params=METHODS, name="method")
def _method(request):
    return METHODS[request.param]


def given(y: np.ndarray, **inputs: np.ndarray) -> IOData:
    u = np.stack(list(inputs.values()), axis=1)
    return IOData(u=u, y=y[:, None], dt=0.01, inputs=tuple(inputs), outputs=("y",), units={}, open_loop=True)


def signals(seed: int, n: int = 1000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """White input, another one, and the noisy answer of pole 0.8 and gain 1 to the first."""
    rng = np.random.default_rng(seed)
    u, w, e = rng.standard_normal((3, n))
    return u, w, lfilter([0, 1], [1, -0.8], u) + 0.1 * e


def test_inputs_that_differ_by_rounding_are_refused(method):
    u, _, y = signals(0)
    with pytest.raises(EstimationError, match=r"inputs 'u' and 'v' move together \(.*\): .* Omit one"):
        method(given(y, u=u, v=np.round(2 * u + 1, 9)), {"n": 1})


def test_those_that_take_part_are_named():
    u, w, y = signals(1)
    with pytest.raises(EstimationError, match="inputs 'u', 'w' and 's' move together"):
        pbsid(given(y, u=u, w=w, s=u - 3 * w), {"n": 1})


def test_an_input_that_is_an_older_sample_of_another_is_refused_from_two_states_on(method):
    u, _, y = signals(2)
    data = given(y, u=u, late=np.r_[0.0, u[:-1]])
    with pytest.raises(EstimationError, match="'u' and 'late' move together within 2 samples"):
        method(data, {"n": 2})
    fit = method(data, {"n": 1})  # one state cannot make the one of the other, so that their effects show
    if method is pbsid:
        assert any("'u' and 'late' move together" in w for w in fit.warnings)
    else:
        effect = fit.model.C @ fit.model.B
        np.testing.assert_allclose(effect, [[1.0, 0.0]], atol=0.03)


def test_smooth_inputs_of_their_own_are_not_refused(method):
    _, _, y = signals(3)
    t = np.arange(y.size)
    u, w = (sum(np.sin(0.01 * k * t + k * k * c) for k in range(1, 13)) for c in (0.3, 0.7))
    assert np.all(np.isfinite(method(given(y + lfilter([0, 1], [1, -0.8], u), u=u, w=w), {"n": 2}).model.theta))


@pytest.mark.parametrize("digits", [5, 3])
def test_inputs_that_nearly_move_together_have_honest_spreads(method, digits):
    z = []
    for seed in range(8):
        u, _, y = signals(seed)
        fit = method(given(y, u=u, v=np.round(2 * u + 1, digits)), {"n": 1})
        _, b, _, c, *_ = fit.model.theta
        slope = np.zeros(fit.model.theta.size)
        slope[1], slope[3] = c, b
        z.append((b * c - 1.0) / np.sqrt(slope @ fit.covariance @ slope))
    assert np.sqrt(np.mean(np.square(z))) < 1.7  # 1 by theory; the 0.1 % point of eight is 1.8
    assert np.max(np.abs(z)) > 0.1


@pytest.mark.parametrize("name", ["cva", "pbsid"])
def test_more_states_than_a_record_without_noise_shows_are_refused(name):
    u, _, _ = signals(4)
    with pytest.raises(EstimationError, match="identifies 1 state, not 2"):
        METHODS[name](given(np.r_[0.0, u[:-1]], u=u), {"n": 2})
