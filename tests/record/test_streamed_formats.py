"""TDMS, MDF, Parquet and Arrow, written by their own libraries: channels, units, rates, groups, and what is refused."""

import datetime as dt
import sys
from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.record import read_record, write_record

N = 400
U, X = np.sin(np.arange(N) / 10), np.round(1000 * np.cos(np.arange(N) / 9)).astype("i2")
WAVE = {"wf_increment": 1e-3, "wf_start_time": dt.datetime(2024, 5, 6), "unit_string": "Volts"}


def tdms(path, channels):
    """Write a file of (group, name, values, properties)."""
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is not installed")
    with nptdms.TdmsWriter(path) as writer:
        half = [nptdms.ChannelObject(g, n, x[: len(x) // 2], p) for g, n, x, p in channels]
        writer.write_segment(half)
        writer.write_segment([nptdms.ChannelObject(g, n, x[len(x) // 2 :]) for g, n, x, _ in channels])
    return path


def mdf(path, groups, version="4.10"):
    """Write a file of groups of (name, values, unit, further properties), with their interval."""
    asammdf = pytest.importorskip("asammdf", reason="asammdf is not installed")
    with asammdf.MDF(version=version) as file:
        for group, (step, channels) in groups.items():
            made = [asammdf.Signal(x, np.arange(len(x)) * step, name=n, unit=u, **more) for n, x, u, more in channels]
            file.append(made, acq_name=group)
        file.save(path, overwrite=True)
    return path


def table(path, columns, metadata=None):
    """Write a Parquet or Arrow file; `metadata`: of fields by name."""
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    from pyarrow import feather, parquet

    arrays = {k: pyarrow.array(v) for k, v in columns.items()}
    fields = [pyarrow.field(k, a.type, metadata=(metadata or {}).get(k)) for k, a in arrays.items()]
    made = pyarrow.table(list(arrays.values()), schema=pyarrow.schema(fields))
    if path.suffix == ".parquet":
        parquet.write_table(made, path, row_group_size=150)
    else:
        feather.write_feather(made, path, chunksize=150)
    return path


def said(record):
    return {k: v for step in record.history for k, v in step.settings.items()}


def test_tdms_gives_channels_in_si_with_rate_and_date(tmp_path):
    path = tdms(
        tmp_path / "a.tdms",
        [("Log", "voltage", U, WAVE), ("Log", "position", X, {**WAVE, "unit_string": "", "unit": "um"})],
    )
    record = read_record(path)
    assert (record.rate_hz, record.names, [c.unit for c in record.channels]) == (
        1000.0,
        ("voltage", "position"),
        ["V", "m"],
    )
    np.testing.assert_array_equal(record["voltage"].values, U)
    np.testing.assert_array_equal(record["position"].values, X / 1e6)
    assert record.provenance["taken_at"].startswith("2024-05-06T00:00:00")
    assert len(record.provenance["sha256"]) == 64
    assert said(record)["group"] == "Log"
    with pytest.raises(RecordError, match=r"1000 Hz but rate_hz says 500"):
        read_record(path, rate_hz=500)
    with pytest.raises(RecordError, match=r"\.tdms files are read, not written"):
        write_record(record, path)


def test_daqmx_scales_are_applied(tmp_path):
    scale = {"NI_Number_Of_Scales": 1, "NI_Scaling_Status": "unscaled", "NI_Scale[0]_Scale_Type": "Linear",
             "NI_Scale[0]_Linear_Slope": 0.5, "NI_Scale[0]_Linear_Y_Intercept": 3.0,
             "NI_Scale[0]_Linear_Input_Source": 0xFFFFFFFF}  # fmt: skip
    record = read_record(tdms(tmp_path / "a.tdms", [("Log", "voltage", X, {**WAVE, **scale})]))
    np.testing.assert_allclose(record["voltage"].values, 0.5 * X + 3.0)


def test_groups_are_asked_back_and_chosen(tmp_path):
    path = tdms(tmp_path / "a.tdms", [("Fast", "u", U, WAVE), ("Slow", "u", U[:50], WAVE)])
    with pytest.raises(RecordError, match=r"2 groups \(Fast/u; Slow/u\)\. Say which: layout={'group': 'Fast'}"):
        read_record(path)
    assert read_record(path, layout={"group": "Slow"}).n_samples == 50
    with pytest.raises(RecordError, match=r"no group 'Fats'.*Did you mean 'Fast'"):
        read_record(path, layout={"group": "Fats"})
    with pytest.raises(RecordError, match=r"layout grop='Fast'; .* has group, channels"):
        read_record(path, layout={"grop": "Fast"})


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (("Log", "i", U[:100], WAVE), r"differ in length \(u 400, i 100\)"),
        (("Log", "i", U, {**WAVE, "wf_increment": 2e-3}), r"differ in rate \(u 1000 Hz, i 500 Hz\)"),
        (("Log", "i", U, {"unit_string": "A"}), r"differ in rate \(u 1000 Hz, i none\)"),
        (("Log", "i", U, {**WAVE, "wf_start_time": dt.datetime(2025, 1, 1)}), r"differ in start"),
        (("Log", "i", U, {**WAVE, "wf_increment": 0.0}), r"differ in rate \(u 1000 Hz, i none\)"),
        (("Log", "i", U, {**WAVE, "Unit": "mV"}), r"'i' is in \[V\] and in \[mV\]"),
        (("Log", "i", np.where(X > 990, np.nan, U), WAVE), r"column 'i': nan is not a finite"),
    ],
)
def test_what_differs_or_contradicts_is_named(tmp_path, second, words):
    path = tdms(tmp_path / "a.tdms", [("Log", "u", U, WAVE), second])
    with pytest.raises(RecordError, match=words):
        read_record(path)
    assert read_record(path, layout={"channels": "u"}).names == ("u",)


def test_no_rate_and_texts_are_told(tmp_path):
    path = tdms(tmp_path / "a.tdms", [("Log", "u", U, {}), ("Log", "note", np.array(["a"] * N), {})])
    with pytest.raises(RecordError, match=r"no column 'time \[s\]'.*rate_hz"):
        read_record(path)
    record = read_record(path, rate_hz=200)
    assert (record.rate_hz, record.names, record["u"].unit, said(record)["left_out"]) == (200.0, ("u",), "?", ["note"])


@pytest.mark.parametrize("version", ["4.10", "4.20", "3.30"])
def test_mdf_gives_physical_values_of_one_time_base(tmp_path, version):
    linear = {"conversion": {"a": 0.001, "b": 1.0}}
    path = mdf(
        tmp_path / ("a.mdf" if version < "4" else "a.mf4"),
        {"fast": (1e-3, [("voltage", U, "V", {}), ("position", X, "mm", linear)])}, version,
    )  # fmt: skip
    record = read_record(path)
    assert (record.rate_hz, record.names, [c.unit for c in record.channels]) == (
        1000.0,
        ("voltage", "position"),
        ["V", "m"],
    )
    np.testing.assert_allclose(record["position"].values, 1e-3 * (0.001 * X + 1.0), rtol=1e-14)
    assert record.provenance["taken_at"]
    assert said(record)["format"] == f"mdf {version}"


def test_mdf_bases_are_asked_back(tmp_path):
    groups = {"fast": (1e-3, [("u", U, "V", {})]), "slow": (1e-2, [("u", U[:40], "V", {})])}
    path = mdf(tmp_path / "a.mf4", groups)
    with pytest.raises(RecordError, match=r"2 groups \(fast/time, fast/u; slow/time, slow/u\)"):
        read_record(path)
    assert read_record(path, layout={"group": "slow"}).rate_hz == 100.0
    twice = {"fast": (1e-3, [("u", U, "V", {}), ("u", -U, "V", {})])}
    with pytest.raises(RecordError, match="'u' occurs twice"):
        read_record(mdf(path, twice))


def test_invalid_samples_of_mdf_are_gaps(tmp_path):
    bits = {"invalidation_bits": np.arange(N) == 7}
    path = mdf(tmp_path / "a.mf4", {"fast": (1e-3, [("u", U, "V", bits), ("i", U, "A", {})])})
    with pytest.raises(RecordError, match="row 8, column 'u': nan"):
        read_record(path)
    record = read_record(path, gaps="interpolate")
    assert said(record)["values"] == 1
    assert record["u"].values[7] == pytest.approx(U[[6, 8]].mean())
    assert read_record(path, gaps="cut").start_s == pytest.approx(8e-3)


@pytest.mark.parametrize("name", ["a.parquet", "a.feather", "a.arrow"])
def test_arrow_tables_have_units_in_metadata_or_names(tmp_path, name):
    stamps = np.datetime64("2024-01-01T00:00:00", "ns") + np.arange(N) * np.timedelta64(100_000, "ns")
    columns = {"stamp": stamps, "voltage [mV]": U, "position": X, "remark": ["a"] * N}
    path = table(tmp_path / name, columns, {"position": {"unit": "um"}})
    record = read_record(path)
    assert (record.rate_hz, record.names, [c.unit for c in record.channels]) == (
        1e4,
        ("voltage", "position"),
        ["V", "m"],
    )
    np.testing.assert_array_equal(record["voltage"].values, U / 1000)
    assert record.provenance["taken_at"].startswith("2024-01-01")
    assert said(record)["left_out"] == ["remark"]
    with pytest.raises(RecordError, match=r"'u' is in \[V\] and in \[mV\]"):
        read_record(table(path, {"u [V]": U}, {"u [V]": {"unit": "mV"}}), rate_hz=1)


def test_arrow_time_and_missing_values(tmp_path):
    time = np.arange(N) * 0.5
    path = table(tmp_path / "a.parquet", {"time [ms]": time, "u [V]": [None, *U[1:].tolist()], "n": np.arange(N)})
    with pytest.raises(RecordError, match=r"row 1, column 'u': nan"):
        read_record(path)
    record = read_record(path, gaps="cut")
    assert (record.rate_hz, record.start_s, record["n"].unit, record["n"].values[0]) == (2000.0, 5e-4, "?", 1.0)
    with pytest.raises(RecordError, match=r"'time' has no unit.* count samples"):
        read_record(table(path, {"time": 2 * time, "u": U}))
    assert read_record(table(path, {"Zeit": time * 1e-3, "u": U})).rate_hz == 2000.0
    with pytest.raises(RecordError, match=r"advances by 9"):
        read_record(table(path, {"time [s]": np.where(time > 50, time + 4, time), "u": U}))


@pytest.mark.parametrize(("name", "module"), [("a.tdms", "nptdms"), ("a.mf4", "asammdf"), ("a.parquet", "pyarrow")])
def test_a_missing_library_is_one_line(tmp_path, monkeypatch, name, module):
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes({"a.tdms": b"TDSm", "a.mf4": b"MDF     ", "a.parquet": b"PAR1"}[name])
    with pytest.raises(RecordError, match=rf"^{module} is not installed, .* ambid\[formats\]$"):
        read_record(tmp_path / name)


def test_identify_and_track_take_the_layout_from_the_call_or_the_rig(tmp_path):
    from ambid import identify, simulate, track
    from ambid.rig import default_rig

    made = simulate("unstable-bearing", duration=0.4, seed=1)
    wave = {"wf_increment": 1 / made.rate_hz}
    columns = [(g, c.name, c.values, {**wave, "unit_string": c.unit}) for g in ("A", "B") for c in made.channels]
    path = tdms(tmp_path / "a.tdms", columns)
    with pytest.raises(RecordError, match="2 groups"):
        identify(path)
    told = identify(path, layout={"group": "B"})
    rig = default_rig()
    known = replace(rig, record=replace(rig.record, layout={"group": "B"}))
    assert identify(path, known).values == told.values
    for way in ({"layout": {"group": "B"}}, {"rig": known}):
        assert track(path, start=told, **way).lines[-1].parameters.keys() >= {"m", "k_i"}
