"""Imports point downward only, and nobody reaches into another room's private modules."""

from __future__ import annotations

import ast
from collections.abc import Iterator

# Highest first. A room may import any tier below its own: neither upward nor sideways.
TIERS: tuple[tuple[str, ...], ...] = (
    ("cli",),
    ("console", "fleet"),
    ("job",),
    ("report",),
    ("ledger",),
    ("control",),
    ("acquisition",),
    ("tracking",),
    ("validation",),
    ("recursive",),
    ("bearing", "rotor"),
    ("nonlinear",),
    ("blackbox",),
    ("estimation",),
    ("simulation",),
    ("rig",),
    ("physics", "signals"),
    ("record",),
    ("units",),
    ("settings",),
    ("errors", "arrays", "compiled", "lazy"),
)
# The one inversion (ARCHITECTURE.md): methods of results and records ask, when called, for what shows or converts them.
ASKED = {
    ("ambid.estimation.result", "ambid.job.presentation"),
    ("ambid.estimation.result", "ambid.job.prediction"),
    ("ambid.record.record", "ambid.record"),
    ("ambid.record.record", "ambid.record.frames"),
    ("ambid.record.record", "ambid.report.record"),
}
RANK = {room: rank for rank, tier in enumerate(TIERS) for room in tier}


def imported_names(tree: ast.Module, module: str, *, is_package: bool) -> Iterator[tuple[int, str]]:
    """Yield (line, full dotted name) of everything of ambid that is imported anywhere in the file.

    Imports inside functions and under TYPE_CHECKING count too; so does ``import_module`` with a literal name.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names if _ours(alias.name))
        elif isinstance(node, ast.ImportFrom):
            base = _absolute(node.module or "", node.level, module, is_package=is_package)
            if _ours(base):
                yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and _call_name(node) in ("import_module", "__import__"):
            name = node.args[0].value if node.args and isinstance(node.args[0], ast.Constant) else None
            if isinstance(name, str) and _ours(name) and (module, name) not in ASKED:
                yield node.lineno, name


def violations(source: str | ast.Module, module: str, *, is_package: bool = False) -> list[str]:
    """Say what `source`, read as the module called `module`, imports against the rules."""
    tree = ast.parse(source) if isinstance(source, str) else source
    parts = module.split(".")
    if len(parts) == 1 or parts[1] == "__main__":
        return []  # ambid/__init__.py and __main__.py stand above all rooms
    room = parts[1]
    if room not in RANK:
        return [f"line 1: {room!r} is in no tier; enter it in tests/conventions/import_rules.py and ARCHITECTURE.md"]
    found = [
        (line, _objection(room, name.split("."))) for line, name in imported_names(tree, module, is_package=is_package)
    ]
    return [f"line {line}: {objection}" for line, objection in found if objection]


def circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules that import each other, directly or through others (Tarjan 1972)."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        order[module] = low[module] = len(order)
        stack.append(module)
        for other in imports[module]:
            if other not in order:
                visit(other)
                low[module] = min(low[module], low[other])
            elif other in stack:
                low[module] = min(low[module], order[other])
        if low[module] == order[module]:
            group = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(group) > 1:
                found.append(sorted(group))

    for module in imports:
        if module not in order:
            visit(module)
    return found


def _objection(room: str, target: list[str]) -> str | None:
    name = ".".join(target)
    if len(target) == 1 or target[1] == "*":
        return f"{room} imports the package ambid itself, which stands above it; import the room that has the name"
    other, inside = target[1], target[2:]
    if other == room or _dunder(other):
        return None
    if other not in RANK:
        return f"{room} imports {name}, which is in no tier; import the room that defines it"
    if RANK[other] < RANK[room]:
        return f"{room} imports {name} upward; move what both need into a room below both"
    if RANK[other] == RANK[room]:
        return f"{room} imports {name} sideways; move what both need into a room below both"
    private = [part for part in inside if part.startswith("_") and not _dunder(part)]
    if private:
        return f"{room} imports {name}: {private[0]} is private to {other}; make it public there or do without"
    return None


def _ours(name: str) -> bool:
    return name.split(".")[0] == "ambid"


def _dunder(name: str) -> bool:
    return name.startswith("__") and name.endswith("__")


def _call_name(node: ast.Call) -> str:
    return ast.unparse(node.func).split(".")[-1]


def _absolute(name: str, level: int, module: str, *, is_package: bool) -> str:
    """Resolve a relative import, as ``from .x import y`` in `module`."""
    if level == 0:
        return name
    parts = module.split(".")
    keep = len(parts) - level + (1 if is_package else 0)
    return ".".join([*parts[:keep], *([name] if name else [])])
