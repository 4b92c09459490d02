"""A record through a rig: roles, units and calibration, and the refusals of what does not fit."""

import numpy as np
import pytest

from ambid.errors import RecordError, UnitError
from ambid.record import read_record
from ambid.rig import bench_record, default_rig, draft_rig, load_rig, read_bench, rig_text
from tests.measured import ABSENT, MAGLEV

DATA = MAGLEV
measured = pytest.mark.skipif(not DATA.exists(), reason=ABSENT)
N = 20
COIL = 'schema = "ambid.rig/1"\nmodel = "coil"\n'


def record(tmp_path, header, scale=1.0):
    path = tmp_path / "r.csv"
    rows = [f"{k * 1e-3:.6g},{k / 40},{k * scale},{k * 3}" for k in range(N)]
    path.write_text(header + "\n" + "\n".join(rows) + "\n")
    return read_record(path)


def test_columns_become_calibrated_roles(tmp_path, rig_file):
    r = bench_record(record(tmp_path, "time [s],duty [1],coil [mV],gap [mm]"), load_rig(rig_file()))
    k = np.arange(N)
    assert r.names == ("voltage", "position", "current")
    assert [c.unit for c in r.channels] == ["V", "m", "A"]
    np.testing.assert_allclose(r["voltage"], 10 * k / 40, rtol=1e-14)  # first half of the table
    np.testing.assert_allclose(r["current"], 0.5 * k * 1e-3 + 0.1, rtol=1e-14)  # gain per volt, as SI has it
    np.testing.assert_allclose(r["position"], 3e-6 * k, rtol=1e-14)  # the rig's um overrides the header's mm
    assert [s.name for s in r.history] == ["read", "calibrate", "calibrate", "select"]
    assert dict(r.history[-1].settings) == {"voltage": "duty", "position": "gap", "current": "coil"}


def test_default_rig_takes_roles_by_name_in_any_order_and_unit(tmp_path):
    r = bench_record(record(tmp_path, "time [s],current [mA],position [um],voltage [kV]"), default_rig())
    assert r.names == ("voltage", "position", "current")
    assert r["voltage"][1] == 3000.0
    assert r["position"][1] == 1e-6


def test_wrong_unit_gives_the_remedy(tmp_path):
    with pytest.raises(UnitError, match=r"column 'current' is in \[V\].*\[A\].*header.*channels\.current\.gain"):
        bench_record(record(tmp_path, "time [s],current [V],position [um],voltage [V]"), default_rig())


@pytest.mark.parametrize(
    ("header", "said"),
    [("position", "has no unit"), ("position [furlong]", r"\[furlong\], an unknown unit")],
)
def test_column_without_a_known_unit_cannot_be_used(tmp_path, header, said):
    with pytest.raises(UnitError, match=said + r".*position \[unit\].*channels\.position\.unit"):
        bench_record(record(tmp_path, f"time [s],current [A],{header},voltage [V]"), default_rig())


def test_unit_in_the_rig_mends_a_missing_one(tmp_path, rig_file):
    path = rig_file(COIL + '[channels.voltage]\n[channels.current]\nunit = "mA"\n')
    r = bench_record(record(tmp_path, "time [s],current,junk,voltage [V]"), load_rig(path))
    np.testing.assert_allclose(r["current"], np.arange(N) / 40e3, rtol=1e-14)


def test_unused_column_of_unknown_unit_does_no_harm(tmp_path, rig_file):
    path = rig_file(COIL)
    assert bench_record(record(tmp_path, "time [s],current [A],x [degC],voltage [V]"), load_rig(path)).n_samples == N


def test_swapped_columns_are_told_by_their_units(tmp_path, rig_file):
    rig = load_rig(rig_file(COIL + '[channels.voltage]\ncolumn = "i"\n[channels.current]\ncolumn = "u"\n'))
    with pytest.raises(UnitError, match=r"swapped.*'i' in \[A\].*'u' in \[V\]"):
        bench_record(record(tmp_path, "time [s],i [A],x [m],u [V]"), rig)


def test_missing_column_names_the_nearest(tmp_path):
    with pytest.raises(RecordError, match=r"'voltage'.*channels\.voltage.*current, position, volt.*'volt'"):
        bench_record(record(tmp_path, "time [s],current [A],position [m],volt [V]"), default_rig())


def test_table_is_not_left_by_extrapolation(tmp_path, rig_file):
    with pytest.raises(RecordError, match=r"'duty', sample 2: .*outside the table"):
        bench_record(record(tmp_path, "time [s],gap [m],duty [1],coil [A]"), load_rig(rig_file()))


def test_gain_needs_no_unit_of_the_role_but_an_offset_alone_does(tmp_path, rig_file):
    rig = load_rig(rig_file(COIL + "[channels.voltage]\n[channels.current]\noffset = 0.5\n"))
    r = bench_record(record(tmp_path, "time [s],current [A],x [m],voltage [V]"), rig)
    np.testing.assert_allclose(r["current"], np.arange(N) / 40 + 0.5, rtol=1e-14)
    with pytest.raises(UnitError, match=r"\[V\].*\[A\]"):
        bench_record(record(tmp_path, "time [s],current [V],x [m],voltage [V]"), rig)


def test_read_bench_uses_the_rigs_rate_and_gap_policy(tmp_path, rig_file):
    path = tmp_path / "r.csv"
    rows = ["x,0,0", *(f"{k / 40},{k},{k}" for k in range(N))]
    path.write_text("duty [1],coil [V],gap [um]\n" + "\n".join(rows) + "\n")
    r = read_bench(path, load_rig(rig_file()))
    assert (r.rate_hz, r.n_samples, r.start_s) == (1000.0, N, 0.001)
    with pytest.raises(RecordError, match="row 2"):
        read_bench(path, load_rig(rig_file()), gaps="error")
    assert read_bench(path, load_rig(rig_file()), rate_hz=50.0).rate_hz == 50.0


def test_mat_variables_come_from_the_rig(tmp_path, rig_file):
    from scipy.io import savemat

    t = np.arange(N) * 1e-3
    savemat(tmp_path / "r.mat", {"log": {"u": t * 2, "clock": t * 1e3}, "i": t})
    text = COIL + '[channels.voltage]\nvariable = "log.u"\nunit = "mV"\n[channels.current]\ncolumn = "i"\n'
    rig = load_rig(rig_file(text + '[record]\ntime = { variable = "log.clock", unit = "ms" }\n'))
    with pytest.raises(UnitError, match=r"channels\.current\.unit"):
        read_bench(tmp_path / "r.mat", rig)
    rig = load_rig(rig_file(text + 'unit = "A"\n[record]\ntime = { variable = "log.clock", unit = "ms" }\n'))
    r = read_bench(tmp_path / "r.mat", rig)
    assert r.rate_hz == 1000.0
    np.testing.assert_allclose(r["voltage"], t * 2e-3, rtol=1e-15)


def test_a_channel_that_is_logged_late_is_taken_back(tmp_path, rig_file):
    source = record(tmp_path, "time [s],u [V],i [A],x [m]")
    text = COIL + '[channels.voltage]\ncolumn = "u"\n[channels.current]\ncolumn = "i"\ndelay = 3\n'
    rig = load_rig(rig_file(text))
    bench = bench_record(source, rig)
    assert bench.n_samples == source.n_samples - 3
    np.testing.assert_array_equal(bench["current"], source["i"][3:])
    np.testing.assert_array_equal(bench["voltage"], source["u"][:-3])
    assert dict(bench.history[-1].settings) == {"current": 3}
    assert "delay = 3" in rig_text(rig, tmp_path)
    with pytest.raises(RecordError, match="is late by 99"):
        bench_record(source, load_rig(rig_file(text.replace("3\n", "99\n"))))


def test_draft_of_plain_names_is_ready_to_use(tmp_path, rig_file):
    source = record(tmp_path, "time [s],current [mA],position [um],voltage [V]")
    rig = load_rig(rig_file(draft_rig(source)))
    assert rig.parameters == default_rig().parameters
    assert bench_record(source, rig).names == ("voltage", "position", "current")


def test_draft_without_position_is_a_coil_where_that_is_told(tmp_path, rig_file):
    source = record(tmp_path, "time [s],u [V],temp [1],i_coil [A]")
    assert '[channels.position]\ncolumn = "position"   # CHECK: no column looks like it' in draft_rig(source)
    rig = load_rig(rig_file(draft_rig(source, coil=True)))
    assert rig.model == "coil"
    assert [c.column for c in rig.channels] == ["u", "i_coil"]


def test_draft_says_where_no_column_fits(tmp_path, rig_file):
    text = draft_rig(record(tmp_path, "time [s],a [1],b [1],c [1]"))
    assert text.count("no column looks like it; there are a [1], b [1], c [1]") == 3
    load_rig(rig_file(text))


@measured
def test_draft_of_the_measured_bench_picks_the_coil_that_works_and_asks_for_a_table(rig_file):
    source = read_record(DATA / "levitate_stairs_a.csv")
    text = draft_rig(source)
    rig = load_rig(rig_file(text))
    assert [c.column for c in rig.channels] == ["duty_upper", "position", "current_upper"]
    assert '# table  = "duty_upper_to_voltage.csv"' in text
    with pytest.raises(UnitError, match=r"'duty_upper' is in \[1\].*channels\.voltage\.gain or table"):
        bench_record(source, rig)


@measured
@pytest.mark.parametrize("name", ["stairs_a", "stairs_b", "updown_c", "sine_d", "sine_e"])
def test_measured_bench_with_its_table(rig_file, name):
    table = (DATA / "duty_to_voltage.csv").as_posix()
    channels = [("voltage", f'duty_upper"\ntable = "{table}'), ("current", "current_upper"), ("position", "position")]
    text = 'schema = "ambid.rig/1"\nmodel = "one-axis"\n'
    text += "".join(f'[channels.{role}]\ncolumn = "{column}"\n' for role, column in channels)
    r = read_bench(DATA / f"levitate_{name}.csv", load_rig(rig_file(text)))
    assert r["voltage"].values.min() >= 0.043
    assert r["voltage"].values.max() <= 11.06
