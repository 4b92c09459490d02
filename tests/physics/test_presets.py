"""Presets: published numbers, and a loop that holds every one of them."""

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.physics.linear_model import model
from ambid.physics.presets import preset, preset_names
from ambid.simulation import closed_loop_poles


@pytest.mark.parametrize("name", preset_names(rotors=False))
def test_loop_is_stable_with_its_delay(name: str) -> None:
    p = preset(name)
    assert np.abs(closed_loop_poles(p.parameters, p.loop, p.rate_hz)).max() < 1.0


@pytest.mark.parametrize("name", [n for n in preset_names(rotors=False) if preset(n).plant is not None])
def test_parameters_are_the_linearisation_of_the_plant(name: str) -> None:
    p = preset(name)
    assert p.plant is not None
    assert dict(p.parameters) == p.plant.linearise(p.operating_point.position)
    assert p.plant.equilibrium(p.operating_point.position) == p.operating_point


@pytest.mark.parametrize("name", preset_names(rotors=False))
def test_rest_lies_inside_the_limits(name: str) -> None:
    p = preset(name)
    for quantity in ("voltage", "current", "position"):
        low, high = getattr(p.limits, quantity)
        assert low < getattr(p.operating_point, quantity) < high
    if p.plant is not None:
        assert p.plant.magnet.range[0] < p.limits.position[0] < p.limits.position[1] < p.plant.magnet.range[1]


def test_thesis_rig_has_the_entries_of_thesis_eq_4_10() -> None:
    p = preset("thesis")
    a = model("one-axis").matrices(p.parameters)
    assert a.A[2, 1] == pytest.approx(5202.7, rel=1e-4)
    assert a.A[2, 2] == pytest.approx(-20.97, rel=1e-3)
    assert a.B[2, 0] == pytest.approx(16.78, rel=1e-3)
    poles = np.sort_complex(np.linalg.eigvals(a.A))
    assert poles[2].real == pytest.approx(-0.00763, rel=1e-2)
    assert poles[0] == pytest.approx(-10.48 - 4017j, rel=1e-3)


def test_published_bearings() -> None:
    p = preset("unstable-bearing").parameters
    assert (p["k_i"], p["k_x"]) == (pytest.approx(55.7, abs=0.05), pytest.approx(-1.29e5, rel=1e-3))
    rmit = preset("rmit-axis")
    assert (rmit.parameters["k_i"], rmit.parameters["k_x"]) == (61.0, -150_000.0)
    assert rmit.limits.position == (-350e-6, 350e-6)
    assert rmit.instruments == {"position_sensor": (4000.0, "V/m"), "amplifier": (-0.2, "A/V")}


def test_unknown_preset_names_the_nearest() -> None:
    with pytest.raises(ModelError, match="Did you mean 'thesis'"):
        preset("theses")
