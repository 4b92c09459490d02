"""Magnets: force, flux and linearisation come from one co-energy; the printed bearing numbers follow."""

import math

import pytest

from ambid.errors import ModelError
from ambid.physics.magnet import MU_0, CoEnergy, DifferentialPair, SingleMagnet

STEP = 1e-30
PAIR = DifferentialPair(turns=138, area=470.3e-6, bias=1.0, gap=0.432e-3, half_angle=0.392, leakage=2e-3)
BALL = SingleMagnet(k=1.3e-4, leakage=0.1)
POINTS = [(PAIR.coenergy, 0.0, 0.0), (PAIR.coenergy, 1.1e-4, -0.4), (BALL.coenergy, 0.010, 0.95)]


def test_bearing_has_its_published_stiffnesses() -> None:
    w = PAIR.coenergy
    assert w.force_per_current(0.0, 0.0) == pytest.approx(55.7, abs=0.05)
    assert w.displacement_coefficient(0.0, 0.0) == pytest.approx(-1.29e5, rel=1e-3)


def test_pair_obeys_the_design_formulas() -> None:
    k = MU_0 * 138**2 * 470.3e-6 / 4.0
    w = PAIR.coenergy
    assert w.force_per_current(0.0, 0.0) == pytest.approx(4 * k / 0.432e-3**2 * math.cos(0.392), rel=1e-14)
    assert w.displacement_coefficient(0.0, 0.0) == pytest.approx(-4 * k / 0.432e-3**3 * math.cos(0.392), rel=1e-14)


def test_single_magnet_obeys_the_force_law() -> None:
    magnet = SingleMagnet(k=MU_0 * 200**2 * 1e-4)
    assert magnet.coenergy.force(2e-3, 1.5) == pytest.approx(-0.5 * magnet.k * (1.5 / 2e-3) ** 2, rel=1e-14)
    # Maxwell's stress B^2 A/(2 mu0) with B = mu0 n i/gap: the same number by another way
    b = MU_0 * 200 * 1.5 / 2e-3
    assert magnet.coenergy.force(2e-3, 1.5) == pytest.approx(-(b**2) * 1e-4 / (2 * MU_0), rel=1e-14)


@pytest.mark.parametrize(("w", "x", "i"), POINTS)
def test_force_and_flux_are_the_slopes_of_the_coenergy(w: CoEnergy, x: float, i: float) -> None:
    assert w.value(complex(x, STEP), complex(i)).imag / STEP == pytest.approx(w.force(x, i), rel=1e-12, abs=1e-15)
    assert w.value(complex(x), complex(i, STEP)).imag / STEP == pytest.approx(w.flux_linkage(x, i), rel=1e-12)


@pytest.mark.parametrize(("w", "x", "i"), POINTS)
def test_linearisation_equals_the_complex_step(w: CoEnergy, x: float, i: float) -> None:
    by_x, by_i = complex(x, STEP), complex(i, STEP)
    assert w.force(complex(x), by_i).imag / STEP == pytest.approx(w.force_per_current(x, i), rel=1e-9)
    assert w.force(by_x, complex(i)).imag / STEP == pytest.approx(-w.displacement_coefficient(x, i), rel=1e-9)
    assert w.flux_linkage(complex(x), by_i).imag / STEP == pytest.approx(w.inductance(x), rel=1e-9)
    # the motional voltage per velocity is the force per current
    assert w.flux_linkage(by_x, complex(i)).imag / STEP == pytest.approx(w.force_per_current(x, i), rel=1e-9)


def test_pair_without_leakage_has_inductance_times_stiffness_equal_to_k_i_squared() -> None:
    w = DifferentialPair(turns=138, area=470.3e-6, bias=1.0, gap=0.432e-3, half_angle=0.392).coenergy
    assert -w.inductance(0.0) * w.displacement_coefficient(0.0, 0.0) == pytest.approx(
        w.force_per_current(0.0, 0.0) ** 2, rel=1e-14
    )


def test_pair_is_two_single_magnets() -> None:
    k, x, i = PAIR.coenergy.k_a, 0.7e-4, 0.3
    one = SingleMagnet(k=k).coenergy
    gap_plus, gap_minus = PAIR.gap - x, PAIR.gap + x
    assert PAIR.coenergy.force(x, i) == pytest.approx(
        -one.force(gap_plus, PAIR.bias + i) + one.force(gap_minus, PAIR.bias - i), rel=1e-13
    )
    first, second = one.flux_linkage(gap_plus, PAIR.bias + i), one.flux_linkage(gap_minus, PAIR.bias - i)
    assert PAIR.coenergy.flux_linkage(x, i) == pytest.approx(first - second + PAIR.leakage * i, rel=1e-13)


@pytest.mark.parametrize("load", [0.0, 39.24, -25.0])
@pytest.mark.parametrize("x", [0.0, 0.5e-4, -1e-4])
def test_pair_holds_a_load(x: float, load: float) -> None:
    assert PAIR.coenergy.force(x, PAIR.holding_current(x, load)) == pytest.approx(-load, abs=1e-9)


def test_single_magnet_holds_a_weight() -> None:
    assert BALL.coenergy.force(0.01, BALL.holding_current(0.01, 0.6)) == pytest.approx(-0.6, rel=1e-13)


def test_what_no_magnet_can_do_is_refused() -> None:
    with pytest.raises(ModelError, match="only attracts"):
        BALL.holding_current(0.01, -0.1)
    with pytest.raises(ModelError, match="bias"):
        PAIR.holding_current(0.0, 500.0)
    with pytest.raises(ModelError, match="air gap"):
        PAIR.holding_current(0.5e-3, 0.0)
    with pytest.raises(ModelError, match=r"gap is -0\.1"):
        DifferentialPair(turns=10, area=1e-4, bias=1.0, gap=-0.1)
