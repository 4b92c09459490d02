"""Sampling under a zero-order hold: the textbook's formulas, poles on the axis included."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.physics.linear_model import StateSpace, discretise, zero_order_hold


def test_double_integrator_and_first_order_lag() -> None:
    A, B = zero_order_hold(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), 0.1)
    assert pytest.approx(np.array([[1.0, 0.1], [0.0, 1.0]])) == A
    assert pytest.approx(np.array([[0.005], [0.1]])) == B
    A, B = zero_order_hold(np.array([[-2.0]]), np.array([[6.0]]), 0.5)
    assert A[0, 0] == pytest.approx(np.exp(-1.0))
    assert B[0, 0] == pytest.approx(3.0 * (1 - np.exp(-1.0)))


def test_complex_steps_give_the_derivative_that_van_loans_block_gives() -> None:
    rng = np.random.default_rng(0)
    A, B, dA, dB = (rng.standard_normal(s) for s in ((3, 3), (3, 2), (3, 3), (3, 2)))
    rest = {"E": np.zeros((3, 0)), "C": np.eye(3)}
    _, (slope,) = discretise(StateSpace(A=A, B=B, **rest), 0.2, derivatives=[StateSpace(A=dA, B=dB, **rest)])
    stepped = zero_order_hold(A + 1e-30j * dA, B + 1e-30j * dB, 0.2)
    assert stepped[0].imag / 1e-30 == pytest.approx(slope.A, rel=1e-11)
    assert stepped[1].imag / 1e-30 == pytest.approx(slope.B, rel=1e-11)
