"""What the operator wants: flags that one thread sets and the tracking loop reads (thesis fig. 5.8)."""

from __future__ import annotations

import threading
from typing import Literal, get_args

from ambid.errors import EstimationError, nearest
from ambid.recursive.lines import Event

Flag = Literal["track", "hold", "accept", "revert"]
Order = Literal["accept", "revert"]
_FLAGS: tuple[str, ...] = get_args(Flag)


class Operator:
    """Flags of the operator; all methods may be called from any thread.

    ``track`` and ``hold`` are states: in ``hold`` the published numbers stay as they are. ``accept`` (the candidate,
    now and unjudged) and ``revert`` (to the numbers accepted before) are orders, carried out once.

    `hold`: whether to begin in ``hold``.
    """

    def __init__(self, *, hold: bool = False) -> None:
        self._lock = threading.Lock()
        self._hold = hold
        self._order: Order | None = None

    @property
    def holding(self) -> bool:
        """Whether the published numbers are to stay as they are."""
        with self._lock:
            return self._hold

    @property
    def waiting(self) -> Order | None:
        """The order that was not taken yet."""
        with self._lock:
            return self._order

    def set(self, flag: str, t: float = 0.0, why: str = "") -> Event:
        """Set a flag.

        `t`: time of the stream, s; `why`: the operator's reason, for the log. Returns for the log.
        """
        if flag not in _FLAGS:
            raise EstimationError(f"operator flag {flag!r} is none of {', '.join(_FLAGS)}.{nearest(flag, _FLAGS)}")
        with self._lock:
            if flag == "accept" or flag == "revert":
                if self._order not in (None, flag):
                    raise EstimationError(f"operator: {self._order!r} waits to be done. Give {flag!r} after that")
                self._order = "accept" if flag == "accept" else "revert"
                what = f"operator orders {flag}"
            else:
                same = self._hold == (flag == "hold")
                self._hold = flag == "hold"
                what = f"operator sets {flag}" + (" (already so)" if same else "")
        return Event(kind="operator", t=t, why=f"{what}: {why}" if why else what)

    def take(self) -> Order | None:
        """Return the order that waits, if any: it is done now and waits no longer."""
        with self._lock:
            order, self._order = self._order, None
        return order
