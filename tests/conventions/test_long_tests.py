"""The list of long tests names tests that there are."""

from functools import cache

from tests.conftest import LONG


@cache
def functions(file):
    return [line.split("(")[0].removeprefix("def ") for line in file.read_text(encoding="utf-8").splitlines()]


def test_each_line_names_a_test():
    names = [x.split(maxsplit=1)[1] for x in LONG.read_text(encoding="utf-8").splitlines() if not x.startswith("#")]
    assert len(names) == len(set(names)) > 100
    for name in names:
        file, _, function = name.partition("[")[0].partition("::")
        assert (LONG.parent / file).is_file(), f"{name}: no such file. Correct tests/long_tests.txt"
        assert function in functions(LONG.parent / file), f"{name}: no such test. Correct tests/long_tests.txt"
