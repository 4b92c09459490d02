"""One co-energy behind force, k_i, k_x, L: derivatives by complex step, the ideal magnets as special cases."""

from itertools import product

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.physics.coenergy_law import FIRST, MAGNET_NUMBERS, MagnetLaw, coenergy_derivatives, law_numbers
from ambid.physics.presets import preset

NUMBERS = {"k": 2e-4, "s": 2.5e-3, "L_g": 0.04, "zeta": 6.3e-3, "sigma": 0.4, "L_leak": 0.05, "L_rise": 0.06,
           "i_knee": 0.28, "i0": 1.0}  # fmt: skip
LAWS = [
    MagnetLaw(gap=gap, pair=pair, saturation=True, rise=True)
    for gap, pair in (("hyperbolic", False), ("exponential", False), ("hyperbolic", True))
]
POINTS = ((1e-3, 0.2), (-0.8e-3, 0.1), (1.7e-3, -0.22), (0.0, 0.05))


def derivatives(law, x, i, numbers):
    w, dw = np.zeros(8), np.zeros((FIRST, len(MAGNET_NUMBERS)))
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
    for one, other in ((1, by_x[0]), (4, by_x[1]), (5, by_x[2]), (6, by_x[3]), (2, by_i[0]), (7, by_i[3])):
        assert w[one] == pytest.approx(other, rel=1e-5, abs=1e-5 * size[one])
    for j, name in enumerate(law.names):
        h = 1e-6 * NUMBERS[name]
        up, down = ({**NUMBERS, name: NUMBERS[name] + d} for d in (h, -h))
        slope = (derivatives(law, x, i, up)[0] - derivatives(law, x, i, down)[0])[:FIRST] / (2 * h)
        assert dw[:, j] == pytest.approx(slope, rel=1e-5, abs=1e-7 * np.abs(w[:FIRST] / NUMBERS[name]).max())


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
