"""Make the transcripts of README and docs again by running their commands: ``python tools/transcripts.py [PAGE ...]``.

A transcript is a fenced block without a language that follows a block of commands (``sh``): lines of what they print,
in their order. ``tests/examples/test_pages.py`` runs the same commands and compares.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from difflib import SequenceMatcher
from itertools import pairwise
from math import hypot
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WHOLE = ("README", "quickstart", "nonlinear", "better_loop")  # every command runs, and uses files of those before it
OTHERS = ("online", "acquisition")  # a block that a transcript follows runs by itself
_ELSEWHERE = (
    "make",
    "git",
    "cd",
    ".",
    "pip",
    "ambid console",
)  # not for a transcript: set-up, and what waits for people
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_NUMBER = re.compile(r"[-+−]?\d[\d.]*(e[+-]\d+)?( [numkM]?(?=[mAVN]\b))?")
_FARTHEST = re.compile(r"moves (?:position|current|voltage)\b")
_DEVIATION = re.compile(r"([-−]?\d[\d.]*) ± ([\d.]+)")


@dataclass(frozen=True)
class Piece:
    """A block of commands, and the transcript after it, if any, with its place in the page."""

    commands: tuple[str, ...]
    shown: str | None
    place: tuple[int, int]


def path_of(page: str) -> Path:
    """Return the file of a page by its short name."""
    return ROOT / "README.md" if page == "README" else ROOT / "docs" / f"{page}.md"


def pieces(page: str) -> list[Piece]:
    """Return the commands of a page that run, block by block."""
    fences = list(_FENCE.finditer(path_of(page).read_text(encoding="utf-8")))
    found = []
    for fence, after in pairwise([*fences, None]):
        if fence is None or fence[1] != "sh":
            continue
        lines = (line.split(" #")[0].strip() for line in fence[2].splitlines())
        commands = tuple(line for line in lines if line and not line.startswith(_ELSEWHERE))
        if after is not None and not after[1]:
            found.append(Piece(commands, after[2], after.span(2)))
        elif page in WHOLE:
            found.append(Piece(commands, None, (fence.end(), fence.end())))
    return found


def played(page: str, run: Callable[[str], str]) -> Iterator[tuple[Piece, str]]:
    """Run the commands of a page, and yield each block with what it prints."""
    for piece in pieces(page):
        yield piece, "".join(run(command) for command in piece.commands)


def refreshed(shown: str, printed: str) -> tuple[str, list[str]]:
    """Return the transcript with what is printed now, and the lines that nothing printed corresponds to."""
    old, new = shown.splitlines(), printed.splitlines()
    lines, lost = [], []
    for what, i, j, k, m in SequenceMatcher(
        None, *([_plain(x) for x in side] for side in (old, new)), False
    ).get_opcodes():
        if what in ("equal", "replace"):
            lines += new[k:m]
        elif what == "delete":
            lost += [x for x in old[i:j] if x.strip()]
    return "".join(f"{line}\n" for line in lines), lost


def differences(shown: str, printed: str, *, scatters: bool = False) -> list[str]:
    """Return what a reader would miss: lines whose words are not printed, and values beyond 2 standard deviations.

    Where another rounding is another run, as of a rotor that levitates, both scatter (`scatters`): 3 of both together,
    and whichever channel moves farthest.
    """
    if scatters:
        shown, printed = (_FARTHEST.sub("moves it", text) for text in (shown, printed))
    left = iter(printed.splitlines())
    found = []
    for line in filter(str.strip, shown.splitlines()):
        same = next((other for other in left if _plain(other) == _plain(line)), None)
        if same is None:
            return [*found, f"not printed, or not in this order: {line.strip()}"]
        for (value, sd), (now, sd_now) in zip(_DEVIATION.findall(line), _DEVIATION.findall(same), strict=True):
            limit = 3.0 * hypot(float(sd), float(sd_now)) if scatters else 2.0 * float(sd)
            if abs(_float(value) - _float(now)) > limit:
                found.append(f"{value} ± {sd} is {now} ± {sd_now} now: {line.strip()}")
    return found


def _plain(line: str) -> str:
    """Words of a line; a number of any size with its prefix is the same to it."""
    return " ".join(_NUMBER.sub("#", line).split())


def _float(text: str) -> float:
    return float(text.replace("−", "-"))


def _in_shell(folder: Path) -> Callable[[str], str]:
    def run(command: str) -> str:
        words = f"{sys.executable} -m {command}" if command.startswith("ambid ") else command
        print(f"  {command}", file=sys.stderr)
        done = subprocess.run(words, shell=True, cwd=folder, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"transcripts: {command} ended with {done.returncode}:\n{done.stderr}")
        return done.stdout

    return run


def main(pages: list[str]) -> int:
    """Write the transcripts of some pages, or of all, anew.

    Parameters
    ----------
    pages : list of str
        Short names such as ``README`` and ``online``; all pages with transcripts where empty.

    Returns
    -------
    int
        0, or 1 where a line of a transcript corresponds to nothing that is printed now.
    """
    complaints = []
    for page in pages or [*WHOLE, *OTHERS]:
        path = path_of(page)
        text = path.read_text(encoding="utf-8")
        with tempfile.TemporaryDirectory() as folder:
            done = [(piece, printed) for piece, printed in played(page, _in_shell(Path(folder))) if piece.shown]
        for piece, printed in reversed(done):
            new, lost = refreshed(piece.shown or "", printed)
            text = text[: piece.place[0]] + new + text[piece.place[1] :]
            complaints += [f"{page}: nothing printed corresponds to {line.strip()!r}" for line in lost]
        path.write_text(text, encoding="utf-8")
    print("\n".join(complaints), end="\n" if complaints else "", file=sys.stderr)
    return 1 if complaints else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
