"""Frames on a line of bytes: COBS( code | fields | CRC-16/XMODEM ) 0x00, and back from whatever a line delivers.

COBS (consistent overhead byte stuffing; Cheshire and Baker 1999) takes the zeros out of a frame, so that 0x00 ends a
frame and nothing else: after any damage the next 0x00 is the place to begin again. Frames here have fewer than 254
bytes, so each block of COBS ends in a zero, and the code is undone in place.
"""

from __future__ import annotations

from binascii import crc_hqx
from dataclasses import dataclass

from ambid.acquire.protocol.codec import Message, fits, pack
from ambid.acquire.protocol.table import CRC_BYTES, table


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameCounters:
    """What a decoder has seen. Every byte fed is in `kept_bytes`, `discarded_bytes`, `empty`, or still pending."""

    frames: int = 0  # sound frames given out
    kept_bytes: int = 0  # bytes of these on the line, their 0x00 included
    # runs between two 0x00 that were discarded: wrong check value; too short or not of the message's length; unknown
    # code; not COBS; longer than any frame
    crc: int = 0
    length: int = 0
    code: int = 0
    cobs: int = 0
    overlong: int = 0
    discarded_bytes: int = 0  # bytes of those, their 0x00 included
    empty: int = 0  # bytes 0x00 with nothing before them: no damage

    @property
    def damaged(self) -> int:
        """Runs that were discarded, whatever their damage."""
        return self.crc + self.length + self.code + self.cobs + self.overlong


def frame(payload: bytes) -> bytes:
    """Return the bytes on the line for code and fields, with CRC, COBS and the 0x00 at the end.

    `payload`: code and fields.
    """
    if not 0 < len(payload) <= table().largest - CRC_BYTES:
        raise ValueError(f"{len(payload)} bytes of code and fields; a frame holds 1 to {table().largest - CRC_BYTES}")
    body = payload + crc_hqx(payload, 0).to_bytes(CRC_BYTES, "little")
    return b"".join(bytes((len(part) + 1,)) + part for part in body.split(b"\0")) + b"\0"


def encode(what: Message) -> bytes:
    """Return the bytes on the line for a message."""
    return frame(pack(what))


class FrameDecoder:
    """Finds the sound frames in what a line delivers, in pieces of any size, and counts all the rest.

    It never raises, whatever it is fed, and keeps at most one frame's bytes between calls.

    `to`: which side's messages are known.
    """

    def __init__(self, to: str = "host") -> None:
        self._kinds = table().by_code(to)
        most = table().largest - CRC_BYTES
        self._lengths = {code: {n for n in range(most + 1) if fits(kind, n)} for code, kind in self._kinds.items()}
        self._longest = table().largest + 1  # on the line, without its 0x00
        self._tail = b""
        self._inside_overlong = False
        self._frames = self._kept = self._discarded = self._empty = 0
        self._damage = {"crc": 0, "length": 0, "code": 0, "cobs": 0, "overlong": 0}

    @property
    def counters(self) -> FrameCounters:
        """What was seen so far."""
        return FrameCounters(
            frames=self._frames,
            kept_bytes=self._kept,
            discarded_bytes=self._discarded,
            empty=self._empty,
            **self._damage,
        )

    @property
    def pending(self) -> int:
        """Bytes of a frame that has not ended yet."""
        return len(self._tail)

    def feed(self, data: bytes | bytearray | memoryview) -> list[bytes]:
        """Take the next bytes of the line.

        `data`: any number of bytes. Returns code and fields of each sound frame that ended in them, in their order;
        code known, length that of the message.
        """
        runs = (self._tail + data).split(b"\0")
        tail = runs.pop()
        if self._inside_overlong:
            tail = self._leave_overlong(runs, tail)
        found: list[bytes] = []
        for run in runs:
            if not run:
                self._empty += 1
                continue
            payload = self._open(run)
            if payload is None:
                self._discarded += len(run) + 1
            else:
                self._kept += len(run) + 1
                found.append(payload)
        if len(tail) > self._longest:
            self._inside_overlong = True
            self._damage["overlong"] += 1
            self._discarded += len(tail)
            tail = b""
        self._tail = tail
        self._frames += len(found)
        return found

    def _leave_overlong(self, runs: list[bytes], tail: bytes) -> bytes:
        """Discard what still belongs to a run that was too long; return what is left of the tail."""
        if runs:
            self._inside_overlong = False
            self._discarded += len(runs.pop(0)) + 1
            return tail
        self._discarded += len(tail)
        return b""

    def _open(self, run: bytes) -> bytes | None:
        """Undo COBS and check; None, counted, for a damaged run. Called for every frame: kept flat for speed."""
        end = len(run)
        if end > self._longest:
            self._damage["overlong"] += 1
            return None
        body = bytearray(run)
        at = 0
        while at < end:
            step = body[at]
            body[at] = 0
            at += step
        if at != end:
            self._damage["cobs"] += 1
            return None
        payload = bytes(body[1:-CRC_BYTES])
        if not payload:
            self._damage["length"] += 1
            return None
        if crc_hqx(payload, 0) != body[-2] | body[-1] << 8:
            self._damage["crc"] += 1
            return None
        if len(payload) not in self._lengths.get(payload[0], ()) and not self._allowed(payload):
            return None
        return payload

    def _allowed(self, payload: bytes) -> bool:
        """Judge a frame with sound CRC that has not a length of its code."""
        kind = self._kinds.get(payload[0])
        if kind is None:
            self._damage["code"] += 1
            return False
        # Another version's identity may be longer or shorter; it must get through, so that its version can be named.
        other_version = kind.name == "identity" and len(payload) > 2 and payload[2] != table().version
        if not other_version:
            self._damage["length"] += 1
        return other_version
