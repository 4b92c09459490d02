"""What no file of the project may hold, and what a test must do."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

# Folders in which people's and build machines' work lies; an example path in a document starts elsewhere.
_PLACES = ("home", "root", "Users", "work", "workspace", "builds")
_MACHINE_PATH = re.compile(rf"(?<![\w.~$}})/-])/(?:{'|'.join(_PLACES)})/[\w.]")


def machine_paths(text: str) -> Iterator[str]:
    """Yield the lines that hold an absolute path of some machine's home or work folder."""
    for number, line in enumerate(text.splitlines(), start=1):
        if _MACHINE_PATH.search(line):
            yield f"line {number}: {line.strip()[:120]}"


def complaints_of_tests(tree: ast.Module) -> Iterator[str]:
    """Say which tests cannot fail, and which marks skip or excuse a test without a reason."""
    asserting = _asserting_functions(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_") and not _asserts(node, asserting):
            yield f"line {node.lineno}: {node.name} asserts nothing"
        elif isinstance(node, ast.Assert) and isinstance(node.test, ast.Constant) and node.test.value:
            yield f"line {node.lineno}: an assert that cannot fail"
        elif isinstance(node, ast.Assert) and isinstance(node.test, ast.Tuple):
            yield f"line {node.lineno}: an assert of a tuple cannot fail"
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield from (f"line {d.lineno}: {c}" for d in node.decorator_list if (c := _bare_mark(d)))
        elif isinstance(node, ast.Assign) and any(getattr(t, "id", "") == "pytestmark" for t in node.targets):
            marks = node.value.elts if isinstance(node.value, ast.List | ast.Tuple) else [node.value]
            yield from (f"line {m.lineno}: {c}" for m in marks if (c := _bare_mark(m)))
        elif isinstance(node, ast.Call) and _bare_call(node):
            yield f"line {node.lineno}: {ast.unparse(node.func)} without a reason"


def _bare_mark(mark: ast.expr) -> str | None:
    call = mark if isinstance(mark, ast.Call) else None
    name = ast.unparse(call.func if call else mark)
    if not re.search(r"\bmark\.(skip|skipif|xfail)$", name):
        return None
    if call and any(k.arg == "reason" for k in call.keywords):
        return None
    if call and name.endswith(".skip") and call.args:
        return None
    return f"{name} without a reason"


def _bare_call(call: ast.Call) -> bool:
    excuses = ast.unparse(call.func) in ("pytest.skip", "pytest.xfail")
    return excuses and not call.args and not any(k.arg == "reason" for k in call.keywords)


def _asserting_functions(tree: ast.Module) -> set[str]:
    """Names of the file's own functions that assert, also through one another."""
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    found: set[str] = set()
    while True:
        more = {f.name for f in functions if f.name not in found and _asserts(f, found)}
        if not more:
            return found
        found |= more


def _asserts(function: ast.FunctionDef, asserting: set[str]) -> bool:
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            return True
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            last = name.split(".")[-1]
            if (
                name in ("pytest.raises", "pytest.warns", "pytest.fail")
                or last.startswith("assert_")
                or last in asserting
            ):
                return True
    return False
