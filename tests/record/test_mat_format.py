"""MATLAB files of both kinds: the same variables give the same record; what is no channel is refused."""

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from ambid.errors import RecordError
from ambid.record import read_record

N = 40
TIME = np.arange(N) * 1e-3
VOLTAGE = np.sin(TIME * 300)
BOTH = np.column_stack([np.cos(TIME), np.arange(N)])


def v5(path):
    data = {"t": TIME, "y": BOTH, "n": np.arange(N, dtype=np.int16)}
    savemat(path, {"u": VOLTAGE[:, None], "row": VOLTAGE[None, :], "data": data, "tv": TIME, "title": "bench 1"})


def v73(path):
    """As MATLAB writes it: HDF5 after a 512-byte header, matrices transposed, structs as groups."""
    with h5py.File(path, "w", userblock_size=512) as file:
        file["u"], file["row"], file["tv"] = VOLTAGE[None, :], VOLTAGE[:, None], TIME[None, :]
        file["title"] = np.frombuffer("bench 1".encode("utf-16-le"), np.uint16)[:, None]
        group = file.create_group("data")
        group["t"], group["y"], group["n"] = TIME[None, :], BOTH.T, np.arange(N, dtype=np.int16)[None, :]
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, made by a test".ljust(116))


def test_a_file_takes_nothing_from_another_one(tmp_path):
    v73(tmp_path / "secret.mat")
    v73(tmp_path / "one.mat")
    with h5py.File(tmp_path / "one.mat", "a") as file:
        file["more"] = h5py.ExternalLink("secret.mat", "/" + next(iter(file)))
    with pytest.raises(RecordError, match="'more' from another file"):
        read_record(tmp_path / "one.mat")


@pytest.fixture(params=[v5, v73])
def path(request, tmp_path):
    request.param(tmp_path / "r.mat")
    return tmp_path / "r.mat"


MAPPING = {
    "time": ("data.t", "s"),
    "voltage": ("u", "mV"),
    "again": ("row", "V"),
    "position": ("data.y(:,2)", "um"),
    "count": ("data.n", "1"),
}


def test_named_variables_become_channels(path):
    r = read_record(path, variables=MAPPING)
    assert r.rate_hz == 1000.0
    assert r.names == ("voltage", "again", "position", "count")
    assert [c.unit for c in r.channels] == ["V", "V", "m", "1"]
    np.testing.assert_allclose(r["voltage"], VOLTAGE * 1e-3, rtol=1e-15)
    np.testing.assert_array_equal(r["again"], VOLTAGE)
    np.testing.assert_allclose(r["position"], np.arange(N) * 1e-6, rtol=1e-15)
    np.testing.assert_array_equal(r["count"], np.arange(N))
    assert r.history[0].settings["variables"]["position"] == "data.y(:,2)"
    assert len(r.provenance["sha256"]) == 64


def test_rate_given_instead_of_time(path):
    assert read_record(path, variables={"voltage": ("u", "V")}, rate_hz=250.0).rate_hz == 250.0
    assert read_record(path, variables={"voltage": ("u", "V")}).rate_hz == 1000.0  # the struct has the time


@pytest.mark.parametrize(
    ("variable", "said"),
    [
        ("uu", "no 'uu'; it has"),
        ("data.q", "data has no 'q'; it has"),
        ("u.x", "u has no 'x'"),
        ("data", "a struct"),
        ("data.y", r"40 x 2 matrix; a channel is one column. Write data.y\(:,1\)"),
        ("data.y(:,3)", "no column 3"),
        ("data.y(:,0)", "no column 0"),
        ("data.y(2,:)", "write it as"),
        ("3y", "write it as"),
    ],
)
def test_what_is_no_channel_is_refused(path, variable, said):
    with pytest.raises(RecordError, match=said):
        read_record(path, variables={"voltage": (variable, "V")}, rate_hz=1.0)


def test_differing_lengths_and_wrong_time_units_are_refused(path):
    with pytest.raises(RecordError, match=r"in \[s\], \[ms\] or \[us\]"):
        read_record(path, variables=MAPPING | {"time": ("tv", "m")})
    with pytest.raises(RecordError, match=r"nearest: "):
        read_record(path, variables=MAPPING | {"time": ("tv", "jiffy")})


def test_gaps_and_irregular_time(tmp_path):
    bad = VOLTAGE.copy()
    bad[7] = np.nan
    savemat(tmp_path / "r.mat", {"u": bad, "t": TIME, "late": TIME + (TIME > 0.02) * 1e-3, "short": TIME[:30]})
    with pytest.raises(RecordError, match="row 8, column 'voltage'"):
        read_record(tmp_path / "r.mat", variables={"voltage": ("u", "V")})
    assert read_record(tmp_path / "r.mat", variables={"voltage": ("u", "V")}, gaps="interpolate").n_samples == N
    with pytest.raises(RecordError, match="advances by 2 samples"):
        read_record(tmp_path / "r.mat", variables={"x": ("t", "V"), "time": ("late", "s")})
    with pytest.raises(RecordError, match="u 40, short 30"):
        read_record(tmp_path / "r.mat", variables={"a": ("u", "V"), "b": ("short", "V")}, rate_hz=1.0)


def test_without_a_mapping_every_vector_is_a_channel_of_unknown_unit(tmp_path):
    savemat(tmp_path / "r.mat", {"u": VOLTAGE, "i": VOLTAGE, "time": TIME, "m": BOTH, "s": 1.0, "name": "x"})
    r = read_record(tmp_path / "r.mat")
    assert r.rate_hz == 1000.0
    assert [(c.name, c.unit) for c in r.channels] == [("u", "?"), ("i", "?")]
    savemat(tmp_path / "none.mat", {"m": BOTH})
    assert read_record(tmp_path / "none.mat", rate_hz=1.0).names == ("m(1)", "m(2)")
    savemat(tmp_path / "none.mat", {"m": BOTH, "n": BOTH})
    with pytest.raises(RecordError, match=r"no numeric vector.*40 x 2 matrix"):
        read_record(tmp_path / "none.mat", rate_hz=1.0)


def test_a_mapping_is_for_mat_files_only(tmp_path):
    with pytest.raises(RecordError, match=r"for \.mat files"):
        read_record(tmp_path / "r.csv", variables={"voltage": ("u", "V")})


def octave(name, x, kind="matrix"):
    """A variable as Octave's ``save`` writes it where no format is told."""
    x = np.atleast_2d(x)
    head = f"# name: {name}\n# type: {kind}\n"
    rows = "".join("".join(f" {v:.17g}" for v in row) + "\n" for row in x)
    return (
        head
        + (f"{x[0, 0]:.17g}\n" if kind == "scalar" else f"# rows: {len(x)}\n# columns: {x.shape[1]}\n{rows}")
        + "\n\n"
    )


def test_a_text_of_octave_is_read_with_its_structs_and_ranges(tmp_path):
    path = tmp_path / "a.mat"
    title = "# name: title\n# type: string\n# elements: 1\n# length: 7\nbench 1\n\n\n"
    odd = "# name: ready\n# type: bool\n1\n\n\n"
    clock = f"# name: t\n# type: double_range\n# base, limit, increment\n0 {(N - 1) * 1e-3} 0.001\n\n\n"
    fields = clock + octave("u", VOLTAGE[:, None]) + octave("y", BOTH)
    struct = f"# name: run\n# type: scalar struct\n# ndims: 2\n 1 1\n# length: 3\n{fields}\n\n"
    path.write_text("# Created by Octave 9.2.0, Fri Mar 01 10:00:00 2024 UTC <a@b>\n" + title + odd + struct)
    record = read_record(path, variables={"voltage": ("run.u", "V"), "x": ("run.y(:,2)", "mm"), "time": ("run.t", "s")})
    np.testing.assert_array_equal(record["voltage"], VOLTAGE)
    np.testing.assert_array_equal(record["x"], BOTH[:, 1] / 1000)
    assert record.rate_hz == pytest.approx(1000.0)
    columns = octave("u", VOLTAGE[:, None]) + octave("i", BOTH[:, :1])
    path.write_text("# Created by Octave 9.2.0\n" + columns + octave("fs", 2000.0, "scalar"))
    assert (read_record(path).names, read_record(path).rate_hz) == (("u", "i"), 2000.0)
    path.write_text("# Created by Octave 9.2.0\n" + columns[:-200])
    with pytest.raises(RecordError, match="no sound text of Octave"):
        read_record(path)


def test_what_a_text_of_octave_holds_besides_leaves_other_variables_alone(tmp_path):
    path, head = tmp_path / "a.mat", "# Created by Octave 9.2.0\n"
    cube = "# name: cube\n# type: matrix\n# ndims: 3\n 2 2 2\n" + " 1\n" * 8 + "\n\n"
    path.write_text(head + cube + octave("u", VOLTAGE[:, None]) + octave("fs", 2000.0, "scalar"))
    np.testing.assert_array_equal(read_record(path)["u"], VOLTAGE)
    with pytest.raises(RecordError, match="cube"):
        read_record(path, variables={"x": ("cube", "m")})
    path.write_text(head + "# name: c\n# type: cell\n# ndims: 3\n 1 1 1\n" + octave("u", VOLTAGE[:, None]))
    with pytest.raises(RecordError, match="a size is missing"):
        read_record(path)


@pytest.mark.parametrize("numbers", ["0 1 0", "0 1e300 1e-9", "0 1e12 1", "0 inf 1", "0 nan 1"])
def test_a_range_of_octave_that_the_file_cannot_mean_is_refused(tmp_path, numbers):
    path, begin = tmp_path / "a.mat", "# name: t\n# type: double_range\n# base, limit, increment\n"
    path.write_text(f"# Created by Octave 9.2.0\n{begin}{numbers}\n\n\n" + octave("u", VOLTAGE[:, None]))
    with pytest.raises(RecordError, match=r"claims \d+ samples|no sound text of Octave"):
        read_record(path)


def test_a_matrix_of_outputs_stands_beside_the_vector_of_the_input(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"u": VOLTAGE, "y": BOTH, "OutputName": np.array(["pos", "cur"], object), "Ts": 1e-3})
    assert read_record(path).names == ("pos", "cur", "u")
    variables = {name: (name, unit) for name, unit in (("u", "V"), ("pos", "mm"), ("cur", "A"))}
    assert read_record(path, variables=variables).names == ("pos", "cur", "u")


def test_rates_in_attributes_of_hdf5_are_read(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("run")
        group["u"], group["i"] = VOLTAGE, BOTH[:, 0]
        group["u"].attrs["units"] = "mV"
        group.attrs.update({"operator": "a", "sample_rate": 5000.0, "gains": [1.0, 2.0]})
    record = read_record(path)
    assert record.rate_hz == 5000.0
    np.testing.assert_array_equal(record["u"], VOLTAGE / 1000)
