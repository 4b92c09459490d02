"""One decorator for compiled kernels, with a cache that notices edits of every file a kernel takes code from, and that
loads a kernel without loading the compiler.

Numba's own cache looks at the kernel's file alone, so a kernel that calls one of another file would keep its old code.
Here the key also holds the contents of all files of the package that a kernel's file imports, and those they import.

Before it looks into its cache Numba brings its typing and target contexts up to date, with all they could compile: a
quarter of a second. A kernel that was compiled before needs only the run time; what has to be compiled still gets all.
"""

from __future__ import annotations

import gc
import hashlib
import re
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, overload

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables of the environment that say how many threads linear algebra has, when it is first imported."""

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGE = Path(__file__).resolve().parent
# called once, before the first kernel is compiled in this process; set by whoever has a terminal to say so on
announce: Callable[[], None] | None = None
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
    from numba import njit

    _listen()
    made: F = njit(**options, cache=True, nogil=True, no_cfunc_wrapper=True)(function)  # type: ignore[call-overload]
    kept = getattr(made, "_cache", None)
    if kept is not None:  # None where NUMBA_DISABLE_JIT leaves plain Python
        index = kept._cache_file
        index._source_stamp = (index._source_stamp, sources_digest(Path(function.__code__.co_filename)))
        kept.load_overload = partial(_load, kept)
    return made


def _load(kept: Any, signature: object, target: Any) -> Any:
    """The kernel from the cache, or None; the contexts are brought up to date by the compiler where there is none."""
    from numba.core.runtime.nrt import rtsys

    rtsys.initialize(target)
    with kept._guard_against_spurious_io_errors():
        return kept._load_overload(signature, target)
    return None


@cache
def _listen() -> None:
    """Hear when something is compiled: say so once, and collect no garbage meanwhile (a twentieth of the time)."""
    from numba.core.event import Event, Listener, register

    class Hear(Listener):
        depth, collects = 0, True

        def on_start(self, event: Event) -> None:
            del event
            global announce
            say, announce = announce, None
            if say is not None:
                say()
            if not self.depth:
                self.collects = gc.isenabled()
                gc.disable()
            self.depth += 1

        def on_end(self, event: Event) -> None:
            del event
            self.depth -= 1
            if not self.depth and self.collects:
                gc.enable()

    register("numba:compile", Hear())  # type: ignore[no-untyped-call]


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
