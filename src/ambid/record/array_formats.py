"""Arrays of NumPy (``.npy``, ``.npz``), HDF5 of other programs and workbooks of Excel: variables are
read as those of MATLAB, sheets as text.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ambid.errors import RecordError, choices
from ambid.record.csv_format import table_of_lines
from ambid.record.frames import imported
from ambid.record.mat_format import content_of_hdf5, read_content
from ambid.record.record import Record, file_bytes, provenance_of, refuse_bomb
from ambid.record.sampling import GapPolicy, check_gap_policy, uniform_record
from ambid.record.streams import one_line


def read_numpy(
    path: Path, *, layout: Mapping[str, str], rate_hz: float | None = None, gaps: GapPolicy = "error",
    variables: Mapping[str, tuple[str, str]] | None = None,
) -> Record:  # fmt: skip
    """Read a record from arrays by name, from one matrix with names beside it or none, or from an array of structs."""
    check_gap_policy(gaps)
    data = file_bytes(path)
    try:
        if data.startswith(b"PK"):
            with zipfile.ZipFile(io.BytesIO(data)) as packed:
                refuse_bomb(sum(x.file_size for x in packed.infolist()), data, path)
        file = np.load(io.BytesIO(data), allow_pickle=False)
        content = {"array": file} if isinstance(file, np.ndarray) else {name: file[name] for name in file.files}
    except RecordError:
        raise
    except Exception as failure:  # the parsers of archive and header raise whatever they meet in a damaged file
        detail = " ".join(str(failure).split())[:120]
        raise RecordError(f"record {path} is no sound file of NumPy arrays ({detail}). Save it again") from None
    plain: dict[str, Any] = {}
    for name, x in content.items():
        plain |= {field: x[field] for field in x.dtype.names} if x.dtype.names else {name: x}
    return read_content(
        plain, path, provenance_of(path, data), path.suffix.lower()[1:], variables=variables, rate_hz=rate_hz,
        gaps=gaps, layout=layout,
    )  # fmt: skip


def read_foreign_hdf5(
    path: Path, *, layout: Mapping[str, str], rate_hz: float | None, gaps: GapPolicy,
    variables: Mapping[str, tuple[str, str]] | None,
) -> Record:  # fmt: skip
    """Read a record from an HDF5 file that another program wrote: datasets in groups, units in their attributes."""
    check_gap_policy(gaps)
    content = content_of_hdf5(path, matlab=False)
    return read_content(
        content,
        path,
        provenance_of(path, file_bytes(path)),
        "hdf5",
        variables=variables,
        rate_hz=rate_hz,
        gaps=gaps,
        layout=layout,
    )


def read_xlsx(
    path: Path, *, layout: Mapping[str, str], rate_hz: float | None = None, gaps: GapPolicy = "error"
) -> Record:
    """Read a record from the sheet of an Excel workbook that holds numbers; ``sheet`` of the layout names another."""
    check_gap_policy(gaps)
    data = file_bytes(path)
    openpyxl = imported("openpyxl", "an Excel workbook", "formats")
    with one_line(path, "no sound Excel workbook", "Save it again"):
        with zipfile.ZipFile(io.BytesIO(data)) as packed:
            refuse_bomb(sum(x.file_size for x in packed.infolist()), data, path)
        book = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)
        shown = [x for x in book.worksheets if x.sheet_state == "visible" or x.title == layout.get("sheet")]
        sheets = {x.title: [_line(row) for row in x.iter_rows(values_only=True)] for x in shown or book.worksheets}
    word = layout.get("sheet")
    if word is not None and word not in sheets:
        raise RecordError(f"record {path} has no sheet {word!r}; it has {choices(word, sheets)} Correct layout sheet")
    name = word or max(sheets, key=lambda x: len(sheets[x]))
    lines = sheets[name]
    while lines and not lines[-1].strip():
        lines.pop()
    empty = min((len(x) - len(x.rstrip("\t")) for x in lines), default=0)  # columns that no row fills
    lines = [x[: len(x) - empty] for x in lines]
    told = {"sheet": name}
    provenance = dict(provenance_of(path, data))
    table, rate = table_of_lines([*lines, ""], path, gaps, layout, rate_hz, provenance, told)
    return uniform_record(table, rate, gaps)


def _line(row: tuple[Any, ...]) -> str:
    """Return the cells of a row as text."""
    return "\t".join(
        "" if x is None else repr(x) if isinstance(x, float | int) else " ".join(str(x).split()) for x in row
    )
