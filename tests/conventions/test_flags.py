"""Below the command nobody writes an option as a shell has it: `ambid.settings.caller` names it for each caller."""

import ast
import re

import pytest

import ambid
from ambid.settings.caller import command, saved, setting, speaking
from tests.conventions.sources import PACKAGE, package_files, parsed

OPTION = re.compile(r"(?<![\w(-])--[a-z]")


def test_no_option_is_spelled_below_the_command():
    spelled = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}: {node.value[:60]!r}"
        for path in package_files()
        if path.relative_to(PACKAGE).parts[0] != "cli"
        for node in ast.walk(parsed(path))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and OPTION.search(node.value)
    ]
    assert not spelled, f"name settings by `ambid.settings.caller.setting`: {spelled}"


def test_each_caller_reads_a_setting_as_it_is_given():
    def names():
        return [
            setting("from_s"), setting("gaps", "cut"), setting("open_loop", True), setting("closed", False),
            setting("layout", "units=row"), setting("limits", "peak=9.5dB"), setting("amplitude", "A"),
            setting("units"), command("identify", "a.csv", rig="a.toml"), saved("design_experiment"),
        ]  # fmt: skip

    assert names() == [
        "from_s", "gaps='cut'", "open_loop=True", "closed=False",
        "layout={'units': 'row'}", "limits={'peak': 9.5}", "amplitude=A", "units",
        "ambid.identify('a.csv', rig='a.toml')", "what ambid.design_experiment(...).save(...) wrote",
    ]  # fmt: skip
    with speaking("shell"):
        assert names() == [
            "--from", "--gaps cut", "--open-loop", "--loop open",
            "--layout units=row", "--limit peak=9.5dB", "--amplitude A", "units",
            "ambid identify a.csv --rig a.toml", "what 'ambid design experiment --json' wrote",
        ]  # fmt: skip
    assert setting("from_s") == "from_s"


def test_an_error_names_what_python_gave():
    with pytest.raises(ambid.AmbidError, match=r"^seconds is -1; it must be a positive number"):
        ambid.design_experiment("prototype", seconds=-1)
    with speaking("shell"), pytest.raises(ambid.AmbidError, match=r"^--seconds is -1; it must be a positive number"):
        ambid.design_experiment("prototype", seconds=-1)
