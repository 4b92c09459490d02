"""Dialects of CSV: what is certain is read and told, what is not is asked back in one line."""

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.record import read_record
from ambid.record.clock import dates

TIME, VOLTAGE, POSITION = np.arange(20) * 1e-3, 0.5 * np.arange(20), 1234.5 * np.arange(20)
HEAD = ["time [s]", "voltage [V]", "position [mm]"]


def point(x):
    return f"{x:.3f}"


def comma(x):
    return f"{x:.3f}".replace(".", ",")


def german(x):
    return f"{x:,.3f}".translate(str.maketrans(",.", ".,"))


def text(heads=(HEAD,), form=point, mark=",", columns=(TIME, VOLTAGE, POSITION), tail=""):
    rows = [mark.join(map(form, row)) for row in zip(*columns, strict=True)]
    return "\n".join([*(x if isinstance(x, str) else mark.join(x) for x in heads), *rows]) + "\n" + tail


NAMES, UNITS = ["time", "voltage", "position"], ["s", "V", "mm"]
BEHIND = ["time (s)", "voltage (V)", "position (mm)"]
TEXTS = ["time", "voltage (V)", "position (left)"]
CERTAIN = {
    "decimal comma": (text(form=comma, mark=";"), {"delimiter": ";", "decimal": ","}),
    "decimal comma, tabs": (text(form=comma, mark="\t"), {"delimiter": "\t", "decimal": ","}),
    "decimal comma, quoted": (text(form=lambda x: f'"{comma(x)}"'), {"decimal": ","}),
    "thousands": (text(form="{:,.3f}".format, mark=";"), {"delimiter": ";", "thousands": ","}),
    "thousands points": (text(form=german, mark=";"), {"delimiter": ";", "decimal": ",", "thousands": "."}),
    "apostrophes": (text(form=lambda x: f"{x:,.3f}".replace(",", "'")), {"thousands": "'"}),
    "narrow spaces": (text(form=lambda x: f"{x:,.3f}".replace(",", "\u202f")), {"thousands": "\u202f"}),
    "row of units": (text([NAMES, UNITS]), {"units": "row"}),
    "units in brackets below": (text([NAMES, [f"[{x}]" for x in UNITS]], comma, ";"),
                                {"units": "row", "delimiter": ";", "decimal": ","}),
    "parentheses": (text([BEHIND]), {"units": "parentheses"}),
    "preamble": (text(["Model,X7,3", "Interval,1e-3", "", "# now", HEAD]), {"preamble": 2}),
    "preamble, units below": (text(["Model X7", NAMES, UNITS]), {"preamble": 1, "units": "row"}),
}  # fmt: skip


@pytest.mark.parametrize("case", CERTAIN)
def test_what_is_certain_is_read_and_told(tmp_path, case):
    data, understood = CERTAIN[case]
    (tmp_path / "a.csv").write_text(data, encoding="utf-8")
    record = read_record(tmp_path / "a.csv")
    assert [(c.name, c.unit) for c in record.channels] == [("voltage", "V"), ("position", "m")]
    assert record.rate_hz == pytest.approx(1000.0)
    np.testing.assert_array_equal(record["voltage"].values, VOLTAGE)
    np.testing.assert_array_equal(record["position"].values, POSITION / 1000)
    assert dict(record.history[0].settings) == {"format": "csv", "rows": 20, **understood}
    if "preamble" in understood:
        assert "Model" in record.provenance["comment"]


LARGE = (np.arange(20.0) + 1, np.arange(20.0) + 1)
BOTH = text(["time [s];voltage [V]"], lambda x: f"{x:.0f},234", ";", LARGE)
ASKED = {
    "1,234": (BOTH, r"row 2: '1,234' may be 1.234 or 1234; .*layout={'decimal': 'comma'}, or layout={'thousands': "
                    r"'comma'}$"),
    "two rows of "
    "text": (text([NAMES, ["left", "right", "mm"]]), r"rows 1 and 2 .*layout={'units': 'row'}, or "
                                                                    r"layout={'units': 'none'}"),
    "a place in parentheses": (text([TEXTS]), r"row 1: \(left\) is no known unit.*layout={'units': 'parentheses'}"),
    "point among commas": (text(form=comma, mark=";", tail="0,020;1.5;3\n"), r"row 22: '1.5' is not a number"),
    "comma among points": (text(form="{:,.3f}".format, mark=";", tail="0,020;1;3\n"), r"row 22: '0,020' is not"),
    "decimal and separating commas": (text(form=comma), r"row 2: 6 cells where the header names 3"),
}  # fmt: skip


@pytest.mark.parametrize("case", ASKED)
def test_what_is_not_certain_is_asked_back(tmp_path, case):
    data, words = ASKED[case]
    (tmp_path / "a.csv").write_text(data, encoding="utf-8")
    with pytest.raises(RecordError, match=words) as refused:
        read_record(tmp_path / "a.csv")
    assert "\n" not in str(refused.value)


def test_the_layout_decides(tmp_path):
    path = tmp_path / "a.csv"

    def read(data, stored="utf-8", **layout):
        path.write_bytes(data.encode(stored))
        record = read_record(path, layout=layout, rate_hz=None if "time [s]" in data else 1000.0)
        assert record.history[0].settings["layout"] == layout
        return record

    assert read(BOTH, decimal="comma")["voltage"].values[0] == 1.234
    assert read(BOTH, thousands=",")["voltage"].values[0] == 1234.0
    named = text([["voltage", "position"], ["bar", "mm"]], columns=(VOLTAGE, POSITION))
    assert [c.source_unit for c in read(named, units="row").channels] == ["bar", "mm"]
    plain = text([["u (V)", "x (left)"]], columns=(VOLTAGE, POSITION))
    assert read(plain, units="none").names == ("u (V)", "x (left)")
    assert [c.source_unit for c in read(plain, units="parentheses").channels] == ["V", "left"]
    micro = text([["time [s]", "voltage [µV]", "position [mm]"]])
    assert read(micro, "latin-1", encoding="latin-1")["voltage"].source_unit == "uV"
    assert read(text(form=comma, mark=";"), decimal=",", separator=";")["voltage"].values[3] == 1.5
    for layout, words in (
        ({"decimal": "x"}, "one of ,, comma"),
        ({"decimal": ",", "separator": ","}, "both decimal and separator"),
        ({"decimal": ",", "thousands": ","}, "both decimal and thousands"),
        ({"units": "row"}, "no names stand above"),
    ):
        with pytest.raises(RecordError, match=words):
            read(text(form=comma, mark=";"), **layout)


def test_utf_16_is_known_by_its_mark(tmp_path):
    (tmp_path / "a.csv").write_bytes(text().encode("utf-16"))
    record = read_record(tmp_path / "a.csv")
    assert record.history[0].settings["encoding"] == "utf-16"
    np.testing.assert_array_equal(record["voltage"].values, VOLTAGE)


def test_long_files_are_read_in_the_same_dialect(tmp_path, monkeypatch):
    monkeypatch.setattr("ambid.record.csv_format._LONG", 1)
    for heads in ([BEHIND], [NAMES, UNITS], ["Model,X7,3", HEAD]):
        (tmp_path / "a.csv").write_text(text(heads))
        np.testing.assert_array_equal(read_record(tmp_path / "a.csv")["position"].values, POSITION / 1000)


def test_a_bomb_is_refused(tmp_path, monkeypatch):
    import gzip

    monkeypatch.setattr("ambid.record.record._MOST_UNPACKED", 1 << 16)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"0,0\n" * (1 << 18)))
    with pytest.raises(RecordError, match="over 200 times its size"):
        read_record(tmp_path / "a.csv.gz")


_SIGNALS = "".join(f"{k % 5 - 2},{k % 7 - 3},{k % 3 - 1}\n" for k in range(12))


@pytest.mark.parametrize(
    "line",
    [
        "Sample rate: 50k",
        "Sample rate: 50 kSa",
        "Sample rate: 50,000 Hz",
        "Abtastrate: 50.000 Hz",
        "dt = 0.02",
        "fs = 50",
    ],
)
def test_a_rate_that_may_be_a_thousand_times_another_is_asked_for(tmp_path, line):
    path = tmp_path / "a.csv"
    path.write_text(f"{line}\nu [V],i [A],x [m]\n{_SIGNALS}")
    with pytest.raises(RecordError, match="rate_hz"):
        read_record(path)
    assert read_record(path, rate_hz=50e3).rate_hz == 50e3


@pytest.mark.parametrize(
    ("line", "rate_hz"),
    [("fs = 50 Hz", 50.0), ("dt = 0.02 s", 50.0), ("dt = 1.000 ms", 1e3), ("Sample rate: 25.000 kHz", 25e3),
     ("dt = 0.001", 1e3), ("fs = 2000", 2e3), ("Samples per second: 100", 100.0)],
)  # fmt: skip
def test_a_rate_with_its_unit_is_taken(tmp_path, line, rate_hz):
    path = tmp_path / "a.csv"
    path.write_text(f"{line}\nu [V],i [A],x [m]\n{_SIGNALS}")
    assert read_record(path).rate_hz == rate_hz


def test_a_temperature_called_t_is_not_the_time_where_another_column_is(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("Zeit [s],T,u [V]\n" + "".join(f"{k / 1000},{20 + k % 2},{k % 5}\n" for k in range(12)))
    record = read_record(path)
    assert (record.rate_hz, record.names) == (1000.0, ("T", "u"))


@pytest.mark.parametrize(
    ("line", "rate"),
    [
        ("Sample rate (kHz): 10", 10_000.0), ("Sampling rate: 10 000 Hz", 10_000.0), ("Rate: 10\u202f000 Hz", 10_000.0),
        ("Abtastrate: 10'000 Hz", 10_000.0), ("Sample rate: 20 kS/s", 20_000.0), ("Sample rate: 20000 Sa/s", 20_000.0),
        ("# Sample rate (kHz) = 10", 10_000.0), ("# sampled at 10 kHz", 10_000.0), ("# dt [ms]: 0.1", 10_000.0),
        ("# fs: 10", None), ("fs = 20kHz", 20_000.0), ("Sample rate: 20k", None), ("Rate: 10", None),
        ("Abtastrate: 10.000 Hz", None), ("# Recorded at 2024", None), ("# logged at: 1000", None),
    ],
)  # fmt: skip
def test_a_rate_above_the_table_is_read_or_asked_for(tmp_path, line, rate):
    path = tmp_path / "r.csv"
    path.write_text(text([line, HEAD[1:]], columns=(VOLTAGE, POSITION)), encoding="utf-8")
    if rate is None:
        with pytest.raises(RecordError, match="rate_hz"):
            read_record(path)
    else:
        assert read_record(path).rate_hz == rate


@pytest.mark.parametrize(
    "stamp",
    [
        "12/31/2025 1:{:02d}:{:05.2f} PM", "31.12.2025 13:{:02d}:{:05.2f}", "31/12/25 13:{:02d}:{:05.2f}",
        "31-12-2025 13:{:02d}:{:05.2f}", "2025/12/31 13:{:02d}:{:05.2f}", "2025-12-31T13:{:02d}:{:05.2f}Z",
        "0 days 00:{:02d}:{:05.2f}",
    ],
)  # fmt: skip
def test_dates_of_any_country_are_time(stamp):
    stamps = [stamp.format(2, 3.0 + k / 10) for k in range(5)]
    for texts in (stamps, [x.replace(".", ",") if x.count(".") == 1 else x for x in stamps]):
        np.testing.assert_allclose(dates(texts), np.arange(5) / 10, atol=1e-9)


def test_midnight_changes_the_day_and_nothing_else_does():
    np.testing.assert_array_equal(dates(["12/31/2025 11:59:59 PM", "1/1/2026 12:00:00 AM"]), [0.0, 1.0])
    for texts in (["31.12.2025 13:00:00", "2.1.2026 13:00:01"], ["31.12.2025 13:00:00", "31.12.2025 1:00:00 PM"],
                  ["31.12.2025 25:00:00", "31.12.2025 25:00:01"], ["1.2.3"], ["31.12.2025 13:00:00", "x"]):  # fmt: skip
        assert dates(texts) is None


INSTRUMENTS = {
    "a delimiter behind every row": text([BEHIND]).replace("\n", ",\n").replace("(mm),", "(mm)"),
    "full-width brackets": text([["time（s）", "voltage（V）", "position（㎜）"]]),
    "brackets, parentheses and units behind": text([["time_s", "voltage (Volts)", "position [mm]"]]),
    "a unit that is no place": text([["time (s)", "voltage (V)", "position (mm)", "temperature (℃)"]],
                                    columns=(TIME, VOLTAGE, POSITION, TIME)),
    "units behind a key": text(['"Model","X7"', '"Vertical Units","V","mm"', NAMES]),
    "names and units behind keys": text(
        ['"TraceName","voltage","position"', '"VUnit","V","mm"', '"SampleRate",1000,1000', '"Time","14:03"', ""],
        columns=(VOLTAGE, POSITION)),
    "units by column in LabVIEW, one without": text(
        ["***End_of_Header***", "Y_Unit_Label\tV\t\tmm", "***End_of_Header***", "X_Value\tvoltage\tplain\tposition"],
        mark="\t", columns=(TIME, VOLTAGE, TIME, POSITION)),
    "rows of LabVIEW that begin with a tab": "\n".join(
        ["Y_Unit_Label\tV\tmm\t", "Delta_X\t1e-3\t1e-3\t", "***End_of_Header***\t\t", "X_Value\tvoltage\tposition"]
        + [f"\t{point(u)}\t{point(x)}" for u, x in zip(VOLTAGE, POSITION, strict=True)]),
    "a header in a comment": text(["# time[s] voltage[V] position[mm]"], mark=" "),
    "time stamps in numbers": text([["timestamp", "voltage [V]", "position [mm]"]]),
}  # fmt: skip


@pytest.mark.parametrize("case", INSTRUMENTS)
def test_what_instruments_write_is_read(tmp_path, case):
    (tmp_path / "a.csv").write_text(INSTRUMENTS[case], encoding="utf-8")
    record = read_record(tmp_path / "a.csv")
    assert record.rate_hz == pytest.approx(1000.0)
    kinds = {c.name: c.unit for c in record.channels if c.name not in ("temperature", "plain")}
    assert kinds == {"voltage": "V", "position": "m"}
    np.testing.assert_array_equal(record["position"].values, POSITION / 1000)


def test_names_that_differ_in_units_alone_are_numbered_and_places_in_an_array_are_names(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(text([["time", "signal", "signal"], UNITS]))
    assert [(c.name, c.unit) for c in read_record(path).channels] == [("signal", "V"), ("signal 2", "m")]
    path.write_text(text([["time [s]", "Y[0]", "Y[1]"]]))
    assert [(c.name, c.unit) for c in read_record(path).channels] == [("Y[0]", "?"), ("Y[1]", "?")]
    path.write_text(text([["time", "signal", "signal"], ["s", "V", "V"]]))
    with pytest.raises(RecordError, match="'signal' occurs twice"):
        read_record(path)


def test_notes_beside_a_table_end_and_a_channel_that_stops_does_not(tmp_path):
    path, rows = tmp_path / "a.csv", [f"{k / 1000},{k % 5},{k % 3}" for k in range(200)]
    path.write_text("\n".join(["time [s],u [V],i [A],mean", rows[0] + ",3.5", *(x + "," for x in rows[1:])]) + "\n")
    record = read_record(path)
    assert record.names == ("u", "i")
    assert record.history[0].settings["left_out"] == ["mean"]
    stopped = [x + f",{k % 7}" * (k < 150) + "," * (k >= 150) for k, x in enumerate(rows)]
    path.write_text("\n".join(["time [s],u [V],i [A],x [m]", *stopped]) + "\n")
    with pytest.raises(RecordError, match=r"row 152, column 'x': the value is missing"):
        read_record(path)


def test_cells_that_name_themselves_are_columns(tmp_path):
    path, rows = tmp_path / "serial.txt", [f"us:{500 * k + 7},u:{k % 5}.5,x_mm:-{k % 3}e-1" for k in range(20)]
    for mark in (",", "\t", " "):
        path.write_text("Ready\n" + "\n".join(x.replace(",", mark) for x in rows) + "\n")
        record = read_record(path)
        assert (record.names, record.rate_hz) == (("u", "x_mm"), 2000.0)
        np.testing.assert_array_equal(record["x_mm"], [-0.1 * (k % 3) for k in range(20)])
    path.write_text("\n".join([*rows, "us:10007,u:"]))
    with pytest.raises(RecordError, match=r"row 21: its cells are not us:…, u:…, x_mm:…"):
        read_record(path)
    path.write_text("\n".join(["Ready", *rows[:19], "us:9507,u:1e999,x_mm:2"]))
    with pytest.raises(RecordError, match=r"row 21, column 'u': '1e999' is not a finite number"):
        read_record(path)
    path.write_text("fs: 2000, gain: 3\n" + text([HEAD]))
    assert read_record(path).names == ("voltage", "position")


def test_a_date_beside_numbers_is_no_number_with_a_space_in_it(tmp_path):
    path, stamps = tmp_path / "a.csv", [f"3/5/2024 2:03:{k:02d} PM" for k in range(20)]
    path.write_text(text([["stamp", "u [V]", "i [A]"]], form=str, columns=(stamps, range(20), range(20))))
    assert dict(read_record(path).history[0].settings).keys() == {"format", "rows", "left_out", "time"}
