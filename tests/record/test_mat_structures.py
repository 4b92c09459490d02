"""Signals in MATLAB structures, version 5 and 7.3: names and units come out; what is not certain is asked back."""

import struct

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from ambid.errors import AmbidError, RecordError
from ambid.job import compare
from ambid.record import read_record
from ambid.rig import draft_rig

N = 40
TIME = np.arange(N) * 1e-3
U = np.sin(TIME * 300)
X = np.arange(N) * 2.0


class Cell(list):
    """A cell array; a list is an array of structs."""


def plain(value):
    """What savemat writes as MATLAB would."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, Cell):
        found = np.empty((1, len(value)), dtype=object)
        for k, x in enumerate(value):
            found[0, k] = plain(x)
        return found
    if isinstance(value, list):
        rows = [tuple(plain(x) for x in row.values()) for row in value]
        return np.array([rows], dtype=[(k, object) for k in value[0]])
    return np.asarray(value)[:, None] if np.ndim(value) == 1 else value


def v5(path, **variables):
    savemat(path, plain(variables))


def v73(path, **variables):
    """As MATLAB writes it: classes in attributes, arrays of structs and cells by references."""
    with h5py.File(path, "w", userblock_size=512) as file:

        def pointer(value):
            name = f"#refs#/{len(file.require_group('#refs#'))}"
            put(name, value)
            return file[name].ref

        def put(name, value):
            if isinstance(value, dict):
                group = file.require_group(name)
                group.attrs["MATLAB_class"] = np.bytes_("struct")
                for key, x in value.items():
                    put(f"{name}/{key}", x)
            elif isinstance(value, Cell):
                file[name] = np.array([[pointer(x)] for x in value], dtype=h5py.ref_dtype)
                file[name].attrs["MATLAB_class"] = np.bytes_("cell")
            elif isinstance(value, list):
                file.require_group(name).attrs["MATLAB_class"] = np.bytes_("struct")
                for key in value[0]:
                    file[f"{name}/{key}"] = np.array([[pointer(x[key])] for x in value], dtype=h5py.ref_dtype)
            elif isinstance(value, str):
                file[name] = np.frombuffer(value.encode("utf-16-le"), np.uint16)[:, None]
                file[name].attrs["MATLAB_class"] = np.bytes_("char")
            else:
                array = np.atleast_1d(np.asarray(value, dtype=np.float64))
                file[name] = array[None, :] if array.ndim == 1 else array.T
                file[name].attrs["MATLAB_class"] = np.bytes_("double")

        for name, value in variables.items():
            put(name, value)
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, made by a test".ljust(116))


@pytest.fixture(params=[v5, v73], ids=["v5", "v73"])
def made(request, tmp_path):
    def make(**variables):
        request.param(tmp_path / "r.mat", **variables)
        return tmp_path / "r.mat"

    return make


def series(name, data, time=TIME, **more):
    return {"Name": name, "Time": time, "Data": data, **more}


def siemens(name, values, unit, factor=1.0):
    over = {"start_value": 0.5, "increment": 1e-3, "number_of_values": len(values), "quantity": {"label": "s"}}
    quantity = {"label": unit, "unit_transformation": {"factor": factor, "offset": 0.0}}
    return {"x_values": over, "y_values": {"values": values, "quantity": quantity}, "function_record": {"name": name}}


STRUCTURES = {
    "fields of logsout": {
        "logsout": {"a": series("u", U, units="mV"), "b": series("", X, DataInfo={"Units": "um"})}
    },
    "array of structs": {"logsout": [series("u", U, units="mV"), series("b", X, units="um")]},
    "dataset": {
        "out": {
            "numElements": 2.0,
            "Elements": Cell(
                [
                    {"Name": "u", "Values": series("", U, units="mV")},
                    {"Name": "b", "Values": series("", X[None, None, :], units="um")},
                ]
            ),
        },
        "tout": TIME,
    },
    "structure with time": {
        "scope": {
            "time": TIME,
            "signals": [
                {"values": U, "label": "u [mV]", "dimensions": 1.0},
                {"values": X, "label": "b [um]", "dimensions": 1.0},
            ],
            "blockName": "m/Scope",
        }
    },
    "lone timeseries": {"one": series("u", U, units="mV"), "two": series("b", X, Units="um")},
    "columns": {"S": {"time": TIME, "u": U, "b": X, "units": {"u": "mV", "b": "um"}}},
    "testlab": {"Signal": siemens("u", U, "mV"), "Signal_0": siemens("b", X, "um")},
}  # fmt: skip


@pytest.mark.parametrize("case", STRUCTURES)
def test_signals_have_names_units_and_rate(made, case):
    path = made(**STRUCTURES[case])
    record = read_record(path)
    assert (record.rate_hz, {c.name: c.unit for c in record.channels}) == (1000.0, {"u": "V", "b": "m"})
    np.testing.assert_allclose(record["u"], U * 1e-3, rtol=1e-15)
    np.testing.assert_allclose(record["b"], X * 1e-6, rtol=1e-15)
    assert record.start_s == (0.5 if case == "testlab" else 0.0)
    assert read_record(path, variables={"b": ("b", "?")}).names == record.names, "a rig's columns, without variables"
    assert read_record(path, layout={"channels": "b"}).names == ("b",)


def test_matrices_are_columns_and_labels_may_be_missing(made):
    signals = [{"values": np.column_stack([U, X]), "label": "s"}, {"values": X, "label": ""}]
    record = read_record(made(scope={"time": TIME, "signals": signals}))
    assert record.names == ("s(1)", "s(2)", "signals(2)")
    assert [c.unit for c in record.channels] == ["?"] * 3
    np.testing.assert_array_equal(record["s(2)"], X)


ASKED = {
    "units": ({"s": series("u", U, units="V", DataInfo={"Units": "mV"})},
              r"several units \(units says \[V\], DataInfo.Units says \[mV\]\).*layout=\{'units': 'units'\}",
              {"units": "DataInfo.Units"}, "V"),
    "groups": ({"log": [series("a", U), series("b", U)], "u": X},
               r"2 groups \(log/a, log/b; vectors/u\).*layout=\{'group': 'log'\}",
               {"group": "log"}, "?"),
    "values": ({"Signal": siemens("u", U, "mm", factor=1e-3)},
               r"in \[mm\] with a unit transformation.*layout=\{'values': 'si'\}",
               {"values": "si"}, "m"),
    "times": ({"log": [series("a", U), series("b", U, time=2 * TIME)]},
              r"'a' and 'b' have different times \(40 samples, 0 to 0\.039 s, 40 samples, 0 to 0\.078 s\)",
              {"channels": "b"}, "?"),
}  # fmt: skip


@pytest.mark.parametrize("case", ASKED)
def test_what_is_not_certain_is_asked_back(made, case):
    variables, said, layout, unit = ASKED[case]
    path = made(**variables)
    with pytest.raises(RecordError, match=said):
        read_record(path)
    record = read_record(path, layout=layout)
    assert record.channels[0].unit == unit
    assert abs(record.channels[0].values).max() == pytest.approx(abs(U).max() * (1e-3 if case == "units" else 1))


REFUSED = {
    "cut off": (
        {"Signal": {**siemens("u", U, "V"), "y_values": {"values": U[:30]}}},
        "'u' has 30 values; number_of_val",
    ),
    "spectrum": (
        {"S": {"x_values": {"quantity": {"label": "Hz"}}, "y_values": {"values": U}}},
        r"over \[Hz\], not over",
    ),
    "text": ({"s": series("u", "open")}, "the values of 'u' are not numeric"),
    "complex": ({"s": series("u", U + 1j * U)}, "the values of 'u' are complex"),
    "short": ({"s": series("u", U[:30])}, "'u' is 30 x 1, its time has 40 samples"),
    "twice": ({"s": [series("u", U), series("u", X)]}, "s has two signals 'u'"),
    "time": ({"s": series("u", U, TimeInfo={"Units": "days"})}, r"'time' is in \[days\]"),
    "jump": ({"s": series("u", U, np.where(TIME > 0.02, TIME + 1, TIME))}, "advances by"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_record_is_refused(tmp_path, case):
    variables, said = REFUSED[case]
    v5(tmp_path / "r.mat", **variables)
    with pytest.raises(RecordError, match=rf"r\.mat.*{said}"):
        read_record(tmp_path / "r.mat")


@pytest.mark.parametrize("kind", ["timetable", "timeseries", "Simulink.SimulationData.Dataset"])
def test_objects_are_refused_with_the_remedy(tmp_path, kind):
    def element(code, data):
        return struct.pack("<II", code, len(data)) + data + b"\0" * (-len(data) % 8)

    inside = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 1, 1)) + element(1, b"")
    texts = b"".join(element(1, text) for text in (b"run1", b"MCOS", kind.encode()))
    opaque = element(14, element(6, struct.pack("<II", 17, 0)) + texts + element(14, inside + element(6, b"\0" * 4)))
    (tmp_path / "v5.mat").write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x100) + b"IM" + opaque)
    v73(tmp_path / "v73.mat", run1=X, tout=TIME)
    with h5py.File(tmp_path / "v73.mat", "a") as file:
        file["run1"].attrs["MATLAB_class"], file["run1"].attrs["MATLAB_object_decode"] = np.bytes_(kind), 3
    for name in ("v5.mat", "v73.mat"):
        with pytest.raises(
            RecordError, match=rf"run1 is a MATLAB object of class {kind}.*There: .*struct\('"
        ) as failure:
            read_record(tmp_path / name)
        assert "run1" in str(failure.value).partition("There")[2]


def test_a_layout_is_for_structures(tmp_path):
    v5(tmp_path / "r.mat", u=U, time=TIME)
    with pytest.raises(RecordError, match="a layout is for structures; it has no structure"):
        read_record(tmp_path / "r.mat", layout={"group": "x"})
    with pytest.raises(RecordError, match="the rig names the variable u"):
        read_record(tmp_path / "r.mat", layout={"group": "x"}, variables={"voltage": ("u", "V")})


def test_a_rotors_draft_and_compare_keep_the_layout(tmp_path):
    """What `ambid init` was told stands in the rig; what needs no rig is told in the call."""
    time, units = np.arange(200) * 1e-3, {"voltage": "V", "current": "A", "position": "um"}
    noise = np.random.default_rng(1).standard_normal((6, time.size))
    names = [(f"{axis}_{what}", unit) for axis in ("ax", "ay") for what, unit in units.items()]
    axes = [series(name, x, time, units=unit) for (name, unit), x in zip(names, noise, strict=True)]
    v5(tmp_path / "r.mat", log=axes, other=axes)
    record = read_record(tmp_path / "r.mat", layout={"group": "log"})
    assert '[record]\nlayout = { group = "log" }' in draft_rig(record)
    with pytest.raises(AmbidError, match="has 2 groups"):
        compare(tmp_path / "r.mat", ["arx:na=1,nb=1,nk=1"], input="ax_voltage", output="ax_current")
    words = {"input": "ax_voltage", "output": "ax_current", "layout": {"group": "log"}, "open_loop": True}
    assert compare(tmp_path / "r.mat", ["arx:na=1,nb=1,nk=1"], **words).entries
