"""Numba looks for changes in a kernel's own file alone: code that it took in from another file may be stale."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from pathlib import Path

from tests.conventions.sources import package_files, parsed, shown

MODULES = {shown(p).removeprefix("src/").removesuffix(".py").replace("/", "."): p for p in package_files()}


def compiled_functions(tree: ast.Module) -> Iterator[str]:
    """Yield ``name-line`` of every function that Numba compiles, as its cache writes it."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(d) for d in node.decorator_list):
            yield f"{node.name}-{min(d.lineno for d in node.decorator_list)}"


def compiled_here(tree: ast.Module) -> set[str]:
    """Return the names that a file compiles itself: ``compiled = njit(...)(name)``, plain code of another file."""
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and "njit" in ast.unparse(node.func))
    return {arg.id for call in calls for arg in call.args if isinstance(arg, ast.Name)}


def taken_in(path: Path) -> list[Path]:
    """Return the other files with compiled code from which a file imports, and theirs."""
    found: list[Path] = []
    here = compiled_here(parsed(path))
    for node in parsed(path).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("ambid."):
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                other = MODULES.get(name)
                wrapped = any(alias.name in here for alias in node.names)
                if other is not None and (wrapped or any(compiled_functions(parsed(other)))):
                    found += [other, *taken_in(other)]
    return found


def stale(path: Path, others: list[Path]) -> list[str]:
    """Return the files of the cache that are younger than a kernel's file, and older than what it took in."""
    names = tuple(f"{path.stem}.{name}." for name in compiled_functions(parsed(path)))
    newest = max((os.stat(p).st_mtime for p in others), default=0.0)
    own = os.stat(path).st_mtime
    cached = [p for p in (path.parent / "__pycache__").glob("*.nbc") if p.name.startswith(names)]
    return [p.name for p in cached if own < p.stat().st_mtime < newest]


def test_compiled_code_is_younger_than_what_it_took_in() -> None:
    found = {
        shown(p): s for p in package_files() if any(compiled_functions(parsed(p))) and (s := stale(p, taken_in(p)))
    }
    assert not found, f"compiled before another file was edited; run make clean: {found}"


def test_what_is_taken_in_and_when_it_is_stale_is_seen(tmp_path: Path) -> None:
    joint = MODULES["ambid.track.joint._kernels"]
    assert MODULES["ambid.track.joint._square_root"] in taken_in(joint)
    assert MODULES["ambid.track.fusion._watch_kernels"] in taken_in(MODULES["ambid.track.fusion._kernels"])
    bearing = MODULES["ambid.identify.nonlinear_bearing._kernels"]
    assert MODULES["ambid.physics.coenergy_law"] in taken_in(bearing)  # plain there, compiled here
    kernel, other = tmp_path / "_kernels.py", tmp_path / "_other.py"
    kernel.write_text("@njit(cache=True)\ndef run(x):\n    return x\n", encoding="utf-8")
    other.write_text("", encoding="utf-8")
    cached = tmp_path / "__pycache__" / "_kernels.run-1.py311.1.nbc"
    cached.parent.mkdir()
    cached.write_bytes(b"")
    os.utime(kernel, (10.0, 10.0))
    os.utime(other, (20.0, 20.0))
    for at, expected in ((30.0, False), (15.0, True), (5.0, False)):  # younger than both, than its own file, than none
        os.utime(cached, (at, at))
        assert bool(stale(kernel, [other])) == expected
