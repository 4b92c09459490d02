"""The nonlinear plant: rest points, linearisation, and the balance of energy."""

import pytest

from ambid.errors import ModelError
from ambid.physics.magnet import DifferentialPair, SingleMagnet
from ambid.physics.nonlinear import NonlinearPlant

PAIR = NonlinearPlant(
    magnet=DifferentialPair(turns=138, area=470.3e-6, bias=1.0, gap=0.432e-3, half_angle=0.392, leakage=1e-3),
    m=4.0,
    R=1.6,
    c=3.0,
    gravity=9.81,
)
BALL = NonlinearPlant(magnet=SingleMagnet(k=1.3e-4, leakage=0.1), m=0.06, R=4.2, gravity=9.81)


@pytest.mark.parametrize(("plant", "x"), [(PAIR, 0.0), (PAIR, 6e-5), (BALL, 0.009)])
def test_rests_at_its_equilibrium(plant: NonlinearPlant, x: float) -> None:
    point = plant.equilibrium(x)
    assert plant.derivative((x, 0.0, point.current), point.voltage) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


@pytest.mark.parametrize(("plant", "x"), [(PAIR, 0.0), (PAIR, 6e-5), (BALL, 0.009)])
def test_linearisation_gives_the_state_matrix_of_the_linear_model(plant: NonlinearPlant, x: float) -> None:
    from ambid.physics.linear_model import model

    point, h = plant.equilibrium(x), 1e-30
    a = model("one-axis").matrices(plant.linearise(x)).A
    for column in range(3):
        state = [complex(s) for s in (x, 0.0, point.current)]
        state[column] += 1j * h
        slopes = [d.imag / h for d in plant.derivative((state[0], state[1], state[2]), complex(point.voltage))]
        assert slopes == pytest.approx(a[:, column], rel=1e-9, abs=1e-9)


def test_gravity_balance_needs_no_magnet_data() -> None:
    # k_i/m = -2 g/i0 and k_x/m = -2 g/x0 for one magnet, whatever its k and leakage
    point, p = BALL.equilibrium(0.009), BALL.linearise(0.009)
    assert p["k_i"] / p["m"] == pytest.approx(-2 * 9.81 / point.current, rel=1e-12)
    assert p["k_x"] / p["m"] == pytest.approx(-2 * 9.81 / 0.009, rel=1e-12)


@pytest.mark.parametrize(("plant", "state"), [(PAIR, (5e-5, 0.02, 0.3)), (BALL, (0.012, -0.1, 0.8))])
def test_energy_changes_by_what_goes_in_and_what_is_lost(
    plant: NonlinearPlant, state: tuple[float, float, float]
) -> None:
    voltage, h = 7.0, 1e-30
    rate = plant.derivative(state, voltage)
    # directional derivative of the energy along the motion, by complex step
    at, speed, amperes = (complex(s, h * r) for s, r in zip(state, rate, strict=True))
    power = plant.energy((at, speed, amperes)).imag / h
    x, v, i = state
    w = plant.magnet.coenergy
    assert power == pytest.approx(voltage * i - plant.R * i**2 - plant.c * v**2, rel=1e-10)
    assert w.value(x, i) > 0.0


def test_impossible_plants_are_refused() -> None:
    with pytest.raises(ModelError, match="m is -1"):
        NonlinearPlant(magnet=BALL.magnet, m=-1.0, R=1.0)
    with pytest.raises(ModelError, match="only attracts"):
        NonlinearPlant(magnet=BALL.magnet, m=1.0, R=1.0).equilibrium(0.01)
