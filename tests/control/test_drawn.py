"""Plants drawn around an estimate: reproducible, physical, by the covariance and by the law of the magnet."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.control.closed import ClosedLoop, Plant
from ambid.control.controller import controller_of_loop
from ambid.control.drawn import Spread, draw_plants
from ambid.errors import ModelError
from ambid.physics.presets import preset_names
from ambid.rig.draft import rig_of_preset
from ambid.simulation.rotor_bench import RotorBench

NONE = Spread(covariance=0, delay=0, position=0, current=0, eddy=0, warm_k=(0, 0), frequency=0, damping=0)


def plant_of_preset(name, **given):
    bench = ambid.preset(name)
    rig = rig_of_preset(bench)
    theta = {p.name: bench.parameters[p.name] for p in rig.plant.parameters}
    delays = np.full(len(rig.plant.inputs), bench.loop.delay)
    return Plant(model=rig.plant, theta=theta, delays=delays, rate_hz=bench.rate_hz, **given), rig


def test_the_estimate_comes_first_and_a_draw_is_the_same_however_many_are_drawn():
    plant, rig = plant_of_preset("unstable-bearing")
    few, many = (draw_plants(plant, rig, n, seed=3).plants for n in (3, 5))
    assert few[0].plant.theta == plant.theta
    assert few[0].words() == "the estimate itself"
    assert [d.changed for d in few] == [d.changed for d in many[:3]]
    assert draw_plants(plant, rig, 3, seed=4).plants[1].changed != few[1].changed


def test_without_any_spread_every_plant_is_the_estimate():
    plant, rig = plant_of_preset("unstable-bearing")
    for drawn in draw_plants(plant, rig, 4, seed=1, spread=NONE).plants:
        assert dict(drawn.plant.theta) == plant.theta
        assert drawn.plant.model is plant.model
        assert drawn.plant.delays == plant.delays


def test_two_opposed_magnets_follow_from_k_x_k_i_and_the_gap():
    """The law that is made up of an estimate and the gap is the one that the preset was made with."""
    plant, rig = plant_of_preset("unstable-bearing")
    only_gap = replace(
        rig, magnet=replace(rig.magnet, parameters=tuple(p for p in rig.magnet.parameters if p.name == "s"))
    )
    known, made = (draw_plants(plant, r, 6, seed=2) for r in (rig, only_gap))
    assert "rig's [magnet]" in known.assumed[0]
    assert "opposed" in made.assumed[0]
    for one, other in zip(known.plants, made.plants, strict=True):
        assert other.plant.theta == pytest.approx(one.plant.theta, rel=1e-9)


def test_a_stable_spring_has_no_magnet_that_explains_it():
    plant, rig = plant_of_preset("thesis")
    found = draw_plants(plant, rig, 3, seed=1)
    assert "not negative" in found.assumed[0]
    assert all(d.plant.theta["k_x"] == plant.theta["k_x"] for d in found.plants)


def test_numbers_scatter_by_the_covariance():
    names = ("m", "k_x", "k_i")
    plant, rig = plant_of_preset("rmit-axis")
    sd = np.array([0.02 * abs(plant.theta[n]) for n in names])
    correlation = np.array([[1.0, -0.9, 0.5], [-0.9, 1.0, -0.3], [0.5, -0.3, 1.0]])
    wanted = correlation * np.outer(sd, sd)
    known = replace(plant, names=names, covariance=wanted)
    drawn = draw_plants(known, rig, 2000, seed=5, spread=replace(NONE, covariance=2.0)).plants[1:]
    found = np.cov(np.array([[d.plant.theta[n] for n in names] for d in drawn]).T) / np.outer(sd, sd)
    assert found == pytest.approx(4.0 * correlation, abs=4.0 * 5.0 / np.sqrt(2000))
    assert all(d.plant.covariance is None for d in drawn)


def test_a_mass_that_the_data_do_not_show_stays_positive_and_keeps_the_ratios():
    names = ("m", "k_x", "k_i")
    plant, rig = plant_of_preset("rmit-axis")
    along = np.array([plant.theta[n] for n in names])
    known = replace(plant, names=names, covariance=0.25**2 * np.outer(along, along))
    for drawn in draw_plants(known, rig, 50, seed=6, spread=replace(NONE, covariance=1.0)).plants:
        theta = drawn.plant.theta
        assert theta["m"] > 0.0
        assert theta["k_x"] / theta["m"] == pytest.approx(-75_000.0)


def test_a_sign_that_the_data_do_not_show_is_drawn_again_and_counted():
    plant, rig = plant_of_preset("rmit-axis")
    known = replace(plant, names=("k_i",), covariance=np.array([[plant.theta["k_i"] ** 2]]))
    found = draw_plants(known, rig, 40, seed=7, spread=replace(NONE, covariance=1.0))
    assert found.rejected > 0
    assert all(d.plant.theta["k_i"] > 0.0 for d in found.plants)


def test_eddy_currents_that_are_fast_are_none():
    plant, rig = plant_of_preset("rmit-axis")
    lagged = draw_plants(plant, rig, 2, seed=1, spread=replace(NONE, eddy=0.5)).plants[1].plant
    controller = controller_of_loop(rig.loop, plant.model, plant.rate_hz)
    fast = replace(lagged, theta={**lagged.theta, "a": 1e9})
    f = np.geomspace(1.0, 5e3, 50)
    was, now, far = (ClosedLoop(plant=p, controller=controller, frequency_hz=f) for p in (plant, fast, lagged))
    assert np.abs(now.of_axes) == pytest.approx(np.abs(was.of_axes), rel=1e-4)
    assert np.abs(now.compliance) == pytest.approx(np.abs(was.compliance), rel=1e-4)
    assert np.max(np.abs(far.of_axes)) > 1.002 * np.max(np.abs(was.of_axes))


def test_a_warm_coil_has_the_resistance_of_copper():
    plant, rig = plant_of_preset("rmit-axis")
    drawn = draw_plants(plant, rig, 2, seed=1, spread=replace(NONE, warm_k=(50.0, 50.0))).plants[1]
    assert drawn.plant.theta["R"] == pytest.approx(plant.theta["R"] * 1.195)
    assert drawn.words() == "coil +50 K, R +20 %"


def test_a_rotor_is_drawn_axis_by_axis_with_its_modes():
    rig = next(r for r in map(rig_of_preset, map(ambid.preset, preset_names(rotors=True))) if r.shaft is not None)
    of = RotorBench.of(rig, None, None).plant
    plant = Plant(
        model=of.model, theta=of.parameters, delays=np.full(len(of.model.inputs), 1.0), rate_hz=rig.record.rate_hz
    )
    drawn = draw_plants(plant, rig, 20, seed=1).plants[1:]
    for d in drawn:
        assert 0.5 <= 1.0 + d.changed["mode1.zeta"] <= 1.0
        assert abs(d.changed["mode1.omega"]) <= 0.03
        assert np.isfinite(d.plant.space.A).all()
    one, other = of.model.axes[:2]
    assert drawn[0].changed[f"{one}.k_x"] != drawn[0].changed[f"{other}.k_x"]


def test_a_spread_that_makes_no_sense_is_refused():
    with pytest.raises(ModelError, match=r"spread\.delay is -1"):
        Spread(delay=-1)
