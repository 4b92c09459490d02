"""Rows of a damaged record: everything that is there is read, what is missing is NaN, and format faults are refused."""

import gzip

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.record import Channel, Record, read_record, read_rows, write_record

LINES = [f"{k * 0.5:.1f},{k * 0.1:.6g},{k}" for k in range(20)]
HEADER = "time [ms],voltage [mV],position [um]"


def written(tmp_path, lines=LINES, name="r.csv", header=HEADER):
    path = tmp_path / name
    data = ("# bench 3\n" + header + "\n" + "\n".join(lines) + "\n").encode()
    path.write_bytes(gzip.compress(data) if name.endswith(".gz") else data)
    return path


@pytest.mark.parametrize("name", ["r.csv", "r.csv.gz"])
def test_a_sound_file_gives_what_read_record_gives(tmp_path, name):
    path = written(tmp_path, name=name)
    rows, record = read_rows(path), read_record(path)
    assert (rows.record.rate_hz, rows.record.start_s) == (record.rate_hz, record.start_s) == (2000.0, 0.0)
    assert rows.record.names == record.names
    assert dict(rows.record.provenance) == dict(record.provenance)
    assert [str(step) for step in rows.record.history] == [str(step) for step in record.history]
    for channel in record.channels:
        np.testing.assert_array_equal(rows.record[channel.name], channel.values)
        assert rows.record.channel(channel.name).unit == channel.unit
    np.testing.assert_allclose(rows.time_s, record.time_s, rtol=1e-12)


def test_damage_is_kept_where_it_is(tmp_path):
    lines = list(LINES)
    lines[3] = "1.5,,3"
    lines[4] = "nan,0.4,inf"
    lines[15] = "2.5,0.5,5"  # time runs back
    del lines[8:11]
    rows = read_rows(written(tmp_path, lines))
    assert rows.record.rate_hz == 2000.0
    assert rows.record.n_samples == 17
    assert np.isnan(rows.record["voltage"]).nonzero()[0].tolist() == [3]
    assert np.isnan(rows.record["position"]).nonzero()[0].tolist() == [4]
    assert rows.record["position"][5] == pytest.approx(5e-6, rel=1e-12)
    assert np.isnan(rows.time_s).nonzero()[0].tolist() == [4]
    np.testing.assert_allclose(rows.time_s[[3, 7, 8, 12]], [1.5e-3, 3.5e-3, 5.5e-3, 2.5e-3], rtol=1e-12)
    with pytest.raises(RecordError):
        read_record(written(tmp_path, lines))


def test_without_time_the_rate_is_needed(tmp_path):
    path = written(tmp_path, [line.split(",", 1)[1] for line in LINES], header="voltage [V],position [m]")
    rows = read_rows(path, rate_hz=100.0)
    assert (rows.record.rate_hz, rows.time_s) == (100.0, None)
    with pytest.raises(RecordError, match="no rate is given"):
        read_rows(path)


def test_a_rate_that_the_time_column_denies_is_refused(tmp_path):
    with pytest.raises(RecordError, match=r"2000 Hz but rate_hz says 100 Hz"):
        read_rows(written(tmp_path), rate_hz=100.0)


@pytest.mark.parametrize(
    ("line", "complaint"), [("1.5,0.3", "2 cells"), ("1.5,0.3,3,4", "4 cells"), ("1;5;0,3;3", "row 6"), ("", "empty")]
)
def test_what_breaks_the_format_is_refused(tmp_path, line, complaint):
    with pytest.raises(RecordError, match=complaint):
        read_rows(written(tmp_path, [*LINES[:3], line, *LINES[4:]]))


def test_time_that_stands_still_gives_no_rate(tmp_path):
    with pytest.raises(RecordError, match="time does not increase"):
        read_rows(written(tmp_path, ["0.0,1,2"] * 20))


def test_rows_of_hdf5_may_hold_nan(tmp_path):
    values = np.arange(20.0)
    values[7] = np.nan
    record = Record(rate_hz=10.0, channels=(Channel(name="a", unit="V", values=values),), start_s=3.0)
    write_record(record, tmp_path / "r.h5")
    rows = read_rows(tmp_path / "r.h5")
    np.testing.assert_array_equal(rows.record["a"], values)
    assert (rows.record.rate_hz, rows.record.start_s, rows.time_s) == (10.0, 3.0, None)


@pytest.mark.parametrize("name", ["r.mat", "r.xyz"])
def test_other_formats_are_refused(tmp_path, name):
    with pytest.raises(RecordError, match="csv"):
        read_rows(tmp_path / name)
