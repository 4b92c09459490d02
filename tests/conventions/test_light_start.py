"""Starting the command costs no heavy import: judged by what is loaded, not by the clock."""

import json
import subprocess
import sys

import pytest

from tests.conventions.sources import PACKAGE, ROOT, rooms

# What a room may load when it is imported, and what the command may load before it does anything.
HEAVY_FOR_ROOMS = ("numba", "llvmlite", "matplotlib", "h5py", "scipy.signal", "scipy.stats", "scipy.io")
HEAVY_FOR_THE_COMMAND = ("numba", "llvmlite", "matplotlib", "h5py", "scipy", "jinja2")

HELP = """
import sys
sys.argv = ["ambid", "--help"]
from ambid.cli import main
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
"""


def loaded_after(code, heavy):
    report = f"import json, sys\nprint('\\n' + json.dumps([m for m in {heavy!r} if m in sys.modules]))"
    done = subprocess.run([sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


ROOMS = """
import importlib, sys
for room in {rooms!r}:
    importlib.import_module("ambid." + room)
    found = [m for m in {heavy!r} if m in sys.modules]
    assert not found, (room, found)
"""


def test_importing_a_room_loads_nothing_heavy():
    light = [room for room in rooms() if room not in ("cli", "compiled")]
    assert loaded_after(ROOMS.format(rooms=light, heavy=HEAVY_FOR_ROOMS), HEAVY_FOR_ROOMS) == []


@pytest.mark.parametrize("code", ["import ambid", HELP] if "cli" in rooms() else ["import ambid"])
def test_the_package_and_the_help_load_nothing_heavy(code):
    assert loaded_after(code, HEAVY_FOR_THE_COMMAND) == []


# What a verb may load on a plain record of one axis, beside what it is for.
HEAVY_FOR_VERBS = (
    "matplotlib",
    "h5py",
    "jinja2",
    "pandas",
    "scipy.optimize",
    "scipy.signal",
    "scipy.stats",
    "scipy.io",
)

VERB = """
import os, sys, tempfile
from ambid.cli import run
os.chdir(tempfile.mkdtemp())
words = ("simulate", "thesis", "-o", "r.csv", "--duration", "1", "--rate", "5000")
assert run(words) == 0
if {verb!r} != "simulate":
    assert run(({verb!r}, "r.csv")) == 0
"""


@pytest.mark.parametrize("verb", ["identify", "info", "simulate", "track"])
def test_a_verb_loads_no_library_that_its_record_does_not_need(verb):
    assert loaded_after(VERB.format(verb=verb), HEAVY_FOR_VERBS) == []


def test_what_is_loaded_is_seen():
    assert loaded_after("import h5py", HEAVY_FOR_ROOMS) == ["h5py"]
    assert PACKAGE.is_dir()
