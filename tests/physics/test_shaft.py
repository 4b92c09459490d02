"""The rotor from drawings: exact beams, an independent transfer-matrix solution, and the independent simulator."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from ambid.errors import ModelError
from ambid.physics import Disc, Material, Shaft, Step, Support, campbell
from tests.rotor_benches import needs_simulator, truth

STEEL = Material(E=2.11e11, rho=7810.0, nu=0.3)
RPM = math.pi / 30
TWO_SLEEVES = Shaft(  # of thesis chapter 6: two sleeves, a disc between them
    steps=tuple(
        Step(length=length, diameter=d)
        for length, d in zip(
            (0.06, 0.08, 0.21, 0.05, 0.21, 0.08, 0.06), (0.022, 0.036, 0.026, 0.040, 0.026, 0.036, 0.022), strict=True
        )
    ),
    discs=(
        Disc(z=0.10, m=0.90, Id=6.0e-4, Ip=9.0e-4),
        Disc(z=0.375, m=2.40, Id=4.2e-3, Ip=8.0e-3),
        Disc(z=0.65, m=0.95, Id=6.3e-4, Ip=9.4e-4),
    ),
    material=STEEL,
)
HOLLOW = Shaft(
    steps=(
        Step(length=0.1, diameter=0.04, bore=0.02),
        Step(length=0.25, diameter=0.06, bore=0.03),
        Step(length=0.1, diameter=0.03),
    ),
    discs=(Disc.of_geometry(z=0.45, outer=0.14, inner=0.03, width=0.02, rho=7810.0),),
    material=STEEL,
)


def test_slender_beam_has_the_frequencies_of_euler_and_bernoulli() -> None:
    length, d = 1.0, 1e-4
    rotor = Shaft(steps=(Step(length=length, diameter=d),), material=STEEL).free_rotor(4)
    wave = np.array([4.730040745, 7.853204624, 10.995607838, 14.137165491])  # cos x cosh x = 1
    exact = wave**2 * math.sqrt(STEEL.E * d**2 / 16 / STEEL.rho) / length**2
    np.testing.assert_allclose(rotor.omega[2:], exact, rtol=5e-6)
    x = rotor.deflection([0.0, 0.5, 1.0])[:, 2]  # of unit mass: 2/sqrt(m) at the ends
    np.testing.assert_allclose(x, 2 / math.sqrt(rotor.mass[0]) * np.array([1.0, -0.608, 1.0]), rtol=1e-3)


def test_mass_and_moments_of_inertia_are_those_of_cylinders() -> None:
    m, z_cg, i_d, i_p = 0.0, 0.0, 0.0, 0.0
    bodies, z = [], 0.2
    for s in HOLLOW.steps:
        bodies.append(Disc.of_geometry(z=z + s.length / 2, outer=s.diameter, inner=s.bore, width=s.length, rho=7810.0))
        z += s.length
    bodies += [replace(disc, z=0.2 + disc.z) for disc in HOLLOW.discs]
    m = sum(b.m for b in bodies)
    z_cg = sum(b.m * b.z for b in bodies) / m
    i_d, i_p = sum(b.Id + b.m * (b.z - z_cg) ** 2 for b in bodies), sum(b.Ip for b in bodies)
    assert bodies[0].m == pytest.approx(7810 * math.pi * (0.04**2 - 0.02**2) / 4 * 0.1)
    rotor = replace(HOLLOW, z=0.2, discs=(bodies[-1],)).free_rotor(3)
    assert (rotor.mass[0], rotor.mass[1], rotor.gyro[1, 1], rotor.z_cg) == pytest.approx((m, i_d, i_p, z_cg), rel=1e-11)
    np.testing.assert_array_equal(rotor.mass[2:], 1.0)
    np.testing.assert_allclose(rotor.gyro[0], 0.0, atol=1e-12)


def determinant(shaft: Shaft, w: float, speed: float, springs: dict[float, float]) -> float:
    """Exact Timoshenko beam in forward whirl at `w` (backward: negative), left end to right end: zero at a mode.

    State: deflection, rotation, moment, shear force; the diametral inertia is Id w² - Ip w W.
    """
    at = np.concatenate([[0.0], np.cumsum([s.length for s in shaft.steps])])
    planes = sorted({*at, *(d.z for d in shaft.discs), *springs})
    kept = [planes[0], *(b for a, b in pairwise(planes) if b - a > 1e-9)]
    state = np.eye(4)[:, :2]  # free end: no moment, no shear
    for a, b in pairwise([*kept, kept[-1]]):
        for plane, k in springs.items():
            if abs(plane - a) < 1e-9:
                state[3] += k * state[0]
        for disc in shaft.discs:
            if abs(disc.z - a) < 1e-9:
                state[2] -= (disc.Id * w**2 - disc.Ip * w * speed) * state[1]
                state[3] -= disc.m * w**2 * state[0]
        if b > a:
            s = shaft.steps[int(np.searchsorted(at, (a + b) / 2)) - 1]
            area, i = math.pi * (s.diameter**2 - s.bore**2) / 4, math.pi * (s.diameter**4 - s.bore**4) / 64
            q = s.bore / s.diameter
            kappa = 6 * 1.3 * (1 + q**2) ** 2 / (8.8 * (1 + q**2) ** 2 + 23.6 * q**2)  # Cowper 1966, nu = 0.3
            shear, bend = kappa * STEEL.E / 2.6 * area, STEEL.E * i
            turn = STEEL.rho * i * (w**2 - 2 * w * speed)
            A = np.array(
                [[0, 1, 0, 1 / shear], [0, 0, 1 / bend, 0], [0, -turn, 0, -1], [-STEEL.rho * area * w**2, 0, 0, 0]]
            )
            state = expm(A * (b - a)) @ state
    return float(np.linalg.det(state[2:]))


@pytest.mark.parametrize("shaft", [TWO_SLEEVES, HOLLOW], ids=["two sleeves", "hollow"])
@pytest.mark.parametrize(("rpm", "stiffness"), [(0.0, 0.0), (20_000.0, 0.0), (20_000.0, 3e6)])
def test_frequencies_are_those_of_the_transfer_matrix(shaft: Shaft, rpm: float, stiffness: float) -> None:
    planes = (0.1, 0.35)
    supports = [Support(z=z, stiffness=stiffness) for z in planes] if stiffness else []
    whirl = campbell(shaft, [rpm * RPM], supports, lines=8)
    checked = 0
    for f, direction in zip(whirl.frequency[0], whirl.direction[0], strict=True):
        if f < 100.0:  # tilting of the free rotor
            continue
        w = math.copysign(f, direction)

        def zero(x: float, w: float = w) -> float:
            return determinant(shaft, w * x, rpm * RPM, dict.fromkeys(planes, stiffness) if stiffness else {})

        assert brentq(zero, 0.999, 1.001, xtol=1e-9) == pytest.approx(1.0, abs=5e-4)
        checked += 1
    assert checked >= 6


@needs_simulator
def test_the_shaft_of_the_independent_simulator_comes_out_alike() -> None:
    # with so many elements that its discs stand on nodes: 145.66, 516.18, 997.16 Hz
    fine = replace(truth.SHAFT, elements_per_metre=120.0)
    modal = truth.modal_of(
        truth.Bench("fine", shaft=fine, modes=4, zeta=(0.004,) * 4, z_bearing=(0.1, 0.65), z_sensor=(0.13, 0.62))
    )
    rotor = replace(TWO_SLEEVES, zeta=(0.004,)).free_rotor(4, planes=(0.1, 0.13, 0.62, 0.65))
    np.testing.assert_allclose(rotor.omega, modal.omega, rtol=1e-4)
    np.testing.assert_allclose(rotor.mass, modal.mass, rtol=1e-10)
    np.testing.assert_allclose(rotor.zeta, modal.zeta)
    np.testing.assert_allclose(rotor.gyro, modal.gyro, atol=2e-3 * abs(modal.gyro).max())
    np.testing.assert_allclose(rotor.deflection([0.1, 0.65]), modal.bearing, atol=1e-4)
    np.testing.assert_allclose(rotor.deflection([0.13, 0.62]), modal.sensor, atol=1e-4)


def test_mode_shapes_are_orthogonal_and_rise_at_the_left() -> None:
    rotor = replace(TWO_SLEEVES, discs=()).free_rotor(5)
    assert np.all(rotor.shape[0, 0] > 0) or rotor.shape[0, 0, 1] < 0  # the tilt falls to the left of its centre
    z = np.linspace(0.0, TWO_SLEEVES.length, 2001)
    slender = rotor.deflection(z), rotor.slope(z)
    np.testing.assert_allclose(
        np.gradient(slender[0][:, 2], z)[5:-5], slender[1][5:-5, 2], atol=0.02 * abs(slender[1][:, 2]).max()
    )


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Step(length=0.0, diameter=0.1), "length 0; it must be positive"),
        (lambda: Step(length=0.1, diameter=0.1, bore=0.1), "bore of 0.1 m"),
        (lambda: Material(E=2e11, rho=7800, nu=0.6), "Poisson's ratio is 0.6"),
        (lambda: Disc(z=0.0, m=-1.0), "mass -1"),
        (lambda: Disc.of_geometry(z=0.0, outer=0.1, inner=0.2, width=0.1, rho=1.0), "inner diameter of 0.2 m"),
        (lambda: Shaft(steps=(), material=STEEL), "no steps"),
        (lambda: replace(TWO_SLEEVES, discs=(Disc(z=0.8, m=1.0),)), "a disc lies at 0.8 m, outside the shaft"),
        (lambda: TWO_SLEEVES.free_rotor(3, planes=(-0.1,)), "a plane lies at -0.1 m"),
        (lambda: TWO_SLEEVES.free_rotor(3).deflection(0.9), "a plane lies at 0.9 m"),
        (lambda: TWO_SLEEVES.free_rotor(500), "500 bending modes are asked for"),
    ],
)  # fmt: skip
def test_an_impossible_shaft_is_refused(make, says: str) -> None:
    with pytest.raises(ModelError, match=says):
        make()
