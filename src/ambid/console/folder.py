"""The files of a folder as a console shows them: by number, so that no name from outside opens anything."""

from __future__ import annotations

import json
import os
import re
import stat
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import FileIO
from itertools import count
from pathlib import Path
from typing import Any

from ambid.console.slot import descriptor
from ambid.errors import AmbidError
from ambid.record import ENDINGS

_MOST = 2000  # files that are listed, the newest
_WALKED = 50_000  # files that are looked at
_DEPTH = 2
_LONGEST = 12_800_000  # bytes of a result whose verdict is looked for


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A file of the folder."""

    number: int
    name: str  # relative to the folder
    kind: str  # record, rig, result, report, ledger
    bytes: int
    changed: float  # s since 1970
    schema: str = ""
    verdict: str = ""
    why: str = ""  # the first reason of the verdict
    loop: bool = False  # of a rig: whether it has a [loop]


class Folder:
    """The files of a folder; numbers stay with their files as long as this lives."""

    def __init__(self, folder: Path) -> None:
        self.path = folder
        self.left_out = 0
        self._numbers: dict[str, int] = {}
        self._seen: dict[str, tuple[float, int, dict[str, Any]]] = {}

    def entries(self) -> list[Entry]:
        """Return records, rigs, results and reports, the newest first; `left_out` tells how many are not listed."""
        found = sorted(self._files(), key=lambda f: -f[1].st_mtime)
        self.left_out = max(0, len(found) - _MOST)
        return [entry for path, about in found[:_MOST] if (entry := self._entry(path, about)) is not None]

    def path_of(self, number: object, kind: str) -> Path:
        """Return the file of a number, which must be of a kind."""
        name = next((n for n, k in self._numbers.items() if k == number and not isinstance(number, bool)), None)
        path = None if name is None else self.path / name
        about = None if path is None else plain(path, self.path)
        entry = None if path is None or about is None else self._entry(path, about)
        if path is None or entry is None or entry.kind != kind:
            raise AmbidError(f"there is no {kind} of this number in the folder. Reload the list")
        return path

    def read(self, number: object, kind: str, most: int) -> bytes:
        """Return what is in the file of a number: of a file that was exchanged for a link meanwhile, nothing."""
        path = self.path_of(number, kind)
        with open_plain(path) as file:
            about = plain(path, self.path)
            if about is None or not os.path.samestat(about, os.fstat(file.fileno())):
                raise AmbidError(f"the {kind} was exchanged while it was opened. Reload the list")
            data = file.read(most + 1)
        if len(data) > most:
            raise AmbidError(f"the {kind} is longer than {most >> 20} MiB. Open it without the console")
        return data

    def new(self, name: object, ending: str, *, once: bool = True) -> Path:
        """Return the place of a file that is to be made; its name is a plain one, `once`: that no file has yet."""
        text = str(name).strip()
        base = text.removesuffix(ending)
        if not base or len(base) > 80 or not all(c.isalnum() or c in "-_. " for c in base) or base.startswith("."):
            raise AmbidError(
                f"the name {text[:80]!r} is none for a file: letters, digits, - and _ make one. Correct it"
            )
        path = self.path / (base + ending)
        if once and (path.exists() or path.is_symlink()):
            raise AmbidError(f"{path.name} already exists. Choose another name")
        return path

    def free(self, name: str) -> str:
        """Take a name that no result has yet, nor its report or rig: the name itself, or the next with a number; its
        result is made, empty.
        """
        for k in count(1):
            own = name if k == 1 else f"{name}-{k}"
            paths = [self.path / f"{own}{ending}" for ending in (".json", ".html", ".toml")]
            if not any(p.exists() or p.is_symlink() for p in paths):
                with suppress(FileExistsError):  # another run was faster
                    paths[0].open("x").close()
                    return own
        raise AssertionError

    def _files(self) -> Iterator[tuple[Path, os.stat_result]]:
        """Yield plain files with an ending that is known; links are not followed."""
        waiting, looked = [(str(self.path), 0)], 0
        for folder, depth in waiting:  # grows
            try:
                inside = list(os.scandir(folder))
            except OSError:
                continue
            for item in inside:
                looked += 1
                if item.name.startswith(".") or looked > _WALKED:
                    continue
                if item.is_dir(follow_symlinks=False):
                    waiting += [(item.path, depth + 1)] if depth < _DEPTH else []
                elif _kind(item.name) and item.is_file(follow_symlinks=False):
                    with suppress(OSError):
                        yield Path(item.path), item.stat(follow_symlinks=False)

    def _entry(self, path: Path, about: os.stat_result) -> Entry | None:
        name, kind = str(path.relative_to(self.path)), _kind(path.name)
        known = self._seen.get(name)
        if known is None or known[:2] != (about.st_mtime, about.st_size):
            self._seen[name] = known = (about.st_mtime, about.st_size, _said(path, kind))
        if not kind or (kind in _KNOWN and not known[2]):
            return None
        number = self._numbers.setdefault(name, len(self._numbers) + 1)
        return Entry(
            number=number, name=name, kind=kind, bytes=about.st_size, changed=about.st_mtime, **known[2]
        )  # fmt: skip


_KINDS = {".toml": "rig", ".json": "result", ".html": "report", ".db": "ledger"}
_SQLITE = b"SQLite format 3\0"
_KNOWN = ("rig", "result", "ledger")  # kinds that are told by what is inside


def _kind(name: str) -> str:
    lower = name.lower()
    return "record" if lower.endswith(ENDINGS) else _KINDS.get(Path(lower).suffix, "")


def plain(path: Path, folder: Path) -> os.stat_result | None:
    """Return what is known of a plain file of the folder; None where it is none, or a link leads to it."""
    try:
        about = path.lstat()
        return (
            about
            if stat.S_ISREG(about.st_mode) and path.resolve() == folder.resolve() / path.relative_to(folder)
            else None
        )
    except (OSError, ValueError):
        return None


def open_plain(path: Path) -> FileIO:
    """Open a plain file for reading."""
    return FileIO(descriptor(path, os.O_RDONLY))


def _said(path: Path, kind: str) -> dict[str, Any]:
    """Return what a rig, a result or a ledger says of itself, as fields of its `Entry`; nothing of what is none."""
    if kind not in _KNOWN:
        return {}
    try:
        with open_plain(path) as file:
            data = file.read(1 << 20 if kind == "rig" else _LONGEST + 1 if kind == "result" else 4000)
        if kind != "result":
            schema, mark = {"rig": ("ambid.rig/1", b'"ambid.rig/1"'), "ledger": ("ambid.ledger", _SQLITE)}[kind]
            loop = kind == "rig" and re.search(rb"^\s*\[loop\]", data, re.MULTILINE) is not None
            return {"schema": schema, "loop": loop} if mark in data[:4000] else {}
        document: Any = json.loads(data) if len(data) <= _LONGEST else None
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(document, dict) or not str(document.get("schema", "")).startswith("ambid."):
        return {}
    verdict = document.get("verdict")
    said = verdict if isinstance(verdict, dict) else {}
    reasons = said.get("reasons")
    first = reasons[0] if isinstance(reasons, list) and reasons else None
    why = first.get("text", "") if isinstance(first, dict) else first or ""
    return {"schema": str(document["schema"])[:40], "verdict": str(said.get("word", ""))[:40], "why": str(why)[:400]}
