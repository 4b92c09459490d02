"""Scenarios: each does what its name says, with the truth beside it, as a record and as a stream."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ambid.errors import ModelError, RigError
from ambid.estimation.estimate import Estimate
from ambid.job import identify
from ambid.physics.presets import preset
from ambid.record import read_record, write_record
from ambid.rig import Rig, default_rig, rig_from_text
from ambid.simulation import Simulation, simulate_preset, simulate_scenario, truth_columns
from ambid.simulation.scenarios import scenario, scenario_names

BEARING = preset("unstable-bearing")
RATE = 20_000
TOP = 15_000 * np.pi / 30


def run(name: str, duration_s: float = 0.5, **more: object) -> Simulation:
    if name != "quiet":
        more.setdefault("amplitude", 8.0)
    return simulate_scenario(name, BEARING, duration_s=duration_s, seed=4, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_leaves_the_rotor_levitated(name: str) -> None:
    done = run(name)
    assert done.record.n_samples == RATE // 2
    assert done.first_contact is None
    assert done.n_over_current == 0
    assert done.largest_pole < 1.0
    assert done.n_saturated == 0
    (told,) = [s.settings for s in done.record.history if s.name == "scenario"]
    assert told["name"] == name
    assert (told.get("size") is not None) == bool(scenario(name).size_is)


@pytest.mark.parametrize(
    ("name", "truth"),
    [
        ("steady", {}), ("quiet", {}),
        ("change", {"k_i": (55.73352, 0.85 * 55.73352, "N/A")}), ("added-mass", {"m": (4.0, 4.4, "kg")}),
        ("sensor-gain", {"gain_position": (1.0, 0.8, "1")}), ("offset", {"force": (0.0, 5.573352, "N")}),
        ("spin-up", {"unbalance": (6.3662e-6, 6.3662e-6, "kg m"), "unbalance_phase": (0.6, 0.6, "rad")}),
    ],
)  # fmt: skip
def test_the_truth_stands_beside_the_record(
    name: str, truth: dict[str, tuple[float, float, str]], tmp_path: Path
) -> None:
    done = run(name, 0.02)
    write_record(done.record, tmp_path / "r.csv")
    found = truth_columns(read_record(tmp_path / "r.csv"))
    assert set(found) == set(truth)
    for key, (first, last, unit) in truth.items():
        assert found[key].unit == unit
        assert found[key].values[[0, 199, 200, -1]] == pytest.approx([first, first, last, last], rel=1e-5)
    assert truth_columns(done.record).keys() == found.keys()


def test_the_coil_warms_as_told() -> None:
    even = run("drift", 2.0)
    t = even.record.time_s
    assert even.record["true_R"] == pytest.approx(1.6 * (1 + 0.2 * t / 60.0), rel=1e-5)


def test_the_spin_up_reaches_its_speed_and_its_angle_is_the_integral() -> None:
    done = run("spin-up", 4.0)
    speed, angle, t = (done.record["speed"], done.record["angle"], done.record.time_s)
    rise = 0.9 * (4.0 - 0.2)
    assert speed.max() == pytest.approx(TOP)
    assert speed == pytest.approx(TOP * np.clip((t - 0.2) / rise, 0.0, 1.0), abs=1e-9)
    assert angle[-1] == pytest.approx(0.5 * TOP * rise + TOP * (t[-1] - 0.2 - rise), rel=1e-12)
    assert np.diff(angle) == pytest.approx(0.5 * (speed[1:] + speed[:-1]) / RATE, abs=1e-8)
    assert [done.record.channel(n).unit for n in ("speed", "angle")] == ["rad/s", "rad"]
    # far above the bearing's own frequencies a free rotor turns about its centre of mass: x = -(moment/m) cos
    still = simulate_scenario("steady", BEARING, duration_s=4.0, seed=4, amplitude=8.0)
    tail = slice(-4000, None)
    moved = (done.states[tail, 0] - still.states[tail, 0]) * 4.0 / 6.3662e-6
    assert moved == pytest.approx(-np.cos(angle[tail] + 0.6), abs=0.15)


def test_before_it_begins_a_scenario_is_the_steady_one() -> None:
    steady = run("steady").record
    for name in ("change", "added-mass", "sensor-gain", "offset"):
        done, k = run(name, at_s=0.3).record, int(0.3 * RATE)
        for channel in ("voltage", "current", "position"):
            assert np.array_equal(done[channel][:k], steady[channel][:k])
            assert not np.array_equal(done[channel][k:], steady[channel][k:])


def test_the_excitation_is_persistent_in_the_band_and_repeats() -> None:
    logged = simulate_scenario("steady", BEARING, duration_s=3.0, seed=4, log_excitation=True)
    u = logged.record["excitation"]
    assert np.array_equal(u[:RATE], u[RATE : 2 * RATE])
    power = np.abs(np.fft.rfft(u[:RATE])) ** 2
    assert power[5:1001].min() > 0.9 * power[5:1001].max()
    assert power[1001:].sum() < 1e-9 * power.sum()
    assert np.abs(u).max() / u.std() < 2.6
    assert logged.within_limits
    # a part of the room is left for what is to come
    assert np.abs(logged.states[:, 2]).max() < 0.6
    again = simulate_preset(BEARING, u, seed=4)
    assert np.array_equal(again.record["position"], logged.record["position"])


def apparent(name: str, fixed: dict[str, float]) -> tuple[Estimate, Estimate]:
    """Identify the second before a change and the second after it has settled."""
    done = simulate_scenario(name, BEARING, duration_s=2.2, at_s=1.0, seed=4)
    rig = default_rig()
    rig = replace(
        rig,
        parameters=tuple(
            replace(p, role="fixed", value=fixed[p.name]) if p.name in fixed else p for p in rig.parameters
        ),
    )
    signals = replace(done.record, channels=done.record.channels[:3])
    return identify(signals, rig, to_s=1.0), identify(signals, rig, from_s=1.2)


@pytest.mark.parametrize(
    ("name", "after"),
    [
        ("change", {"k_i": 0.85}),
        ("added-mass", {"m": 1.1}),
        # a position read 20 % short is one of a bench with other parameters (z = 0.8 x in the equations)
        ("sensor-gain", {"m": 1 / 0.8**2, "k_x": 1 / 0.8**2, "k_i": 1 / 0.8}),
    ],
)
def test_off_line_identification_finds_the_truth_before_and_after(name: str, after: dict[str, float]) -> None:
    before_it, after_it = apparent(name, {"c": 0.0})
    for estimate, factors in ((before_it, {}), (after_it, after)):
        for p in ("m", "k_x", "k_i", "R", "L"):
            truth = BEARING.parameters[p] * factors.get(p, 1.0)
            found = estimate.parameter(p)
            assert found.sd is not None
            assert abs(found.value - truth) < 4.0 * found.sd
            assert found.sd < 0.01 * abs(truth)


BALL = """schema = "ambid.rig/1"
name = "ball"
model = "one-axis"
[channels.voltage]
column = "u"
[channels.current]
column = "i"
gain = 0.5
unit = "V"
[channels.position]
column = "z"
[channels.speed]
column = "turns"
[parameters]
m = {{ value = {m!r}, unit = "kg" }}
k_x = {{ value = {k_x!r}, unit = "N/m" }}
k_i = {{ value = {k_i!r}, unit = "N/A" }}
R = {{ value = {R!r}, unit = "ohm" }}
L = {{ value = {L!r}, unit = "H" }}
[loop]
kp = {kp!r}
ki = {ki!r}
kd = {kd!r}
kc = {kc!r}
derivative_cutoff_hz = {derivative_cutoff_hz!r}
delay = 1
limits = {{ voltage = 48.0, current = 1.0, position = 2e-4 }}
[record]
rate_hz = 20000.0
"""


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    gains = {k: getattr(BEARING.loop, k) for k in ("kp", "ki", "kd", "kc", "derivative_cutoff_hz")}
    return rig_from_text(BALL.format(**BEARING.parameters, **gains), tmp_path / "rig.toml")


def test_a_rig_is_simulated_in_its_own_columns(rig: Rig) -> None:
    done = simulate_scenario("spin-up", rig, duration_s=0.3, seed=1, amplitude=5.0)
    assert done.record.names == ("u", "z", "i", "turns", "angle", "true_unbalance", "true_unbalance_phase")
    assert done.record.rate_hz == 20_000.0
    same = simulate_scenario(
        "spin-up", replace(BEARING, noise=type(BEARING.noise)()), duration_s=0.3, seed=1, amplitude=5.0
    )
    assert done.record["i"] == pytest.approx(same.record["current"] / 0.5, rel=1e-12)
    assert np.array_equal(done.record["turns"], same.record["speed"])
    still = simulate_scenario("change", rig, duration_s=0.1, seed=1)
    assert not still.record["turns"].values.any()
    assert still.record["true_k_i"][-1] == pytest.approx(0.85 * BEARING.parameters["k_i"])


def test_bad_requests_are_refused(rig: Rig) -> None:
    for name, more, said in (
        ("chang", {}, "Did you mean 'change'"),
        ("change", {"at_s": 9.0}, "from 0 to 4 s"),
        ("change", {"size": np.nan}, "finite"),
        ("change", {"duration_s": -1.0}, "it must be 1 to"),
        ("change", {"amplitude": -1.0}, "zero or positive"),
        ("change", {"rate_hz": 0.0}, "rate_hz"),
        ("steady", {"size": 1.0}, "no size"),
        ("quiet", {"amplitude": 1.0}, "no excitation"),
        ("added-mass", {"size": -1.0}, "must stay positive"),
    ):
        with pytest.raises(ModelError, match=said):
            simulate_scenario(name, BEARING, seed=0, **more)  # type: ignore[arg-type]
    free = replace(rig, limits=None)
    with pytest.raises(ModelError, match="Give one"):
        simulate_scenario("steady", free)
    with pytest.raises(RigError, match="gives no rate"):
        simulate_scenario("steady", replace(rig, record=type(rig.record)()))
    coil = rig_from_text(
        'schema = "ambid.rig/1"\nmodel = "coil"\n[parameters]\nR = { value = 1.5, unit = "ohm" }\n'
        'L = { value = 2.0, unit = "mH" }\n[record]\nrate_hz = 1000.0\n', Path("coil.toml"),
    )  # fmt: skip
    with pytest.raises(ModelError, match="changes 'k_i'"):
        simulate_scenario("change", coil, amplitude=1.0)
