"""The nonlinear loop: small signals, energy, order of convergence, touchdown."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.physics.coenergy_law import MagnetLaw, law_numbers
from ambid.physics.law_magnet import LawMagnet
from ambid.physics.linear_model import model
from ambid.physics.loop import Limits, Loop
from ambid.physics.magnet import DifferentialPair, SingleMagnet
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint, PowerStage
from ambid.physics.presets import Preset, preset
from ambid.simulation import LinearPlant, simulate, simulate_preset

LOSSLESS = NonlinearPlant(magnet=SingleMagnet(k=1.3e-4, leakage=0.02), m=0.06, R=0.0, gravity=9.81)
PAIR = NonlinearPlant(
    magnet=DifferentialPair(turns=138, area=470.3e-6, bias=1.0, gap=0.432e-3, half_angle=0.392, leakage=2e-3),
    m=4.0,
    R=0.0,
)


LOSSY = replace(
    PAIR,
    magnet=LawMagnet(
        law=MagnetLaw(pair=True, asymmetric=True),
        values={**law_numbers(PAIR.magnet.coenergy), "k_asym": 0.1, "i0_asym": 0.05},
    ),
    R=1.6,
    c=30.0,
    stage=PowerStage(v_drop=0.8, i_drop=0.3),
)


def distance_from_linear(p: Preset, size: float) -> float:
    """Largest difference of the currents of both plants over 0.05 s of closed loop, without noise."""
    assert p.plant is not None
    n = int(0.05 * p.rate_hz)
    u = size * np.sign(np.sin(2 * np.pi * 40.0 * (np.arange(n) + 0.5) / p.rate_hz))
    linear = LinearPlant(model=model("one-axis"), parameters=p.parameters)
    both = [
        simulate(q, u, rate_hz=p.rate_hz, seed=0, loop=p.loop, operating_point=p.operating_point, substeps=4)
        for q in (linear, p.plant)
    ]
    return float(np.abs(both[0].states[:, 2] - both[1].states[:, 2]).max())


@pytest.mark.parametrize(("name", "volts", "order"), [("levitated-ball", 0.4, 2), ("unstable-bearing", 2.0, 3)])
def test_small_signals_are_linear(name: str, volts: float, order: int) -> None:
    # one magnet deviates with the square of the amplitude, the symmetric pair with its cube
    p = preset(name)
    ratio = distance_from_linear(p, volts) / distance_from_linear(p, volts / 2)
    assert ratio == pytest.approx(2.0**order, rel=0.1)


def energy_error(plant: NonlinearPlant, start: list[float], voltage: float, rate: float, seconds: float) -> float:
    """Relative error of stored energy against electric work less losses (integrals by Simpson's rule)."""
    n = round(seconds * rate) + 1
    point = OperatingPoint(position=start[0])
    done = simulate(
        plant, np.full(n, voltage), rate_hz=rate, seed=0, start=start, operating_point=point, loop=Loop(delay=0)
    )
    x = [tuple(map(float, row)) for row in (done.states[0], done.states[-1])]
    v, i = done.states[:, 1], done.states[:, 2]
    drop = np.array([plant.stage.drop(j) for j in i])
    power = (voltage - drop - plant.R * i) * i - plant.c * v**2
    work = (power[0] + power[-1] + 4 * power[1:-1:2].sum() + 2 * power[2:-1:2].sum()) / (3 * rate)
    gained = plant.energy((x[1][0], x[1][1], x[1][2])) - plant.energy((x[0][0], x[0][1], x[0][2]))
    return float(abs(gained - work)) / (0.5 * plant.m * x[1][1] ** 2)


@pytest.mark.parametrize(
    ("plant", "start", "voltage", "rate", "seconds"),
    [
        (LOSSLESS, [0.010, 0.0, 0.9], 0.0, 1000.0, 0.02),
        (LOSSLESS, [0.010, 0.1, 0.5], 3.0, 1000.0, 0.02),
        (PAIR, [2e-5, 0.0, 0.1], 0.0, 5000.0, 0.008),
        (PAIR, [2e-5, -0.02, 0.1], 5.0, 5000.0, 0.008),
        (LOSSY, [2e-5, -0.02, 0.1], 5.0, 5000.0, 0.008),
    ],
)
def test_energy_balance_holds_to_fourth_order(
    plant: NonlinearPlant, start: list[float], voltage: float, rate: float, seconds: float
) -> None:
    coarse = energy_error(plant, start, voltage, rate, seconds)
    fine = energy_error(plant, start, voltage, 2 * rate, seconds)
    assert fine < 1e-5
    assert coarse / fine > 12.0  # 16 and more for a fourth-order method


def test_substeps_converge_with_fourth_order() -> None:
    p = preset("levitated-ball")
    u = np.array([1.0, 1.0, -1.0, -1.0, 1.0, 0.0])
    assert p.plant is not None
    runs = [
        simulate(p.plant, u, rate_hz=200.0, seed=0, operating_point=p.operating_point, substeps=s).states[-1]
        for s in (2, 4, 64)
    ]
    assert np.abs(runs[0] - runs[2]).max() / np.abs(runs[1] - runs[2]).max() > 12.0


def test_fractional_delay_switches_inside_the_sample() -> None:
    p = preset("levitated-ball")
    assert p.plant is not None
    u = np.random.default_rng(0).standard_normal(100)
    fine = simulate(
        p.plant, np.repeat(u, 4), rate_hz=8000.0, seed=0, loop=Loop(delay=3), operating_point=p.operating_point
    )
    coarse = simulate(
        p.plant, u, rate_hz=2000.0, seed=0, loop=Loop(delay=0.75), operating_point=p.operating_point, substeps=3
    )
    assert coarse.states == pytest.approx(fine.states[::4], abs=1e-8)


@pytest.mark.parametrize("nonlinear", [False, True])
def test_touchdown_is_reported_and_the_rotor_stays_in_the_gap(nonlinear: bool) -> None:
    p = preset("unstable-bearing")
    u = np.zeros(4000)
    u[0] = 0.5
    done = simulate_preset(p, u, seed=0, closed=False, nonlinear=nonlinear)
    x, k = done.states[:, 0], done.first_contact
    assert k is not None
    assert np.abs(x[:k]).max() < 0.2e-3
    assert abs(x[k]) == 0.2e-3
    assert np.abs(x).max() <= 0.2e-3
    assert done.states[k, 1] == 0.0
    assert any("touched" in w for w in done.warnings)
    assert any("unstable" in w for w in done.warnings)


def test_rotor_can_leave_a_stop_again() -> None:
    p = preset("levitated-ball")
    assert p.plant is not None
    # at rest on the lower stop (20 mm), then far more than the holding current
    u = np.full(1500, 6.0)
    done = simulate(
        p.plant, u, rate_hz=2000.0, seed=0, limits=Limits(position=(0.002, 0.020)), start=[0.020, 0.0, 0.0],
        operating_point=p.operating_point,
    )  # fmt: skip
    assert done.first_contact == 1
    assert done.states[:, 0].min() < 0.019


@pytest.mark.parametrize(("name", "volts"), [("unstable-bearing", 5.0), ("levitated-ball", 1.0)])
def test_leaving_the_air_gap_is_an_error(name: str, volts: float) -> None:
    # the equations themselves go on through the pole face
    p = preset(name)
    assert p.plant is not None
    with pytest.raises(ModelError, match=r"air gap or diverges at sample \d+"):
        simulate(p.plant, np.full(4000, volts), rate_hz=p.rate_hz, seed=0, operating_point=p.operating_point)


def test_an_eddy_pole_lags_the_force() -> None:
    p = preset("unstable-bearing")
    u = np.repeat(np.random.default_rng(1).choice([-4.0, 4.0], 50), 20)
    runs = {}
    for pole in (np.inf, 2e5, 2000.0):
        plant = replace(p.plant, eddy_pole=pole)
        runs[pole] = simulate(
            plant, u, rate_hz=p.rate_hz, seed=0, loop=p.loop, operating_point=p.operating_point, substeps=20
        )
        assert runs[pole].states.shape == (1000, 3)
    # a very fast pole is a delay of the force by 1/a; a slow one is another plant
    size = np.abs(runs[np.inf].states).max(axis=0)
    assert np.all(np.abs(runs[2e5].states - runs[np.inf].states).max(axis=0) < 0.02 * size)
    assert np.all(np.abs(runs[2000.0].states - runs[np.inf].states).max(axis=0) > 0.05 * size)
    # p' = a (f - p): a plant held at rest by its own force stays there
    still = simulate(replace(p.plant, eddy_pole=2000.0), np.zeros(50), rate_hz=p.rate_hz, seed=0, loop=p.loop)
    assert np.abs(still.states).max() < 1e-12


def test_the_stage_limits_and_drops_what_the_log_does_not_show() -> None:
    p = preset("levitated-ball")
    stage = PowerStage(limits=(0.0, 5.0), v_drop=0.6, i_drop=0.05)
    settings = {"rate_hz": 2000.0, "seed": 0, "start": [0.010, 0.0, 0.95], "operating_point": p.operating_point}
    u = np.repeat([7.0, 4.5, -3.0], 10)
    lossy = simulate(replace(p.plant, stage=stage), u - p.operating_point.voltage, **settings)
    assert lossy.record["voltage"] == pytest.approx(u)  # the command, beyond what the stage can give
    i = lossy.states[:, 2]
    same = np.clip(u, 0.0, 5.0) - 0.6 * np.tanh(i / 0.05)
    straight = simulate(p.plant, same - p.operating_point.voltage, **settings)
    assert lossy.states == pytest.approx(straight.states, rel=1e-3, abs=1e-6)
    assert stage.slope(0.0) == pytest.approx(12.0)
    h = 1e-20
    assert stage.slope(0.03) == pytest.approx(stage.drop(0.03 + 1j * h).imag / h, rel=1e-12)
    with pytest.raises(ModelError, match="i_drop"):
        PowerStage(i_drop=0.0)
