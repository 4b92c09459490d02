"""What users call has a numpydoc docstring that agrees with its signature; all else has a few sentences."""

import ast
import importlib
import inspect
import re
from functools import cache
from pathlib import Path

import pytest

from tests.conventions.docstring_rules import module_complaints, promised_by
from tests.conventions.sources import PACKAGE, ROOT, module_name, package_files, parsed, rooms, shown

FILES = package_files()
SECTIONS = re.compile(r"^\s*(Parameters|Returns|Yields|Raises|Attributes)\n\s*-{3,}$", re.MULTILINE)


@cache
def exported() -> dict[Path, set[str]]:
    """Names that users call: what the package and its rooms export, by the file that defines them."""
    found: dict[Path, set[str]] = {}
    for home in ["ambid", *(f"ambid.{room}" for room in rooms())]:
        module = importlib.import_module(home)
        for name in getattr(module, "__all__", []):
            value = inspect.unwrap(getattr(module, name))
            value = getattr(value, "py_func", value)  # a compiled function carries its source there
            if inspect.isclass(value) or inspect.isfunction(value):
                found.setdefault(Path(inspect.getsourcefile(value)), set()).add(value.__name__)
    return found


def test_what_users_call_is_documented_in_full():
    found = [f"{shown(p)}: {c}" for p in FILES for c in module_complaints(parsed(p), only=exported().get(p, set()))]
    assert not found, "\n" + "\n".join(found)


def test_what_stays_inside_a_room_is_documented_in_a_few_sentences():
    found = [
        f"{shown(path)}: {complaint}"
        for path in FILES
        for complaint in inside_complaints(parsed(path), exported().get(path, set()))
        if not (path.name.startswith("_") and path.name != "__init__.py" and complaint.endswith("has no docstring"))
    ]
    assert not found, "\n" + "\n".join(found)


def inside_complaints(tree, exported_names):
    """Say which public names have no docstring, and which have the form of those that users call."""
    if tree.body and not ast.get_docstring(tree):
        yield "line 1: the module has no docstring"
    for top in tree.body:
        if not isinstance(top, ast.FunctionDef | ast.ClassDef) or top.name in exported_names | {"command"}:
            continue
        for node in [top, *(n for n in ast.walk(top) if isinstance(n, ast.FunctionDef))]:
            text = ast.get_docstring(node) or ""
            if node is top and not top.name.startswith("_") and not text and not node.decorator_list:
                yield f"line {node.lineno}: {node.name} has no docstring"
            if SECTIONS.search(text):
                yield f"line {node.lineno}: {node.name} stays inside its room: one to three sentences, no sections"


def test_docstrings_take_at_most_a_third_of_the_lines_of_code():
    code = doc = 0
    for path in FILES:
        lines, inside = set(), set()
        for node in ast.walk(parsed(path)):
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                inside.update(range(node.lineno, node.end_lineno + 1))
            elif hasattr(node, "lineno"):
                lines.add(node.lineno)
                lines.add(node.end_lineno)
        doc, code = doc + len(inside), code + len(lines - inside)
    assert doc < code / 3


def test_every_name_a_room_exports_exists():
    modules = [importlib.import_module(f"ambid.{room}") for room in rooms()]
    missing = [f"{m.__name__}.{name}" for m in modules for name in getattr(m, "__all__", []) if not hasattr(m, name)]
    assert not missing, "exported, but not there"


def promises(tree):
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            for member in node.body:
                if isinstance(member, ast.FunctionDef) and (path := promised_by(member, ast.get_docstring(node) or "")):
                    yield member, path


def test_a_docstring_that_refers_to_a_contract_finds_the_method_there_with_the_same_parameters():
    met = 0
    for path in FILES:
        for method, contract in promises(parsed(path)):
            module, _, name = contract.rpartition(".")
            promised = inspect.unwrap(getattr(getattr(importlib.import_module(module), name), method.name))
            assert promised.__doc__
            own = [a.arg for a in (*method.args.args, *method.args.kwonlyargs)]
            assert list(inspect.signature(promised).parameters) == own, f"{shown(path)}: {method.name}"
            met += 1
    assert met > 5


def test_the_walk_meets_the_package():
    assert PACKAGE / "errors.py" in FILES
    assert module_name(PACKAGE / "record" / "record.py") == "ambid.record.record"
    assert PACKAGE.is_relative_to(ROOT)


GOOD = '''
"""A module."""

@dataclass(frozen=True)
class Gain:
    """A gain.

    Attributes
    ----------
    values : Array, shape (n_outputs,), in V/A
    name : str
        Any.
    """

    values: Array
    name: str

    @property
    def first(self) -> float:
        """The first, in V/A."""

    def at(self, index: int) -> float:
        """Return the gain at `index` in V/A."""


def scale(x: Array, *names: str, gain: float = 1.0) -> Array:
    """Scale.

    Parameters
    ----------
    x : Array, shape (n_samples,), in A
    *names : str
        Channels.
    gain : float
        In V/A.

    Returns
    -------
    Array, shape (n_samples,), in V

    Raises
    ------
    ValueError
        If the gain is 0.
    """
    def inner():
        raise KeyError("not its own")
    if gain == 0:
        raise ValueError("gain")
    return x
'''

BROKEN = {
    "module": ('"""A module."""', "", "module has no docstring"),
    "class": ('    """A gain.\n', '    f"""A gain.\n', "class Gain has no docstring"),
    "attribute": ("    name : str\n        Any.\n", "", "'name' is not documented under Attributes"),
    "attribute shape": (", shape (n_outputs,), in V/A\n    name", "\n    name", "Attributes names no shape"),
    "parameter": ("    gain : float\n        In V/A.\n", "", "'gain' is not documented under Parameters"),
    "starred": ("    *names : str\n        Channels.\n", "", "'names' is not documented"),
    "parameter shape": ("x : Array, shape (n_samples,), in A", "x : Array", "'x' is an array"),
    "stale parameter": (
        "    gain : float\n",
        "    gain : float\n    offset : float\n",
        "'offset' that it does not have",
    ),
    "returns": ("    Returns\n    -------\n    Array, shape (n_samples,), in V\n", "", "no section Returns"),
    "returned shape": ("    Array, shape (n_samples,), in V\n", "    Array\n", "Returns names no shape"),
    "raises": ("    Raises\n    ------\n    ValueError\n        If the gain is 0.\n", "", "no section Raises"),
    "raises another": ("    ValueError\n        If", "    TypeError\n        If", "raises ValueError, which Raises"),
    "property": ('        """The first, in V/A."""\n', "        return 1.0\n", "Gain.first has no docstring"),
    "property shape": ("def first(self) -> float", "def first(self) -> Array", "names no shape"),
    "one sentence": ("gain at `index` in", "gain in", "'index' is not documented"),
    "one sentence, array": ("def at(self, index: int) -> float", "def at(self, index: int) -> Array", "names no shape"),
    "function": ('    """Scale.\n', '    f"""Scale.\n', "scale has no docstring"),
}


def test_a_good_module_passes():
    assert list(module_complaints(ast.parse(GOOD))) == []


@pytest.mark.parametrize(("old", "new", "complaint"), BROKEN.values(), ids=BROKEN.keys())
def test_a_missing_part_is_found(old, new, complaint):
    assert old in GOOD
    found = list(module_complaints(ast.parse(GOOD.replace(old, new, 1))))
    assert any(complaint in line for line in found), found


REFERRING = '''
"""A module."""

class Bench:
    """A bench. See `ambid.acquisition.device.Device` for what its methods promise."""

    def start(self, mode: str) -> None:
        """As `Device.start`."""
        raise DeviceError("refused")
'''


def test_a_method_may_refer_to_the_contract_that_its_class_names():
    assert list(module_complaints(ast.parse(REFERRING))) == []


@pytest.mark.parametrize(
    ("old", "new"),
    [("See `ambid.acquisition.device.Device`", "See it"), ("`Device.start`", "`Device.stop`"), ("As `", "Like `")],
    ids=["not named", "another method", "no reference"],
)
def test_a_method_that_refers_to_nothing_is_found(old, new):
    found = list(module_complaints(ast.parse(REFERRING.replace(old, new, 1))))
    assert any("'mode' is not documented" in line for line in found)


def test_only_the_named_are_looked_at():
    bare = '"""M."""\ndef a():\n    pass\ndef b():\n    pass\ndef _c():\n    pass\n'
    assert len(list(module_complaints(ast.parse(bare)))) == 2
    assert len(list(module_complaints(ast.parse(bare), only={"a"}))) == 1
