"""Imports point downward only (ARCHITECTURE.md); the rule itself is tested on fabricated sources."""

import importlib

import pytest

from tests.conventions.import_rules import RANK, circles, imported_names, violations
from tests.conventions.sources import ROOT, module_name, package_files, parsed, rooms, shown


def test_every_import_points_downward():
    found = [
        f"{shown(path)}: {violation}"
        for path in package_files()
        for violation in violations(parsed(path), module_name(path), is_package=path.name == "__init__.py")
    ]
    assert not found, "\n" + "\n".join(found)


def test_no_files_import_each_other_in_a_circle():
    files = {module_name(path): path for path in package_files()}
    imports = {}
    for module, path in files.items():
        names = (name for _, name in imported_names(parsed(path), module, is_package=path.name == "__init__.py"))
        homes = {name if name in files else name.rpartition(".")[0] for name in names}
        imports[module] = {home for home in homes if home in files and home != module}
    lazy = {module for module in files if "exports(__name__)" in files[module].read_text(encoding="utf-8")}
    for module in lazy:
        imports[module] = set()  # what a room exports is imported when it is first used, not with the room
    assert circles(imports) == []


def test_no_room_with_lazy_exports_has_a_file_or_folder_of_the_same_name():
    """Which of the two `room.name` meant would hang on the order of imports."""
    modules = {module_name(path) for path in package_files()}
    lazy = [f"ambid.{room}" for room in rooms() if hasattr(importlib.import_module(f"ambid.{room}"), "__getattr__")]
    assert lazy
    exported = {f"{room}.{name}" for room in lazy for name in importlib.import_module(room).__all__}
    assert sorted(modules & exported) == []


def test_a_circle_is_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]
    assert circles({"a": {"b"}, "b": set()}) == []


def test_every_room_stands_in_a_tier_and_on_the_map():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    assert not [room for room in rooms() if room not in RANK], "rooms without a tier in import_rules.py"
    assert not [r for r in rooms() if f"`{r}/`" not in text and f"`{r}.py`" not in text], "rooms not in ARCHITECTURE.md"


FABRICATED = {
    "upward": ("ambid.physics.linear_model", "from ambid.simulation.bench import simulate", "upward"),
    "upward, the room itself": ("ambid.record.record", "from ambid import rig", "upward"),
    "upward by two dots": ("ambid.record.csv_format", "from ..physics import models", "upward"),
    "upward, plain import": ("ambid.units", "import ambid.record.record as r", "upward"),
    "sideways": ("ambid.signals.conditioning", "from ambid.physics import models", "sideways"),
    "sideways, top": ("ambid.fleet.many", "import ambid.console", "sideways"),
    "inside a function": ("ambid.rig.load", "def f():\n    from ambid.bearing import greybox\n", "line 2: rig"),
    "for typing only": (
        "ambid.errors",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ambid.record import Record\n",
        "line 3: errors",
    ),
    "by name": ("ambid.bearing", "import importlib\nm = importlib.import_module('ambid.validation')", "upward"),
    "private module": ("ambid.rig.schema", "from ambid.record._files import file_bytes", "_files is private to record"),
    "private module as a name": ("ambid.rig.schema", "from ambid.record import _files", "_files is private to record"),
    "private name": (
        "ambid.simulation.bench",
        "from ambid.physics.linear_model import _blocks",
        "_blocks is private to physics",
    ),
    "the package itself": ("ambid.job", "import ambid", "stands above it"),
    "everything": ("ambid.job", "from ambid import *", "stands above it"),
    "an unknown room": ("ambid.toolbox.things", "import numpy", "in no tier"),
    "from an unknown room": ("ambid.job", "from ambid.toolbox import things", "in no tier"),
}


@pytest.mark.parametrize(("module", "source", "complaint"), FABRICATED.values(), ids=FABRICATED.keys())
def test_a_forbidden_import_is_found(module, source, complaint):
    found = violations(source, module)
    assert len(found) == 1
    assert complaint in found[0]


ALLOWED = {
    "downward": (
        "ambid.bearing.linear",
        "from ambid.physics.linear_model import model\nfrom ambid.errors import ModelError",
    ),
    "own private module": ("ambid.record.csv_format", "from ambid.record._files import file_bytes"),
    "own private module, relative": ("ambid.record.csv_format", "from ._files import file_bytes"),
    "others' libraries": ("ambid.errors", "import numpy.linalg\nfrom ambidextrous import cli"),
    "the version": ("ambid.report.html", "from ambid import __version__"),
}


@pytest.mark.parametrize(("module", "source"), ALLOWED.values(), ids=ALLOWED.keys())
def test_an_allowed_import_passes(module, source):
    assert violations(source, module) == []


def test_relative_imports_of_a_room_resolve_from_the_room():
    assert violations("from .csv_format import read_csv", "ambid.record", is_package=True) == []
    assert "upward" in violations("from ..rig import load", "ambid.record", is_package=True)[0]
