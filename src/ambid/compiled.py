"""One decorator for compiled kernels, with a cache that notices edits of every file a kernel takes code from.

Numba's own cache looks at the kernel's file alone, so a kernel that calls one of another file would keep its old code.
Here the key also holds the contents of all files of the package that a kernel's file imports, and those they import.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, overload

from numba import njit

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGE = Path(__file__).resolve().parent
_IMPORT = re.compile(r"^from ambid(?:\.([\w.]+))? import (.+)", re.MULTILINE)


@overload
def compiled(function: F) -> F: ...
@overload
def compiled(function: None = None, **options: Any) -> Callable[[F], F]: ...
def compiled(function: F | None = None, **options: Any) -> F | Callable[[F], F]:
    """Compile a function that runs over samples; `options` are those of `numba.njit`, e.g. ``error_model="numpy"``.

    It releases the lock of Python while it runs, and is compiled once per machine and set of argument types.
    """
    if function is None:
        return lambda f: _compile(f, options)
    return _compile(function, options)


def _compile(function: F, options: dict[str, Any]) -> F:
    made: F = njit(cache=True, nogil=True, **options)(function)
    index = getattr(getattr(made, "_cache", None), "_cache_file", None)
    if index is not None:  # None where NUMBA_DISABLE_JIT leaves plain Python
        index._source_stamp = (index._source_stamp, sources_digest(Path(function.__code__.co_filename)))
    return made


@cache
def sources_digest(path: Path) -> str:
    """Return a digest of the contents of `path` and of all files of the package that it imports, directly or not."""
    digest = hashlib.sha256()
    for file in sorted(_imported(path, set())):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _imported(path: Path, seen: set[Path]) -> set[Path]:
    """Return `path` and what it imports of the package."""
    seen.add(path)
    for match in _IMPORT.finditer(path.read_text(encoding="utf-8")):
        base = _PACKAGE.joinpath(*(match[1] or "").split("."))
        names = re.findall(r"\w+", match[2])
        for file in (base.with_suffix(".py"), *(base / f"{name}.py" for name in names)):
            if file.is_file() and file not in seen and file.name != "compiled.py":
                _imported(file, seen)
    return seen
