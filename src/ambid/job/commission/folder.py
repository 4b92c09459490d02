"""The folder of a commissioning: what it leaves there, each file whole or not at all, never over an earlier one's."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ambid.errors import AmbidError

FILES = ("rig.toml", "record.h5", "second.h5", "estimate.json", "report.html", "track.jsonl", "commission.json")
"""What a commissioning leaves in its folder."""


def check_folder(folder: str | Path) -> None:
    """Refuse a folder that holds an earlier commissioning."""
    place = Path(folder)
    if not place.is_dir():
        raise AmbidError(f"{place} is no folder; commissioning leaves {len(FILES)} files in one. Make it first")
    if not os.access(place, os.W_OK):
        raise AmbidError(f"folder {place} may not be written. Choose another folder")
    there = [name for name in FILES if (place / name).exists()]
    there += sorted(path.name for path in place.glob("*.journal"))
    if there:
        raise AmbidError(f"{place} holds {', '.join(there)} of an earlier commissioning. Take an empty folder")


def write_text(path: Path, text: str) -> None:
    """Write a file that is there whole or not at all.

    `path`: written over if it exists; `text`: in UTF-8.
    """
    with whole_file(path) as beside:
        beside.write_text(text, encoding="utf-8")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Let a file be written under another name, and put it in place whole.

    `path`: where it goes. Returns where it is to be written.
    """
    beside = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        yield beside
        os.replace(beside, path)
    except OSError as failure:
        raise AmbidError(f"{path} cannot be written: {failure.strerror or failure}. Check folder and disk") from None
    finally:
        beside.unlink(missing_ok=True)
