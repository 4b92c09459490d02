"""Bytes and text of a file, with every way in which a file can fail turned into one line."""

from __future__ import annotations

import difflib
import gzip
import hashlib
import zlib
from pathlib import Path

from ambid.errors import AmbidError, RecordError


def file_bytes(path: Path, error: type[AmbidError] = RecordError, what: str = "record") -> bytes:
    """Return the bytes of a file that exists, is a file, can be read and is not empty.

    `path`: the file; `error`: what to raise; `what`: what the file is, for messages. Returns at least one.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise error(f"{what} {path} does not exist{_similar(path)}. Check the path") from None
    except IsADirectoryError:
        raise error(f"{what} {path} is a folder; a file is wanted. Name the file inside it") from None
    except PermissionError:
        raise error(f"{what} {path} may not be read (permission denied). Change its permissions") from None
    except OSError as failure:
        raise error(
            f"{what} {path} cannot be read: {failure.strerror or failure}. Check the path and the disk"
        ) from None
    if not data:
        raise error(f"{what} {path} is empty (0 bytes). Export or copy it again")
    return data


def _similar(path: Path) -> str:
    """Name the file of the same folder whose name is nearest, if one is near."""
    try:
        names = [p.name for p in path.parent.iterdir()]
    except OSError:
        return f" (nor does its folder {path.parent})"
    near = difflib.get_close_matches(path.name, names, n=1)
    return f" ({near[0]} does)" if near else ""


def sha256_of(data: bytes) -> str:
    """Return the SHA-256 of the bytes.

    `data`: of a whole file. Returns 64 hexadecimal digits.
    """
    return hashlib.sha256(data).hexdigest()


def gunzipped(data: bytes, path: Path) -> bytes:
    """Return what a gzip file holds.

    `data`: of the gzip file; `path`: its name, for messages. Returns unpacked.
    """
    try:
        return gzip.decompress(data)
    except EOFError:
        raise RecordError(f"record {path} is a truncated gzip file: its end is missing. Copy it again") from None
    except (gzip.BadGzipFile, zlib.error) as failure:
        raise RecordError(f"record {path} is not a sound gzip file ({failure}). Copy it again, or rename it") from None


def utf8_text(data: bytes, path: Path, error: type[AmbidError] = RecordError, what: str = "record") -> str:
    """Decode UTF-8; a byte order mark at the beginning is dropped, as it is no character.

    `data`: of a text file; `path`: its name, for messages; `error`: what to raise; `what`: what the file is, for
    messages. Returns with lines ending in a line feed, whatever they ended in.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise error(f"{what} {path} is UTF-16; text must be UTF-8. Save it as UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        row = data.count(b"\n", 0, failure.start) + 1
        byte = data[failure.start]
        raise error(f"{what} {path}, row {row}: byte 0x{byte:02x} is not UTF-8 text. Save the file as UTF-8") from None
    if "\0" in text:
        raise error(f"{what} {path} holds binary data (a zero byte); text is wanted. Check that it is the right file")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text
