"""Where the sources are, and each of them parsed once."""

from __future__ import annotations

import ast
import subprocess
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "ambid"

_MADE_FOLDERS = {".git", ".venv", "build", "dist", "_site", "__pycache__"}


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def shown(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def package_files() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def files_of_tests() -> list[Path]:
    return sorted((ROOT / "tests").rglob("*.py"))


def rooms() -> list[str]:
    """The names directly under the package: rooms (folders with code) and top-level modules."""
    folders = {path.relative_to(PACKAGE).parts[0] for path in package_files() if path.parent != PACKAGE}
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__", "__main__"}
    return sorted(folders | modules)


def module_name(path: Path) -> str:
    """``src/ambid/record/__init__.py`` is ``ambid.record``."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def project_files() -> list[Path]:
    """Every file that belongs to the project: what git tracks or would track; without git, all but what is made."""
    listing = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    if listing.returncode == 0:
        found = [ROOT / name for name in listing.stdout.split("\0") if name]
    else:
        found = [path for path in ROOT.rglob("*") if not _MADE_FOLDERS & set(path.relative_to(ROOT).parts)]
    return sorted(path for path in found if path.is_file())
