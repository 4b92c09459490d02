"""Exact discretisation: against SciPy, a finer grid, and derivatives by Frechet and complex step."""

import numpy as np
import pytest
from scipy.linalg import expm, expm_frechet
from scipy.signal import cont2discrete

from ambid.physics.linear_model import StateSpace, discretise, model
from tests.bearing.benches import BEARING, COIL, SPRUNG, THESIS
from tests.estimation.reference import STEP

CASES = [
    ("one-axis", THESIS, 1e-4),
    ("one-axis", {**BEARING, "c": 20.0}, 5e-5),
    ("coil", COIL, 1e-4),
    ("rotor", SPRUNG, 2e-4),
]


def close(got, wanted, rtol=1e-10):
    """Equal within `rtol` of the largest entry of each row (entries of one row share a unit but for the column's)."""
    np.testing.assert_allclose(got, wanted, rtol=rtol, atol=rtol * np.abs(wanted).max())


@pytest.mark.parametrize(("name", "theta", "period"), CASES)
def test_zero_order_hold_equals_scipy(name, theta, period):
    s = model(name).matrices(theta)
    d, slopes = discretise(s, period)
    for b, ours in ((s.B, d.B), (s.E, d.E)):
        a_ref, b_ref, *_ = cont2discrete((s.A, b, s.C, np.zeros((s.C.shape[0], b.shape[1]))), period)
        close(d.A, a_ref)
        close(ours, b_ref)
    assert not np.any(d.B_late)
    assert slopes == ()
    assert np.array_equal(d.C, s.C)


@pytest.mark.parametrize(("name", "theta", "period"), CASES)
def test_directional_derivatives_equal_frechet(name, theta, period):
    of = model(name)
    s, names = of.matrices(theta), [p.name for p in of.parameters]
    _, slopes = discretise(s, period, derivatives=[of.derivative(theta, q) for q in names])
    (n, nu), nd = s.B.shape, s.E.shape[1]
    whole = np.zeros((n + nu + nd, n + nu + nd))
    whole[:n] = np.hstack([s.A, s.B, s.E]) * period
    for q, slope in zip(names, slopes, strict=True):
        g, along = of.derivative(theta, q), np.zeros_like(whole)
        along[:n] = np.hstack([g.A, g.B, g.E]) * period
        wanted = expm_frechet(whole, along, compute_expm=False)[:n]
        got = np.hstack([slope.A, slope.B, slope.E])
        close(got, wanted)
        assert not np.any(slope.B_late)


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 0.9])
@pytest.mark.parametrize(("name", "theta", "period"), CASES)
def test_derivatives_with_a_late_input_equal_a_complex_step(name, theta, period, fraction):
    of = model(name)
    names = [p.name for p in of.parameters]
    directions = [of.derivative(theta, q) for q in names]
    _, slopes = discretise(of.matrices(theta), period, fraction=fraction, derivatives=directions)
    assert len(slopes) == len(names) + 1
    moved = [discretise(of.matrices({**theta, q: theta[q] + 1j * STEP}), period, fraction=fraction)[0] for q in names]
    moved.append(discretise(of.matrices(theta), period, fraction=fraction + 1j * STEP)[0])
    for slope, m in zip(slopes, moved, strict=True):
        for part in ("A", "B", "B_late", "E"):
            wanted = np.imag(getattr(m, part)) / STEP
            # parts that cancel against the whole (B + B_late) are as exact as the whole
            size = np.abs(np.imag(m.B + m.B_late) / STEP).max() if part == "B_late" else 0.0
            np.testing.assert_allclose(
                getattr(slope, part), wanted, rtol=1e-10, atol=1e-10 * max(np.abs(wanted).max(), size)
            )


@pytest.mark.parametrize(("late", "of_a_sample"), [(0, 4), (1, 4), (2, 4), (3, 4), (2, 5)])
def test_a_late_input_is_a_whole_delay_on_a_finer_grid(late, of_a_sample):
    s = model("one-axis").matrices(BEARING)
    period, n = 5e-5, 60
    u = np.random.default_rng(3).standard_normal(n)
    d, _ = discretise(s, period, fraction=late / of_a_sample)
    fine, _ = discretise(s, period / of_a_sample)
    x, z = np.zeros(3), np.zeros(3)
    held = np.concatenate([np.zeros(late), np.repeat(u, of_a_sample)])
    for k in range(1, n):
        for j in range(of_a_sample):
            z = fine.A @ z + fine.B[:, 0] * held[k * of_a_sample + j]
        x = d.A @ x + d.B[:, 0] * u[k] + d.B_late[:, 0] * u[k - 1]
        if k == 1:  # both start alike: the first sample's input before the record is not told to the fine one
            x = z = np.zeros(3)
    np.testing.assert_allclose(x, z, rtol=1e-11)


def test_hold_of_a_double_integrator_is_the_textbook_one():
    s = StateSpace(
        A=np.array([[0.0, 1.0], [0.0, 0.0]]), B=np.array([[0.0], [1.0]]), E=np.array([[0.0], [1.0]]), C=np.eye(2)
    )
    d, _ = discretise(s, 0.1, fraction=0.3)
    np.testing.assert_allclose(d.A, [[1, 0.1], [0, 1]], rtol=1e-14)
    np.testing.assert_allclose(d.B[:, 0], [0.07**2 / 2, 0.07], rtol=1e-13)
    np.testing.assert_allclose((d.B + d.B_late)[:, 0], [0.1**2 / 2, 0.1], rtol=1e-13)
    np.testing.assert_allclose(d.E[:, 0], [0.1**2 / 2, 0.1], rtol=1e-13)


def test_composition_of_two_half_steps():
    s = model("one-axis").matrices(THESIS)
    whole, half = discretise(s, 1e-4)[0], discretise(s, 5e-5)[0]
    close(half.A @ half.A, whole.A, 1e-12)
    close(half.A @ half.B + half.B, whole.B, 1e-12)
    close(whole.A, expm(s.A * 1e-4), 1e-12)
