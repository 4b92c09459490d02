"""Navigation reaches every page of the documentation, the reference every public name; no build is needed."""

from __future__ import annotations

import importlib.util
import re
from importlib import import_module

import pytest

from tests.conventions.sources import PACKAGE
from tests.examples.conftest import EXAMPLES

DOCS = EXAMPLES.parent


@pytest.fixture(scope="module")
def reference():
    spec = importlib.util.spec_from_file_location("docs_reference", DOCS / "reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_navigation_reaches_every_page_once():
    trees = re.findall(r"^```\{toctree\}\n(.*?)^```$", (DOCS / "index.md").read_text(encoding="utf-8"), re.M | re.S)
    entries = [line for tree in trees for line in tree.split("\n\n", 1)[1].split()]
    assert sorted(entries) == sorted(set(entries))
    pages = {path.stem for path in DOCS.glob("*.md")} - {"index"}
    notebooks = {f"made/notebooks/{path.stem}" for path in (DOCS / "notebooks").glob("*.py")}
    made = {"made/gallery/index", *(f"made/reference/{name}" for name in ("commands", "options", "python"))}
    assert set(entries) == pages | notebooks | made


def test_the_reference_has_every_room_that_exports_names(reference):
    names = [path.parent.name for path in sorted(PACKAGE.glob("*/__init__.py"))]
    exporting = {f"ambid.{name}" for name in names if getattr(import_module(f"ambid.{name}"), "__all__", None)}
    assert {room for group in reference.GROUPS.values() for room in group} == {"ambid", *exporting}


def test_the_reference_describes_every_command_and_option(reference, tmp_path):
    reference.write_reference(tmp_path)
    text = (tmp_path / "commands.md").read_text(encoding="utf-8")
    for name, command in reference.verbs():
        part = text.split(f"\n## ambid {name}\n")[1].split("\n## ambid ")[0]
        options = {option for p in command.params for option in p.opts if option.startswith("--")}
        assert [option for option in options if option not in part] == [], name


@pytest.mark.parametrize("path", sorted((DOCS / "notebooks").glob("*.py")), ids=lambda path: path.stem)
def test_a_notebook_runs(path, capsys):
    names: dict[str, object] = {"__name__": "__main__"}
    exec(compile(path.read_text(encoding="utf-8"), path.name, "exec"), names)
    assert capsys.readouterr().err == ""
