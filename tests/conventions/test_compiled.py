"""The cache of a kernel is keyed by every file it takes code from; Numba alone looks at the kernel's own."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

from ambid.compiled import _imported, sources_digest
from tests.conventions.sources import PACKAGE, package_files, parsed, shown

KERNEL = "from ambid.compiled import compiled\n\n\n@compiled\ndef twice(x):\n    return {factor} * x\n"
CALLER = (
    "import numpy as np\nfrom ambid.compiled import compiled\nfrom ambid.inner_kernel import twice\n\n\n"
    "@compiled\ndef run(n):\n    if n < 0:\n        raise ValueError('below zero')\n"
    "    return twice(np.ones(n).sum() + np.dot(np.eye(2), np.ones(2))[0])\n"
)


SAYS = (
    "from ambid import compiled\ncompiled.announce = lambda: print('first')\n"
    "from ambid.outer_kernel import run\nprint(run(3), len(run.stats.cache_hits))\n"
    "try:\n    run(-1)\nexcept ValueError as error:\n    print(error)\n"
)


def test_kernels_come_from_the_cache_until_an_edit_of_what_they_call_and_compilation_is_announced_once(
    tmp_path: Path,
) -> None:
    package = tmp_path / "ambid"
    package.mkdir()
    for name in ("__init__.py", "compiled.py"):
        (package / name).write_text("" if name == "__init__.py" else (PACKAGE / name).read_text(encoding="utf-8"))
    (package / "outer_kernel.py").write_text(CALLER)
    printed = []
    for factor in (2, 2, 5):
        (package / "inner_kernel.py").write_text(KERNEL.format(factor=factor))
        done = subprocess.run(
            [sys.executable, "-c", SAYS],
            env={"PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"},
            capture_output=True,
            text=True,
            check=True,
        )
        printed.append(done.stdout.splitlines())
    # compiled, from the cache without the compiler, compiled again; an error comes out of each
    assert printed == [["first", "8.0 0", "below zero"], ["8.0 1", "below zero"], ["first", "20.0 0", "below zero"]]


def test_what_a_kernel_takes_in_is_followed_through_files() -> None:
    kernels = PACKAGE / "bearing" / "magnet_kernels.py"
    found = {shown(path) for path in _imported(kernels, set())}
    assert "src/ambid/physics/coenergy_law.py" in found
    assert sources_digest(kernels) != sources_digest(PACKAGE / "estimation" / "kernels.py")


def test_only_one_file_compiles() -> None:
    def uses_numba(path: Path) -> bool:
        if "numba" not in path.read_text(encoding="utf-8"):
            return False
        imports = (n for n in ast.walk(parsed(path)) if isinstance(n, ast.Import | ast.ImportFrom))
        return any("numba" in ast.unparse(n) for n in imports)

    assert [shown(p) for p in package_files() if uses_numba(p)] == ["src/ambid/compiled.py"]
