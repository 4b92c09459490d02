"""Fleets, ledger, alarms, long records and console: scripts that print what they find, each in a process of its own."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from table import Table

HERE = Path(__file__).resolve().parent
SCRIPTS = ("fleet", "fleet_shared", "ledger", "monitoring", "alarms", "formats", "console")


def works_tables() -> Iterator[Table]:
    for name in SCRIPTS:
        said = subprocess.run(
            [sys.executable, HERE / f"{name}.py"], stdout=subprocess.PIPE, text=True, check=True, cwd=HERE.parent,
            env={**os.environ, "PYTHONPATH": str(HERE.parent)},
        ).stdout  # fmt: skip
        print(said, flush=True)
        about = ast.get_docstring(ast.parse((HERE / f"{name}.py").read_text(encoding="utf-8"))) or name
        rows = tuple((line.strip(),) for line in said.splitlines())
        yield Table(group=about.partition(":")[0].partition("\n")[0].rstrip("."), columns=("measured",), rows=rows)
