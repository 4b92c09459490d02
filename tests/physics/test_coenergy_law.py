"""One co-energy behind force, k_i, k_x, L: derivatives by complex step, the ideal magnets as special cases."""

from itertools import product

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.physics.coenergy_law import MAGNET_NUMBERS, ORDERS, SLOPED, MagnetLaw, coenergy_derivatives, law_numbers
from ambid.physics.magnet import DifferentialPair
from ambid.physics.presets import preset

NUMBERS = {"k": 2e-4, "s": 2.5e-3, "L_g": 0.04, "zeta": 6.3e-3, "sigma": 0.4, "L_leak": 0.05, "L_rise": 0.06,
           "i_knee": 0.28, "i0": 1.0, "k_asym": 0.15, "i0_asym": -0.07}  # fmt: skip
LAWS = [
    MagnetLaw(gap=gap, pair=pair, saturation=True, rise=True, asymmetric=pair)
    for gap, pair in (("hyperbolic", False), ("exponential", False), ("hyperbolic", True))
]
POINTS = ((1e-3, 0.2), (-0.8e-3, 0.1), (1.7e-3, -0.22), (0.0, 0.05))


def derivatives(law, x, i, numbers):
    w, dw = np.zeros(len(ORDERS)), np.zeros((len(SLOPED), len(MAGNET_NUMBERS)))
    coenergy_derivatives(x, i, law.vector(numbers), law.gap == "exponential", law.pair, w, dw)
    return w, dw


@pytest.mark.parametrize("law", LAWS, ids=str)
@pytest.mark.parametrize("point", POINTS)
def test_force_and_flux_come_from_the_coenergy(law, point):
    x, i = point
    w, _ = derivatives(law, x, i, NUMBERS)
    force = law.value(x + 1e-30j, i + 0j, NUMBERS).imag / 1e-30
    assert w[0] == pytest.approx(force, rel=1e-12)

    def flux(x, i):
        return law.value(complex(x), complex(i, 1e-30), NUMBERS).imag / 1e-30

    h = 1e-5
    assert w[2] == pytest.approx((flux(x + h * 1e-2, i) - flux(x - h * 1e-2, i)) / (2e-2 * h), rel=1e-5)
    assert w[3] == pytest.approx((flux(x, i + h) - flux(x, i - h)) / (2 * h), rel=1e-6)


@pytest.mark.parametrize("law", LAWS, ids=str)
@pytest.mark.parametrize("point", POINTS)
def test_higher_derivatives_and_those_by_the_numbers(law, point):
    x, i = point
    hx, hi = 1e-8, 1e-5
    by_x = (derivatives(law, x + hx, i, NUMBERS)[0] - derivatives(law, x - hx, i, NUMBERS)[0]) / (2 * hx)
    by_i = (derivatives(law, x, i + hi, NUMBERS)[0] - derivatives(law, x, i - hi, NUMBERS)[0]) / (2 * hi)
    w, dw = derivatives(law, x, i, NUMBERS)
    size = np.abs(w) + 1e-6 * np.abs(w).max()
    for one, name in enumerate(ORDERS):
        if name[1:] in ORDERS and name[0] == "x":
            assert w[one] == pytest.approx(by_x[ORDERS.index(name[1:])], rel=1e-5, abs=1e-5 * size[one]), name
        if name[:-1] in ORDERS and name[-1] == "i":
            assert w[one] == pytest.approx(by_i[ORDERS.index(name[:-1])], rel=1e-5, abs=1e-5 * size[one]), name
    rows = [ORDERS.index(name) for name in SLOPED]
    for j, name in enumerate(law.names):
        h = 1e-6 * abs(NUMBERS[name])
        up, down = ({**NUMBERS, name: NUMBERS[name] + d} for d in (h, -h))
        slope = (derivatives(law, x, i, up)[0] - derivatives(law, x, i, down)[0])[rows] / (2 * h)
        if not law.pair and name in ("i0", "k_asym", "i0_asym"):
            assert not dw[:, j].any()
        assert dw[:, j] == pytest.approx(slope, rel=1e-5, abs=1e-7 * np.abs(w[rows] / NUMBERS[name]).max()), name


@pytest.mark.parametrize("law", LAWS, ids=str)
@pytest.mark.parametrize("point", POINTS)
def test_force_per_current_and_motional_voltage_are_one_number(law, point):
    """dF/di = dlambda/dx: force and flux linkage, each by complex step, differ by differencing the other way round."""
    x, i = point
    w, _ = derivatives(law, x, i, NUMBERS)
    force, flux, h = (lambda j: law.value(x + 1e-40j, complex(j), NUMBERS).imag / 1e-40,
                      lambda at: law.value(complex(at), i + 1e-40j, NUMBERS).imag / 1e-40, 1e-4)  # fmt: skip

    def slope(f, at, step):  # Richardson's extrapolation of central differences: error of the order step^6
        d = [(f(at + step / k) - f(at - step / k)) / (2 * step / k) for k in (1, 2, 4)]
        one, two = (4 * d[1] - d[0]) / 3, (4 * d[2] - d[1]) / 3
        return (16 * two - one) / 15

    by_current, by_position = slope(force, i, 1e-2), slope(flux, x, h)
    assert by_current == pytest.approx(by_position, rel=1e-6)
    assert w[ORDERS.index("xi")] == pytest.approx(by_position, rel=1e-6)


def test_a_closed_path_of_position_and_current_takes_no_energy_from_the_field():
    """Electrical work i dlambda is what the force does, round a closed path: nothing is made, nothing lost."""
    from scipy.integrate import quad

    for law in LAWS:
        q = law.vector(NUMBERS)

        def power(t, law=law, q=q):
            x, i = 4e-4 * np.cos(t), 0.15 + 0.1 * np.sin(t)
            dx, di = -4e-4 * np.sin(t), 0.1 * np.cos(t)
            w, dw = np.zeros(len(ORDERS)), np.zeros((len(SLOPED), len(MAGNET_NUMBERS)))
            coenergy_derivatives(x, i, q, law.gap == "exponential", law.pair, w, dw)
            return i * (w[2] * dx + w[3] * di), w[0] * dx  # lambda' = W_xi x' + W_ii i'

        electrical, mechanical = (quad(lambda t, c=c: power(t)[c], 0, 2 * np.pi)[0] for c in (0, 1))
        assert abs(mechanical) > 1e-7
        assert electrical == pytest.approx(mechanical, rel=1e-9), str(law)


@pytest.mark.parametrize("name", ["unstable-bearing", "levitated-ball", "prototype"])
def test_the_ideal_magnets_are_special_cases(name):
    magnet = preset(name).plant.magnet
    ideal, numbers = magnet.coenergy, law_numbers(magnet.coenergy)
    law = MagnetLaw(pair=ideal.k_a > 0)
    low = 2e-3 if not law.pair else -0.6 * ideal.s_a
    for x, i in product(np.linspace(low, 0.6 * ideal.s_a if law.pair else 15e-3, 4), (-0.4, 0.3, 0.9)):
        table, _ = law.table(np.array([x]), np.array([i]), numbers)
        wanted = [ideal.force(x, i), ideal.displacement_coefficient(x, i), ideal.force_per_current(x, i),
                  ideal.inductance(x)]  # fmt: skip
        assert table[0] == pytest.approx(wanted, rel=1e-12)


def test_saturated_iron_pulls_in_proportion_to_the_current():
    law = MagnetLaw(saturation=True)
    strong = {**NUMBERS, "sigma": 1e4}
    force = law.table(np.full(2, 5e-3), np.array([1.0, 2.0]), strong)[0][:, 0]
    assert force[1] / force[0] == pytest.approx(2.0, rel=0.02)
    linear = law.table(np.full(2, 5e-3), np.array([1.0, 2.0]), {**NUMBERS, "sigma": 0.0})[0][:, 0]
    assert linear[1] / linear[0] == pytest.approx(4.0, rel=1e-12)


def test_a_pair_has_no_exponential_gap():
    with pytest.raises(ModelError, match="hyperbolic"):
        MagnetLaw(pair=True, gap="exponential")


def test_only_a_pair_can_be_unequal():
    with pytest.raises(ModelError, match="pair=True"):
        MagnetLaw(asymmetric=True)


def test_a_pair_of_the_presets_is_a_case_of_the_law_too():
    magnet = DifferentialPair(turns=138, area=470e-6, bias=1.0, gap=0.43e-3, leakage=2e-3)
    ideal, numbers = magnet.coenergy, law_numbers(magnet.coenergy)
    x, i = 1.3e-4, 0.4
    table, _ = MagnetLaw(pair=True).table(np.array([x]), np.array([i]), numbers)
    wanted = [ideal.force(x, i), ideal.displacement_coefficient(x, i), ideal.force_per_current(x, i),
              ideal.inductance(x)]  # fmt: skip
    assert table[0] == pytest.approx(wanted, rel=1e-12)
    assert ideal.force(x, magnet.holding_current(x, 12.0)) == pytest.approx(-12.0, rel=1e-9)
