"""What no file of the project may hold, and what every test must do; the rules are tested on fabricated sources."""

import ast

import pytest

from tests.conftest import LONGEST
from tests.conventions.hygiene_rules import complaints_of_tests, machine_paths
from tests.conventions.sources import PACKAGE, ROOT, files_of_tests, package_files, parsed, project_files, shown

LONGEST_FILE = 500  # lines of code


def test_requirements_hold_no_address():
    files = sorted((ROOT / "requirements").iterdir())
    assert {"base.txt", "build.txt", "dev.txt", "docs.txt"} <= {path.name for path in files}
    assert not [shown(path) for path in files if "://" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("name", ["base", "build", "dev", "docs", "lock"])
def test_every_requirement_is_pinned_with_hashes(name):
    text = (ROOT / "requirements" / f"{name}.txt").read_text(encoding="utf-8")
    entries = [e for e in text.replace("\\\n", " ").splitlines() if e.strip() and not e.lstrip().startswith("#")]
    assert entries
    assert not [e.split()[0] for e in entries if "==" not in e.split()[0] or "--hash=sha256:" not in e]


def test_the_tools_bring_the_same_versions_as_the_product():
    def pins(name):
        lines = (ROOT / "requirements" / name).read_text(encoding="utf-8").splitlines()
        return {line.split()[0] for line in lines if line[:1].isalnum()}

    assert pins("base.txt") <= pins("dev.txt")


def test_the_tests_that_begin_first_are_there():
    assert not [name for name in LONGEST if not (ROOT / "tests" / name).is_file()]


def test_no_file_names_a_place_on_somebodys_machine():
    found = []
    for path in project_files():
        data = path.read_bytes()
        if b"\0" not in data:
            found += [f"{shown(path)}: {line}" for line in machine_paths(data.decode("utf-8", "replace"))]
    assert not found, "\n" + "\n".join(found)


def test_source_files_hold_one_idea():
    lengths = {shown(path): lines_of_code(path) for path in package_files()}
    too_long = {name: lines for name, lines in lengths.items() if lines > LONGEST_FILE}
    assert not too_long, f"more than {LONGEST_FILE} lines of code: divide them by what they do: {too_long}"


def lines_of_code(path):
    """Lines that hold code: neither blank nor comments nor docstrings."""
    strings = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            strings.update(range(node.lineno, node.end_lineno + 1))
    rows = enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
    return sum(1 for k, row in rows if row.strip() and not row.lstrip().startswith("#") and k not in strings)


def test_tests_can_fail_and_excuses_have_reasons():
    found = [f"{shown(path)}: {c}" for path in files_of_tests() for c in complaints_of_tests(parsed(path))]
    assert not found, "\n" + "\n".join(found)


def test_the_package_is_typed():
    assert (PACKAGE / "py.typed").is_file()


HOME = "/" + "home" + "/somebody/records"


@pytest.mark.parametrize("text", [HOME, f"open('{HOME}')", f"cd {HOME} && make", "see /" + "work/records/a.csv"])
def test_a_machine_path_is_found(text):
    assert [line[:7] for line in machine_paths(f"first\n{text}\n")] == ["line 2:"]


@pytest.mark.parametrize("text", ["docs/home/index", "src/work/x", "$X/" + "root/y", "~/records", "/usr/bin/env bash"])
def test_other_paths_pass(text):
    assert list(machine_paths(text)) == []


WEAK = {
    "nothing": ("def test_a():\n    x = 1\n", "asserts nothing"),
    "true": ("def test_a():\n    assert True\n", "cannot fail"),
    "tuple": ("def test_a():\n    assert (x == 1, 'message')\n", "cannot fail"),
    "bare skip": ("@pytest.mark.skip\ndef test_a():\n    assert x\n", "mark.skip without a reason"),
    "bare skipif": ("@pytest.mark.skipif(y)\ndef test_a():\n    assert x\n", "skipif without a reason"),
    "bare xfail": ("@pytest.mark.xfail(strict=True)\ndef test_a():\n    assert x\n", "xfail without a reason"),
    "bare pytestmark": ("pytestmark = [pytest.mark.skip]\n", "mark.skip without a reason"),
    "bare call": ("def test_a():\n    pytest.skip()\n    assert x\n", "pytest.skip without a reason"),
}


@pytest.mark.parametrize(("source", "complaint"), WEAK.values(), ids=WEAK.keys())
def test_a_weak_test_is_found(source, complaint):
    found = list(complaints_of_tests(ast.parse(source)))
    assert len(found) == 1
    assert complaint in found[0]


STRONG = {
    "assert": "def test_a():\n    assert x\n",
    "raises": "def test_a():\n    with pytest.raises(ValueError):\n        f()\n",
    "numpy": "def test_a():\n    np.testing.assert_allclose(x, y)\n",
    "own helper": "def near(x):\n    assert x\ndef both(x):\n    near(x)\ndef test_a():\n    both(1)\n",
    "skip with a reason": "@pytest.mark.skipif(y, reason='no records')\ndef test_a():\n    assert x\n",
}


@pytest.mark.parametrize("source", STRONG.values(), ids=STRONG.keys())
def test_a_strong_test_passes(source):
    assert list(complaints_of_tests(ast.parse(source))) == []
