"""A record written in pieces is the file that `write_record` makes, and a disk that fails does not end the program."""

import gzip
import os
import signal
import subprocess
import sys
import tracemalloc

import h5py
import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.record import Channel, Record, Step, read_record, write_record
from ambid.record.chunks import write_chunks
from ambid.record.hdf5_format import write_hdf5

N = 50_000


@pytest.fixture(scope="module")
def record():
    values = np.random.default_rng(1).normal(size=(N, 2))
    channels = (
        Channel(name="x", unit="m", values=values[:, 0], source_unit="um"),
        Channel(name="n", unit="1", values=values[:, 1]),
    )
    return Record(
        rate_hz=2000.0, start_s=0.25, channels=channels, history=(Step(name="acquire", settings={"samples": N}),),
        provenance={"port": "emulated"},
    )  # fmt: skip


def without_samples(record):
    none = np.empty(0)
    channels = tuple(Channel(name=c.name, unit=c.unit, values=none, source_unit=c.source_unit) for c in record.channels)
    return Record(
        rate_hz=record.rate_hz, start_s=record.start_s, channels=channels, history=record.history,
        provenance=record.provenance,
    )  # fmt: skip


def pieces(record, size=7001):
    values = np.column_stack([c.values for c in record.channels])
    return (values[k : k + size] for k in range(0, len(values), size))


def write(record, path, **texts):
    write_chunks(without_samples(record), record.n_samples, pieces(record), path, texts)()


def described(path):
    """Everything in an HDF5 file, values bit by bit, and how each dataset is stored."""
    found = {}

    def take(name, item):
        attributes = {k: str(v) for k, v in item.attrs.items()}
        if isinstance(item, h5py.Dataset):
            value = item[()]
            content = value if isinstance(value, bytes) else value.tobytes()
            stored = (item.dtype, item.shape, item.chunks, item.compression, item.compression_opts, item.shuffle)
            found[name] = (attributes, content, stored, item.maxshape)
        else:
            found[name] = (attributes,)

    with h5py.File(path) as file:
        found["/"] = {k: str(v) for k, v in file.attrs.items()}
        file.visititems(take)
    return found


def test_hdf5_is_what_write_hdf5_would_have_written(tmp_path, record):
    write_hdf5(record, tmp_path / "whole.h5")
    write(record, tmp_path / "pieces.h5")
    assert described(tmp_path / "pieces.h5") == described(tmp_path / "whole.h5")


def test_further_texts_do_not_disturb_the_reader(tmp_path, record):
    write(record, tmp_path / "pieces.h5", acquisition="{}")
    back = read_record(tmp_path / "pieces.h5")
    assert all(np.array_equal(a.values, b.values) for a, b in zip(back.channels, record.channels, strict=True))
    assert back.history == record.history
    with h5py.File(tmp_path / "pieces.h5") as file:
        assert file["acquisition"].asstr()[()] == "{}"


def test_csv_is_what_write_csv_would_have_written(tmp_path, record):
    for name in ("csv", "csv.gz"):
        write_record(record, tmp_path / f"whole.{name}")
        write(record, tmp_path / f"pieces.{name}")
    assert (tmp_path / "pieces.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    assert gzip.decompress((tmp_path / "pieces.csv.gz").read_bytes()) == (tmp_path / "whole.csv").read_bytes()


def test_a_lost_row_is_empty_cells_in_csv_which_the_reader_refuses_naming_the_remedy(tmp_path, record):
    values = np.arange(40.0).reshape(20, 2)
    values[8:10] = np.nan
    write_chunks(without_samples(record), 20, [values], tmp_path / "gap.csv", {})()
    with pytest.raises(RecordError, match=r"row 10.*gaps="):
        read_record(tmp_path / "gap.csv")
    assert read_record(tmp_path / "gap.csv", gaps="cut").n_samples == 10
    assert read_record(tmp_path / "gap.csv", gaps="interpolate").n_samples == 20


@pytest.mark.parametrize("wrong", [N - 1, N + 1])
@pytest.mark.parametrize("name", ["a.h5", "a.csv"])
def test_more_or_fewer_than_announced_is_refused(tmp_path, record, wrong, name):
    with pytest.raises(RecordError, match="announced"):
        write_chunks(without_samples(record), wrong, pieces(record), tmp_path / name, {})


def test_a_file_that_changed_is_seen(tmp_path, record):
    check = write_chunks(without_samples(record), N, pieces(record), tmp_path / "a.h5", {})
    check()
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["channels/1"][N - 1] = 5.0
    with pytest.raises(RecordError, match="does not read back"):
        check()


def test_a_long_record_does_not_need_the_memory_of_its_samples(tmp_path, record):
    n, rows = 1_000_000, 20_000
    piece = np.ones((rows, 2))
    tracemalloc.start()
    try:
        write_chunks(without_samples(record), n, (piece for _ in range(n // rows)), tmp_path / "long.h5", {})()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < n * 2 * 8 / 3


FULL = """
import resource, sys
import numpy as np, h5py
from ambid.errors import RecordError
from ambid.record import Channel, Record
from ambid.record.hdf5_format import write_hdf5
values = np.random.default_rng(1).normal(size=4000)
record = Record(rate_hz=1.0, channels=tuple(Channel(name=str(k), unit="1", values=values) for k in range(3)))
for size in (0, 50, 1000, 9000, 30000, 80000, 90000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    try:
        write_hdf5(record, sys.argv[1])
    except RecordError as failure:
        sys.stdout.write(str(failure) + "\\n")
"""


def test_a_full_disk_is_an_error_and_not_the_end_of_the_program(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path / "full.h5")], stdout=subprocess.PIPE, text=True, timeout=120
    )
    assert done.returncode == 0  # HDF5 alone ends in a segmentation fault here
    assert [line.partition(": ")[2] for line in done.stdout.splitlines()] == ["File too large. Check the folder"] * 7


def test_ctrl_c_waits_for_the_library(tmp_path, record):
    def interrupting():
        for k, piece in enumerate(pieces(record)):
            if k == 3:
                os.kill(os.getpid(), signal.SIGINT)
            yield piece

    with pytest.raises(KeyboardInterrupt):
        write_chunks(without_samples(record), N, interrupting(), tmp_path / "a.h5", {})
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    write(record, tmp_path / "b.h5")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_handler_that_raises_waits_for_the_library(tmp_path, record, number):
    def handler(*_):
        raise KeyboardInterrupt

    def interrupting():
        for k, piece in enumerate(pieces(record)):
            if k == 3:
                os.kill(os.getpid(), number)
            yield piece

    usual = signal.signal(number, handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            write_chunks(without_samples(record), N, interrupting(), tmp_path / "a.h5", {})
        assert signal.getsignal(number) is handler
    finally:
        signal.signal(number, usual)


INTERRUPTED = """
import os, signal, sys
import numpy as np
from ambid.record import Channel, Record, hdf5_format
from ambid.record.hdf5_format import write_hdf5

def handler(*_):
    raise KeyboardInterrupt

signal.signal(signal.SIGINT, handler)
write, number = hdf5_format._Unfailing.write, iter(range(10**9))

def interrupted(self, data):
    if next(number) == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGINT)
    return write(self, data)

hdf5_format._Unfailing.write = interrupted
record = Record(channels=(Channel(name="a", unit="m", values=np.arange(5000.0)),), rate_hz=1.0)
try:
    write_hdf5(record, sys.argv[1])
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.parametrize("at", [0, 4, 8])
def test_a_handler_that_raises_inside_the_library_is_not_the_end_of_the_program(tmp_path, at):
    command = [sys.executable, "-c", INTERRUPTED, str(tmp_path / "a.h5"), str(at)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "interrupted\n")
