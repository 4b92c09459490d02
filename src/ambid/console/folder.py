"""The files of a folder as a console shows them: by number, so that no name from outside opens anything."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ambid.errors import AmbidError

_RECORDS = (".csv", ".csv.gz", ".h5", ".hdf5", ".mat")
_MOST = 2000  # files that are listed
_DEPTH = 2
_HEAD = 200_000  # bytes of a result in which its verdict is looked for


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A file of the folder."""

    number: int
    name: str  # relative to the folder
    kind: str  # record, rig, result, report
    bytes: int
    changed: float  # s since 1970
    schema: str = ""
    verdict: str = ""


class Folder:
    """The files of a folder; numbers stay with their files as long as this lives."""

    def __init__(self, folder: Path) -> None:
        self.path = folder
        self._numbers: dict[str, int] = {}
        self._seen: dict[str, tuple[float, int, str, str]] = {}

    def entries(self) -> list[Entry]:
        """Return records, rigs, results and reports, the newest first."""
        found = [entry for path in self._files() if (entry := self._entry(path)) is not None]
        return sorted(found, key=lambda e: -e.changed)

    def path_of(self, number: object, kind: str) -> Path:
        """Return the file of a number, which must be of a kind."""
        name = next((n for n, k in self._numbers.items() if k == number and not isinstance(number, bool)), None)
        path = None if name is None else self.path / name
        entry = None if path is None or not _plain(path, self.path) else self._entry(path)
        if entry is None or entry.kind != kind:
            raise AmbidError(f"there is no {kind} of this number in the folder. Reload the list")
        return self.path / entry.name

    def new(self, name: object, ending: str) -> Path:
        """Return the place of a file that is to be made; its name is that of a plain new file."""
        text = str(name).strip()
        base = text.removesuffix(ending)
        if not base or len(base) > 80 or not all(c.isalnum() or c in "-_. " for c in base) or base.startswith("."):
            raise AmbidError(
                f"the name {text[:80]!r} is none for a file: letters, digits, - and _ make one. Correct it"
            )
        path = self.path / (base + ending)
        if path.exists() or path.is_symlink():
            raise AmbidError(f"{path.name} already exists. Choose another name")
        return path

    def _files(self) -> list[Path]:
        found: list[Path] = []
        for root, folders, names in os.walk(self.path, followlinks=False):
            here = Path(root)
            depth = len(here.relative_to(self.path).parts)
            folders[:] = [] if depth >= _DEPTH else [f for f in folders if not f.startswith(".")]
            found += [here / n for n in names if not n.startswith(".")]
            if len(found) > _MOST:
                break
        return [p for p in found[:_MOST] if _plain(p, self.path)]

    def _entry(self, path: Path) -> Entry | None:
        name, lower = str(path.relative_to(self.path)), path.name.lower()
        kind = "record" if lower.endswith(_RECORDS) else _KINDS.get(path.suffix.lower(), "")
        if not kind:
            return None
        try:
            about = path.stat()
        except OSError:
            return None
        known = self._seen.get(name)
        if known is None or known[:2] != (about.st_mtime, about.st_size):
            schema, verdict = _said(path, kind)
            self._seen[name] = known = (about.st_mtime, about.st_size, schema, verdict)
        if kind in ("rig", "result") and not known[2]:
            return None
        number = self._numbers.setdefault(name, len(self._numbers) + 1)
        return Entry(
            number=number, name=name, kind=kind, bytes=about.st_size, changed=about.st_mtime, schema=known[2],
            verdict=known[3],
        )  # fmt: skip


_KINDS = {".toml": "rig", ".json": "result", ".html": "report"}


def _plain(path: Path, folder: Path) -> bool:
    """Whether a path is a plain file of the folder, reached through no link."""
    try:
        return path.is_file() and not path.is_symlink() and path.resolve().is_relative_to(folder.resolve())
    except OSError:
        return False


def _said(path: Path, kind: str) -> tuple[str, str]:
    """Return schema and verdict of a rig or a result."""
    if kind == "rig":
        try:
            with path.open(encoding="utf-8") as file:
                text = file.read(4000)
        except (OSError, UnicodeError):
            return "", ""
        return ("ambid.rig/1" if '"ambid.rig/1"' in text else ""), ""
    if kind != "result" or path.stat().st_size > 64 * _HEAD:
        return "", ""
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return "", ""
    if not isinstance(document, dict) or not str(document.get("schema", "")).startswith("ambid."):
        return "", ""
    verdict = document.get("verdict")
    word = verdict.get("word", "") if isinstance(verdict, dict) else ""
    return str(document["schema"])[:40], str(word)[:40]
