"""Vector fitting finds what is there exactly, stable or not, in s and in z."""

import numpy as np
import pytest

from ambid.blackbox.frequency_rational import vector_fit
from ambid.errors import EstimationError
from tests.blackbox.frequency.responses import plant, poles_of

F = np.linspace(5.0, 2000.0, 400)
W = 2 * np.pi * F


def modes(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Light modes inside the band, half of them unstable, and residues of two inputs and two outputs."""
    rng = np.random.default_rng(seed)
    up = 10 ** rng.uniform(1.8, 4.0, n // 2) * (rng.choice([-1, 1], n // 2) * rng.uniform(0.01, 0.1, n // 2) + 1j)
    R = (rng.normal(size=(n // 2, 2, 2)) + 1j * rng.normal(size=(n // 2, 2, 2))) * np.abs(up)[:, None, None]
    return np.stack([up, up.conj()], 1).ravel(), np.stack([R, R.conj()], 1).reshape(n, 2, 2)


@pytest.mark.parametrize("n", [2, 6, 12, 20])
@pytest.mark.parametrize("dt", [None, 1 / 5000])
def test_exact_poles_up_to_order_20(n, dt):
    poles, residues = modes(n, n)
    D = np.array([[1.0, 0.5], [-0.2, 2.0]])
    points = 1j * W if dt is None else np.exp(1j * W * dt)
    true = poles if dt is None else np.exp(poles * dt)
    G = D + np.einsum("fk,kyu->fyu", 1 / (points[:, None] - true), residues)
    fit = vector_fit(W, G, n, dt=dt)
    assert fit.converged
    np.testing.assert_allclose(np.sort_complex(fit.poles), np.sort_complex(true), rtol=1e-8)
    np.testing.assert_allclose(fit.D, D, atol=1e-7)
    np.testing.assert_allclose(fit.frequency_response(W), G, rtol=1e-7, atol=1e-9 * np.abs(G).max())


def test_unstable_bearing_without_noise():
    G = plant("unstable-bearing", F)
    fit = vector_fit(W, G, 3, weight=1 / np.abs(G), feedthrough=False)
    np.testing.assert_allclose(np.sort_complex(fit.poles), poles_of("unstable-bearing"), rtol=1e-6)
    np.testing.assert_allclose(fit.frequency_response(W), G, rtol=1e-5)


def test_first_poles_do_not_matter_much():
    G = plant("unstable-bearing", F)
    far = np.array([-3.0, -30.0, -3000.0], dtype=complex)
    fit = vector_fit(W, G, 3, weight=1 / np.abs(G), start=far)
    np.testing.assert_allclose(np.sort_complex(fit.poles), poles_of("unstable-bearing"), rtol=1e-6)


def test_units_do_not_matter():
    G = plant("unstable-bearing", F)
    one = vector_fit(W, G, 3, weight=1 / np.abs(G))
    other = vector_fit(1e-6 * W, 1e9 * G, 3, weight=1 / np.abs(G))
    np.testing.assert_allclose(np.sort_complex(other.poles) * 1e6, np.sort_complex(one.poles), rtol=1e-7)


def test_too_few_lines_and_bad_numbers_are_refused():
    G = plant("unstable-bearing", F)
    with pytest.raises(EstimationError, match="poles from 3 lines"):
        vector_fit(W[:3], G[:3], 5)
    with pytest.raises(EstimationError, match="at least 1 pole"):
        vector_fit(W, G, 0)
    bad = G.copy()
    bad[7, 0, 0] = np.nan
    with pytest.raises(EstimationError, match="not finite"):
        vector_fit(W, bad, 3)
