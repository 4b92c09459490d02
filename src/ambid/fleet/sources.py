"""Which records a fleet has, and which rig, bearing and time belong to each: by one rig, a pattern or a table."""

from __future__ import annotations

import csv
import fnmatch
import glob
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ambid.errors import AmbidError, RecordError, counted, needs
from ambid.job.data import known_rig
from ambid.ledger.entry import moment, sha_of
from ambid.record import Record, Source, read_record
from ambid.record.hdf5_format import started_of
from ambid.rig import Rig
from ambid.settings.caller import setting

_WORD = re.compile(r"\{(\w+)\}")
_WILD = re.compile(r"[*?\[{]")
_COLUMNS = ("pattern", "rig", "bearing", "taken_at")

Rigs = Rig | str | Path | None | Sequence[Rig | str | Path]
"""One rig for all; a file's name with ``{word}`` of the records' pattern; a table ``.csv``; or one for each record."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """A record of a fleet with what belongs to it."""

    source: Any  # a path, a URL, or a record in memory
    name: str
    rig: Rig
    bearing: str
    taken_at: float | None  # s since 1970, UTC; None: the record says so itself
    by_file: bool = False  # whether the time of its file counts instead
    size: float = 1.0  # by which it takes longer than another one

    @property
    def remote(self) -> bool:
        """Whether it lies elsewhere than among the files of this machine."""
        return isinstance(self.source, str) and "://" in self.source

    def digest(self) -> str:
        """Return the SHA-256 of the record's file, or of what a record in memory holds."""
        if isinstance(self.source, Record):
            digest = hashlib.sha256(f"{self.source.rate_hz!r} {self.source.start_s!r}".encode())
            for c in self.source.channels:
                digest.update(f"{c.name} {c.unit} ".encode() + c.values.tobytes())
            return digest.hexdigest()
        if not self.remote:
            return sha_of(Path(self.source))
        with opened(self.source) as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def when(self) -> float | None:
        """Return when the record was taken; None where it says so itself, or nobody does."""
        if self.by_file and isinstance(self.source, (str, Path)):
            if not self.remote:
                return Path(self.source).stat().st_mtime
            system, path = _system(str(self.source))
            try:
                return float(system.modified(path).timestamp())
            except (NotImplementedError, AttributeError):
                raise AmbidError(f"{self.name} has no time of its file. Name it by {{taken_at}}") from None
        return self.taken_at

    @contextmanager
    def here(self, sha: str) -> Iterator[Any]:
        """Yield the record, or a file of this machine while the context lasts; `sha`: what is expected of one that is
        fetched.
        """
        if not self.remote:
            yield self.source
            return
        with TemporaryDirectory(prefix="ambid-") as folder:
            path = Path(folder) / self.source.rpartition("/")[2]
            with opened(self.source) as file, path.open("wb") as copy:
                while part := file.read(1 << 20):
                    copy.write(part)
            if sha_of(path) != sha:
                raise RecordError(f"record {self.source} changed while the fleet ran. Run again")
            yield path


def _system(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and its path there."""
    with needs("fsspec", url, "fleet"):
        from fsspec.core import url_to_fs
    try:
        system: tuple[Any, str] = url_to_fs(url)
    except (ImportError, ValueError) as failure:
        text = " ".join(str(failure).split()).rstrip(".")
        raise AmbidError(f"{url} cannot be reached: {text}. Install its reader, or correct it") from None
    return system


@contextmanager
def opened(url: str) -> Iterator[Any]:
    """Open what lies elsewhere."""
    system, path = _system(url)
    try:
        with system.open(path, "rb") as file:
            yield file
    except OSError as failure:
        raise RecordError(f"record {url} cannot be read: {failure.strerror or failure}. Check the path") from None


def items(records: Source | Sequence[Source], rigs: Rigs, taken_at: str | None = None) -> list[Item]:
    """Return the records that are meant, each with its rig; all is looked at before anything runs.

    `taken_at`: where neither name nor table says it; ``"file"``: the time of the file.
    """
    sources = list(records) if isinstance(records, (list, tuple)) else [records]
    apart = list(rigs) if isinstance(rigs, (list, tuple)) else None
    if apart is not None and len(apart) != len(sources):
        raise AmbidError(
            f"{counted(len(apart), 'rig')} for {counted(len(sources), 'record')}. Give one for each, or one"
        )
    table = None if apart is not None else _Table.of(rigs)
    result: list[Item] = []
    loaded: dict[Any, Rig] = {}
    for k, source in enumerate(sources):
        for one, words in _matches(source):
            name = str(one) if isinstance(one, (str, Path)) else f"record {len(result) + 1}"
            row = {"rig": apart[k]} if apart is not None else table.row(name) if table else {}
            rig, bearing, at = (_filled(row.get(x), words, name) or words.get(x) for x in _COLUMNS[1:])
            at = at or taken_at
            rig_key = rig if isinstance(rig, (str, Path)) or rig is None else id(rig)
            if rig_key not in loaded:
                loaded[rig_key] = known_rig(rig)
            result.append(
                Item(
                    source=one, name=name, rig=loaded[rig_key], bearing=bearing or loaded[rig_key].name,
                    taken_at=None if at in (None, "file") else moment(str(at), f"taken_at of {name}"),
                    by_file=at == "file", size=_size(one),
                )
            )  # fmt: skip
    return result


def fit_for_ledger(fleet: Sequence[Item], *, strict: bool) -> list[Item]:
    """Return the records with the time that each says itself, where nothing else says it; refuse what no ledger keeps.

    `strict`: also records that do not say it; what lies elsewhere is looked at when it is here.
    """
    dated, lacking = list[Item](), list[Item]()
    for item in fleet:
        if not item.bearing.strip():
            raise AmbidError(f"record {item.name}: its bearing has no name. Name it in the table or in the rig")
        silent = item.taken_at is None and (isinstance(item.source, Record) or not (item.by_file or item.remote))
        said = started_in(item.source) if silent else None
        if said == "":
            lacking.append(item)
        dated.append(replace(item, taken_at=moment(said, f"the time in {item.name}")) if said else item)
    if lacking and strict:
        raise AmbidError(undated(lacking, len(fleet)))
    return dated


def started_in(record: Any) -> str | None:
    """Return when a record in memory, or in a file here, says that it was taken; empty where it does not; None where
    the file cannot be read, as the job will tell.
    """
    if isinstance(record, Record):
        return record.provenance.get("started", "")
    return started_of(Path(record)) if Path(record).suffix.lower() in (".h5", ".hdf5") else ""


def undated(lacking: Sequence[Item], n: int) -> str:
    """Return the refusal of records of which nobody says when they were taken."""
    first = lacking[0].name
    who = f"record {first} does" if n == 1 else f"{len(lacking)} of {counted(n, 'record')}, the first {first}, do"
    return (
        f"{who} not say when taken, and the ledger has to know. Give {setting('taken_at', 'TIME')}, "
        f"{setting('taken_at', 'file')} for the time of the file, or name records by {{taken_at}}"
    )


def _size(source: Any) -> float:
    """Return how large a record is; one that is not of this machine as any other."""
    if isinstance(source, Record):
        return float(source.n_samples * len(source.channels))
    try:
        return 1.0 if "://" in str(source) else float(Path(source).stat().st_size)
    except OSError:
        return 1.0


def _matches(source: Any) -> Iterator[tuple[Any, dict[str, str]]]:
    """Yield the records that a path, pattern or table in memory stands for, with the words of the pattern."""
    if not isinstance(source, (str, Path)):
        yield read_record(source), {}
        return
    text = str(source)
    if not _WILD.search(text) or ("://" not in text and Path(text).exists()):
        if "://" not in text and not Path(text).is_file():
            raise AmbidError(f"record {text} does not exist. Check the path")
        yield _readable(text), {}
        return
    wild = _WORD.sub("*", text)
    if "://" in text:
        system, path = _system(wild)
        paths = [system.unstrip_protocol(x) for x in system.glob(path)]
    else:
        paths = glob.glob(wild, recursive=True)
    shape = _expression(_bare(text))
    fits = [(path, shape.fullmatch(_bare(path))) for path in sorted(paths)]
    if not any(fit for _, fit in fits):
        raise AmbidError(f"no record matches {text}. Check the pattern")
    yield from ((_readable(path), fit.groupdict()) for path, fit in fits if fit)


def _bare(path: str) -> str:
    """Return a path without its scheme: file systems differ in how many strokes they begin with."""
    return path.rpartition("://")[2].lstrip("/")


def _readable(path: str) -> Any:
    """Return a path, but what lies in this process's memory as a record: no other process sees it there."""
    if not path.startswith("memory://"):
        return path
    item = Item(source=path, name=path, rig=known_rig(None), bearing="", taken_at=None)
    with item.here(item.digest()) as copy:
        return read_record(copy)


def _expression(pattern: str) -> re.Pattern[str]:
    """Return what a pattern of paths means: stars and words in one component, ``**`` over any number."""
    parts, names = [], set[str]()
    for part in re.split(r"(\*\*/|\*|\?|\[[^]]+\]|\{\w+\})", pattern.removeprefix("./")):
        word = _WORD.fullmatch(part)
        if word:
            parts.append(f"(?P={word[1]})" if word[1] in names else f"(?P<{word[1]}>[^/]+)")
            names.add(word[1])
        elif part in ("**/", "*", "?"):
            parts.append({"**/": "(?:.*/)?", "*": "[^/]*", "?": "[^/]"}[part])
        else:
            parts.append(fnmatch.translate(part)[4:-3] if part.startswith("[") else re.escape(part))
    return re.compile(r"(?:\./)?" + "".join(parts), re.DOTALL)


def _filled(template: Any, words: Mapping[str, str], name: str) -> Any:
    """Return a text with the words of a record's pattern in it."""
    if not isinstance(template, (str, Path)) or not _WORD.search(str(template)):
        return template
    missing = [w for w in _WORD.findall(str(template)) if w not in words]
    if missing:
        raise AmbidError(
            f"record {name}: {template} has {{{missing[0]}}}, the records' pattern has not. Put it there, as in "
            f"'records/{{{missing[0]}}}/*.h5'"
        )
    return _WORD.sub(lambda word: words[word[1]], str(template))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Table:
    """Rows of patterns with what belongs to the records that match them."""

    where: str
    rows: Sequence[tuple[re.Pattern[str], Mapping[str, Any]]]

    @classmethod
    def of(cls, rigs: Any) -> _Table:
        """Return the table that is meant; one rig is a table of one row."""
        if not isinstance(rigs, (str, Path)) or not str(rigs).lower().endswith(".csv"):
            return cls(where="", rows=[(re.compile(".*", re.DOTALL), {"rig": rigs})])
        path = Path(rigs)
        try:
            with path.open(encoding="utf-8-sig", newline="") as file:
                lines = csv.DictReader(file, skipinitialspace=True)
                names, read = [n.strip() for n in lines.fieldnames or ()], list(lines)
        except (OSError, UnicodeDecodeError, csv.Error) as failure:
            raise AmbidError(f"table {path} cannot be read: {failure}. Check the path") from None
        strange = [n for n in names if n not in _COLUMNS]
        if strange or not {"pattern", "rig"} <= set(names):
            raise AmbidError(
                f"table {path} has the columns {', '.join(names)}; it must have pattern and rig, and may have bearing "
                "and taken_at. Correct the first row"
            )
        rows = []
        for number, line in enumerate(read, 2):
            cells = {name: (cell or "").strip() for name, cell in zip(names, line.values(), strict=False)}
            if None in line or not cells["pattern"] or not cells["rig"]:
                raise AmbidError(f"table {path}, row {number}: a cell is missing or too many. Correct it")
            settings = {n: x for n, x in cells.items() if x and n != "pattern"}
            settings["rig"] = str(path.parent / settings["rig"])
            rows.append((_expression("**/" + cells["pattern"].removeprefix("/")), settings))
        return cls(where=str(path), rows=rows)

    def row(self, name: str) -> Mapping[str, Any]:
        """Return the one row that a record matches, the words of its pattern put in."""
        matches = [(fit, told) for shape, told in self.rows if (fit := shape.fullmatch(name))]
        if len(matches) != 1:
            what = "no pattern" if not matches else "several patterns"
            raise AmbidError(
                f"record {name} matches {what} of {self.where}. Correct the table: each must match one row"
            )
        fit, told = matches[0]
        words = fit.groupdict()
        filled = {n: _filled(x, words, name) if words else x for n, x in told.items()}
        return {**{n: words[n] for n in ("bearing", "taken_at") if n in words}, **filled}
