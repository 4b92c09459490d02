"""Names that a package exports without importing what is behind them until one is used (PEP 562).

The names stand once, in the package's ``if TYPE_CHECKING:`` block as ``from home import name as name``: type checkers
read them there, and so does `exports`. It keeps ``import ambid`` and the command's help fast.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path


def exports(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` for the package whose name is given."""
    module = sys.modules[package]
    homes = _homes(Path(module.__file__ or "").read_text(encoding="utf-8"))

    def load(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name]), name)
        setattr(module, name, value)
        return value

    return load, lambda: sorted({*vars(module), *homes}), sorted(homes)


def _homes(source: str) -> dict[str, str]:
    """Return the module that each name of the ``if TYPE_CHECKING:`` block comes from."""
    blocks = (n for n in ast.parse(source).body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")
    imports = (n for block in blocks for n in block.body if isinstance(n, ast.ImportFrom))
    return {alias.asname: n.module for n in imports for alias in n.names if alias.asname and n.module}
