"""Campbell diagrams and critical speeds: closed forms, the direct eigenproblem, and published rotors."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh

from ambid.errors import ModelError
from ambid.physics import Disc, FreeRotor, Material, Shaft, Step, Support, campbell, critical_speeds
from tests.physics.test_shaft import TWO_SLEEVES

RPM = math.pi / 30
RIGID = FreeRotor(
    z_cg=0.0, mass=np.array([6.0, 0.05]), omega=np.zeros(2), zeta=np.zeros(2), gyro=np.diag([0.0, 0.02]),
    z=np.array([-0.2, 0.2]), shape=np.array([[[1.0, -0.2], [0.0, 1.0]], [[1.0, 0.2], [0.0, 1.0]]]),
)  # fmt: skip


def test_a_free_rigid_rotor_nutates_at_ip_over_id() -> None:
    whirl = campbell(RIGID, [100.0, 1000.0])
    np.testing.assert_allclose(whirl.frequency, [[40.0], [400.0]], rtol=1e-12)
    np.testing.assert_allclose(whirl.direction, 1.0)


def test_a_rigid_rotor_on_springs_whirls_as_the_quadratic_says() -> None:
    k, speed = 2e5, 3000.0
    whirl = campbell(RIGID, [0.0, speed], [Support(z=-0.1, stiffness=k), Support(z=0.1, stiffness=k)])
    translation = math.sqrt(2 * k / 6.0)
    half, root = 0.02 * speed / (2 * 0.05), 2 * k * 0.1**2 / 0.05
    conical = [math.hypot(half, math.sqrt(root)) - half, math.hypot(half, math.sqrt(root)) + half]
    assert sorted(whirl.frequency[-1]) == pytest.approx(sorted([translation, translation, *conical]), rel=1e-9)
    assert whirl.direction[-1][np.argsort(whirl.frequency[-1])][[0, -1]] == pytest.approx([-1.0, 1.0])


def test_a_magnet_without_control_has_no_whirl_and_damping_is_that_of_the_mass() -> None:
    pulled = [Support(z=z, stiffness=-1e5) for z in (-0.1, 0.1)]
    assert campbell(RIGID, [0.0, 10.0], pulled).poles.shape == (2, 0)
    held = [Support(z=z, stiffness=2e5, damping=100.0) for z in (-0.1, 0.1)]
    whirl = campbell(RIGID, [0.0], held)
    assert np.min(abs(whirl.damping - 200.0 / (2 * math.sqrt(4e5 * 6.0)))) < 1e-9


# Friswell, Penny, Garvey, Lees, Dynamics of Rotating Machines (2010), examples 5.9.1, 5.9.2, 5.9.5 (p. 206-212) and
# 5.9.9 (p. 218), six elements; the digits stand in the tests of ROSS 2.3.0 (ross/tests/test_examples.py), too
BOOK = Material(E=211e9, rho=7810.0, nu=211 / (2 * 81.2) - 1)


def book(*discs: tuple[float, float]) -> Shaft:
    found = tuple(Disc.of_geometry(z=z, outer=d, inner=0.05, width=0.07, rho=7810.0) for z, d in discs)
    return Shaft(steps=(Step(length=1.5, diameter=0.05),), discs=found, material=BOOK, elements=6)


TWO_DISCS, OVERHUNG = book((0.5, 0.28), (1.0, 0.35)), book((1.5, 0.35))
ALIKE = [Support(z=z, stiffness=1e6) for z in (0.0, 1.5)]
UNLIKE = [Support(z=z, stiffness=((1e6, 0.0), (0.0, 8e5))) for z in (0.0, 1.5)]
STIFF = [Support(z=z, stiffness=1e7) for z in (0.0, 1.0)]


@pytest.mark.parametrize(
    ("shaft", "supports", "rpm", "published"),
    [
        (TWO_DISCS, ALIKE, 0, [86.66, 86.66, 274.31, 274.31, 716.78, 716.78]),
        (TWO_DISCS, ALIKE, 4000, [85.39, 87.80, 251.78, 294.71, 600.18, 827.08]),
        (TWO_DISCS, UNLIKE, 0, [82.65, 86.66, 254.52, 274.31, 679.49, 716.79]),
        (TWO_DISCS, UNLIKE, 4000, [82.33, 86.86, 239.64, 287.25, 583.49]),
        (OVERHUNG, STIFF, 0, [90.14, 90.14, 630.73, 630.73, 830.43, 830.43]),
        (OVERHUNG, STIFF, 4000, [76.19, 103.91, 565.99, 634.23, 647.75, 1174.2]),
    ],
)  # fmt: skip
def test_the_rotors_of_friswell_have_their_published_frequencies(shaft, supports, rpm, published) -> None:
    whirl = campbell(shaft, [rpm * RPM], supports, lines=len(published))
    np.testing.assert_allclose(whirl.frequency[0], published, rtol=1e-4)
    fine = campbell(replace(shaft, elements=60), [rpm * RPM], supports, lines=len(published))
    np.testing.assert_allclose(fine.frequency[0], published, rtol=1e-3)


def test_damped_bearings_give_the_published_damped_frequencies() -> None:
    supports = [Support(z=z, stiffness=1e6, damping=3e3) for z in (0.0, 1.5)]
    whirl = campbell(TWO_DISCS, [0.0], supports, lines=6)
    np.testing.assert_allclose(whirl.frequency[0, ::2] / (2 * np.pi), [13.89, 46.54, 103.22], rtol=2e-4)
    np.testing.assert_allclose(abs(whirl.poles[0, ::2]) / (2 * np.pi), [13.91, 48.18, 137.06], rtol=4e-4)


# Lalanne and Ferraris, Rotordynamics Prediction in Engineering (1998), rotor with three discs on unlike bearings
THREE_DISCS = Shaft(
    steps=(Step(length=1.3, diameter=0.1),),
    discs=tuple(
        Disc.of_geometry(z=z, outer=d, inner=0.1, width=w, rho=7800.0)
        for z, d, w in ((0.2, 0.24, 0.05), (0.5, 0.40, 0.05), (1.0, 0.40, 0.06))
    ),
    material=Material(E=2e11, rho=7800.0, nu=0.3),
)
JOURNALS = [Support(z=z, stiffness=((5e7, 0.0), (0.0, 7e7)), damping=((500.0, 0.0), (0.0, 700.0))) for z in (0.0, 1.3)]


def test_the_rotor_of_lalanne_and_ferraris_has_its_published_frequencies_and_critical_speeds() -> None:
    f = campbell(THREE_DISCS, np.linspace(0.0, 25_000 * RPM, 6), JOURNALS, lines=11).frequency / (2 * np.pi)
    published = [55.408, 67.209, 157.90, 193.71, 249.90, 407.62, 446.62, 715.03, 622.65]
    np.testing.assert_allclose(f[-1, :9], published, rtol=1e-3)  # the last two lines have crossed
    assert np.min(abs(f[-1, 9:] - 1093.0)) < 1.0  # two lines repel each other there
    found = [c.speed / RPM for c in critical_speeds(THREE_DISCS, 30_000 * RPM, JOURNALS, lines=10)]
    np.testing.assert_allclose(found, [3620, 3798, 10018, 11279, 16785, 24409, 26611], rtol=1.1e-3)


def test_critical_speeds_solve_their_eigenproblem() -> None:
    supports = [Support(z=0.1, stiffness=((4e6, 0.0), (0.0, 2e6))), Support(z=0.65, stiffness=3e6)]
    rotor = TWO_SLEEVES.free_rotor(12, planes=(0.1, 0.65), residual=True)
    n = rotor.mass.size
    K = np.kron(np.eye(2), np.diag(rotor.mass * rotor.omega**2))
    for s in supports:
        row = rotor.deflection(s.z)[0]
        k = s.stiffness * np.eye(2) if isinstance(s.stiffness, float) else np.array(s.stiffness)
        K += np.kron(k, np.outer(row, row))
    M = np.kron(np.eye(2), np.diag(rotor.mass)).astype(complex)
    M += -1j * np.kron([[0, 1], [-1, 0]], rotor.gyro)  # K q = W² (M - j G) q
    inverse, _ = eigh(M, K)
    exact = np.sort(1 / np.sqrt(inverse[inverse > 0]))
    exact = exact[exact < 40_000 * RPM]
    found = critical_speeds(rotor, 40_000 * RPM, supports)
    assert exact.size >= 6
    np.testing.assert_allclose([c.speed for c in found], exact, rtol=1e-6)
    assert {np.sign(c.direction) for c in found} == {-1.0, 1.0}
    assert n == rotor.gyro.shape[0]


def test_a_mode_is_followed_through_crossings_whatever_the_step_of_speed() -> None:
    fine = campbell(THREE_DISCS, np.linspace(0.0, 30_000 * RPM, 61), JOURNALS, lines=10)
    coarse = campbell(THREE_DISCS, [0.0, 30_000 * RPM], JOURNALS, lines=10)
    np.testing.assert_allclose(coarse.poles[-1], fine.poles[-1], rtol=1e-9)
    assert np.any(np.diff(fine.frequency[-1]) < 0)  # lines did cross
    assert np.max(abs(np.diff(fine.frequency, 2, axis=0)) / fine.frequency[1:-1]) < 0.01  # and none has a kink


def test_few_coordinates_with_their_residual_stand_for_the_whole_shaft() -> None:
    supports = [Support(z=0.1, stiffness=1e8, damping=2e3), Support(z=0.65, stiffness=2e7)]
    whole = TWO_SLEEVES.free_rotor(118, planes=(0.1, 0.65))
    wanted = campbell(whole, [20_000 * RPM], supports, lines=8)
    np.testing.assert_allclose(campbell(TWO_SLEEVES, [20_000 * RPM], supports, lines=8).poles, wanted.poles, rtol=1e-7)


def test_what_cannot_be_drawn_is_refused() -> None:
    for speeds in ([], [10.0, 5.0], [-1.0, 2.0]):
        with pytest.raises(ModelError, match="have to rise"):
            campbell(RIGID, speeds)
    with pytest.raises(ModelError, match="it shows at most 12"):
        campbell(TWO_DISCS, [0.0], ALIKE, lines=14)
    with pytest.raises(ModelError, match="must be positive"):
        critical_speeds(RIGID, 0.0)


def test_every_step_of_a_shaft_counts_as_an_element() -> None:
    coarse = campbell(replace(TWO_SLEEVES, elements=1), [0.0], lines=5).frequency[0]
    fine = campbell(TWO_SLEEVES, [0.0], lines=5).frequency[0]
    np.testing.assert_allclose(coarse[1:], fine[1:], rtol=0.01)
