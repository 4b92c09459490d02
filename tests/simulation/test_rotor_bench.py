"""Rotors on many axes: our simulator against the independent one, contact and limits, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from ambid import simulate
from ambid.errors import AmbidError, ModelError, RigError
from ambid.job.simulation import simulate_used
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.law_magnet import LawMagnet
from ambid.physics.linear_model import model
from ambid.physics.loop import Limits, Noise
from ambid.physics.nonlinear import NonlinearPlant
from ambid.physics.presets import Preset, preset, preset_names
from ambid.rig import RigChannel, preset_text, rig_from_text, rig_of_preset
from ambid.signals import excitation_of_axes, multisine
from ambid.simulation import LinearPlant, Schedule, rotor_bench
from ambid.simulation import simulate as simulate_plant
from ambid.simulation.rotor_bench import RotorBench, poles_of
from tests.rotor_benches import needs_simulator, rig_of, truth

QUIET = {"position_noise": 0.0, "current_noise": 0.0, "voltage_noise": 0.0, "force_noise": 0.0}


@needs_simulator
@pytest.mark.parametrize("name", ["rigid", "rigid-spin", "utrc"])
def test_without_noise_the_records_are_those_of_the_independent_simulator(name: str) -> None:
    bench = replace(truth.BENCHES[name], **QUIET, period=0.6, settle=3, periods=1)
    theirs, period = truth.simulate(bench, 1), truth.multisine(bench, np.random.default_rng(1))
    rotor = RotorBench.of(rig_of(bench), None, None)
    assert rotor.largest_pole < 1.0
    done = rotor.simulate(bench.kc * np.tile(period, (4, 1)), seed=1, settle=3 * len(period))
    assert done.within_limits
    for what in ("voltage", "position", "current"):
        ours = np.column_stack([done.record[f"{axis}_{what}"] for axis in truth.AXES])
        # they begin in different ways, which the loop forgets: 1e-9 is left after three periods
        assert np.abs(ours - theirs[what]).max() < 1e-9 * np.abs(theirs[what]).max()


@needs_simulator
def test_noise_has_the_spread_of_the_independent_simulator() -> None:
    bench = replace(truth.BENCHES["rigid"], amplitude=1e-9, settle=1, periods=2)
    theirs = truth.simulate(bench, 1)
    done = RotorBench.of(rig_of(bench), None, None).simulate(np.zeros((30_000, 4)), seed=2, settle=10_000)
    for what in ("voltage", "position", "current"):
        ours = np.column_stack([done.record[f"{axis}_{what}"] for axis in truth.AXES])
        np.testing.assert_allclose(ours.std(axis=0), theirs[what].std(axis=0), rtol=0.08)


@needs_simulator
def test_a_rotor_stops_at_the_stops_and_says_so() -> None:
    rig = replace(rig_of(truth.BENCHES["rigid"]), limits=Limits(position=(-1e-5, 1e-5)), noise=Noise(force=0.1))
    done = RotorBench.of(rig, None, False).simulate(np.ones((20_000, 4)), seed=1)
    held = done.states[:, :4]
    assert done.first_contact is not None
    assert np.abs(held).max() < 1.2e-5  # an axis moves another one a little, within a sample
    assert np.abs(held[-1]).min() > 0.9e-5  # unstable: every axis ends at a stop


@needs_simulator
def test_what_cannot_be_simulated_is_refused() -> None:
    rig = rig_of(truth.BENCHES["flexible"])
    numbers = {name: x for name, x in rig.modes.numbers.items() if name != "mode1.zeta"}
    with pytest.raises(RigError, match=r"there is no value for mode1\.zeta"):
        RotorBench.of(replace(rig, modes=replace(rig.modes, numbers=numbers)), None, None)
    assert rig.loop is not None
    with pytest.raises(ModelError, match="the loop is unstable on 'flexible'"):
        RotorBench.of(replace(rig, loop=replace(rig.loop, kd=0.0)), None, None).refuse_unstable()
    with pytest.raises(ModelError, match="one column an axis"):
        RotorBench.of(rig, None, None).simulate(np.zeros(100), seed=1)
    with pytest.raises(ModelError, match="diverges at sample"):
        RotorBench.of(replace(rig, limits=Limits()), None, False).simulate(np.full((60_000, 4), 1e300), seed=1)


@pytest.mark.parametrize("name", preset_names(rotors=True))
def test_presets_levitate_within_their_limits_and_their_rig_gives_the_same_record(name: str) -> None:
    done, told = simulate_used(name, duration=0.8, periods=4, seed=3)
    assert done.within_limits
    assert done.largest_pole < 0.9995  # what is left of the start falls below 1e-4 in a second
    rig = rig_from_text(preset_text(preset(name)), "bench.toml")
    again = simulate(rig, duration=0.8, periods=4, seed=3, amplitude=told.peak)
    assert again.names == done.record.names
    assert rig.rotor is not None
    axis = rig.rotor.axes[-1]
    for column in (f"{axis}_voltage", f"{axis}_current", f"{axis}_position"):
        np.testing.assert_allclose(again[column], done.record[column], rtol=1e-6, atol=1e-9)
    assert ("angle" in again.names) == (rig.rotor.speed > 0)
    positions = np.array([again[f"{axis}_position"] for axis in rig.rotor.axes])
    # moved by a fair part of the room, and held in it
    assert 0.01 < np.abs(positions).max() / preset(name).limits.position[1] < 0.5


def test_records_begin_in_steady_state_and_excite_the_axes_that_are_asked_for() -> None:
    quiet = replace(preset("rmit"), noise=Noise())
    record = simulate(quiet, duration=1.0, periods=2, settle=2, axes=["xL"], amplitude=1.0, band=(10.0, 400.0))
    assert np.ptp(record["yL_reference"]) == 0.0
    x = record["xL_position"]
    assert np.abs(x[:10_000] - x[10_000:]).max() < 1e-3 * np.abs(x).max()
    assert np.abs(record["xR_position"]).max() > 1e-3 * np.abs(x).max()  # through the rotor
    assert np.abs(record["yR_position"]).max() < 1e-6 * np.abs(x).max()  # at rest, planes do not couple


AXIAL = """
schema = "ambid.rig/1"
name = "a mass on one axial axis"
model = "rotor"
[bearings.T]
axial = true
axes = ["az"]
[parameters]
m = { value = 4.0, unit = "kg" }
"az.k_i" = { value = 55.7, unit = "N/A" }
"az.k_x" = { value = -129000.0, unit = "N/m" }
"az.R" = { value = 1.6, unit = "ohm" }
"az.L" = { value = 27.0, unit = "mH" }
[magnet]
saturation = true
[magnet.parameters]
s = { value = 0.432, unit = "mm" }
sigma = { value = 0.0, unit = "1/A^2", role = "fixed" }
[record]
rate_hz = 20000.0
"""


@pytest.mark.parametrize("sigma", [0.0, 0.3])
def test_one_axial_axis_is_the_one_axis_bench_linear_and_nonlinear(sigma: float) -> None:
    bearing = preset("unstable-bearing")
    rig = rig_from_text(AXIAL.replace("sigma = { value = 0.0", f"sigma = {{ value = {sigma}"), "axial.toml")
    rig = replace(rig, loop=replace(bearing.loop, delay=1.3), limits=bearing.limits)
    u = multisine(4000, 20_000.0, amplitude=18.0, band=(10.0, 1000.0), seed=1)
    linear = RotorBench.of(rig, None, None)
    theta = {**{name.removeprefix("az."): x for name, x in linear.plant.parameters.items()}, "c": 0.0}
    bent = RotorBench.of(rig, None, None, nonlinear=True)
    assert bent.poles is not None
    k, s, bias = bent.poles.numbers[0, :3]
    values = {"k": k, "s": s, "i0": bias, "sigma": sigma, "L_leak": bent.poles.leakage[0]}
    magnet = LawMagnet(law=MagnetLaw(gap="hyperbolic", pair=True, saturation=True), values=values)
    plants = [LinearPlant(model=model("one-axis"), parameters=theta), NonlinearPlant(magnet=magnet, m=4.0, R=1.6)]
    assert plants[1].linearise(0.0) == pytest.approx(theta, rel=1e-12)
    for bench, plant in zip((linear, bent), plants, strict=True):
        many = bench.simulate(u[:, None], seed=1).record
        one = simulate_plant(plant, u, rate_hz=20_000.0, seed=1, loop=rig.loop, limits=rig.limits, substeps=8).record
        for what in ("voltage", "current", "position"):
            assert np.abs(many[f"az_{what}"] - one[what]).max() < 1e-6 * np.abs(one[what]).max()
    bows = np.abs(bent.simulate(u[:, None], seed=1).states - linear.simulate(u[:, None], seed=1).states).max(axis=0)
    assert bows[0] > 0.01 * np.abs(one["position"]).max()


@pytest.mark.parametrize("name", preset_names(rotors=True))
def test_nonlinear_magnets_levitate_and_are_linear_for_small_motion(name: str) -> None:
    quiet = replace(preset(name), noise=Noise())
    assert quiet.rotor is not None
    quiet = replace(quiet, rotor=replace(quiet.rotor, unbalance=(), runout=()))
    told = {"duration": 0.1, "periods": 2, "settle": 0, "amplitude": 0.01}
    linear, bent = simulate(quiet, **told), simulate(quiet, **told, nonlinear=True)
    for role in linear.names:
        assert np.abs(bent[role] - linear[role]).max() <= 2e-4 * np.abs(linear[role]).max()
    done, _ = simulate_used(name, duration=0.2, periods=2, nonlinear=True)
    assert done.within_limits


def test_flux_linkages_of_magnets_are_the_integral_of_the_voltages() -> None:
    """Without resistance every volt goes into dW'/di."""
    bench_preset = preset("spindle")
    ideal = {f"{axis}.R": 1e-12 for axis in ("ax", "ay", "bx", "by", "az")}
    bench_preset = replace(bench_preset, parameters={**bench_preset.parameters, **ideal}, noise=Noise())
    rig = rig_of_preset(replace(bench_preset, loop=replace(bench_preset.loop, delay=0.0)))
    bench = RotorBench.of(rig, None, None, nonlinear=True)
    u = excitation_of_axes("gaussian", 2000, 20_000.0, axes=5, amplitude=12.0, band=(10.0, 1000.0), seed=3)
    done = bench.simulate(u, seed=1)
    assert bench.poles is not None
    x, i, found = done.states[:, :5], done.states[:, 5:], done.states[:, 5:] * bench.poles.leakage
    for (k, gap, bias, sigma, side), j in zip(bench.poles.numbers, bench.poles.axes, strict=True):
        current = bias + side * i[:, j]
        found[:, j] += side * k / (gap - side * x[:, j]) * current / np.sqrt(1.0 + sigma * current**2)
    volts = np.column_stack([done.record[f"{axis}_voltage"] for axis in bench.model.axes])
    assert np.abs(x).max() > 0.1 * 0.4e-3
    np.testing.assert_allclose(np.diff(found, axis=0), volts[:-1] / 20_000.0, rtol=0, atol=1e-7 * np.ptp(found))


def test_a_rig_that_names_them_gets_speed_and_pulses() -> None:
    rig = rig_of_preset(preset("central-mass"))
    more = (RigChannel(role="speed", column="speed"), RigChannel(role="tacho", column="pulses"))
    record = simulate(replace(rig, channels=(*rig.channels, *more)), duration=0.2, amplitude=1.0)
    assert record["speed"] == pytest.approx(np.full(4000, 100.0 * np.pi))
    assert np.count_nonzero(np.diff(record["pulses"]) > 0) in (9, 10)  # 50 revolutions in a second


def test_magnets_that_cannot_be_are_refused() -> None:
    def refuse(bench: Preset, says: str, **theta: float) -> None:
        with pytest.raises(RigError, match=says):
            simulate(replace(bench, parameters={**bench.parameters, **theta}), duration=0.1, nonlinear=True)

    refuse(preset("rmit"), "L of yR is below", **{"yR.L": 24e-3})
    refuse(preset("rmit"), "has k_i > 0 > k_x", **{"yR.k_x": 1e5})
    with pytest.raises(RigError, match="there is no gap"):
        simulate(replace(rig_of_preset(preset("rmit")), magnet=None), duration=0.1, nonlinear=True)


def _quiet_bench(name: str) -> RotorBench:
    return RotorBench.of(replace(rig_of_preset(preset(name)), noise=Noise()), None, True)


def test_a_run_up_that_stays_at_one_speed_is_the_simulation_at_that_speed() -> None:
    bench = _quiet_bench("utrc")
    speed = Schedule(times_s=(0.0, 0.5), values=(bench.model.speed, bench.model.speed))
    for one in (bench, replace(bench, poles=poles_of(bench.rig, bench.model, bench.plant.parameters))):
        ran = one.run_up(speed, 3000, seed=1, settle=2000)
        stood = one.simulate(np.zeros((5000, 4)), seed=1, settle=2000, columns=False)
        assert np.abs(ran.states - stood.states).max() < 1e-5 * np.abs(stood.states).max()
        assert ran.record["speed"].values == pytest.approx(bench.model.speed)
        assert "ax_reference" in ran.record.names  # the rig names it


def test_stretches_of_a_run_up_are_short_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    bench, top = _quiet_bench("utrc"), 20_000.0 * np.pi / 30.0
    course = Schedule(times_s=(0.0, 0.2, 0.3), values=(0.0, top, top))
    rough = bench.run_up(course, 6000, seed=1)
    monkeypatch.setattr(rotor_bench, "_PHASE", 1e-9)  # one sample each
    fine = bench.run_up(course, 6000, seed=1)
    assert np.abs(rough.states - fine.states).max() < 5e-4 * np.abs(fine.states).max()
    w, angle = fine.record["speed"].values, fine.record["angle"].values
    assert np.abs(np.gradient(angle) * 20_000.0 - w)[5:-5].max() < 0.2


def test_run_ups_that_cannot_be_simulated_are_refused() -> None:
    for speeds in ("0", "0:x", (0.0, -5.0), (0.0, 0.0)):
        with pytest.raises(AmbidError, match=r"two speeds in rpm or more"):
            simulate("utrc", run_up=speeds)
    with pytest.raises(AmbidError, match="at 20000 Hz it must be at most 600000"):
        simulate("utrc", run_up="0:1e9")
    with pytest.raises(AmbidError, match="run_up takes no band"):
        simulate("utrc", run_up="0:1000", band=(1.0, 2.0))
    with pytest.raises(AmbidError, match="for a rotor on many axes"):
        simulate("thesis", run_up="0:1000")
    with pytest.raises(RigError, match="no value for Ip"):
        simulate("rmit", run_up="0:1000")
