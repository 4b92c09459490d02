"""Damaged and foreign files of every format: exit code 2 and one line that names the file, nothing else said."""

import gc
import gzip
import struct

import h5py
import numpy as np
import pytest

from ambid.record import Channel, Record, write_record
from tests.record.test_mat_structures import series, v5, v73
from tests.record.test_streamed_formats import WAVE, U, X, mdf, table, tdms
from tests.signals.response_files import F, plant, uff

TIME = np.arange(U.size) * 1e-3
LIBRARIES = {".tdms": "nptdms", ".mf4": "asammdf", ".mdf": "asammdf", ".parquet": "pyarrow", ".feather": "pyarrow"}
WHOLE = {
    "r.tdms": lambda path: tdms(path, [("Log", "u", U, WAVE), ("Log", "x", X, WAVE)]),
    "r.mf4": lambda path: mdf(path, {"fast": (1e-3, [("u", U, "V", {}), ("x", X, "mm", {})])}),
    "r.mdf": lambda path: mdf(path, {"fast": (1e-3, [("u", U, "V", {}), ("x", X, "mm", {})])}, "3.30"),
    "r.parquet": lambda path: table(path, {"time [s]": TIME, "u [V]": U}),
    "r.feather": lambda path: table(path, {"time [s]": TIME, "u [V]": U}),
    "5.mat": lambda path: v5(path, log=[series("u", U, TIME), series("x", 1.0 * X, TIME)]),
    "73.mat": lambda path: v73(path, log=[series("u", U, TIME), series("x", 1.0 * X, TIME)]),
    "r.h5": lambda path: write_record(RECORD, path),
    "r.csv.gz": lambda path: write_record(RECORD, path),
    "r.uff": lambda path: path.write_bytes(uff([(4, 1, 7, F, plant()[:, 0], ("m", "V"))])),
}
RECORD = Record(rate_hz=1e3, channels=(Channel(name="u", unit="V", values=U, source_unit="V"),))
DAMAGE = {
    "empty": lambda b: b"",
    "a tenth": lambda b: b[: len(b) // 10],
    "half": lambda b: b[: len(b) // 2],
    "last bytes missing": lambda b: b[:-20],
    "text": lambda b: b"date;remark\nMonday;none\n" * 50,
    "another program's": lambda b: b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 20,
    "zeros": lambda b: bytes(len(b)),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Bytes of a sound file by name."""
    folder, found = tmp_path_factory.mktemp("whole"), {}

    def get(name):
        if name not in found:
            pytest.importorskip(LIBRARIES.get(name[name.index(".") :], "h5py"), reason="the format's library is absent")
            WHOLE[name](folder / name)
            found[name] = (folder / name).read_bytes()
        return found[name]

    return get


def refused(ambid, path):
    found = ambid("frf" if path.suffix == ".uff" else "info", path)
    gc.collect()
    assert found.code == 2, found
    assert found.out == ""
    assert found.err.count("\n") == 1
    assert path.name in found.err
    return found.err


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", WHOLE)
def test_damaged_files_are_refused_in_one_line(tmp_path, ambid, whole, name, damage, recwarn):
    (tmp_path / name).write_bytes(DAMAGE[damage](whole(name)))
    refused(ambid, tmp_path / name)
    assert not recwarn.list


def hollow(path, schema):
    """HDF5 that claims 1e13 numbers and holds none."""
    with h5py.File(path, "w", userblock_size=0 if schema else 512) as file:
        group = file.create_group("channels") if schema else file
        data = group.create_dataset("0", (10**13,), "f8", chunks=(1024,), fillvalue=0.0)
        data.attrs.update(name="u", unit="V", source_unit="V")
        if schema:
            file.attrs.update(schema="ambid.record/1", rate_hz=1e3, start_s=0.0)
            file["history"], file["provenance"] = "[]", "{}"


def cut_between_chunks(path, whole):
    """TDMS whose last segment lost its last chunks: all channels end together."""
    nptdms = pytest.importorskip("nptdms", reason="npTDMS is not installed")
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.ChannelObject("Log", n, x, WAVE) for n, x in (("u", U), ("x", 2 * U))])
    data = bytearray(path.read_bytes())
    at = struct.unpack_from("<Q", data, 12)[0]
    data[12:20] = struct.pack("<Q", at + 16 * U.size)  # two chunks are announced
    path.write_bytes(data)


def misshapen(path):
    """MATLAB 5 with a tag that is zero, at which SciPy's parser ends the program."""
    v5(path, log=series("u", U, TIME))
    path.write_bytes(path.read_bytes().replace(struct.pack("<II", 9, 8 * U.size), struct.pack("<II", 0, 8 * U.size)))


FOREIGN = {
    "shape.mat": (lambda p, _: misshapen(p), "an element of type 0"),
    "claims.h5": (lambda p, _: hollow(p, schema=True), "claims 10000000000000 samples"),
    "claims.mat": (lambda p, _: hollow(p, schema=False), "claims 10000000000000 samples"),
    "bomb.csv.gz": (lambda p, _: p.write_bytes(gzip.compress(bytes(1 << 20)) * 260), "unpack"),
    "binary.csv.gz": (lambda p, _: p.write_bytes(gzip.compress(b"time [s],u [V]\n\0\1\2\n" * 20)), "binary data"),
    "nan.csv": (lambda p, _: p.write_text("time [s],u [V]\n" + "nan,1\n" * 20), "row 2, column 'time'"),
    "nan.parquet": (lambda p, _: table(p, {"time [s]": np.where(TIME == 0.01, np.nan, TIME), "u": U}), "row 11"),
    "nan.tdms": (lambda p, _: tdms(p, [("Log", "time", np.full(U.size, np.nan), {"unit_string": "s"}),
                                       ("Log", "u", U, {})]), "row 1, column 'time'"),
    "inf.mat": (lambda p, _: v5(p, log=series("u", np.where(U > 0.9, np.inf, U), TIME)), "column 'u': inf"),
    "cells.mat": (lambda p, _: v5(p, log=np.array([["a", 1.0]], dtype=object)), "no numeric vector"),
    "mixed.mat": (lambda p, _: v5(p, log=[{"Name": "u", "Time": TIME, "Data": "x"}]), "not numeric"),
    "chunks.tdms": (cut_between_chunks, "cut off"),
    "r.npz": (lambda p, w: p.write_bytes(w("73.mat")), "no sound file of NumPy arrays"),
    "half.npz": (lambda p, w: np.savez(p, u=U) or p.write_bytes(p.read_bytes()[:-40]), "no sound file of NumPy arrays"),
    "objects.npy": (lambda p, w: np.save(p, np.array([{}, 1]), allow_pickle=True), "no sound file of NumPy arrays"),
    "csv.tdms": (lambda p, w: p.write_bytes(w("r.csv.gz")), "no TDMS file"),
    "tdms.mf4": (lambda p, w: p.write_bytes(w("r.tdms")), "no MDF file"),
    "h5.parquet": (lambda p, w: p.write_bytes(w("r.h5")), "no Parquet or Arrow file"),
    "parquet.csv": (lambda p, w: p.write_bytes(w("r.parquet")), ""),
    "parquet.uff": (lambda p, w: p.write_bytes(w("r.parquet")), "no universal file"),
}  # fmt: skip


@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_files_and_huge_claims_are_refused_in_one_line(tmp_path, ambid, whole, name):
    make, said = FOREIGN[name]
    make(tmp_path / name, whole)
    assert said in refused(ambid, tmp_path / name)
