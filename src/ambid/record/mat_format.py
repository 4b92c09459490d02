"""Records from MATLAB: ``.mat`` of version 5 (SciPy), checked element by element first, and 7.3 (HDF5). A mapping names
variables as MATLAB does, ``i``, ``data.i``, ``y(:,2)``, and their units; `mat_structures` need none.
"""

from __future__ import annotations

import io
import itertools
import math
import re
import struct
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.clock import TIME_NAMES, clock_of, timed
from ambid.record.hdf5_format import hdf5_of
from ambid.record.mat_structures import Foreign, read_structures, refuse_foreign, scalars, structures
from ambid.record.record import Record, file_bytes, provenance_of
from ambid.record.sampling import GapPolicy, Table, check_gap_policy, refuse_gaps, uniform_record
from ambid.record.streams import one_line, refuse_claim
from ambid.record.words import is_time, rate_of
from ambid.units import UNKNOWN

# bytes of numbers by type
_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION = 1, 2, 3, 4, 5, 16
_DEEPEST = 100


def check_elements(data: bytes) -> None:
    """Raise ValueError where an element of a file of version 5 is damaged."""
    if 0 in data[:4]:  # version 4
        return
    if data[124:128] not in (b"\0\1IM", b"\1\0MI"):
        raise ValueError("its head is of no version")
    order = "<" if data[126:128] == b"IM" else ">"
    at = 128
    while at < len(data):
        kind, begin, size, following = _element(data, at, len(data), order)
        if kind == _MATRIX:
            _check_matrix(data, begin, begin + size, order, 0)
        elif kind != _COMPRESSED:
            raise ValueError(f"an element of type {kind} at byte {at}")
        at = begin + size if kind == _COMPRESSED else following


def _element(data: bytes, at: int, end: int, order: str) -> tuple[int, int, int, int]:
    """Return type, begin, size and what follows an element, which must lie before `end`."""
    if at + 8 > end:
        raise ValueError(f"half an element at byte {at}")
    word, size = struct.unpack_from(f"{order}II", data, at)
    kind, begin = word, at + 8
    if word >> 16:  # a small one
        kind, size, begin = word & 0xFFFF, word >> 16, at + 4
    following = at + 8 if word >> 16 else begin + size + (-size % 8 if kind != _COMPRESSED else 0)
    if (kind not in _SIZES and kind not in (_MATRIX, _COMPRESSED)) or begin + size > (at + 8 if word >> 16 else end):
        raise ValueError(f"an element of type {kind} and {size} bytes at byte {at}")
    return kind, begin, size, following


def _check_matrix(data: bytes, at: int, end: int, order: str, depth: int) -> None:
    if at == end:
        return
    if depth > _DEEPEST:
        raise ValueError("structures within structures without end")

    def number(kinds: tuple[int, ...]) -> tuple[int, int, int]:
        nonlocal at
        kind, begin, size, at = _element(data, at, end, order)
        if kind not in kinds:
            raise ValueError(f"an element of type {kind} at byte {begin}")
        return kind, begin, size

    _, begin, size = number((6,))
    if size != 8:
        raise ValueError("flags of an array")
    flags = struct.unpack_from(f"{order}I", data, begin)[0]
    array = flags & 0xFF
    if array > _FUNCTION:  # an object, which is not read
        return
    _, begin, size = number((5, 6))
    shape = struct.unpack_from(f"{order}{size // 4}i", data, begin)
    if len(shape) < 2 or size % 4 or min(shape) < 0:
        raise ValueError(f"an array of shape {shape}")
    number((1, 2, 16))
    count = math.prod(shape)
    if array == _OBJECT:
        number((1, 2, 16))
    if array in (_STRUCT, _OBJECT):
        _, begin, size = number((5, 6))
        longest = struct.unpack_from(f"{order}i", data, begin)[0] if size == 4 else 0
        _, begin, size = number((1, 2, 16))
        if longest < 1 or size % longest:
            raise ValueError("names of fields")
        count *= size // longest
    if array in (_STRUCT, _OBJECT, _CELL, _FUNCTION):
        for _ in range(1 if array == _FUNCTION else count):
            _, begin, size = number((_MATRIX,))
            _check_matrix(data, begin, begin + size, order, depth + 1)
        return
    for _ in range(2 if array == _SPARSE else 0):
        number((5, 6))
    for _ in range(2 if flags & 0x800 else 1):
        kind, _, size = number(tuple(_SIZES))
        if array not in (_CHAR, _SPARSE) and size != count * _SIZES[kind]:
            raise ValueError(f"{size} bytes for an array of shape {shape}")


_STEP = r"[A-Za-z]\w*(?:[({]\d+[)}])*"
_EXPRESSION = re.compile(rf"(?P<path>{_STEP}(?:\.{_STEP})*)\s*(?:\(\s*:\s*,\s*(?P<column>\d+)\s*\))?")


def read_mat(
    path: str | Path,
    *,
    variables: Mapping[str, tuple[str, str]] | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy = "error",
    layout: Mapping[str, str] | None = None,
) -> Record:
    """Read a record, SI where units are known, from a ``.mat`` file of version 5 or 7.3, or a text of Octave;
    `rate_hz`: for one without time.
    """
    path = Path(path)
    check_gap_policy(gaps)
    data = file_bytes(path)
    return read_content(
        _content(path, data), path, provenance_of(path, data), "mat", variables=variables, rate_hz=rate_hz, gaps=gaps,
        layout=layout or {},
    )  # fmt: skip


def read_content(
    content: Mapping[str, Any], path: Path, provenance: Mapping[str, str], kind: str, *,
    variables: Mapping[str, tuple[str, str]] | None, rate_hz: float | None, gaps: GapPolicy, layout: Mapping[str, str],
) -> Record:  # fmt: skip
    """Make a record of variables: structs are mappings, arrays of them and cells are lists."""
    wanted = {name: x for name, (x, _) in (variables or {}).items() if name != "time"}
    listed = [x for name, x in wanted.items() if x != name or _is_vector(content.get(x))]
    listed = listed if len(listed) == len(wanted) else []  # some are no variables: columns of a matrix, with names
    groups: Mapping[str, Any] = {}
    if not listed or not any(is_time(x) for x in (*content, *(variables or {}))):
        refuse_foreign(content, path)
        groups = structures(content, path)
    if groups and not listed:
        return read_structures(path, provenance, groups, layout, rate_hz, gaps, kind, scalars(content))
    if set(layout) - {"time", "time_unit"}:
        why = f"the rig names the variable {listed[0]}" if listed else "it has no structure with signals"
        raise RecordError(f"record {path}: a layout is for structures; {why}. Omit the layout")
    mapping = dict(variables) if variables is not None else _every_vector(content, path)
    columns = {name: _vector(content, expression, path) for name, (expression, _) in mapping.items()}
    told: dict[str, object] = {}
    if "time" not in mapping:
        columns, mapping, told, rate_hz = _with_time(content, columns, mapping, groups, path, layout, rate_hz)
    values = _side_by_side(columns, mapping, path)
    names = tuple(columns)
    time = names.index("time") if "time" in names else None
    if time is not None:
        variable, unit = mapping["time"]
        text = None if unit == UNKNOWN else unit
        stamps, said = timed(
            values[:, time], variable, text, str(told.get("time", "")), f"record {path}", layout, rate_hz
        )
        values[:, time], told = stamps, {**told, **said}
    table = Table(
        where=str(path), names=names, values=values, first_row=1, time=time,
        unit_texts=tuple(None if unit == UNKNOWN else unit for _, unit in mapping.values()),
        provenance=provenance,
        settings={"format": kind, "variables": {name: expression for name, (expression, _) in mapping.items()}, **told},
    )  # fmt: skip
    if gaps == "error":
        refuse_gaps(table)
    return uniform_record(table, rate_hz, gaps)


def _with_time(
    content: Mapping[str, Any], columns: dict[str, Array], mapping: dict[str, tuple[str, str]],
    groups: Mapping[str, Any], path: Path, layout: Mapping[str, str], rate_hz: float | None,
) -> tuple[dict[str, Array], dict[str, tuple[str, str]], dict[str, object], float | None]:  # fmt: skip
    """Find the time of columns: among them, in a vector beside them, in the structure, or in a rate beside them."""
    if rate_hz is not None:
        columns = {k: x for k, x in columns.items() if k.lower() not in TIME_NAMES}
        return columns, {k: mapping[k] for k in columns}, {}, rate_hz
    size = max(x.size for x in columns.values())
    used = {x for x, _ in mapping.values()}
    vectors = {k: _vector(content, k, path) for k, x in content.items() if k not in used and _is_vector(x)}
    every = {**columns, **{k: x for k, x in vectors.items() if x.size == size and k not in columns}}
    beside = scalars(content)
    units = [None if k not in mapping or mapping[k][1] == UNKNOWN else mapping[k][1] for k in every]
    clock = clock_of(list(every), units, list(every.values()), where=f"record {path}", beside=beside, layout=layout)
    told: dict[str, object] = {"time": clock.why} if clock.why else {}
    if clock.column is not None:
        name = list(every)[clock.column]
        unit = mapping.get(name, (name, UNKNOWN))[1]
        rest = {k: x for k, x in columns.items() if k != name}
        source = mapping.get(name, (name, unit))[0]
        return {**rest, "time": every[name]}, {**{k: mapping[k] for k in rest}, "time": (source, unit)}, told, rate_hz
    stamps = next((s.time for x in groups.values() for s in x if s.time is not None and s.time.size == size), None)
    if stamps is not None and clock.rate_hz is None:
        return {**columns, "time": stamps}, {**mapping, "time": ("time", "s")}, told, rate_hz
    return columns, mapping, told, clock.rate_hz


def _content(path: Path, data: bytes) -> dict[str, Any]:
    """Return the variables of the file, structs as nested dicts."""
    if b"\x89HDF\r\n\x1a\n" in (data[:8], data[512:520]):
        return content_of_hdf5(path, matlab=True)
    if data.startswith(b"# Created by Octave"):
        with one_line(path, "no sound text of Octave", "Save it again, as save -v7"):
            return dict(_octave(iter(data.decode().split("\n")), path, len(data)))
    from scipy.io import loadmat

    try:
        check_elements(data)
        with warnings.catch_warnings():  # objects are all called None; any other name that occurs twice is a failure
            warnings.filterwarnings("error", message="Duplicate variable")
            warnings.filterwarnings("ignore", message='Duplicate variable name "None"')
            content = loadmat(
                io.BytesIO(data), struct_as_record=False, squeeze_me=False, verify_compressed_data_integrity=True
            )
    except Exception as failure:  # loadmat raises whatever its parser meets in a damaged file
        raise RecordError(
            f"record {path} is not a valid MATLAB file ({type(failure).__name__}: {failure}). Save it again from MATLAB"
        ) from None
    return {
        bytes(value["s0"].flat[0]).decode("latin-1") if name == "None" else name: _fields(value)
        for name, value in content.items()
        if not name.startswith("__")
    }


def _fields(value: Any) -> Any:
    """Turn structs into dicts, arrays of them and cells into lists, text into str."""
    if hasattr(value, "_fieldnames"):
        return {name: _fields(getattr(value, name)) for name in value._fieldnames}
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype.names and "s2" in value.dtype.names:
        return Foreign(bytes(value["s2"].flat[0] or b"").decode("latin-1"))
    if value.dtype == object:
        return _fields(value.flat[0]) if value.size == 1 else [_fields(x) for x in value.ravel(order="F")]
    if value.dtype.kind == "U":
        return value.flat[0] if value.size == 1 else value.tolist()
    return value


def _octave(lines: Iterator[str], path: Path, size: int, most: float = math.inf) -> Iterator[tuple[str, Any]]:
    """Yield the variables of a text that Octave saves where no format is told, structs as nested dicts; `size`: of the
    file, in bytes.
    """

    def numbers(count: int) -> Array:
        return np.array(" ".join(next(lines) for _ in range(count)).split(), dtype=np.float64)

    def sizes(count: int) -> list[int]:
        own = itertools.takewhile(lambda x: not x.startswith("# name: "), lines)
        said = (re.match(r"# (?:rows|columns|length|elements): (\d+)", x) for x in own)
        found = [int(x[1]) for x in itertools.islice(filter(None, said), count)]
        if len(found) < count:
            raise ValueError("a size is missing")
        return found

    while most > 0 and (line := next((x for x in lines if x.startswith("# name: ")), "")):
        most, kind = most - 1, next(lines).removeprefix("# type: ").removeprefix("float ")
        value: Any = Foreign(kind)
        if kind == "scalar":
            value = numbers(1).reshape(1, 1)
        elif kind == "matrix" and (rows := re.match(r"# rows: (\d+)", next(lines))):  # else of more dimensions
            columns = sizes(1)[0]
            value = numbers(int(rows[1])).reshape(int(rows[1]), columns)
        elif kind.endswith("range"):
            base, limit, step = (next(lines), numbers(1))[1][:3].tolist()
            count = max(1 + math.floor((limit - base) / step + 1e-9), 0)  # ZeroDivisionError: refused
            refuse_claim(path, count, 1, size)
            value = base + step * np.arange(count)[None, :]
        elif kind == "string":
            value = [(next(lines), next(lines))[1] for _ in range(sizes(1)[0])]
            value = value[0] if len(value) == 1 else value
        elif kind == "cell":
            value = [x for _, x in _octave(lines, path, size, math.prod(sizes(2)))]
        elif kind.endswith("struct"):
            value = dict(_octave(lines, path, size, sizes(1)[0]))
        yield line.removeprefix("# name: "), value


def content_of_hdf5(path: Path, *, matlab: bool) -> dict[str, Any]:
    """Return the variables of a file of version 7.3, or of the datasets and groups of any HDF5 file."""
    import h5py

    size = path.stat().st_size

    def text_of(node: Any, name: str) -> str:
        text = node.attrs.get(name, b"")
        return text.decode("latin-1") if isinstance(text, bytes) else str(text)

    def taken(node: Any) -> Any:
        kind = text_of(node, "MATLAB_class")
        if "MATLAB_object_decode" in node.attrs and kind not in ("function_handle", "string"):
            return Foreign(kind)
        if isinstance(node, h5py.Group):
            fields = {name: taken(node[name]) for name in node if not name.startswith("#")}
            arrays = [
                isinstance(x, list) and "MATLAB_class" not in node[k].attrs and not isinstance(node[k], h5py.Group)
                for k, x in fields.items()
            ]
            units = {n: text_of(x, k) for n, x in node.items() for k in ("units", "unit") if k in x.attrs}
            fields |= {"units": units} if units and "units" not in fields else {}
            said: dict[str, set[float]] = {}
            for key, x in [] if matlab else [y for part in (node, *node.values()) for y in part.attrs.items()]:
                if isinstance(x, np.number | float | int) and rate_of(key, float(x)):
                    said.setdefault(key, set()).add(float(x))
            fields |= {k: np.full((1, 1), min(x)) for k, x in said.items() if len(x) == 1 and k not in fields}
            if arrays and all(arrays) and len({len(x) for x in fields.values()}) == 1:  # an array of structs
                return [dict(zip(fields, row, strict=True)) for row in zip(*fields.values(), strict=True)]
            return fields
        refuse_claim(path, node.size, node.dtype.itemsize, size)
        if "MATLAB_empty" in node.attrs:
            return "" if kind == "char" else [] if kind == "cell" else np.empty((0, 0))
        values = np.asarray(node[()])
        if h5py.check_ref_dtype(node.dtype) is not None:
            return [taken(file[reference]) for reference in values.ravel()]
        if kind == "char":
            return values.astype("<u2").tobytes().decode("utf-16-le", "replace") if min(values.shape) < 2 else ""
        # MATLAB stores column-major: what HDF5 shows is the transpose of the variable.
        return values.T if matlab and values.ndim >= 2 else values.reshape(1, 1) if values.ndim == 0 else values

    try:
        with hdf5_of(path) as file:
            content: dict[str, Any] = taken(file)
            return content
    except (
        OSError,
        RuntimeError,
        LookupError,
        ValueError,
        TypeError,
        AttributeError,
        ArithmeticError,
        MemoryError,
    ) as failure:
        raise RecordError(f"record {path} is not a valid MATLAB 7.3 or HDF5 file ({failure}). Save it again") from None


def _every_vector(content: Mapping[str, Any], path: Path) -> dict[str, tuple[str, str]]:
    """Map every numeric vector of the file, of unknown unit."""
    vectors = {
        name: (name, UNKNOWN) for name, value in content.items() if _is_vector(value) and len(value.reshape(-1)) > 1
    }
    if not vectors:
        shapes = ", ".join(f"{name} {_shape(value)}" for name, value in list(content.items())[:8]) or "nothing"
        raise RecordError(
            f"record {path} holds no numeric vector at its top ({shapes}). Say in the rig which one is which channel:"
            ' channels.<role>.variable = "data.y" or "y(:,2)"'
        )
    return vectors


def _is_vector(value: Any) -> bool:
    numeric = isinstance(value, np.ndarray) and value.dtype.kind in "fiu"
    return bool(numeric and value.size > 1 and value.size == max(value.shape))


def _vector(content: Mapping[str, Any], expression: str, path: Path) -> Array:
    """Look a variable up and return it as a column, shape (n_samples,)."""
    match = _EXPRESSION.fullmatch(expression.strip())
    if match is None:
        raise RecordError(f"{expression!r} is not a variable of {path}; write it as y, data.y, rec.Y(2).Data or y(:,2)")
    value: Any = content
    inside = ""
    for name in re.findall(r"[A-Za-z]\w*|\d+", match["path"]):
        if name.isdigit():
            parts = value if isinstance(value, list) else [value]
            if not 1 <= int(name) <= len(parts):
                raise RecordError(f"record {path}: {inside} has {len(parts)} parts, not {name}. Correct the variable")
            value, inside = parts[int(name) - 1], f"{inside}({name})"
            continue
        if not isinstance(value, Mapping) or name not in value:
            names = ", ".join(list(value)[:12]) if isinstance(value, Mapping) else "no fields"
            raise RecordError(
                f"record {path}: {inside or 'the file'} has no {name!r}; it has {names or 'nothing'}. Correct the "
                "variable"
            )
        value, inside = value[name], f"{inside}.{name}" if inside else name
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        raise RecordError(
            f"record {path}: variable {expression!r} is {_shape(value)}; it must be real numbers. Correct it"
        )
    if match["column"] is not None:
        k = int(match["column"])
        if value.ndim != 2 or not 1 <= k <= value.shape[1]:
            raise RecordError(
                f"record {path}: {match['path']!r} is {_shape(value)}; it has no column {k}. Correct the number"
            )
        value = value[:, k - 1]
    if value.size != max(value.shape, default=0):
        raise RecordError(
            f"record {path}: variable {expression!r} is {_shape(value)}; a channel is one column."
            f" Write {expression.strip()}(:,1) for its first"
        )
    return np.asarray(value, dtype=np.float64).reshape(-1)


def _shape(value: Any) -> str:
    if isinstance(value, Mapping | list):
        return "a struct" if isinstance(value, Mapping) else "an array of structs, or a cell array"
    if isinstance(value, Foreign):
        return f"an object of class {value.kind}"
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        return "a " + " x ".join(map(str, value.shape)) + " matrix"
    if isinstance(value, np.ndarray) and value.dtype.kind == "c":
        return "complex"
    return "not numeric"


def _side_by_side(columns: Mapping[str, Array], mapping: Mapping[str, tuple[str, str]], path: Path) -> Array:
    lengths = {name: column.size for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        listing = ", ".join(f"{mapping[name][0]} {n}" for name, n in lengths.items())
        raise RecordError(
            f"record {path}: variables differ in length ({listing}); all must have the same. Choose others"
        )
    return np.column_stack(list(columns.values()))
