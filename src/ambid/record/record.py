"""The record: uniformly sampled channels in SI units, with the history of what was done to them; and the bytes and text
of its file, with every way in which a file can fail in one line.
"""

from __future__ import annotations

import difflib
import gzip
import hashlib
import io
import math
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from html import escape
from importlib import import_module
from numbers import Real
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, BinaryIO, overload

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from ambid.arrays import Array
from ambid.errors import AmbidError, RecordError, choices
from ambid.settings.caller import LARGEST, setting
from ambid.settings.elsewhere import RECORD, missing
from ambid.units import parse_unit

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure

_LONG, _LONGEST = 1 << 20, 1 << 28  # bytes of a file between which its check value waits until it is asked
INSIDE: list[Path] = []  # of this process: folders in one of which what is read has to lie; without any, anywhere


def _tables(name: str) -> Any:
    """Return a function that turns tables into records, or back."""
    return getattr(import_module("ambid.record.frames"), name)


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One line of a record's history.

    Attributes
    ----------
    name : str
        What was done, e.g. ``"lowpass"``.
    settings : Mapping[str, object]
        Its settings as JSON-able values, e.g. ``{"cutoff_hz": 500.0}``.
    """

    name: str
    settings: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    def __str__(self) -> str:
        inside = ", ".join(f"{k}={v}" for k, v in self.settings.items())
        return f"{self.name}({inside})"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Channel(NDArrayOperatorsMixin):
    """One measured or simulated quantity; in arithmetic, and to NumPy's functions and methods, it is its values.

    Attributes
    ----------
    name : str
        Column name in the file, or role (``voltage``, ``current``, ``position``) once a rig has named it.
    unit : str
        SI unit of `values`, e.g. ``"V"``; ``"1"`` for a plain number.
    values : ndarray, shape (n_samples,), float64, in `unit`
        Read-only.
    source_unit : str
        Unit the values had in the file, before conversion to SI.
    """

    name: str
    unit: str
    values: Array
    source_unit: str = ""

    def __post_init__(self) -> None:
        if np.iscomplexobj(self.values):
            raise RecordError(
                f"channel {self.name!r} holds complex numbers; a measured channel is real. Pass real part and imaginary"
                " part as two channels"
            )
        values = np.ascontiguousarray(self.values, dtype=np.float64)
        if values.ndim != 1:
            raise RecordError(
                f"channel {self.name!r} has shape {values.shape}; a channel is one column (n_samples,). Pass one column"
            )
        if values.flags.writeable:
            values = values.copy() if values is self.values else values
            values.flags.writeable = False
        object.__setattr__(self, "values", values)
        if not self.source_unit:
            object.__setattr__(self, "source_unit", self.unit)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.array(self.values, dtype=dtype, copy=copy)

    def __array_ufunc__(self, function: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        plain = [x.values if isinstance(x, Channel) else x for x in inputs]
        return getattr(function, method)(*plain, **options)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "values":  # which an object that is being copied lacks
            raise AttributeError(name)
        return getattr(self.values, name)

    def to(self, unit: str) -> Array:
        """Return the values in another unit of the same kind.

        Parameters
        ----------
        unit : str
            Such as ``"um"``.

        Returns
        -------
        ndarray, shape (n_samples,)
        """
        return parse_unit(unit).of_si(self.values, self.unit)  # type: ignore[no-any-return]

    def __len__(self) -> int:
        return int(self.values.size)

    def __iter__(self) -> Iterator[Any]:
        return iter(self.values)

    def __getitem__(self, at: Any) -> Any:
        if isinstance(at, slice) and any(isinstance(x, float) for x in (at.start, at.stop)):
            raise RecordError(
                f"channel {self.name!r} is cut by samples. Cut the record in seconds: record{_shown(at)}[{self.name!r}]"
            )
        return self.values[at]

    def __repr__(self) -> str:
        return f"Channel {self.name} [{self.unit}], {self.values.size} samples"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Record:
    """Uniformly sampled channels in SI units. Never changed in place: each step returns a new record.

    ``record["current"]`` is a channel, ``record[2.0:5.0]`` the record from 2 s to 5 s; iterating gives names, `len`
    the number of samples.

    Attributes
    ----------
    rate_hz : float
        Sampling rate in Hz.
    channels : tuple of Channel
        All of the same length, with distinct names, in file order.
    start_s : float
        Time of the first sample in s.
    history : tuple of Step
        What was done to the record since it was measured, oldest first.
    provenance : Mapping[str, str]
        Where it came from: ``file`` (name only), ``sha256`` (of the file's bytes), ``simulator`` and the like.
    """

    rate_hz: float
    channels: tuple[Channel, ...]
    start_s: float = 0.0
    history: tuple[Step, ...] = ()
    provenance: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        check_rate(self.rate_hz)
        if not self.channels:
            raise RecordError("the record has no channels; it needs at least one. Check the file's columns")
        names = [c.name for c in self.channels]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise RecordError(f"channel {twice[0]!r} occurs twice in the record; names must differ. Rename one column")
        lengths = {c.values.size for c in self.channels}
        if len(lengths) > 1:
            listing = ", ".join(f"{c.name} {c.values.size}" for c in self.channels)
            raise RecordError(f"channels differ in length ({listing}); all must have the same. Cut or resample them")

    @property
    def n_samples(self) -> int:
        """Number of samples of each channel."""
        return int(self.channels[0].values.size)

    @property
    def duration_s(self) -> float:
        """Length in s, ``n_samples / rate_hz``."""
        return self.n_samples / self.rate_hz

    @property
    def names(self) -> tuple[str, ...]:
        """Channel names in order."""
        return tuple(c.name for c in self.channels)

    @property
    def time_s(self) -> Array:
        """Sampling instants in s, shape (n_samples,)."""
        return self.start_s + np.arange(self.n_samples) / self.rate_hz

    def channel(self, name: str) -> Channel:
        """Return the channel called `name`.

        Raises
        ------
        RecordError
            If there is none; the message lists those there are.
        """
        for c in self.channels:
            if c.name == name:
                return c
        raise RecordError(f"the record has no channel {name!r}; it has {choices(name, self.names)} Check the name")

    @property
    def units(self) -> dict[str, str]:
        """SI unit by channel."""
        return {c.name: c.unit for c in self.channels}

    @property
    def shape(self) -> tuple[int, int]:
        """Samples and channels."""
        return self.n_samples, len(self.channels)

    def keys(self) -> tuple[str, ...]:
        """Return the names of the channels, so that ``dict(record)`` holds them.

        Returns
        -------
        tuple of str
        """
        return self.names

    def items(self) -> Iterator[tuple[str, Channel]]:
        """Return names and channels.

        Returns
        -------
        iterator of (str, Channel)
        """
        return zip(self.names, self.channels, strict=True)

    def to_numpy(self) -> Array:
        """Return all channels as columns, SI.

        Returns
        -------
        ndarray, shape (n_samples, n_channels)
        """
        return np.stack([c.values for c in self.channels], axis=1)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return self.to_numpy().astype(dtype or np.float64, copy=False)

    if not TYPE_CHECKING:  # an editor and a type checker know the attributes alone

        def __getattr__(self, name: str) -> Channel:
            if name.startswith("_") or name == "channels":  # which an object that is being copied lacks
                raise AttributeError(name)
            if name in self.names:
                return self.channel(name)
            raise missing("a record", name, dir(self), RECORD)

    def __dir__(self) -> list[str]:
        return sorted({*object.__dir__(self), *(n for n in self.names if n.isidentifier())})

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.names)

    @overload
    def __getitem__(self, key: str) -> Channel: ...
    @overload
    def __getitem__(self, key: slice | list[str]) -> Record: ...
    def __getitem__(self, key: str | slice | list[str]) -> Channel | Record:
        if isinstance(key, str):
            return self.channel(key)
        if isinstance(key, list) and key and all(isinstance(x, str) for x in key):
            return self.with_step(Step(name="channels"), channels=tuple(self.channel(x) for x in key))
        if isinstance(key, slice) and key.step is None:
            ends = [key.start, key.stop]
            if all(x is None or (isinstance(x, Real) and not isinstance(x, bool)) for x in ends):
                return cut(self, *(None if x is None else float(x) for x in ends))
        raise RecordError(
            f"a record has no part {_shown(key)}; it has channels by name, and parts in seconds. Write "
            f'record["{self.names[0]}"] or record[0.5:2.0], and record["{self.names[0]}"].values[7] for a sample'
        )

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return self.n_samples

    @classmethod
    def from_dataframe(
        cls,
        table: Any,
        *,
        rate_hz: float | None = None,
        units: Mapping[str, str] | None = None,
        gaps: str = "error",
    ) -> Record:
        """Take a record from a table in memory.

        Parameters
        ----------
        table : pandas or polars DataFrame, xarray Dataset, or Mapping of str to array
            Columns are called ``name [unit]``, or their units are given beside them. Time is a column ``time [s]``, an
            index or coordinate of seconds, time differences or dates (then from 0 on), or is told by `rate_hz`.
        rate_hz : float, optional
            Sampling rate in Hz, for a table without time.
        units : Mapping of str to str, optional
            Unit by column.
        gaps : {"error", "interpolate", "cut"}, optional
            What to do about missing values.

        Returns
        -------
        Record
            In SI units, under the rules that hold for files.

        Raises
        ------
        RecordError
            If the table breaks a rule.

        Examples
        --------
        >>> from ambid import Record
        >>> Record.from_dataframe({"current [mA]": [0, 1, 2, 3, 4, 5, 6, 7]}, rate_hz=1000.0)
        Record of 8 samples, 0.008 s at 1000 Hz: current [A]
        """
        return _tables("read_table")(table, rate_hz=rate_hz, units=units, gaps=gaps)  # type: ignore[no-any-return]

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a pandas DataFrame: columns ``name [unit]``, time in s as its index; `from_dataframe` takes it back.

        Returns
        -------
        pandas.DataFrame
        """
        return _tables("to_dataframe")(self)

    def to_xarray(self) -> xarray.Dataset:
        """Return an xarray Dataset: a variable a channel with its unit, over the coordinate time in s.

        Returns
        -------
        xarray.Dataset
            With rate, history and provenance as attributes.
        """
        return _tables("to_xarray")(self)

    def save(self, path: str | Path) -> None:
        """Write the record, as `ambid.write_record` does; `ambid.load` reads it back.

        Parameters
        ----------
        path : str or Path
            Ends in ``.csv``, ``.csv.gz`` or ``.h5``.
        """
        import_module("ambid.record").write_record(self, path)

    def plot(self, *, ax: Any = None) -> Figure:
        """Draw every channel: over time with its faults, close, and over frequency.

        Parameters
        ----------
        ax : matplotlib axes or several, optional
            To draw into: as many channels over time as there are axes; nothing else of their figure is touched.

        Returns
        -------
        matplotlib.figure.Figure
            Nothing opens a window: a notebook displays the last line of a cell.
        """
        title = f"{self.provenance.get('file', 'record')}: {self.duration_s:.4g} s at {self.rate_hz:.6g} Hz"
        draw = import_module("ambid.report.record").record_figure
        return draw(self, title, ax=ax)  # type: ignore[no-any-return]

    def _repr_html_(self) -> str:
        """Return the table that a notebook shows."""
        heads = "".join(f"<th>{x}</th>" for x in ("channel", "unit", "least", "mean", "largest"))
        rows = "".join(
            f"<tr><td>{escape(c.name)}</td><td>{escape(c.unit)}</td>"
            + "".join(f"<td>{f(c.values):.4g}</td>" for f in (np.nanmin, np.nanmean, np.nanmax))
            + "</tr>"
            for c in self.channels
        )
        line = f"{self.n_samples} samples, {self.duration_s:.4g} s at {self.rate_hz:.6g} Hz"
        return f"<div><b>Record</b>: {line}<table><tr>{heads}</tr>{rows}</table></div>"

    def __repr__(self) -> str:
        listed = ", ".join(f"{c.name} [{c.unit}]" for c in self.channels)
        return f"Record of {self.n_samples} samples, {self.duration_s:.4g} s at {self.rate_hz:.6g} Hz: {listed}"

    def with_step(self, step: Step, **changes: object) -> Record:
        """Return a copy with `changes` made and `step` added to its history."""
        return replace(self, history=(*self.history, step), **changes)  # type: ignore[arg-type]


def _shown(key: object) -> str:
    """Write a key as it stands between the brackets."""
    if not isinstance(key, slice):
        return f"[{key!r}]"
    ends = ["" if x is None else repr(x) for x in (key.start, key.stop)]
    return f"[{':'.join([*ends, repr(key.step)] if key.step is not None else ends)}]"


_MOST_UNPACKED = 1 << 28  # bytes, unless the packed ones are many: what packs better than any numbers is no record

# Sampling instants that are given as decimals (2.0 s at 1 kHz) miss the grid by round-off; a thousandth of a sample is
# none.
_GRID_TOLERANCE = 1e-3


def cut(record: Record, from_s: float | None = None, to_s: float | None = None) -> Record:
    """Keep the samples with from_s <= t < to_s, on the record's own time axis.

    Parameters
    ----------
    record : Record
    from_s, to_s : float, optional
        Ends in s; the record's own by default.

    Returns
    -------
    Record, a new one with the step in its history
        Its `start_s` is the time of its first sample.

    Raises
    ------
    RecordError
        If an end lies outside the record, or nothing would be left.
    """
    begin, end = record.start_s, record.start_s + record.duration_s
    for label, bound in (("from", from_s), ("to", to_s)):
        if not (bound is None or isinstance(bound, Real)):
            raise RecordError(f"cut {label} {bound!r}: it must be a time in s. Give a number")
    first_s = begin if from_s is None else float(from_s)
    last_s = end if to_s is None else float(to_s)
    slack = _GRID_TOLERANCE / record.rate_hz
    for label, t in (("from", first_s), ("to", last_s)):
        if not begin - slack <= t <= end + slack:
            raise RecordError(f"cut {label} {t:g} s; the record spans {begin:g} to {end:g} s. Give a time inside it")
    first = math.ceil((first_s - begin) * record.rate_hz - _GRID_TOLERANCE)
    last = math.ceil((last_s - begin) * record.rate_hz - _GRID_TOLERANCE)
    if last <= first:
        raise RecordError(
            f"cut from {first_s:g} to {last_s:g} s keeps no sample; from must lie before to. Swap or widen them"
        )
    first, last = max(first, 0), min(last, record.n_samples)
    channels = tuple(replace(c, values=c.values[first:last].copy()) for c in record.channels)
    step = Step(name="cut", settings={"from_s": first_s, "to_s": last_s, "samples": last - first})
    return record.with_step(step, channels=channels, start_s=begin + first / record.rate_hz)


def check_rate(rate_hz: object) -> float:
    """Return a sampling rate in Hz; refuse what is none, and what is absurd."""
    if isinstance(rate_hz, Real) and not isinstance(rate_hz, bool) and 1.0 / LARGEST <= float(rate_hz) <= LARGEST:
        return float(rate_hz)
    raise RecordError(
        f"the sampling rate given is {rate_hz!r}; it must be a positive number of Hz, up to {LARGEST:g}. Correct "
        f"{setting('rate_hz')}"
    )


def file_bytes(path: Path, error: type[AmbidError] = RecordError, what: str = "record") -> bytes:
    """Return the bytes, at least one, of a file that exists, is a file and can be read, or raise `error` of it."""
    with readable(path, error, what) as file:
        data = file.read()
    if not data:
        raise error(f"{what} {path} is empty (0 bytes). Export or copy it again")
    return data


@contextmanager
def readable(path: Path, error: type[AmbidError] = RecordError, what: str = "record") -> Iterator[BinaryIO]:
    """Open a file that exists, is a file and can be read; arguments as `file_bytes`."""
    if INSIDE and not any(path.resolve().is_relative_to(folder.resolve()) for folder in INSIDE):
        raise error(f"{what} {path} is outside of {INSIDE[0]}. Copy it into that folder")
    try:
        refuse_pipe(path, error, what)
        with path.open("rb") as file:
            yield file
    except FileNotFoundError:
        raise error(f"{what} {path} does not exist{_similar(path)}. Check the path") from None
    except IsADirectoryError:
        raise error(f"{what} {path} is a folder; it must be a file. Name the file inside it") from None
    except PermissionError:
        raise error(f"{what} {path} may not be read (permission denied). Change its permissions") from None
    except OSError as failure:
        raise error(
            f"{what} {path} cannot be read: {failure.strerror or failure}. Check the path and the disk"
        ) from None


def refuse_pipe(path: Path, error: type[AmbidError] = RecordError, what: str = "record") -> None:
    """Refuse what has no end, or waits for a writer when it is opened; arguments as `file_bytes`."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise error(f"{what} {path} is a device or a pipe; it must be a file. Write what it gives into one")


def _similar(path: Path) -> str:
    """Name the file of the same folder whose name is nearest, if one is near."""
    try:
        names = [p.name for p in path.parent.iterdir()]
    except OSError:
        return f" (nor does its folder {path.parent})"
    near = difflib.get_close_matches(path.name, names, n=1)
    return f" ({near[0]} does)" if near else ""


class Provenance(Mapping[str, str]):
    """Where a record comes from; the SHA-256 of its file, longer to compute than to read, is so where it is asked."""

    def __init__(self, known: Mapping[str, str], data: bytes) -> None:
        """`known`: all but ``sha256``, which is that of `data`."""
        self._known, self._data = dict(known), data

    def _all(self) -> dict[str, str]:
        if "sha256" not in self._known:
            self._known["sha256"], self._data = sha256_of(self._data), b""
        return self._known

    def __getitem__(self, key: str) -> str:
        return self._all()[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())


def provenance_of(path: Path, data: bytes) -> Mapping[str, str]:
    """Return name and SHA-256 of a file."""
    if not _LONG <= len(data) < _LONGEST:
        return MappingProxyType({"file": path.name, "sha256": sha256_of(data)})
    return Provenance({"file": path.name}, data)


def sha256_of(data: bytes) -> str:
    """Return the SHA-256 of the bytes in 64 hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def gunzipped(data: bytes, path: Path) -> bytes:
    """Return what the bytes of a gzip file hold; `path` is for messages."""
    most = most_unpacked(data)
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            text = file.read(most + 1)
    except EOFError:
        raise RecordError(f"record {path} is a truncated gzip file: its end is missing. Copy it again") from None
    except (gzip.BadGzipFile, zlib.error) as failure:
        raise RecordError(f"record {path} is not a valid gzip file ({failure}). Copy it again, or rename it") from None
    refuse_bomb(len(text), data, path)
    return text


def most_unpacked(data: bytes) -> int:
    """Return the bytes that a packed record may hold."""
    return max(_MOST_UNPACKED, 200 * len(data))


def refuse_bomb(size: int, data: bytes, path: Path) -> None:
    """Refuse a packed record of which `size` bytes are known to come."""
    if size > (most := most_unpacked(data)):
        raise RecordError(
            f"record {path} unpacks to more than {most >> 20} MiB, over 200 times its size: that is no record. Check "
            "where it comes from"
        )


def utf8_text(data: bytes, path: Path, error: type[AmbidError] = RecordError, what: str = "record") -> str:
    """Decode UTF-8 into lines that end in a line feed; a byte order mark at the beginning is dropped. `path`, `error`
    and `what` are for messages.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise error(f"{what} {path} is UTF-16; text must be UTF-8. Save it as UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        row = data.count(b"\n", 0, failure.start) + 1
        byte = data[failure.start]
        remedy = f", or give {setting('layout', 'encoding=latin-1')}" if what == "record" else ""
        raise error(
            f"{what} {path}, row {row}: byte 0x{byte:02x} is not UTF-8 text. Save the file as UTF-8{remedy}"
        ) from None
    if "\0" in text:
        raise error(f"{what} {path} holds binary data (a zero byte); it must be text. Check that it is the right file")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text
