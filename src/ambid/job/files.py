"""Files that are written: checked before the work begins, put in place together; no measured record is written over."""

from __future__ import annotations

import gzip
import os
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from ambid.errors import AmbidError
from ambid.settings.caller import setting

FIGURE_ENDINGS = (".png", ".svg", ".pdf")
PAGE_ENDINGS = (".html", ".htm", ".pdf")
_NOTES = "-metadata.json"  # the ending of what belongs to another file
_LOOKED = 64  # bytes of a file that say what it is
_MADE = (b"# simulated by ambid", b'{"schema": "ambid.', b'{\n "schema": "ambid.')
EXPORT_ENDINGS = (".mat", ".py", ".c", ".h", ".fmu")
METRICS_ENDINGS = (".prom",)
MAT_HEADER = b"MATLAB 5.0 MAT-file, written by ambid"
"""With what ``.mat`` files begin that were written here, so that no other is written over."""
_ARCHIVE = b"documentation/made-by-ambid.txt"  # the first entry of an FMU, as `fmu.MARK`
_BEGINNINGS = {
    FIGURE_ENDINGS: (b"\x89PNG", b"%PDF", b"<"), PAGE_ENDINGS: (b"<", b"%PDF"),
    EXPORT_ENDINGS: (MAT_HEADER, b'"""The plant of ', b"/* The plant of "), METRICS_ENDINGS: (b"# HELP ambid_",),
}  # fmt: skip
_STREAMED = ("json",)  # settings that take - for standard output


class Files:
    """Files that are going to be written, each beside its place, and moved when all are there; after an error or Ctrl-C
    nothing is left. None of `inputs`, which are read, may be written over.
    """

    def __init__(self, *inputs: Path | None) -> None:
        """Claim nothing yet."""
        self._inputs = [path for path in inputs if path is not None]
        self._claimed: list[Path] = []
        self._staged: dict[Path, Path] = {}

    def claim(self, path: Path | None, name: str, suffixes: Sequence[str] = (), *, force: bool | None = None) -> None:
        """Check before any work that a file (None: none) can be written; `name`: of its setting; `suffixes`: its
        endings, any if empty; `force`: of that name, None: no such setting. Without it only figures, reports, results
        and simulated records are written over, and that is told.
        """
        if path is None:
            return
        try:
            self._check(path, name, suffixes)
            if path.is_file() and not force and not _made_here(path, _BEGINNINGS.get(tuple(suffixes), ())):
                remedy = "Choose another name" + ("" if force is None else f", or give {setting('force', True)}")
                raise AmbidError(f"{setting(name)} {path} exists, and is not a result of ambid. {remedy}")
        except (OSError, RuntimeError, ValueError) as failure:  # a name that no file can have, a link to itself
            words = getattr(failure, "strerror", None) or failure
            raise AmbidError(f"{setting(name)} {path} cannot be used: {words}. Give another name") from None
        self._claimed.append(path)

    def _check(self, path: Path, name: str, suffixes: Sequence[str]) -> None:
        whole = path.resolve()
        folder = (whole if path.is_symlink() else path).parent
        if path.exists() and not path.is_file() and not path.is_dir():
            remedy = "Use - for standard output" if name in _STREAMED else "Name one"
            raise AmbidError(f"{setting(name)} {path} is a device or a pipe; it must be a file. {remedy}")
        if path.is_dir():
            raise AmbidError(f"{setting(name)} {path} is a folder; it must be a file. Name a file inside it")
        if suffixes and not path.name.lower().endswith(tuple(suffixes)):
            raise AmbidError(f"{setting(name)} {path} must end in {' or '.join(suffixes)}. Rename it")
        if not folder.is_dir():
            raise AmbidError(f"{setting(name)} {path}: there is no folder {folder}. Make it first, or correct the path")
        if not os.access(folder, os.W_OK):
            raise AmbidError(f"{setting(name)} {path}: folder {folder} may not be written. Choose another folder")
        for other in self._inputs:
            if _same(path, other):
                raise AmbidError(
                    f"{setting(name)} {path} is also an input, which would be overwritten. Choose another file"
                )
        for other in self._claimed:
            if _same(path, other):
                raise AmbidError(f"{setting(name)} {path} is named by two options. Choose another file for one of them")

    def stage(self, path: Path, write: Callable[[Path], object]) -> None:
        """Write a file under a name beside `path`, of the same ending, which `write` takes."""
        named, path = path.name, path.resolve()  # through a link, to the file that it stands for
        beside = path.with_name(f".{os.getpid()}-{named}")
        self._staged[path] = beside
        try:
            write(beside)
        except (OSError, AmbidError) as failure:  # the other files are still put in place where the caller goes on
            self._staged.pop(path).unlink(missing_ok=True)
            if isinstance(failure, AmbidError):
                raise
            raise AmbidError(
                f"{path} cannot be written: {failure.strerror or failure}. Check folder and disk"
            ) from None

    def stage_text(self, path: Path, text: str) -> None:
        """Write a UTF-8 text file under a name beside `path`."""
        self.stage(path, lambda beside: beside.write_text(text, encoding="utf-8"))

    def stage_notes(self, path: Path, comments: Sequence[str]) -> None:
        """Write what is to be said of a CSV file that is staged, into the file beside it."""
        if comments:
            from ambid.record.csv_format import notes_in, notes_path, notes_text

            beside = notes_path(path)
            if beside.exists() and not notes_in(beside):
                raise AmbidError(
                    f"{beside} would hold the notes of {path.name}, and is another file. Move it, or choose another "
                    "name"
                )
            data = self._staged[path.resolve()].read_bytes()
            self.stage_text(notes_path(path), notes_text(path.name, data, comments))

    def replaced(self, path: Path) -> None:
        """Take note that a file is going to be replaced."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                for path, beside in self._staged.items():
                    if path.exists() and path.stat().st_size and not path.name.endswith(_NOTES):
                        self.replaced(path)
                    os.replace(beside, path)
        finally:
            for beside in self._staged.values():
                beside.unlink(missing_ok=True)


def _made_here(path: Path, drawn: tuple[bytes, ...]) -> bool:
    """Whether a file is empty, or begins as a result, a simulated record or, whatever its name, what is drawn."""
    with path.open("rb") as raw:
        begin = raw.read(_LOOKED)
    try:
        if begin.startswith(b"\x1f\x8b"):
            with gzip.open(path) as file:
                begin = file.read(_LOOKED)
        elif begin.startswith(b"\x89HDF"):
            import h5py

            with h5py.File(path) as found:
                return b"simulat" in found["provenance"][()]
    except (OSError, EOFError, KeyError, TypeError, ValueError, zlib.error):  # damaged: nobody knows what it was
        return False
    if path.name.endswith((".csv", ".csv.gz")) and _noted(path):
        return True
    return not begin or begin.startswith((*_MADE, *drawn)) or (begin.startswith(b"PK") and _ARCHIVE in begin)


def _noted(path: Path) -> bool:
    """Whether the notes beside a CSV file say that it was simulated."""
    from ambid.record.csv_format import notes_of
    from ambid.record.record import sha256_of

    return any(f"# {line}".encode().startswith(_MADE) for line in notes_of(path, sha256_of(path.read_bytes())))


def _same(a: Path, b: Path) -> bool:
    if a.exists() and b.exists():
        return a.samefile(b)
    return a.resolve() == b.resolve()
