"""Tables in memory: the same record from each kind, the rules of files, and every slip refused on one line."""

from __future__ import annotations

import datetime
import subprocess
import sys

import numpy as np
import pandas as pd
import polars as pl
import pytest
import xarray as xr

from ambid.errors import RecordError
from ambid.record import Record, read_record, read_rows, write_record

N, RATE = 50, 1000.0
T = np.arange(N) / RATE
U, I = np.sin(2 * np.pi * 40 * T), np.cos(2 * np.pi * 40 * T)  # noqa: E741
PLAIN = {"voltage [V]": U, "current [mA]": 1e3 * I}
UNITS = {"voltage": "V", "current": "mA"}
NAMED = pd.DataFrame({"voltage": U, "current": 1e3 * I}, index=pd.Index(T))
DATES = pd.Timestamp("2026-03-01 12:00", tz="Europe/Berlin") + pd.to_timedelta(T, unit="s")


def dataset(**more) -> xr.Dataset:
    variables = {"voltage": ("time", U, {"units": "V"}), "current": ("time", 1e3 * I, {"units": "mA"})}
    return xr.Dataset(variables | more, coords={"time": T})


TABLES = {
    "pandas, time column": (pd.DataFrame({"time [s]": T} | PLAIN), {}),
    "pandas, time column in ms": (pd.DataFrame({"t [ms]": 1e3 * T} | PLAIN), {}),
    "pandas, seconds as index": (pd.DataFrame(PLAIN, index=T), {}),
    "pandas, named index in ms": (pd.DataFrame(PLAIN, index=pd.Index(1e3 * T, name="time [ms]")), {}),
    "pandas, time differences": (pd.DataFrame(PLAIN, index=pd.to_timedelta(T, unit="s")), {}),
    "pandas, dates": (pd.DataFrame(PLAIN, index=DATES), {}),
    "pandas, dates in a column": (pd.DataFrame({"time": DATES} | PLAIN), {}),
    "pandas, rate": (pd.DataFrame(PLAIN), {"rate_hz": RATE}),
    "pandas, units beside": (NAMED, {"units": UNITS}),
    "pandas, nullable": (pd.DataFrame(PLAIN).astype("Float64"), {"rate_hz": RATE}),
    "pandas, every second row": (pd.DataFrame({k: np.repeat(x, 2) for k, x in PLAIN.items()})[::2], {"rate_hz": RATE}),
    "polars, time column": (pl.DataFrame({"time [s]": T} | PLAIN), {}),
    "polars, durations": (pl.DataFrame({"time": [datetime.timedelta(seconds=t) for t in T]} | PLAIN), {}),
    "polars, rate": (pl.DataFrame(PLAIN), {"rate_hz": RATE}),
    "xarray": (dataset(), {}),
    "xarray, dates": (dataset().assign_coords(time=DATES.tz_localize(None)), {}),
    "xarray, no coordinate": (dataset().drop_vars("time"), {"rate_hz": RATE}),
    "dict": (PLAIN, {"rate_hz": RATE}),
    "dict, units beside": ({"voltage": U.tolist(), "current": 1e3 * I}, {"rate_hz": RATE, "units": UNITS}),
    "dict, time": ({"time [s]": T} | PLAIN, {}),
    "dict of Series": ({"time [s]": pd.Series(T)} | {k: pd.Series(x) for k, x in PLAIN.items()}, {}),
}


@pytest.mark.parametrize("kind", TABLES)
def test_every_table_gives_the_record_that_the_file_gives(kind, tmp_path):
    table, words = TABLES[kind]
    found = Record.from_dataframe(table, **words)
    write_record(Record.from_dataframe(PLAIN, rate_hz=RATE), tmp_path / "r.csv")
    wanted = read_record(tmp_path / "r.csv")
    assert found.rate_hz == pytest.approx(RATE, rel=1e-9)
    assert (found.start_s, found.names) == (0.0, wanted.names)
    assert [c.unit for c in found.channels] == ["V", "A"]
    assert [c.source_unit for c in found.channels] == ["V", "mA"]
    for name in found:
        np.testing.assert_allclose(found[name], wanted[name], rtol=1e-15)
    assert len(found.provenance["sha256"]) == 64
    assert found.history[0].name == "read"


def test_a_record_becomes_tables_and_comes_back():
    record = Record.from_dataframe(PLAIN, rate_hz=RATE)[0.01:0.04]
    for table in (record.to_dataframe(), record.to_xarray(), {x: record[x] for x in record}):
        words = {"rate_hz": RATE} if isinstance(table, dict) else {}
        back = read_record(table, **words)
        assert back.rate_hz == pytest.approx(RATE)
        assert back.start_s == pytest.approx(0.0 if words else 0.01)
        assert [(c.name, c.unit) for c in back.channels] == [(c.name, c.unit) for c in record.channels]
        assert all((back[x] == record[x]).all() for x in record)
    assert record.to_xarray().attrs["history"].startswith("read(")


def holed(gap=np.nan) -> dict:
    u = U.copy()
    u[7] = gap
    return {"time [s]": T, "voltage [V]": u}


def test_missing_values_are_refused_or_treated_as_in_files():
    masked = {"voltage [V]": np.ma.masked_equal(np.arange(N), 7)}
    for table in (holed(), pd.DataFrame(holed()), pl.DataFrame(holed(None) | {"voltage [V]": [None, *U[1:]]}), masked):
        with pytest.raises(RecordError, match=r"row [07], column 'voltage'.*gaps"):
            read_record(table, rate_hz=RATE)
    assert read_record(holed(), gaps="interpolate")["voltage"][7] == pytest.approx((U[6] + U[8]) / 2)
    assert read_record(holed(), gaps="cut").n_samples == N - 8
    assert np.isnan(read_rows(pd.DataFrame(holed())).record["voltage"][7])
    whole = pd.array([None, *range(N - 1)], dtype="Int64")
    with pytest.raises(RecordError, match="row 0, column 'count'"):
        read_record(pd.DataFrame({"count [1]": whole}), rate_hz=RATE)


JITTERED = T + 0.4e-3 * (np.arange(N) == 20)
REFUSED = {
    "a rate in words": (PLAIN, {"rate_hz": "1000"}, "rate given is '1000'"),
    "a truth as a rate": (PLAIN, {"rate_hz": True}, "rate given is True"),
    "an absurd rate": (PLAIN, {"rate_hz": 1e300}, "up to 1e"),
    "several rates": (PLAIN, {"rate_hz": [1.0]}, "positive number of Hz"),
    "units without names": (PLAIN, {"rate_hz": RATE, "units": ["V", "mA"]}, "a unit by column"),
    "numbers as objects": ({"u [V]": U.astype(object)}, {"rate_hz": RATE}, "numbers as objects"),
    "neither time nor rate": (PLAIN, {}, "no column 'time \\[s\\]'"),
    "rate against time": ({"time [s]": T} | PLAIN, {"rate_hz": 500.0}, "1000 Hz.*500 Hz"),
    "jitter": ({"time [s]": JITTERED} | PLAIN, {}, "row 20.*1 %"),
    "time backwards": (pd.DataFrame(PLAIN, index=T[::-1]), {}, "backwards"),
    "time without a unit": ({"time": 10 * T} | PLAIN, {}, "'time' has no unit.*100 Hz"),
    "time in volts": ({"time [V]": T} | PLAIN, {}, "time must be in"),
    "time twice": (pd.DataFrame({"time [s]": T} | PLAIN, index=pd.Index(T, name="t")), {}, "time twice"),
    "time alone": ({"time [s]": T}, {}, "nothing else"),
    "dates as a channel": ({"when": DATES} | PLAIN, {"rate_hz": RATE}, "holds times"),
    "an index of text": (pd.DataFrame(PLAIN, index=[f"{t} s" for t in T]), {}, "is no time"),
    "an index of something else": (pd.DataFrame(PLAIN, index=pd.Index(T, name="gap")), {}, "'gap'.* is no time"),
    "rows left out": (pd.DataFrame(PLAIN).drop(index=[4, 5]), {"rate_hz": RATE}, "jumps"),
    "MultiIndex of rows": (pd.DataFrame(PLAIN).set_index([np.zeros(N), T]), {}, "MultiIndex.*each row"),
    "MultiIndex of columns": (pd.DataFrame({("a", "u"): U, ("b", "u"): U}), {"rate_hz": RATE}, "MultiIndex.*column"),
    "a name twice": (pd.DataFrame(np.c_[U, I], columns=["u", "u"]), {"rate_hz": RATE}, "'u' twice"),
    "a name twice but for the unit": ({"u [V]": U, "u [mV]": I}, {"rate_hz": RATE}, "'u' twice"),
    "names that are numbers": (pd.DataFrame(np.c_[U, I]), {"rate_hz": RATE}, "called 0"),
    "text": ({"voltage [V]": [f"{x} V" for x in U]}, {"rate_hz": RATE}, "no numbers.*'0.0 V'"),
    "objects": (pd.DataFrame({"voltage [V]": U.astype(object)}).map(str), {"rate_hz": RATE}, "no numbers"),
    "categories": (pd.DataFrame({"u": pd.Categorical(["on", "off"] * 25)}), {"rate_hz": RATE}, "no numbers.*'on'"),
    "complex": ({"voltage [V]": U + 1j * I}, {"rate_hz": RATE}, "complex"),
    "whole numbers too large": ({"stamp [1]": 10**18 + np.arange(N)}, {"rate_hz": RATE}, "2\\^53"),
    "nullable ones": (pd.DataFrame({"stamp [1]": pd.array(10**18 + np.arange(N), dtype="Int64")}), {"rate_hz": RATE},
                      "2\\^53"),
    "a matrix": ({"voltage [V]": np.c_[U, I]}, {"rate_hz": RATE}, "shape \\(50, 2\\)"),
    "a number": ({"voltage [V]": 1.0}, {"rate_hz": RATE}, "shape \\(\\)"),
    "lengths": ({"u [V]": U, "i [A]": I[:-1]}, {"rate_hz": RATE}, "differ in length \\(u 50, i 49\\)"),
    "nothing": ({}, {"rate_hz": RATE}, "no columns"),
    "no rows": (pd.DataFrame({"u [V]": []}, dtype=float), {"rate_hz": RATE}, "0 rows"),
    "few rows": (pd.DataFrame(PLAIN)[:3], {"rate_hz": RATE}, "3 rows"),
    "units that contradict": (PLAIN, {"rate_hz": RATE, "units": {"current": "A"}}, "in \\[A\\] and in \\[mA\\]"),
    "units of no column": (PLAIN, {"rate_hz": RATE, "units": {"currant": "A"}}, "Did you mean 'current'"),
    "a unit that is no text": (PLAIN, {"rate_hz": RATE, "units": {"voltage": 1}}, "a unit is a text"),
    "a rate that is none": (PLAIN, {"rate_hz": -1.0}, "positive"),
    "gaps that are none": (PLAIN, {"rate_hz": RATE, "gaps": "skip"}, "interpolate"),
    "two dimensions": (dataset(map=(("x", "y"), np.zeros((2, 3)))), {}, "'map'.*dimensions"),
    "a Series": (pd.Series(U), {"rate_hz": RATE}, "to_frame"),
    "a LazyFrame": (pl.DataFrame(PLAIN).lazy(), {"rate_hz": RATE}, "collect"),
    "a DataArray": (dataset()["voltage"], {}, "to_dataset"),
    "an array": (np.c_[U, I], {"rate_hz": RATE}, "ndarray.*dict of arrays"),
    "a list of tables": ([PLAIN], {"rate_hz": RATE}, "of type list"),
    "nothing at all": (None, {}, "NoneType"),
}  # fmt: skip


@pytest.mark.parametrize("slip", REFUSED)
def test_what_breaks_a_rule_is_refused_on_one_line_with_what_to_do(slip):
    table, words, said = REFUSED[slip]
    with pytest.raises(RecordError, match=said) as refused:
        read_record(table, **words)
    assert "\n" not in str(refused.value)
    assert str(refused.value)[-1] not in ".:"
    assert ". " in str(refused.value)


def test_units_beside_a_file_or_a_record_are_refused(tmp_path):
    record = Record.from_dataframe(PLAIN, rate_hz=RATE)
    write_record(record, tmp_path / "r.csv")
    for source in (record, tmp_path / "r.csv"):
        with pytest.raises(RecordError, match="units= is for tables"):
            read_record(source, units={"voltage": "V"})


def test_a_record_handed_in_stays_as_it_is_and_keeps_its_rate():
    record = Record.from_dataframe(PLAIN, rate_hz=RATE)
    assert read_record(record) is record
    assert read_record(record, rate_hz=RATE) is record
    with pytest.raises(RecordError, match="1000 Hz but rate_hz"):
        read_record(record, rate_hz=10.0)


@pytest.mark.parametrize(("name", "method"), [("pandas", "to_dataframe"), ("xarray", "to_xarray")])
def test_a_package_that_is_missing_is_named(name, method, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(RecordError, match=f"{name} is not installed"):
        getattr(Record.from_dataframe(PLAIN, rate_hz=RATE), method)()


def test_reading_a_file_or_a_dict_imports_none_of_the_packages():
    code = (
        "import sys, ambid; r = ambid.Record.from_dataframe({'u [V]': range(9)}, rate_hz=1.0);"
        "print(r, [m for m in ('pandas', 'polars', 'xarray') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "Record of 9 samples, 9 s at 1 Hz: u [V] []"


def test_a_unit_of_time_that_is_guessed_is_told():
    table = {"time": 0.5 * np.arange(40), "u [V]": np.sin(np.arange(40))}
    record = read_record(table)
    assert record.rate_hz == pytest.approx(2000.0)
    assert record.history[0].settings["time"] == "in [ms], in which its rate is a usual one"
