"""HDF5: nothing is lost, and files of others are refused."""

import h5py
import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.record import Channel, Record, Step, read_record, write_record
from ambid.record.calibration import Calibration
from ambid.record.hdf5_format import read_hdf5, write_hdf5


def record():
    rng = np.random.default_rng(3)
    table = Calibration(unit_in="1", unit_out="V", raw=np.array([0.0, 1.0]), out=np.array([0.1, 11.06]), source="d.csv")
    return Record(
        rate_hz=10000 / 3,
        start_s=-0.1,
        channels=(
            Channel(name="voltage", unit="V", values=rng.standard_normal(500), source_unit="1"),
            Channel(name="position", unit="m", values=rng.standard_normal(500) * 1e-300, source_unit="µm"),
        ),
        history=(
            Step(name="read", settings={"format": "csv", "rows": 500}),
            table.step("voltage"),
            Step(name="lowpass", settings={"cutoff_hz": np.float64(500.0), "taps": np.arange(3)}),
        ),
        provenance={"file": "bench µ.csv", "sha256": "ab" * 32},
    )


def test_round_trip_loses_nothing(tmp_path):
    before = record()
    write_record(before, tmp_path / "r.h5")
    after = read_record(tmp_path / "r.h5")
    assert (after.rate_hz, after.start_s, after.names) == (before.rate_hz, before.start_s, before.names)
    for a, b in zip(after.channels, before.channels, strict=True):
        assert (a.name, a.unit, a.source_unit) == (b.name, b.unit, b.source_unit)
        assert a.values.tobytes() == b.values.tobytes()
    assert dict(after.provenance) == dict(before.provenance)
    assert [s.name for s in after.history] == ["read", "calibrate", "lowpass"]
    assert dict(after.history[1].settings) == dict(before.history[1].settings)
    assert dict(after.history[2].settings) == {"cutoff_hz": 500.0, "taps": [0, 1, 2]}


def test_long_histories_fit(tmp_path):
    points = np.linspace(0, 1, 20_000)  # as text far beyond the 64 kB of an HDF5 attribute
    table = Calibration(unit_in="1", unit_out="V", raw=points, out=points, source="d.csv")
    write_hdf5(record().with_step(table.step("voltage")), tmp_path / "r.h5")
    assert read_hdf5(tmp_path / "r.h5").history[-1].settings["raw"] == points.tolist()


def test_record_without_a_file_gets_this_one(tmp_path):
    simulated = Record(rate_hz=1.0, channels=(Channel(name="v", unit="V", values=np.arange(9.0)),))
    write_record(simulated, tmp_path / "r.hdf5")
    provenance = read_record(tmp_path / "r.hdf5").provenance
    assert provenance["file"] == "r.hdf5"
    assert len(provenance["sha256"]) == 64


def test_values_that_are_not_finite_obey_the_same_rules_as_csv(tmp_path):
    values = np.arange(50.0)
    values[20] = np.nan
    write_hdf5(
        Record(rate_hz=10.0, start_s=1.0, channels=(Channel(name="v", unit="V", values=values),)), tmp_path / "r.h5"
    )
    assert np.isnan(read_hdf5(tmp_path / "r.h5")["v"][20])  # the format itself is lossless
    with pytest.raises(RecordError, match=r"row 20, column 'v'.*gaps="):
        read_record(tmp_path / "r.h5")
    np.testing.assert_allclose(read_record(tmp_path / "r.h5", gaps="interpolate")["v"], np.arange(50.0))
    cut = read_record(tmp_path / "r.h5", gaps="cut")
    np.testing.assert_array_equal(cut["v"], np.arange(21.0, 50.0))
    assert cut.start_s == 1.0 + 21 / 10.0


def test_rate_that_contradicts_the_file(tmp_path):
    write_record(record(), tmp_path / "r.h5")
    with pytest.raises(RecordError, match=r"rate_hz says 1000 Hz. Omit it"):
        read_record(tmp_path / "r.h5", rate_hz=1000.0)


def test_foreign_and_newer_and_damaged_files_are_refused(tmp_path):
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["measurement"] = np.arange(5.0)
    with pytest.raises(RecordError, match=r"no column 'time \[s\]' \(columns: measurement\)"):
        read_record(tmp_path / "foreign.h5")
    write_record(record(), tmp_path / "newer.h5")
    with h5py.File(tmp_path / "newer.h5", "a") as file:
        file.attrs["schema"] = "ambid.record/9"
    with pytest.raises(RecordError, match=r"'ambid\.record/9'"):
        read_record(tmp_path / "newer.h5")
    write_record(record(), tmp_path / "partial.h5")
    with h5py.File(tmp_path / "partial.h5", "a") as file:
        del file["history"]
    with pytest.raises(RecordError, match="damaged"):
        read_record(tmp_path / "partial.h5")
    whole = (tmp_path / "newer.h5").read_bytes()
    for name, data in (("text.h5", b"time [s],voltage [V]\n"), ("cut.h5", whole[: len(whole) // 2]), ("empty.h5", b"")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(RecordError) as failure:
            read_record(tmp_path / name)
        assert name in str(failure.value)


def external_link(channels):
    channels["0"] = h5py.ExternalLink("secret.h5", "/channels/0")


def external_file(channels):
    channels.create_dataset("0", shape=(500,), dtype="f8", external=[("secret.bin", 0, 4000)])


def virtual(channels):
    layout = h5py.VirtualLayout(shape=(500,), dtype="f8")
    layout[:] = h5py.VirtualSource("secret.h5", "channels/0", shape=(500,))
    channels.create_virtual_dataset("0", layout)


@pytest.mark.parametrize("borrow", [external_link, external_file, virtual])
def test_a_record_takes_nothing_from_another_file(tmp_path, borrow):
    for name in ("secret.h5", "one.h5"):
        write_record(record(), tmp_path / name)
    np.zeros(500).tofile(tmp_path / "secret.bin")
    with h5py.File(tmp_path / "one.h5", "a") as file:
        del file["channels/0"]
        borrow(file["channels"])
    with pytest.raises(RecordError, match="'channels/0' from another file"):
        read_record(tmp_path / "one.h5")


def test_what_cannot_be_stored_is_refused(tmp_path):
    with pytest.raises(RecordError, match="JSON-able"):
        write_hdf5(record().with_step(Step(name="odd", settings={"f": object()})), tmp_path / "r.h5")
    with pytest.raises(RecordError, match="cannot be written"):
        write_hdf5(record(), tmp_path / "no" / "r.h5")
    with pytest.raises(RecordError, match="comment"):
        write_record(record(), tmp_path / "r.h5", comments=["x"])
    with pytest.raises(RecordError, match="read, not written"):
        write_record(record(), tmp_path / "r.mat")
