"""A rig is simulated into records that the same rig reads back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ambid.errors import RigError
from ambid.physics.presets import preset
from ambid.record import write_csv
from ambid.rig import Rig, load_rig, read_bench
from ambid.simulation import simulate_preset, simulate_rig

RIG = """schema = "ambid.rig/1"
name = "ball"
model = "one-axis"
[channels.voltage]
column = "duty"
table = "table.csv"
[channels.current]
column = "shunt"
gain = 0.5
offset = 0.1
unit = "V"
[channels.position]
column = "z"
[channels.reference]
column = "z_wanted"
[parameters]
m = {{ value = 60.0, unit = "g", role = "fixed" }}
k_x = {{ value = {k_x!r}, unit = "N/m" }}
k_i = {{ value = {k_i!r}, unit = "N/A" }}
R = {{ value = 4.2, unit = "ohm" }}
L = {{ value = {L!r}, unit = "H" }}
[operating_point]
position = {{ value = 10.0, unit = "mm" }}
current = {{ value = 0.95, unit = "A" }}
[loop]
kp = {kp!r}
ki = {ki!r}
kd = {kd!r}
kc = {kc!r}
derivative_cutoff_hz = {derivative_cutoff_hz!r}
delay = 1
limits = {{ voltage = [0.0, 12.0], position = [0.002, 0.020] }}
[noise]
position = 2e-6
current = 1e-3
"""


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    p = preset("levitated-ball")
    gains = {k: getattr(p.loop, k) for k in ("kp", "ki", "kd", "kc", "derivative_cutoff_hz")}
    (tmp_path / "rig.toml").write_text(RIG.format(**{**p.parameters, **gains}))
    (tmp_path / "table.csv").write_text("duty [1],voltage [V]\n0.0,0.0\n0.05,0.0\n0.5,5.5\n1.0,12.0\n")
    return load_rig(tmp_path / "rig.toml")


def test_record_is_read_back_through_the_rig(rig: Rig, tmp_path: Path) -> None:
    u = np.random.default_rng(0).standard_normal(500)
    done = simulate_rig(rig, u, rate_hz=2000.0, seed=1)
    assert set(done.record.names) == {"duty", "shunt", "z", "z_wanted"}
    assert 0.0 <= done.record["duty"].values.min() < done.record["duty"].values.max() <= 1.0
    write_csv(done.record, tmp_path / "record.csv")
    read = read_bench(tmp_path / "record.csv", rig)
    # the preset has the same plant, loop and operating point; only its noise differs
    same = simulate_preset(preset("levitated-ball"), u, seed=1, noise=rig.noise)
    for name in ("voltage", "current", "position"):
        assert read[name] == pytest.approx(same.record[name], rel=1e-6)
    assert np.all(read["reference"] == 0.010)


def test_loop_opens_on_request(rig: Rig) -> None:
    done = simulate_rig(replace(rig, limits=None), np.zeros(5), rate_hz=2000.0, seed=1, closed=False)
    assert np.array_equal(done.states[:, 0], np.full(5, 0.010))
    assert any("unstable" in w for w in done.warnings)


def test_what_the_rig_lacks_is_named(rig: Rig) -> None:
    u = np.zeros(5)
    bare = tuple(replace(p, value=None, role="free") if p.name in ("R", "L") else p for p in rig.parameters)
    with pytest.raises(RigError, match=r"no value for .*R, L; a linear simulation"):
        simulate_rig(replace(rig, parameters=bare), u, rate_hz=2000.0, seed=1)
    with pytest.raises(RigError, match=r"no \[loop\]"):
        simulate_rig(replace(rig, loop=None), u, rate_hz=2000.0, seed=1, closed=True)
    beyond = np.full(50, 20.0)
    with pytest.raises(RigError, match=r"channels\.voltage gives 0 to 12"):
        simulate_rig(replace(rig, limits=None), beyond, rate_hz=2000.0, seed=1)
    in_mm = tuple(replace(c, unit="mm") if c.role == "position" else c for c in rig.channels)
    with pytest.raises(RigError, match=r"channels\.position\.unit"):
        simulate_rig(replace(rig, channels=in_mm), u, rate_hz=2000.0, seed=1)
