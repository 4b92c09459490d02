"""The bridge from a magnet law to a plant: derivatives of one co-energy, rest points, and what is refused."""

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.physics.coenergy_law import MagnetLaw, law_numbers
from ambid.physics.law_magnet import LawMagnet
from ambid.physics.magnet import DifferentialPair, SingleMagnet

IDEAL = (
    (SingleMagnet(k=1.3e-4, leakage=0.1), MagnetLaw(), 0.010, 0.9),
    (
        DifferentialPair(turns=138, area=470e-6, bias=1.0, gap=0.43e-3, leakage=2e-3), MagnetLaw(pair=True), 8e-5, -0.3,
    ),
)  # fmt: skip
COIL = {"L_leak": 0.08, "L_rise": 0.03, "i_knee": 0.6, "sigma": 0.4}
LAWS = (
    LawMagnet(
        law=MagnetLaw(gap="exponential", saturation=True, rise=True), values={"L_g": 0.06, "zeta": 5e-3, **COIL},
        x_offset=1e-3,
    ),
    LawMagnet(law=MagnetLaw(saturation=True, rise=True), values={"k": 1.3e-4, "s": 2e-3, **COIL}),
    LawMagnet(
        law=MagnetLaw(pair=True, saturation=True, asymmetric=True), x_offset=-2e-3,
        values={"k": 1e-4, "s": 0.03, "i0": 1.2, "k_asym": -0.1, "i0_asym": 0.05, **COIL},
    ),
)  # fmt: skip


@pytest.mark.parametrize(("magnet", "law", "x", "i"), IDEAL)
def test_an_ideal_magnet_is_the_same_plant(magnet, law, x, i) -> None:
    w, off = magnet.coenergy, 3e-5
    same = LawMagnet(law=law, values=law_numbers(w), x_offset=off)
    for name in ("value", "force", "flux_linkage", "force_per_current", "displacement_coefficient"):
        assert getattr(same, name)(x + off, i) == pytest.approx(getattr(w, name)(x, i), rel=1e-12), name
    assert same.inductance(x + off, i) == pytest.approx(w.inductance(x), rel=1e-12)
    assert same.range == pytest.approx(tuple(end + off for end in magnet.range))
    assert same.holding_current(x + off, 0.6) == pytest.approx(magnet.holding_current(x, 0.6), rel=1e-12)


@pytest.mark.parametrize("magnet", LAWS)
def test_everything_is_a_slope_of_the_energy_and_of_the_flux(magnet) -> None:
    x, i, h = 0.008, 0.7, 1e-30
    assert magnet.force(x, i) == pytest.approx(magnet.value(complex(x, h), complex(i)).imag / h, rel=1e-12)
    assert magnet.flux_linkage(x, i) == pytest.approx(magnet.value(complex(x), complex(i, h)).imag / h, rel=1e-12)
    d = 1e-6
    assert magnet.inductance(x, i) == pytest.approx(
        (magnet.flux_linkage(x, i + d) - magnet.flux_linkage(x, i - d)) / (2 * d), rel=1e-8
    )
    assert magnet.force_per_current(x, i) == pytest.approx(
        (magnet.force(x, i + d) - magnet.force(x, i - d)) / (2 * d), rel=1e-8
    )
    slope = (magnet.force(x + d, i) - magnet.force(x - d, i)) / (2 * d)
    assert magnet.displacement_coefficient(x, i) == pytest.approx(-slope, rel=1e-6)


@pytest.mark.parametrize("magnet", LAWS)
def test_the_holding_current_holds(magnet) -> None:
    for load in (0.02, 0.1):
        i = magnet.holding_current(0.008, load)
        assert magnet.force(0.008, i) == pytest.approx(-load, rel=1e-12)
        assert np.abs(i) < 3.0


def test_what_is_no_magnet_is_refused() -> None:
    with pytest.raises(ModelError, match="no value for s"):
        LawMagnet(law=MagnetLaw(), values={"k": 1e-4})
    with pytest.raises(ModelError, match="no value for sigma"):
        LawMagnet(law=MagnetLaw(saturation=True), values={"k": 1e-4, "s": 0.0})
    with pytest.raises(ModelError, match="k is 0"):
        LawMagnet(law=MagnetLaw(), values={"k": 0.0, "s": 0.0})
    with pytest.raises(ModelError, match="L_leak is -1"):
        LawMagnet(law=MagnetLaw(), values={"k": 1e-4, "s": 0.0, "L_leak": -1.0})
    with pytest.raises(ModelError, match="i0_asym below i0"):
        LawMagnet(law=LAWS[2].law, values={**LAWS[2].values, "i0_asym": 2.0})
    with pytest.raises(ModelError, match="closes an air gap"):
        LAWS[1].holding_current(-0.003, 1.0)
    with pytest.raises(ModelError, match="only attracts"):
        LAWS[0].holding_current(0.01, 0.0)
    with pytest.raises(ModelError, match="more than the bias"):
        LAWS[2].holding_current(0.008, 10.0)
