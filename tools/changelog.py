"""Make CHANGELOG.md from the notes in changes/ (see changes/README.md): ``python tools/changelog.py [--check]``."""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("added", "changed", "fixed", "removed")
TITLE = "# Changelog\n\nMade from the notes in `changes/` by `make changelog`; edit those.\n"


def changelog(notes: Path) -> str:
    """Return the text of CHANGELOG.md: what is not released yet first, then one part per version, newest first.

    Parameters
    ----------
    notes : Path
        The folder ``changes/``: one file per change, and a folder per released version.

    Returns
    -------
    str
        Markdown, one section per kind of change, in the order of the notes' names.

    Raises
    ------
    ValueError
        If a note has no known kind, or says nothing.
    """
    versions = sorted((p for p in notes.iterdir() if p.is_dir()), key=_version_key, reverse=True)
    parts = [_part("Unreleased", notes), *(_part(folder.name, folder) for folder in versions)]
    return "\n".join([TITLE, *(part for part in parts if part)])


def _part(heading: str, folder: Path) -> str:
    changes = [_read(path) for path in sorted(folder.glob("*.md")) if path.name != "README.md"]
    if not changes:
        return ""
    lines = [f"## {heading}", ""]
    for kind in KINDS:
        texts = [text for its_kind, text in changes if its_kind == kind]
        if texts:
            lines += [f"### {kind.capitalize()}", "", *(f"- {text}" for text in texts), ""]
    return "\n".join(lines)


def _read(path: Path) -> tuple[str, str]:
    first, _, rest = path.read_text(encoding="utf-8").partition("\n")
    kind = first.removeprefix("kind:").strip()
    if not first.startswith("kind:") or kind not in KINDS:
        raise ValueError(f"{path.name}: its first line is {first!r}; it must be 'kind: ' and one of {', '.join(KINDS)}")
    text = " ".join(rest.split())
    if not text:
        raise ValueError(f"{path.name}: nothing follows its kind. Say in a sentence or two what changes for a user")
    return kind, text


def _version_key(folder: Path) -> tuple[int, ...]:
    parts = folder.name.split(".")
    if not all(part.isdigit() for part in parts):
        raise ValueError(f"changes/{folder.name} is no version; a folder of released notes is named like 0.2.0")
    return tuple(int(part) for part in parts)


def main(arguments: list[str]) -> int:
    """Write CHANGELOG.md, or with ``--check`` only say whether it is up to date.

    Parameters
    ----------
    arguments : list of str
        ``[]`` or ``["--check"]``.

    Returns
    -------
    int
        0, or 1 where the file is out of date or a note is wrong.
    """
    target = ROOT / "CHANGELOG.md"
    try:
        text = changelog(ROOT / "changes")
    except ValueError as error:
        print(f"changelog: {error}", file=sys.stderr)
        return 1
    if arguments == ["--check"]:
        if target.is_file() and target.read_text(encoding="utf-8") == text:
            return 0
        print("changelog: CHANGELOG.md is out of date. Run `make changelog`", file=sys.stderr)
        return 1
    target.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
