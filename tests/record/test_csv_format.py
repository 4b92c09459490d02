"""CSV records: what is read, exactly; what comes back after writing, to the last bit."""

import gzip
import hashlib

import numpy as np
import pandas
import pytest

from ambid.errors import RecordError
from ambid.record import Channel, Record, read_record, write_record
from ambid.record.csv_format import read_csv, write_csv
from ambid.record.csv_kernels import powers_of_ten, read_rows
from tests.measured import ABSENT, RECORDS

DATA = RECORDS
COLUMNS = ("position", "current_upper", "current_lower", "duty_upper", "duty_lower")


def lines(n=20, rate=1000.0):
    return [f"{k / rate:.9g},{0.1 * k},{-2.5 * k}" for k in range(n)]


def written(tmp_path, text, name="r.csv"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def csv(header="time [s],voltage [V],position [mm]", rows=None, comments=""):
    return comments + header + "\n" + "\n".join(rows if rows is not None else lines()) + "\n"


def test_columns_become_channels_in_si(tmp_path):
    text = csv(comments="# bench 3\n#second line\n")
    r = read_record(written(tmp_path, text))
    assert r.rate_hz == 1000.0
    assert r.names == ("voltage", "position")
    assert [c.unit for c in r.channels] == ["V", "m"]
    assert [c.source_unit for c in r.channels] == ["V", "mm"]
    np.testing.assert_array_equal(r["voltage"], [float(f"{0.1 * k}") for k in range(20)])
    np.testing.assert_allclose(r["position"], -2.5e-3 * np.arange(20), rtol=1e-15)
    assert r.provenance["sha256"] == hashlib.sha256(text.encode()).hexdigest()
    assert r.provenance["comment"] == "bench 3\nsecond line"
    assert r.history[0].name == "read"


@pytest.mark.parametrize(("unit", "factor"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("µs", 1e6)])
def test_time_units_give_the_same_rate_and_start(tmp_path, unit, factor):
    rows = [f"{(5.0 + k * 5e-5) * factor:.12g},{k}" for k in range(40)]
    r = read_record(written(tmp_path, csv(f"time [{unit}],voltage [V]", rows)))
    assert r.rate_hz == pytest.approx(20000.0, rel=1e-9)
    assert r.start_s == pytest.approx(5.0, rel=1e-12)


def test_rate_is_given_where_time_is_not(tmp_path):
    path = written(tmp_path, csv("voltage [V]", [str(k) for k in range(9)]))
    assert read_record(path, rate_hz=500.0).rate_hz == 500.0
    with pytest.raises(RecordError, match=r"give rate_hz"):
        read_record(path)


def test_gzip_and_byte_order_mark_and_windows_lines_change_nothing(tmp_path):
    text = csv()
    plain = read_record(written(tmp_path, text))
    for k, other in enumerate([b"\xef\xbb\xbf" + text.encode(), text.replace("\n", "\r\n").encode()]):
        np.testing.assert_array_equal(read_record(written(tmp_path, other, f"{k}.csv"))["position"], plain["position"])
    zipped = read_record(written(tmp_path, gzip.compress(text.encode()), "r.csv.gz"))
    np.testing.assert_array_equal(zipped["position"], plain["position"])
    assert zipped.rate_hz == plain.rate_hz


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_other_delimiters_are_read_where_unambiguous_and_said(tmp_path, delimiter):
    r = read_record(written(tmp_path, csv().replace(",", delimiter)))
    np.testing.assert_allclose(r["voltage"], 0.1 * np.arange(20), rtol=1e-15)
    assert r.history[0].settings["delimiter"] == delimiter


def test_unit_missing_or_unknown_is_kept_as_unknown(tmp_path):
    r = read_record(written(tmp_path, csv("time [s],voltage,temperature [degC]")))
    assert [(c.unit, c.source_unit) for c in r.channels] == [("?", "?"), ("?", "degC")]


def test_round_trip_keeps_every_bit(tmp_path):
    rng = np.random.default_rng(7)
    values = rng.standard_normal(200) * 10.0 ** rng.integers(-300, 300, 200)
    values[:3] = [0.1 + 0.2, 5e-324, -0.0]
    record = Record(
        rate_hz=10000.0,
        start_s=2.5,
        channels=(Channel(name="position", unit="m", values=values), Channel(name="duty", unit="?", values=-values)),
    )
    for name in ("a.csv", "a.csv.gz"):
        write_record(record, tmp_path / name, comments=["made by a test"])
        back = read_record(tmp_path / name)
        assert back.rate_hz == 10000.0
        assert back.start_s == 2.5
        assert [c.unit for c in back.channels] == ["m", "?"]
        assert back["position"].values.tobytes() == values.tobytes()
        assert back.provenance["comment"] == "made by a test"
        assert pandas.read_csv(tmp_path / name)["position [m]"].to_numpy().tobytes() == values.tobytes()
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes() + (b"" if name.endswith("gz") else b"\n"))
    assert "comment" not in read_record(tmp_path / "a.csv").provenance  # it is another file now


def test_equal_records_give_equal_files(tmp_path):
    r = read_record(written(tmp_path, csv()))
    write_csv(r, tmp_path / "a.csv.gz")
    write_csv(r, tmp_path / "b.csv.gz")
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()


def test_rates_that_are_no_whole_number_survive_rewriting(tmp_path):
    r = Record(rate_hz=610.3515625, channels=(Channel(name="v", unit="V", values=np.arange(5000.0)),))
    write_csv(r, tmp_path / "a.csv")
    assert read_csv(tmp_path / "a.csv").rate_hz == pytest.approx(610.3515625, rel=1e-9)


def test_writer_refuses_what_the_reader_would_refuse(tmp_path):
    nan = Record(rate_hz=1.0, channels=(Channel(name="v", unit="V", values=np.array([0.0, np.nan] + [0.0] * 8)),))
    with pytest.raises(RecordError, match="'v', sample 1"):
        write_csv(nan, tmp_path / "a.csv")
    comma = Record(rate_hz=1.0, channels=(Channel(name="v,w", unit="V", values=np.zeros(9)),))
    with pytest.raises(RecordError, match="Rename"):
        write_csv(comma, tmp_path / "a.csv")
    good = Record(rate_hz=1.0, channels=(Channel(name="v", unit="V", values=np.zeros(9)),))
    with pytest.raises(RecordError, match="cannot be written"):
        write_csv(good, tmp_path / "no" / "a.csv")


@pytest.mark.parametrize("long", [1 << 30, 0], ids=["by NumPy", "compiled"])
def test_long_files_keep_their_order_and_name_a_late_fault(tmp_path, monkeypatch, long):
    monkeypatch.setattr("ambid.record.csv_format._LONG", long)
    values = np.random.default_rng(1).standard_normal((50_000, 3))
    rows = [",".join(map(repr, row)) for row in values.tolist()]
    header = "a [V],b [A],c [m]"
    r = read_csv(written(tmp_path, csv(header, rows)), rate_hz=1e4)
    np.testing.assert_array_equal(np.column_stack([c.values for c in r.channels]), values)
    rows[45_678] = "1,x,2"
    path = written(tmp_path, csv(header, rows, "# one comment\n"))
    with pytest.raises(RecordError, match="row 45681, column 'b': 'x'"):
        read_csv(path, rate_hz=1e4)
    cut = read_csv(path, rate_hz=1e4, gaps="cut")
    np.testing.assert_array_equal(np.column_stack([c.values for c in cut.channels]), values[:45_678])


def test_compiled_reading_gives_the_nearest_double():
    rng, powers = np.random.default_rng(5), powers_of_ten()
    x = np.concatenate(
        [
            rng.standard_normal(20_000) * 10.0 ** rng.integers(-30, 30, 20_000),
            rng.integers(-(10**6), 10**6, 5000) / 1000,
            np.nextafter(2.0 ** rng.integers(-60, 60, 1000), 0.0),
            [0.0, -0.0, 1e22, 5e-60, 2.0**53 + 2.0],
        ]
    )
    for style in ("r", ".17g", ".9g", ".12f"):
        cells = [repr(v) if style == "r" else format(v, style) for v in x.tolist() if style != ".12f" or abs(v) < 1e3]
        text, found = np.frombuffer(("\n".join(cells) + "\n").encode(), dtype=np.uint8), np.empty((len(cells), 1))
        assert read_rows(text, 0, ord(","), powers, found) == text.size
        np.testing.assert_array_equal(found[:, 0], [float(cell) for cell in cells])


def test_compiled_reading_is_right_or_leaves_it_where_digits_are_many():
    rng, powers, found = np.random.default_rng(9), powers_of_ten(), np.empty((1, 1))
    cells = ["969.4874619156155404", "-952.7811483202159479", "9999999999999999999", "0.0009223372036854775809"]
    for digits in rng.integers(17, 23, 4000).tolist():
        number = "".join(map(str, [int(rng.integers(1, 10)), *rng.integers(0, 10, digits - 1).tolist()]))
        place = int(rng.integers(0, digits))
        cells.append(f"{number[:place]}.{number[place:]}")
    read = 0
    for cell in cells:
        if read_rows(np.frombuffer(f"{cell}\n".encode(), dtype=np.uint8), 0, ord(","), powers, found) > 0:
            read += 1
            assert found[0, 0] == float(cell), cell
    assert read > 1000


@pytest.mark.parametrize(
    "row", ["1,", ",1", "1", "1,2,3", "1,x", "1,nan", "1,2e", "1,.", "1,1e999", "1,1e23", "1, 2", "1;2", ""]
)
def test_compiled_reading_leaves_what_is_not_plain(row):
    text = np.frombuffer(f"{row}\n".encode(), dtype=np.uint8)
    assert read_rows(text, 0, ord(","), powers_of_ten(), np.empty((1, 2))) == -1


@pytest.mark.skipif(not DATA.exists(), reason=ABSENT)
@pytest.mark.parametrize(
    ("name", "rate", "n", "names"),
    [
        ("maglev/levitate_stairs_a", 1000.0, 15001, ("reference", *COLUMNS)),
        ("maglev/coil_steps_1", 200.0, 4201, COLUMNS),
        ("benchmarks/dryer", 12.5, 1000, ("input", "output")),
        ("benchmarks/silverbox", 610.35155, 131072, ("input", "output")),
    ],
)  # fmt: skip
def test_measured_records(name, rate, n, names):
    r = read_record(DATA / f"{name}.csv")
    assert r.rate_hz == pytest.approx(rate, rel=1e-8)
    assert r.n_samples == n
    assert r.names == names
