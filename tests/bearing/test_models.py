"""Linear models: the equations of motion, their energy, and exact derivatives."""

import numpy as np
import pytest

from ambid.errors import ModelError, nearest
from ambid.physics.linear_model import model, model_names
from tests.bearing.benches import BEARING, COIL, FALLING, SPRUNG, THESIS
from tests.estimation.reference import STEP, continuous

DAMPED = {**BEARING, "c": 35.0}
CASES = [("one-axis", THESIS), ("one-axis", DAMPED), ("coil", COIL), ("rotor", SPRUNG), ("rotor", FALLING)]


@pytest.mark.parametrize(("name", "theta"), CASES)
def test_matrices_are_the_equations_of_motion(name, theta):
    s = model(name).matrices(theta)
    for ours, theirs in zip((s.A, s.B, s.E, s.C), continuous(name, theta), strict=True):
        np.testing.assert_allclose(ours, np.real(theirs), rtol=1e-15)


@pytest.mark.parametrize(("name", "theta"), CASES)
def test_derivatives_match_a_complex_step(name, theta):
    of = model(name)
    for spec in of.parameters:
        moved = of.matrices({**theta, spec.name: theta[spec.name] + 1j * STEP})
        exact, at = of.derivative(theta, spec.name), of.matrices(theta)
        for part in "ABEC":
            wanted, got = np.imag(getattr(moved, part)) / STEP, getattr(exact, part)
            assert got.shape == getattr(at, part).shape
            np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=0)


def test_energy_goes_where_it_should():
    # H = (m v^2 + k_x x^2 + L i^2)/2 changes by V i + f v - R i^2 - c v^2 only: the force k_i i and the motional
    # voltage k_i x' exchange energy without loss, whatever the sign of k_i and k_x
    s = model("one-axis").matrices(DAMPED)
    h = np.diag([DAMPED["k_x"], DAMPED["m"], DAMPED["L"]])
    np.testing.assert_allclose(h @ s.A + s.A.T @ h, -2 * np.diag([0, DAMPED["c"], DAMPED["R"]]), atol=1e-9)
    np.testing.assert_allclose(h @ s.B, [[0], [0], [1]], atol=1e-15)
    np.testing.assert_allclose(h @ s.E, [[0, 0], [1, 0], [0, 1]], atol=1e-15)


def test_a_stiff_current_source_turns_the_axis_into_the_rotor():
    # a large resistance, driven by R i, is a current source: the two models must agree on the mechanics
    axis = model("one-axis").matrices({**FALLING, "R": 1e9, "L": 1e-3})
    rotor = model("rotor").matrices(FALLING)
    np.testing.assert_array_equal(axis.A[:2, :2], rotor.A)
    np.testing.assert_array_equal(axis.A[:2, 2:], rotor.B)
    np.testing.assert_array_equal(axis.E[:2, :1], rotor.E)


def test_a_negative_spring_is_unstable_and_a_positive_one_is_not():
    assert np.linalg.eigvals(model("rotor").matrices(FALLING).A).real.max() == pytest.approx(np.sqrt(1.29e5 / 4))
    assert np.linalg.eigvals(model("rotor").matrices(SPRUNG).A).real.max() < 0
    assert np.linalg.eigvals(model("one-axis").matrices(BEARING).A).real.max() > 0
    assert np.linalg.eigvals(model("one-axis").matrices(THESIS).A).real.max() < 0


@pytest.mark.parametrize("name", model_names())
def test_names_fit_shapes_and_units(name):
    of = model(name)
    s = of.matrices({**THESIS, **{p.name: 1.0 for p in of.parameters}})
    assert s.A.shape == (len(of.states),) * 2
    assert s.B.shape == (len(of.states), len(of.inputs))
    assert s.E.shape == (len(of.states), len(of.disturbances))
    assert s.C.shape == (len(of.outputs), len(of.states))
    assert set(of.units) >= {*of.inputs, *of.outputs, *of.states, *of.disturbances}
    for row, output in zip(s.C, of.outputs, strict=True):
        assert row[of.states.index(output)] == 1.0


@pytest.mark.parametrize("name", model_names())
def test_an_unknown_parameter_is_refused_by_name(name):
    theta = {p.name: 1.0 for p in model(name).parameters}
    with pytest.raises(ModelError, match=r"no parameter 'Q'.*it has"):
        model(name).derivative(theta, "Q")


def test_an_unknown_model_names_the_nearest():
    with pytest.raises(ModelError, match="Did you mean 'one-axis'"):
        model("oneaxis")
    assert nearest("zzz", ["coil"]) == ""


def test_references_are_critical_damping():
    # c of the rotor alone: sqrt(m |k_x|); of the axis: the stiffness k_i^2/L of a shorted coil where it is larger
    assert model("rotor").references(SPRUNG)["c"] == pytest.approx(np.sqrt(0.5 * 8e4))
    assert model("one-axis").references(THESIS)["c"] == pytest.approx(np.sqrt(0.1 * 310.08**2 / 59.6e-3))
    assert not model("coil").references(COIL)
