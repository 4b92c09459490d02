"""Stabilisation diagram of a simulated plant with known modes."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.prediction import run_states
from ambid.errors import EstimationError
from ambid.estimation.modes import assurance
from ambid.report.response import stabilisation_figure
from ambid.validation.orders import stabilisation
from tests.validation.blackbox.fits import DT, io

MODES_HZ, DAMPING = np.array([6.0, 15.0]), np.array([0.03, 0.02])
REAL = 4.0  # rad/s, unstable


def record(*, unstable=False, n=4000):
    """Two modes of a plant with two outputs; on request an unstable real pole under feedback."""
    rng = np.random.default_rng(2)
    w = 2 * np.pi * MODES_HZ
    s = -DAMPING * w + 1j * w * np.sqrt(1 - DAMPING**2)
    blocks = [np.array([[p.real, p.imag], [-p.imag, p.real]]) for p in np.exp(s * DT)]
    n_x = 5 if unstable else 4
    A = np.zeros((n_x, n_x))
    A[:2, :2], A[2:4, 2:4] = blocks
    B = np.ones((n_x, 1))
    C = np.array([[1.0, 0.3, 0.8, 0.0, 0.5], [0.5, -0.4, -1.0, 0.3, 0.5]])[:, :n_x]
    r, e = rng.standard_normal((n, 1)), 0.05 * rng.standard_normal((n, 2))
    if not unstable:
        return io(r, run_states(A, B, r) @ C.T + e)
    A[4, 4] = np.exp(REAL * DT)
    x, u, y = np.zeros(n_x), np.zeros((n, 1)), np.zeros((n, 2))
    for k in range(n):
        y[k] = C @ x + e[k]
        u[k] = r[k] - 0.15 * x[4]
        x = A @ x + B @ u[k]
    return io(u, y)


@pytest.mark.parametrize("method", ["pbsid", "n4sid"])
def test_the_modes_are_the_true_ones_and_no_others(method):
    found = stabilisation(record(), method, 12)
    np.testing.assert_allclose([m.frequency_hz for m in found.modes], MODES_HZ, rtol=0.01)
    np.testing.assert_allclose([m.damping for m in found.modes], DAMPING, rtol=0.15)
    assert found.orders == tuple(range(1, 13))
    assert found.suggested >= 4
    assert all(len(m.orders) >= 6 for m in found.modes)
    assert {p.order for p in found.poles if p.stable} <= set(range(2, 13))


def test_an_unstable_pole_under_feedback_has_negative_damping():
    found = stabilisation(record(unstable=True), "pbsid", 12)
    unstable = [m for m in found.modes if m.damping < 0]
    assert len(unstable) == 1
    assert unstable[0].pole.real == pytest.approx(REAL, rel=0.1)
    assert abs(unstable[0].pole.imag) < 1e-9


def test_assurance_does_not_see_size_or_phase():
    a = (1.0, 0.5j, -0.3)
    assert assurance(a, tuple((2 - 3j) * x for x in a)) == pytest.approx(1.0)
    assert assurance((1.0, 0.0), (0.0, 1.0)) == 0.0


def test_the_figure_shows_every_pole():
    found = stabilisation(record(n=1000), "pbsid", 8)
    page = stabilisation_figure(found)
    diagram = page.axes[2]
    assert sum(len(line.get_xdata()) for line in diagram.lines[-3:]) == len(found.poles)
    assert diagram.get_ylabel() == "order"


def test_what_is_unknown_is_refused():
    with pytest.raises(EstimationError, match="pbsid"):
        stabilisation(record(n=500), "pbsidd")
