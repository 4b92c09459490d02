"""Orders: what a page tells a run, with who, when, and the state that the page had seen; and how the run answers."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from ambid.console.folder import open_plain
from ambid.console.slot import Slot, append

FRESH_S = 2.0
"""Age of what a page has seen, s, from which on its orders are refused."""
ANSWER_S = 0.6
"""How long an order waits to be carried out, s; a run that wakes later refuses it."""
_ANSWERS = 8  # that are kept
_LONGEST = 300  # characters of a text
_LOG = 1 << 20  # bytes of the log that are looked through
LATE = (
    "it came from a page that showed an older state, or waited too long: it is not carried out. "
    "Look at what is shown now, and order again"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """One order."""

    word: str
    id: str = ""
    by: str = ""  # the page that gave it
    at: float = 0.0  # s since 1970
    until: float | None = None  # s of this machine's steady clock
    beat: int | None = None  # sign of life of the run that the page had seen last
    number: int | None = None  # of the question that it answers
    goal: float | None = None  # time of the values that a revert is to return to, s of the track

    @classmethod
    def of(cls, said: Mapping[str, Any]) -> Self:
        """Return what is written in a line; what is of another type than it has to be is left out."""
        raw = {k: said[k][:80] for k in ("word", "id", "by") if isinstance(said.get(k), str)}
        texts = {k: x.encode("utf-8", "replace").decode() for k, x in raw.items()}  # so that it can be told
        numbers = {k: float(said[k]) for k in ("at", "until", "goal") if _is_number(said.get(k))}
        counts = {k: int(said[k]) for k in ("beat", "number") if _is_number(said.get(k))}
        return cls(**{"word": "", **texts}, **numbers, **counts)  # type: ignore[arg-type]

    @property
    def expired(self) -> bool:
        """Whether whoever gave it was told by now that it was not delivered."""
        return self.until is not None and time.monotonic() > self.until


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1 << 53


def acknowledge(place: Path, keys: Sequence[str], by: str) -> None:
    """Log that somebody has taken note of events of a run, which may be over."""
    said = {"word": "acknowledge", "keys": [k[:_LONGEST] for k in keys], "by": by, "at": time.time(), "done": True}
    append(place / "orders.jsonl", json.dumps(said))


def acknowledged(place: Path) -> dict[str, tuple[str, float]]:
    """Return which events of a run were acknowledged, by whom and when first."""
    found = dict[str, tuple[str, float]]()
    with suppress(OSError), open_plain(place / "orders.jsonl") as file:
        for line in file.read(_LOG).splitlines():
            with suppress(ValueError, KeyError, TypeError):
                said = json.loads(line) if b'"acknowledge"' in line else {}
                for key in said.get("keys", ()):
                    found.setdefault(str(key), (str(said["by"]), float(said["at"])))
    return found


class Desk:
    """The run's side: beats, answers, whether it tracks and how it ended, in a file that needs no room on the disk.

    `place`: the run's folder.
    """

    def __init__(self, place: Path) -> None:
        self._slot, self._log = Slot(place / "status.bin"), place / "orders.jsonl"
        self._lock = threading.Lock()
        self._answers: deque[Mapping[str, Any]] = deque(maxlen=_ANSWERS)
        self._beats: deque[tuple[int, float]] = deque(maxlen=16)
        self._state: dict[str, Any] = {"follows": False, "stopping": False, "beat": 0}
        with suppress(OSError):
            self._slot.make()

    def note(self, **state: Any) -> None:
        """Keep what has become of the run."""
        with self._lock:
            self._state.update(state)
            self._write()

    def _write(self) -> None:
        with suppress(OSError, ValueError):
            self._slot.write({**self._state, "answers": list(self._answers)})

    def beat(self) -> int:
        """Give a sign of life; its number."""
        n = self._state["beat"] + 1
        self._beats.append((n, time.monotonic()))
        self.note(beat=n, at=time.monotonic())
        return int(n)

    def late(self, order: Order) -> bool:
        """Whether an order is of an older state than now, or has waited too long."""
        since = next((at for n, at in tuple(self._beats) if n == order.beat), None)  # another thread adds to them
        unseen = order.beat is not None and (since is None or time.monotonic() - since > FRESH_S)
        return order.expired or unseen

    def answer(self, order: Order, why: str = "") -> Mapping[str, Any]:
        """Answer an order, `why`: why it was not carried out, and log it."""
        answer = {"id": order.id, "word": order.word, "by": order.by, "at": order.at, "done": not why,
                  "why": why[:_LONGEST], "answered": time.time()}  # fmt: skip
        with self._lock:
            self._answers.append(answer)
            self._write()
        with suppress(OSError):  # of a full disk
            append(self._log, json.dumps(answer))
        return answer
