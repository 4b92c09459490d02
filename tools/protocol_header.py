"""Make what follows from the table of the wire protocol: ``.venv/bin/python tools/protocol_header.py [--check]``."""

from __future__ import annotations

import sys
from pathlib import Path

from ambid.acquire.protocol.c_header import c_header
from ambid.acquire.protocol.page import protocol_page
from ambid.acquire.protocol.table import table

ROOT = Path(__file__).resolve().parents[1]


def made() -> dict[Path, str]:
    """Return the files that are made from the table.

    Returns
    -------
    dict of Path to str
        Each file and its text.
    """
    return {
        ROOT / "firmware" / "amb_daq" / "protocol.h": c_header(table()),
        ROOT / "docs" / "protocol.md": protocol_page(table()),
    }


def main(arguments: list[str]) -> int:
    """Write the files, or with ``--check`` only say which are out of date.

    Parameters
    ----------
    arguments : list of str
        ``[]`` or ``["--check"]``.

    Returns
    -------
    int
        0, or 1 where a file is out of date.
    """
    stale = [p for p, text in made().items() if not p.is_file() or p.read_text(encoding="utf-8") != text]
    if arguments == ["--check"]:
        for path in stale:
            print(
                f"protocol: {path.relative_to(ROOT)} is out of date. Run `python tools/protocol_header.py`",
                file=sys.stderr,
            )
        return 1 if stale else 0
    for path in stale:
        path.write_text(made()[path], encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
