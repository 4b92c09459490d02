"""A rig's nonlinear plant: as a preset's, conserving energy, seen through its sensors; and what it lacks is named."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import RigError
from ambid.physics.loop import Limits, Noise
from ambid.physics.presets import preset, preset_names
from ambid.rig import preset_text, rig_from_text, rig_of_preset
from ambid.simulation import plant_of_rig, simulate_preset, simulate_rig
from tests.simulation.test_nonlinear import energy_error

HEAD = 'schema = "ambid.rig/1"\nname = "bench"\nmodel = "one-axis"\n'
PARAMETERS = """[parameters]
m = { value = 60, unit = "g" }
R = { value = 4.2, unit = "ohm" }
"""
SINGLE = """[magnet]
kind = "single"
gap = "exponential"
saturation = true
rise = true
[magnet.parameters]
L_g = { value = 60, unit = "mH" }
zeta = { value = 5.5, unit = "mm" }
sigma = { value = 0.3, unit = "1/A^2" }
L_leak = { value = 80, unit = "mH" }
L_rise = { value = 30, unit = "mH" }
i_knee = { value = 0.5, unit = "A" }
"""
PAIR = """[magnet]
kind = "pair"
saturation = true
[magnet.parameters]
k = { value = 5.2, unit = "N mm^2/A^2" }
s = { value = 0.43, unit = "mm" }
L_leak = { value = 2, unit = "mH" }
i0 = { value = 1, unit = "A" }
sigma = { value = 0.2, unit = "1/A^2" }
k_asym = { value = 0.1, unit = "1" }
v_drop = { value = 0.5, unit = "V" }
i_drop = { value = 0.3, unit = "A" }
x_offset = { value = 20, unit = "um" }
"""


def rig(magnet, parameters=PARAMETERS):
    return rig_from_text(HEAD + parameters + magnet, "bench.toml")


def ball(**numbers):
    """The levitated ball's rig with further numbers of the magnet."""
    bench = rig_of_preset(preset("levitated-ball"))
    assert bench.magnet is not None
    more = tuple(replace(bench.magnet.parameters[0], name=name, value=value) for name, value in numbers.items())
    magnet = replace(bench.magnet, eddy="a" in numbers, parameters=(*bench.magnet.parameters, *more))
    return replace(bench, magnet=magnet, noise=Noise())


def simulated(bench, volts=1.0, n=400, **settings):
    u = volts * np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], n // 10), 10)
    return simulate_rig(bench, u, rate_hz=2000.0, seed=1, nonlinear=True, **settings)


@pytest.mark.parametrize("name", ["unstable-bearing", "levitated-ball", "prototype"])
def test_a_presets_rig_simulates_as_the_preset(name) -> None:
    bench = preset(name)
    read = rig_from_text(preset_text(bench), "bench.toml")
    u = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 30), 10)
    noise = replace(bench.noise, position_resolution=0.0, current_resolution=0.0, voltage_resolution=0.0)
    ours = simulate_rig(replace(read, noise=noise), u, rate_hz=bench.rate_hz, seed=3, nonlinear=True)
    theirs = simulate_preset(bench, u, seed=3, nonlinear=True, noise=noise)
    for role in ("voltage", "current", "position"):
        size = np.abs(theirs.record[role]).max()
        assert ours.record[role] == pytest.approx(theirs.record[role], rel=1e-9, abs=1e-9 * size)
    assert ours.truth.keys() == theirs.truth.keys()
    assert dict(ours.truth) == pytest.approx(dict(theirs.truth), rel=1e-9, abs=1e-12)
    assert "nonlinear" in ours.record.provenance["plant"]


@pytest.mark.parametrize("name", preset_names(rotors=False))
def test_a_presets_rig_is_read_again(name) -> None:
    bench = preset(name)
    read = rig_from_text(preset_text(bench), "bench.toml")
    assert (read.loop, read.limits, read.noise) == (bench.loop, bench.limits, bench.noise)
    assert {p.name: p.value for p in read.parameters} == dict(bench.parameters)
    assert (read.magnet is None) == (bench.plant is None)


@pytest.mark.parametrize(
    ("magnet", "start", "voltage", "rate"),
    [(SINGLE, [0.010, 0.05, 0.9], 3.0, 2000.0), (PAIR, [6e-5, -0.01, 0.2], 4.0, 40_000.0)],
)
def test_energy_balance_holds_to_fourth_order(magnet, start, voltage, rate) -> None:
    # by the co-energy itself: the compiled equations took its derivatives
    plant = plant_of_rig(rig(magnet, PARAMETERS + 'c = { value = 0.1, unit = "N s/m", role = "fixed" }\n'))
    coarse, fine = (energy_error(plant, start, voltage, f * rate, 40 / rate) for f in (1, 2))
    assert fine < 1e-5
    assert coarse / fine > 12.0


def test_sensors_and_stage_show_what_they_are_told_to() -> None:
    plain = simulated(ball())
    away = ball(x_offset=1e-3)
    limits = Limits(voltage=(0.0, 12.0), position=(0.003, 0.021))
    moved = simulated(replace(away, operating_point={"position": 0.011}, limits=limits))
    assert moved.record["position"] - 1e-3 == pytest.approx(plain.record["position"], rel=1e-9)
    assert moved.record["current"] == pytest.approx(plain.record["current"], rel=1e-9)
    shown = simulated(ball(i_offset=0.02))
    assert shown.record["current"] - 0.02 == pytest.approx(plain.record["current"], rel=1e-9)
    assert shown.states == pytest.approx(plain.states, rel=1e-9, abs=1e-12)
    helped = simulated(ball(v_offset=0.3))
    assert helped.record["voltage"] + 0.3 == pytest.approx(plain.record["voltage"], rel=1e-9)
    dropped = simulated(ball(v_drop=0.4, i_drop=0.02), volts=0.0)
    assert dropped.record["voltage"][0] == pytest.approx(4.2 * 0.95 + 0.4, rel=1e-6)
    assert np.ptp(dropped.states[:, 0]) < 1e-12  # it rests there
    assert (dropped.truth["R"], dropped.truth["v_drop"], shown.truth["i_offset"]) == (4.2, 0.4, 0.02)


def test_an_eddy_pole_acts_and_a_fast_one_takes_small_steps() -> None:
    plain, slow, fast = simulated(ball()), simulated(ball(a=300.0)), simulated(ball(a=2e5))
    size = np.ptp(plain.states, axis=0)
    assert np.all(np.abs(slow.states - plain.states).max(axis=0) > 0.01 * size)
    assert np.all(np.abs(fast.states - plain.states).max(axis=0) < 0.01 * size)
    fine = simulated(ball(a=300.0), substeps=16)
    assert slow.states == pytest.approx(fine.states, rel=1e-5, abs=1e-7)


def test_noise_resolutions_and_limits_are_the_rigs() -> None:
    steps = Noise(position_resolution=1e-5, current_resolution=0.01, voltage_resolution=0.05)
    done = simulated(replace(ball(), noise=steps))
    for role, step in (("position", 1e-5), ("current", 0.01), ("voltage", 0.05)):
        counts = done.record[role] / step
        assert counts == pytest.approx(np.round(counts), abs=1e-6)
    hard = simulated(replace(ball(), limits=Limits(voltage=(3.5, 4.5), position=(0.002, 0.02))), volts=0.6)
    assert (hard.record["voltage"].values.min(), hard.record["voltage"].values.max()) == (3.5, 4.5)
    assert hard.n_saturated > 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (PARAMETERS, r"has no \[magnet\]; a nonlinear simulation needs one"),
        (PARAMETERS + "[magnet]\n", "magnet.kind is 'auto'.*Give kind"),
        (PARAMETERS + "[magnet]\nkind = 'single'\n", r"no value for k, s, L_leak; .*in \[magnet.parameters\] for k, s"),
        (PARAMETERS + PAIR.replace("value = 1, ", ""), "no value for i0; a nonlinear simulation of a hyperbolic pair"),
        (PARAMETERS + SINGLE.replace("value = 0.3, ", ""), "no value for sigma;"),
        (PARAMETERS + SINGLE.replace("gap =", "eddy = true\ngap ="), "no value for a;"),
        (PARAMETERS + PAIR + 'g = { unit = "m/s^2" }\n', "no value for g;"),
        (PARAMETERS.replace("value = 60, ", "") + PAIR, r"no value for m; .* in \[parameters\] for m$"),
    ],
)
def test_what_a_simulation_lacks_is_named_on_one_line(text, said) -> None:
    with pytest.raises(RigError, match=said) as refused:
        plant_of_rig(rig_from_text(HEAD + text, "bench.toml"))
    assert "\n" not in str(refused.value)
