"""Damaged CSV records: each is refused in one line that says where and what to do."""

import gzip
import os
import time
from pathlib import Path

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.record import read_record

HEADER = "time [s],voltage [V],position [mm]"


def rows(n=20):
    return [f"{k * 0.001:.6g},{0.1 * k:.6g},{k}" for k in range(n)]


def changed(row, text):
    """The rows with the one in file line `row` (the header is line 1) replaced."""
    body = rows()
    body[row - 2] = text
    return body


def text(body, header=HEADER):
    return (header + "\n" + "\n".join(body) + "\n").encode()


CASES = {
    "empty file": (b"", ["0 bytes", "again"]),
    "only blank lines": (b"\n\n\n", ["header"]),
    "header only": (text([]), ["no data"]),
    "comments only": (b"# a\n# b\n", ["header"]),
    "one row": (text(rows(1)), ["1 row", "at least 8"]),
    "two rows": (text(rows(2)), ["2 rows", "at least 8"]),
    "seven rows": (text(rows(7)), ["7 rows", "at least 8"]),
    "no header, three rising": ("\n".join(rows()).encode(), ["column 1, column 2", "layout={'time': 'NAME'}"]),
    "text in numbers": (text(changed(9, "0.007,high,7")), ["row 9", "'voltage'", "'high'", "gaps='cut'"]),
    "missing cell": (text(changed(9, "0.007,,7")), ["row 9", "'voltage'", "missing", "gaps='cut'"]),
    "nan": (text(changed(9, "0.007,0.7,NaN")), ["row 9", "'position'", "'NaN'"]),
    "infinite": (text(changed(9, "0.007,-inf,7")), ["row 9", "'voltage'", "'-inf'"]),
    "overflow": (text(changed(9, "0.007,1e999,7")), ["row 9", "'voltage'", "'1e999'"]),
    "underscored number": (text(changed(9, "0.007,1_0,7")), ["row 9", "'voltage'", "'1_0'"]),
    "too few cells": (text(changed(9, "0.007,0.7")), ["row 9", "2 cells", "3 columns"]),
    "too many cells": (text(changed(9, "0.007,0.7,7,8")), ["row 9", "4 cells", "3 columns"]),
    "cut off in the last row": (text(changed(21, "0.019,1.")), ["row 21", "cut off"]),
    "all rows too wide": (text([r + ",1" for r in rows()]), ["row 2", "4 cells"]),
    "empty line inside": (text(changed(9, "")), ["row 9", "empty"]),
    "comment among data": (text(changed(9, "# pause")), ["row 9", "comment"]),
    "decimal commas, comma separated": (text([r.replace(".", ",") for r in rows()]), ["row 3", "decimal comma"]),
    "semicolons under a comma header": (text([r.replace(",", ";") for r in rows()]), ["row 2", "';'", "commas"]),
    "two delimiters in the header": (text(rows(), "time [s],voltage [V];position [mm]"), ["row 1", "';'", "commas"]),
    "header separated by blanks": (text(rows(), "time [s] voltage [V] position [mm]"), ["row 1", "commas"]),
    "duplicate column": (text(rows(), "time [s],voltage [V],voltage [mm]"), ["row 1", "'voltage'", "twice"]),
    "nameless column": (text(rows(), "time [s],voltage [V],[mm]"), ["row 1", "column 3", "no name"]),
    "trailing comma in the header": (text(rows(), HEADER + ","), ["row 1", "column 4"]),
    "time without a unit": (
        text([f"{k * 10},{k},{k}" for k in range(20)], "time,voltage [V],position [mm]"),
        ["row 1", "'time'", "rises by 10 a row", "time [s]"],
    ),
    "whole numbers, in ms or us": (
        text([f"{k * 2},{k},{k}" for k in range(20)], "time,voltage [V],position [mm]"),
        ["ms (500 Hz) or us (500000 Hz)", "layout={'time_unit': 's'}"],
    ),
    "time in s or ms": (
        text([f"{k / 100},{k},{k}" for k in range(20)], "time,voltage [V],position [mm]"),
        ["s (100 Hz) or ms (100000 Hz)", "layout={'time_unit': 's'}"],
    ),
    "time in metres": (text(rows(), "time [m],voltage [V],position [mm]"), ["'time'", "[m]", "[ms]"]),
    "time in an unknown unit": (text(rows(), "time [jiffy],voltage [V],position [mm]"), ["'time'", "[jiffy]", "[ms]"]),
    "time only": (text([r.split(",")[0] for r in rows()], "time [s]"), ["nothing else"]),
    "time stands still": (text(changed(9, "0.006,0.7,7")), ["row 9", "stands still"]),
    "time runs backwards": (text(changed(9, "0.0035,0.7,7")), ["row 9", "backwards"]),
    "time all zero": (text(["0,1,2"] * 20), ["row 3", "stands still"]),
    "jitter of 2 %": (text(changed(9, "0.00702,0.7,7")), ["row 9", "1.02 samples", "rate_hz", "resample"]),
    "skipped sample": (text(rows()[:7] + rows()[8:]), ["row 9", "2 samples", "gaps='cut'"]),
    "skipped last sample": (text([*rows()[:19], "0.020,2,20"]), ["row 21", "2 samples"]),
    "UTF-16": (text(rows()).decode().encode("utf-16")[:-1], ["utf-16", "encoding"]),
    "binary": (text(changed(9, "0.007,\0,7")), ["binary"]),
    "gzip without saying so": (gzip.compress(text(rows())), ["gzipped", ".gz"]),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_damage_is_named_in_one_line(tmp_path, case):
    data, said = CASES[case]
    path = tmp_path / "damaged.csv"
    path.write_bytes(data)
    with pytest.raises(RecordError) as failure:
        read_record(path)
    message = str(failure.value)
    assert "\n" not in message
    assert "damaged.csv" in message
    for words in said:
        assert words in message


def test_truncated_gzip(tmp_path):
    path = tmp_path / "r.csv.gz"
    path.write_bytes(gzip.compress(text(rows(500)))[:-200])
    with pytest.raises(RecordError, match="truncated"):
        read_record(path)


def test_gzip_that_is_none_or_empty(tmp_path):
    path = tmp_path / "r.csv.gz"
    path.write_bytes(text(rows()))
    with pytest.raises(RecordError, match="not a valid gzip"):
        read_record(path)
    path.write_bytes(gzip.compress(b""))
    with pytest.raises(RecordError, match="empty inside"):
        read_record(path)


def test_missing_file_names_the_nearest(tmp_path):
    (tmp_path / "record_7.csv").write_bytes(text(rows()))
    with pytest.raises(RecordError, match=r"record7\.csv does not exist \(record_7\.csv does\)"):
        read_record(tmp_path / "record7.csv")
    with pytest.raises(RecordError, match="folder"):
        read_record(tmp_path / "nowhere" / "record7.csv")


def test_folder_instead_of_a_file(tmp_path):
    (tmp_path / "r.csv").mkdir()
    with pytest.raises(RecordError, match="is a folder"):
        read_record(tmp_path / "r.csv")
    with pytest.raises(RecordError, match="is a folder"):
        read_record(tmp_path)


def test_permission_denied(tmp_path, monkeypatch):
    def denied(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", denied)  # file modes do not stop a superuser
    with pytest.raises(RecordError, match=r"r\.csv may not be read \(permission denied\)"):
        read_record(tmp_path / "r.csv")


def test_unknown_format_lists_the_known(tmp_path):
    with pytest.raises(RecordError, match=r"\.csv\.gz.*\.mat"):
        read_record(tmp_path / "record.doc")


@pytest.mark.parametrize("rate", [0.0, -5.0, float("nan"), float("inf")])
def test_rate_must_be_positive(tmp_path, rate):
    path = tmp_path / "r.csv"
    path.write_bytes(text([r.partition(",")[2] for r in rows()], "voltage [V],position [mm]"))
    with pytest.raises(RecordError, match="positive number of Hz"):
        read_record(path, rate_hz=rate)


def test_rate_that_contradicts_time(tmp_path):
    path = tmp_path / "r.csv"
    path.write_bytes(text(rows()))
    assert read_record(path, rate_hz=1000.0).rate_hz == 1000.0
    with pytest.raises(RecordError, match=r"1000 Hz.*2000 Hz"):
        read_record(path, rate_hz=2000.0)


def test_unknown_gap_policy(tmp_path):
    path = tmp_path / "r.csv"
    path.write_bytes(text(rows()))
    with pytest.raises(RecordError, match="interpolate"):
        read_record(path, gaps="fill")


@pytest.mark.parametrize("head", ["fs [kHz]: 20", "Sample rate (kHz),20", "fs = 0.02 MHz"])
def test_a_rate_above_the_numbers_is_in_its_unit(tmp_path, head):
    (tmp_path / "r.csv").write_text(head + "\nu [V],i [A]\n" + _rows(20), encoding="utf-8")
    assert read_record(tmp_path / "r.csv").rate_hz == 20_000.0


@pytest.mark.parametrize(
    "head", ["Abtastrate: 20.000 Hz", "rate: 200,000 Hz", "fs = 20", "fs [parsec]: 2000", "dt [furlong]: 0.001"]
)
def test_a_rate_above_the_numbers_that_could_be_another_is_not_taken(tmp_path, head):
    (tmp_path / "r.csv").write_text(head + "\nu [V];i [A]\n" + _rows(20).replace(",", ";"), encoding="utf-8")
    with pytest.raises(RecordError, match=r"no rate is given|has no unit"):
        read_record(tmp_path / "r.csv")


def test_time_of_no_usual_rate_is_asked_back(tmp_path):
    body = "".join(f"{45000 + k / 1.728e9:.12f},{k % 3}\n" for k in range(50))  # days, as Excel counts them
    (tmp_path / "r.csv").write_text("Time,u [V]\n" + body, encoding="utf-8")
    with pytest.raises(RecordError, match="it may be in s, ms or us"):
        read_record(tmp_path / "r.csv")


def test_a_rate_at_the_edge_of_the_usual_ones_is_asked_whatever_its_last_digit(tmp_path):
    for step in ("0.02", "0.0200001", "0.0199999"):
        (tmp_path / "r.csv").write_text(
            "t,u [V]\n" + "".join(f"{k * float(step)},{k % 3}\n" for k in range(50)), "utf-8"
        )
        with pytest.raises(RecordError, match=r"it may be in s \(.* or ms"):
            read_record(tmp_path / "r.csv")


def test_a_quote_without_end_is_refused_in_one_line(tmp_path):
    (tmp_path / "r.csv").write_text("time [s],u [V]\n" + '"' * 200_000, encoding="utf-8")
    with pytest.raises(RecordError, match="1 row"):
        read_record(tmp_path / "r.csv")


@pytest.mark.parametrize("head", ["", ",".join(f"c{k}" for k in range(100_000)) + "\n"])
def test_a_hundred_thousand_columns_are_refused_at_once(tmp_path, head):
    (tmp_path / "r.csv").write_text(head + ("1.5," * 99_999 + "2\n") * 9, encoding="utf-8")
    began = time.perf_counter()
    with pytest.raises(RecordError, match="100000 columns; a record has at most"):
        read_record(tmp_path / "r.csv")
    assert time.perf_counter() - began < 20.0


@pytest.mark.parametrize("name", ["r.csv", "r.csv.gz", "r.mat", "r.npz", "r.h5"])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(RecordError, match="a device or a pipe"):
        read_record(tmp_path / name)


def test_arrays_under_a_password_are_refused(tmp_path):
    np.savez(tmp_path / "r.npz", time=np.zeros(99))
    data = (tmp_path / "r.npz").read_bytes()
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        where = data.index(mark) + at
        data = data[:where] + b"\x01" + data[where + 1 :]
    (tmp_path / "r.npz").write_bytes(data)
    with pytest.raises(RecordError, match="no sound file of NumPy arrays"):
        read_record(tmp_path / "r.npz")


def test_arrays_that_unpack_to_gigabytes_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("ambid.record.record._MOST_UNPACKED", 1000)
    np.savez_compressed(tmp_path / "r.npz", time=np.zeros(1_000_000), u=np.zeros(1_000_000))
    with pytest.raises(RecordError, match="unpacks to more than"):
        read_record(tmp_path / "r.npz")


@pytest.mark.parametrize(
    "notes", ["[" * 100_000, "{}", "[]", "null", '{"sha256": 1, "rdfs:comment": {}}', "\x00", "x" * (3 << 20), None]
)
def test_notes_beside_that_are_none_change_nothing(tmp_path, notes):
    (tmp_path / "r.csv").write_text("time [s],u [V]\n" + "".join(f"{k / 100},{k}\n" for k in range(9)))
    beside = tmp_path / "r.csv-metadata.json"
    if notes is None:
        os.mkfifo(beside)
    else:
        beside.write_text(notes, encoding="utf-8")
    assert "comment" not in read_record(tmp_path / "r.csv").provenance


def _rows(n):
    return "".join(f"{k},{k % 3}\n" for k in range(n))
