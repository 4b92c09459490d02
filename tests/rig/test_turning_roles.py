"""Speed and angle of a turning rotor: roles that a rig may name, whatever its model."""

import numpy as np
import pytest

from ambid.errors import RigError, UnitError
from ambid.record import Channel, Record, write_record
from ambid.rig import bench_record, draft_rig, load_rig, read_bench, rig_text, write_rig

N = 40
TURNING = '[channels.angle]\ncolumn = "phi"\n[channels.speed]\ncolumn = "tacho"\n'
PLAIN = 'schema = "ambid.rig/1"\nmodel = "one-axis"\n[channels.voltage]\n[channels.current]\n[channels.position]\n'


def record(speed_unit="rad/s", **more):
    t = np.arange(N) / 1000.0
    columns = {"voltage": ("V", np.cos(t)), "current": ("A", np.sin(t)), "position": ("m", 1e-5 * t)}
    columns |= {"tacho": (speed_unit, 10.0 + t), "phi": ("rad", 10.0 * t), "true_k_i": ("N/A", t), **more}
    return Record(rate_hz=1000.0, channels=tuple(Channel(name=n, unit=u, values=v) for n, (u, v) in columns.items()))


def test_they_are_named_by_role_and_the_truth_is_left_out(rig_file, tmp_path):
    rig = load_rig(rig_file(PLAIN + TURNING))
    assert [c.role for c in rig.channels] == ["voltage", "position", "current", "speed", "angle"]
    write_record(record(), tmp_path / "r.csv")
    read = read_bench(tmp_path / "r.csv", rig)
    assert read.names == ("voltage", "position", "current", "speed", "angle")
    assert [read.channel(n).unit for n in ("speed", "angle")] == ["rad/s", "rad"]
    assert np.array_equal(read["speed"], record()["tacho"])


def test_they_are_not_needed(rig_file):
    rig = load_rig(rig_file(PLAIN))
    assert bench_record(record(), rig).names == ("voltage", "position", "current")


def test_rpm_and_degrees_become_si(rig_file, tmp_path):
    path = tmp_path / "r.csv"
    rows = "".join(f"{k / 1000},1,1,1,{60 * k},{180 * k}\n" for k in range(N))
    path.write_text("time [s],voltage [V],current [A],position [m],tacho [rpm],phi [deg]\n" + rows)
    read = read_bench(path, load_rig(rig_file(PLAIN + TURNING)))
    np.testing.assert_allclose(read["speed"], 2 * np.pi * np.arange(N), rtol=1e-14)
    np.testing.assert_allclose(read["angle"], np.pi * np.arange(N), rtol=1e-14)
    bare = path.read_text().replace("tacho [rpm]", "tacho")
    path.write_text(bare)
    read = read_bench(path, load_rig(rig_file(PLAIN + TURNING + 'unit = "rpm"\n')))
    np.testing.assert_allclose(read["speed"], 2 * np.pi * np.arange(N), rtol=1e-14)


def test_turns_per_second_are_not_taken_for_an_angular_speed(rig_file):
    rig = load_rig(rig_file(PLAIN + TURNING))
    with pytest.raises(UnitError, match=r"'tacho' is in \[Hz\]; the rig needs a speed in \[rad/s\]"):
        bench_record(record("Hz"), rig)
    turns = load_rig(rig_file(PLAIN + TURNING + f"gain = {2 * np.pi!r}\n"))
    assert bench_record(record("Hz"), turns)["speed"][0] == pytest.approx(20 * np.pi)


def test_a_delay_or_a_misspelt_role_is_refused(rig_file):
    with pytest.raises(RigError, match=r"channels\.speed\.delay.*inputs only"):
        load_rig(rig_file(PLAIN + TURNING + 'delay = "auto"\n'))
    with pytest.raises(RigError, match=r"unknown role \[channels\.sped\].*'speed'"):
        load_rig(rig_file(PLAIN + '[channels.sped]\ncolumn = "tacho"\n'))
    with pytest.raises(RigError, match="both channels"):
        load_rig(rig_file(PLAIN + TURNING.replace("phi", "tacho")))


def test_writing_keeps_them(rig_file, tmp_path):
    rig = load_rig(rig_file(PLAIN + TURNING + 'gain = 2.0\nunit = "V"\n'))
    write_rig(rig, tmp_path / "again.toml")
    again = load_rig(tmp_path / "again.toml")
    for c, same in zip(again.channels, rig.channels, strict=True):
        assert (c.role, c.column, c.unit) == (same.role, same.column, same.unit)
    assert again.channel("speed").calibration.gain == 2.0
    assert '[channels.speed]\ncolumn = "tacho"' in rig_text(rig, tmp_path)


def test_a_draft_names_them_where_name_and_unit_say_so(rig_file):
    turning = load_rig(rig_file(draft_rig(record(speed_unit="rad/s", omega=("rad/s", np.ones(N))))))
    assert turning.channel("speed").column == "omega"
    assert turning.channel("angle").column == "phi"
    plain = load_rig(
        rig_file(draft_rig(record(speed_unit="1", phi=("1", np.ones(N)), speed_ref=("rad/s", np.ones(N)))))
    )
    assert [c.role for c in plain.channels] == ["voltage", "position", "current"]
