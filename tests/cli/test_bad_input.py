"""Damaged records and rigs: each is refused on one line that says what, where and what to do, or fails a named check.

Never a traceback, never a confident estimate.
"""

import gzip
import json
import re

import numpy as np
import pytest

from ambid.cli.demo import PRESET
from ambid.physics.presets import preset

TRUTH = preset(PRESET).parameters
HEADER = "time [ms],voltage [V],current [mA],position [um]"


def columns(text):
    """The numbers of the record, shape (n_rows, 4)."""
    return np.loadtxt(text.splitlines()[2:], delimiter=",")


def with_columns(values, header=HEADER):
    lines = [",".join(f"{x:.9g}" for x in row) for row in values]
    return "\n".join([header, *lines]) + "\n"


def changed(edit, header=HEADER):
    """A damage of the numbers."""

    def damage(text):
        values = columns(text)
        edited = edit(values)
        return with_columns(values if edited is None else edited, header)

    return damage


def cell(row, column, word):
    """Put a word into one cell; `row` counts rows of numbers from 0."""

    def damage(text):
        lines = text.splitlines()
        cells = lines[row + 2].split(",")
        cells[column] = word
        lines[row + 2] = ",".join(cells)
        return "\n".join(lines) + "\n"

    return damage


def header(old, new):
    return lambda text: text.replace(old, new, 1)


def set_column(column, function):
    def edit(values):
        values[:, column] = function(values[:, column])

    return edit


def first_rows(count):
    return lambda text: "\n".join(text.splitlines()[: count + 2]) + "\n"


def irregular(values):
    values[1000:, 0] += 0.02


def backwards(values):
    values[500, 0], values[501, 0] = values[501, 0], values[500, 0]


def twice(values):
    values[500, 0] = values[499, 0]


def gap(values):
    return np.delete(values, slice(700, 730), axis=0)


# Damages of the text of the record: what the one line has to say.
RECORDS = {
    "missing unit": (header("current [mA]", "current"), r"column 'current' has no unit.*current \[unit\]"),
    "wrong unit": (header("current [mA]", "current [mV]"), r"'current' is in \[mV\]; the rig needs a current in \[A\]"),
    "unknown unit": (header("current [mA]", "current [Ams]"), r"'current' is in \[Ams\], an unknown unit"),
    "position in volt": (header("position [um]", "position [V]"), r"'position' is in \[V\].*gain or table"),
    "swapped headers": (
        header("voltage [V],current [mA]", "voltage [mA],current [V]"),
        r"swapped columns\?.*channels\.voltage.*channels\.current.*Swap",
    ),
    "NaN": (cell(99, 2, "NaN"), r"row 102.*'current'"),
    "infinite": (cell(99, 3, "inf"), r"row 102.*'position'"),
    "text in numbers": (cell(99, 1, "n/a"), r"row 102.*'voltage'.*n/a"),
    "missing value": (cell(99, 2, ""), r"row 102.*'current'"),
    "decimal commas": (lambda t: t.replace(".", ","), r"row 3"),
    "short row": (cell(99, 3, "1.0,2.0"), r"row 102.*5"),
    "two rows": (first_rows(2), r"2 rows.*at least 8"),
    "header only": (first_rows(0), r"row|rows"),
    "no header": (lambda t: "\n".join(t.splitlines()[2:]) + "\n", r"no column 'voltage'.*column 2, column 3"),
    "empty": (lambda t: "", r"is empty \(0 bytes\)"),
    "comments only": (lambda t: "# nothing\n", r"header"),
    "duplicate column": (header("position [um]", "current [A]"), r"'current'.*twice"),
    "missing column": (header("position [um]", "height [um]"), r"no column 'position'.*channels\.position"),
    "no time, no rate": (header("time [ms]", "load [N]"), r"no column 'time \[s\]'.*--rate"),
    "time in metres": (header("time [ms]", "time [m]"), r"'time' is in \[m\]; time must be in \[s\]"),
    "time in s or ms": (
        changed(lambda v: v * [0.2, 1, 1, 1], HEADER.replace(" [ms]", "")),
        r"'time' has no unit.*100 Hz",
    ),
    "irregular time": (changed(irregular), r"row \d+"),
    "time runs backwards": (changed(backwards), r"row \d+"),
    "time stands still": (changed(twice), r"row \d+"),
    "rows missing": (changed(gap), r"row \d+.*(--gaps|gaps)"),
    "dead position sensor": (changed(set_column(3, lambda x: 0 * x + 1.5)), r"'?position'?.*constant"),
    "dead current sensor": (changed(set_column(2, lambda x: 0 * x)), r"'?current'?.*constant"),
    "dead input": (changed(set_column(1, lambda x: 0 * x + 3.0)), r"'?voltage'?.*constant"),
    "all zeros": (changed(lambda v: v * [1, 0, 0, 0]), r"constant"),
}


def refused(outcome, pattern):
    assert outcome.code == 2, (outcome.code, outcome.err, outcome.out[:2000])
    assert outcome.out == ""
    lines = outcome.err.splitlines()
    assert len(lines) == 1, outcome.err
    assert lines[0].startswith("ambid: ")
    assert re.search(pattern, lines[0]), lines[0]
    # what to do about it: a sentence of its own at the end, or the rule said as what must be
    assert re.search(r"[.?] (Did you mean .+|[A-Z].+)$|must be in .+$", lines[0]), lines[0]


@pytest.mark.parametrize(("damage", "pattern"), RECORDS.values(), ids=RECORDS.keys())
def test_a_damaged_record_is_refused(bench, ambid, record_text, damage, pattern):
    (bench / "record.csv").write_text(damage(record_text), encoding="utf-8")
    refused(ambid("identify", "record.csv", "--rig", "rig.toml", "--json", "found.json"), pattern)
    assert not (bench / "found.json").exists()


def truncated_gzip(text):
    return gzip.compress(text.encode())[:-2000]


# Damages of the file itself: its name, its bytes, what is said.
FILES = {
    "truncated gzip": ("record.csv.gz", truncated_gzip, r"truncated gzip"),
    "no gzip": ("record.csv.gz", str.encode, r"not a valid gzip"),
    "gzip without its name": ("record.csv", lambda t: gzip.compress(t.encode()), r"gzipped although"),
    "empty gzip": ("record.csv.gz", lambda t: gzip.compress(b""), r"empty inside"),
    "UTF-16": ("record.csv", lambda t: t.encode("utf-16")[:-1], r"utf-16"),
    "binary": ("record.csv", lambda t: bytes(range(256)) * 10, r"record\.csv"),
    "empty MATLAB file": ("record.mat", lambda t: b"", r"empty \(0 bytes\)"),
    "no MATLAB file": ("record.mat", str.encode, r"record\.mat"),
    "no HDF5 file": ("record.h5", str.encode, r"record\.h5"),
    "spreadsheet": ("record.xlsx", str.encode, r"no sound Excel workbook|openpyxl is not installed"),
    "pictures": ("record.png", str.encode, r"format is not known.*\.csv"),
}


@pytest.mark.parametrize(("name", "damage", "pattern"), FILES.values(), ids=FILES.keys())
def test_a_damaged_file_is_refused(bench, ambid, record_text, name, damage, pattern):
    (bench / name).write_bytes(damage(record_text))
    refused(ambid("identify", name, "--rig", "rig.toml"), pattern)


M = 'm   = { unit = "kg" }'

# Damages of the rig: what is replaced by what, what is said.
RIGS = {
    "unknown key": ('model  = "one-axis"', 'modle  = "one-axis"', r"unknown key 'modle'.*Did you mean 'model'"),
    "unknown key of a channel": ('delay  = "auto"', 'delai  = "auto"', r"unknown key 'delai' in \[channels\.voltage\]"),
    "unknown role": ("[channels.current]", "[channels.curent]", r"unknown role \[channels\.curent\].*'current'"),
    "missing channel": ('[channels.current]\ncolumn = "current"', "", r"\[channels\.current\] is missing"),
    "column twice": ('column = "position"', 'column = "current"', r"column 'current' is both"),
    "column that is not there": ('column = "position"', 'column = "x_upper"', r"no column 'x_upper'"),
    "unknown model": ('"one-axis"', '"two-axis"', r"model 'two-axis' is unknown.*one-axis"),
    "unknown parameter": ("k_x =", "kx =", r"unknown parameter 'kx'.*'k_x'"),
    "negative mass": (M, 'm = { value = -4.0, unit = "kg" }', r"parameters\.m.*-4\.0 kg; it must be positive"),
    "prior without sd": (M, 'm = { value = 4.0, unit = "kg", role = "prior" }', r"parameters\.m is a prior with no sd"),
    "prior with a negative sd": (
        M, 'm = { value = 4.0, unit = "kg", role = "prior", sd = -1.0 }', r"parameters\.m.*positive standard deviation"
    ),
    "sd without prior": (M, 'm = { value = 4.0, unit = "kg", sd = 1.0 }', r"parameters\.m is free but has an sd"),
    "fixed without value": (M, 'm = { unit = "kg", role = "fixed" }', r"parameters\.m is fixed but has no value"),
    "value without unit": (M, "m = { value = 4.0 }", r"parameters\.m has a value but no unit"),
    "unit of another kind": (M, 'm = { value = 4.0, unit = "N" }', r"parameters\.m.*\[N\].*\[kg\]"),
    "unknown unit of a parameter": (M, 'm = { value = 4.0, unit = "stone" }', r"'stone' is unknown"),
    "number in quotes": (M, 'm = { value = "4.0", unit = "kg" }', r"value is '4\.0'; it must be a number"),
    "NaN in the rig": (M, 'm = { value = nan, unit = "kg" }', r"parameters\.m\.value is nan; it must be finite"),
    "infinity in the rig": (M, 'm = { value = inf, unit = "kg" }', r"parameters\.m\.value is inf; it must be finite"),
    "unknown word for a role": (M, 'm = { value = 4.0, unit = "kg", role = "known" }', r"role is 'known'.*'fixed'"),
    "negative delay": ('delay  = "auto"', "delay = -1", r"channels\.voltage\.delay is -1"),
    "fractional delay": ('delay  = "auto"', "delay = 1.5", r"channels\.voltage\.delay is 1\.5"),
    "delay of an output to be found": (
        'column = "current"', 'column = "current"\ndelay = "auto"', r"channels\.current\.delay is 'auto'"
    ),
    "gain of zero": ('column = "current"', 'column = "current"\ngain = 0.0', r"channels\.current\.gain is 0"),
    "missing table": ('column = "current"', 'column = "current"\ntable = "no.csv"', r"current\.table.*no\.csv"),
    "table and gain": (
        'column = "current"', 'column = "current"\ntable = "no.csv"\ngain = 1.0', r"has both a table and a gain"
    ),
    "no TOML": ('model  = "one-axis"', "model  = one-axis", r"not valid TOML.*line 4"),
    "another schema": ("ambid.rig/1", "ambid.rig/9", r"schema 'ambid\.rig/9'.*'ambid\.rig/1'"),
    "no schema": ('schema = "ambid.rig/1"', "", r"has no schema"),
    "row as matrix of a law": (
        "[parameters]", '[loop]\nkind = "state-space"\nA = [1.0]\n[parameters]', r"loop\.A\.1 is 1\.0; .*list of rows"
    ),
    "law without a command": (
        "[parameters]", '[loop]\nkind = "state-space"\nrate_hz = 2e4\nA = []\nB = []\nC = []\nD = []\n[parameters]',
        r"loop\.D is empty",
    ),
    "part that ends too early": ("[parameters]", "[record]\nfrom = 0.1\nto = 0.05\n[parameters]", r"to is 0\.05"),
    "part beyond the end": ("[parameters]", "[record]\nfrom = 9.0\n[parameters]", r"9 s; the record spans 0 to"),
    "operating point in another unit": (
        "[parameters]", '[operating_point]\nposition = { value = 1, unit = "A" }\n[parameters]', r"point\.position"
    ),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "pattern"), RIGS.values(), ids=RIGS.keys())
def test_a_damaged_rig_is_refused(bench, ambid, rig_text, old, new, pattern):
    assert old in rig_text
    (bench / "rig.toml").write_text(rig_text.replace(old, new, 1), encoding="utf-8")
    refused(ambid("identify", "record.csv", "--rig", "rig.toml"), pattern)


@pytest.mark.parametrize(
    ("content", "pattern"),
    [(b"", r"rig\.toml is empty \(0 bytes\)"), (b"\n\n", r"is empty"), (b'name = "\xb5"', r"byte 0xb5 is not UTF-8")],
    ids=["empty", "blank", "Latin-1"],
)
def test_a_rig_that_is_no_text_is_refused(bench, ambid, content, pattern):
    (bench / "rig.toml").write_bytes(content)
    refused(ambid("identify", "record.csv", "--rig", "rig.toml"), pattern)


WORDS = {
    "no such record": (["identify", "recrod.csv"], r"recrod\.csv does not exist \(record\.csv does\)"),
    "folder as record": (["identify", "."], r"is a folder"),
    "no such rig": (["identify", "record.csv", "--rig", "rig.tml"], r"rig\.tml does not exist \(rig\.toml does\)"),
    "folder as rig": (["identify", "record.csv", "--rig", "."], r"is a folder"),
    "from beyond the end": (["identify", "record.csv", "--from", "99"], r"99 s; the record spans 0 to 0\.15 s"),
    "from after to": (["identify", "record.csv", "--from", "0.1", "--to", "0.05"], r"from must lie before to"),
    "from that is no number": (["identify", "record.csv", "--from", "nan"], r"--from is nan; it must be a number"),
    "almost nothing left": (["identify", "record.csv", "--to", "0.002"], r"samples"),
    "another rate than the time column's": (["identify", "record.csv", "--rate", "1000"], r"rate"),
    "negative rate": (["identify", "record.csv", "--rate", "-1"], r"rate"),
    "unknown way with gaps": (["identify", "record.csv", "--gaps", "ignore"], r"'ignore'.*interpolate"),
    "rig as estimate": (["validate", "rig.toml", "record.csv"], r"rig\.toml, row 1: not JSON"),
    "record as rig": (["identify", "record.csv", "--rig", "record.csv"], r"not valid TOML"),
}


@pytest.mark.parametrize(("words", "pattern"), WORDS.values(), ids=WORDS.keys())
def test_wrong_words_are_refused(bench, ambid, words, pattern):
    refused(ambid(*words), pattern)


def saturated(values):
    values[:, 3] = np.clip(values[:, 3], -15.0, 15.0)


def dropped_out(values):
    for first in range(200, 3000, 400):
        values[first : first + 60, 3] = 0.0


def spiked(values):
    values[::97, 3] += 300.0


def only_noise(values):
    values[:, 1:] = np.random.default_rng(1).normal(size=(values.shape[0], 3)) * [5.0, 100.0, 20.0]


def exchanged(values):
    values[:, [2, 3]] = values[:, [3, 2]]


def late_position(values):
    values[:, 3] = np.roll(values[:, 3], 12)


# What reads well but cannot be a sound measurement of this bench.
DOUBTFUL = {
    "saturated sensor": (saturated, {}),
    "drop-outs": (dropped_out, {}),
    "outliers": (spiked, {}),
    "only noise": (only_noise, {}),
    "current and position exchanged": (exchanged, {}),
    "current with the wrong sign": (set_column(2, np.negative), {}),
    "position logged late": (late_position, {}),
    "coil of a moving rotor": (
        lambda values: None,
        {'"one-axis"': '"coil"', '[channels.position]\ncolumn = "position"': "", M: "", 'k_x = { unit = "N/m" }': "",
         'k_i = { unit = "N/A" }': "", 'c   = { value = 0.0, unit = "N s/m", role = "fixed" }': ""},
    ),
    "rotor whose mass is not given": (
        lambda values: None,
        {'"one-axis"': '"rotor"', '[channels.voltage]\ncolumn = "voltage"\ndelay  = "auto"': "",
         'R   = { unit = "ohm" }': "", 'L   = { unit = "H" }': ""},
    ),
    "mass fixed a hundred times too large": (
        lambda values: None, {M: 'm = { value = 400.0, unit = "kg", role = "fixed" }'}
    ),
    "resistance fixed in the wrong unit": (
        lambda values: None, {'R   = { unit = "ohm" }': 'R = { value = 1.6, unit = "kohm", role = "fixed" }'}
    ),
}  # fmt: skip


@pytest.mark.parametrize(("edit", "rig"), DOUBTFUL.values(), ids=DOUBTFUL.keys())
def test_a_doubtful_record_never_gives_a_confident_wrong_estimate(bench, ambid, record_text, rig_text, edit, rig):
    (bench / "record.csv").write_text(changed(edit)(first_rows(1000)(record_text)), encoding="utf-8")
    for old, new in rig.items():
        assert old in rig_text
        rig_text = rig_text.replace(old, new, 1)
    (bench / "rig.toml").write_text(rig_text, encoding="utf-8")
    found = ambid("identify", "record.csv", "--rig", "rig.toml", "--json", "-", "--strict")
    if found.code == 2:
        refused(found, r"\w")
        return
    assert found.err == ""
    estimate = json.loads(found.out)
    failed = [name for name, check in estimate["checks"].items() if not check["passed"]]
    if found.code == 3:
        assert estimate["status"] != "converged" or failed
        assert estimate["warnings"]
    else:  # nothing noticed: then it must not have done any harm
        assert found.code == 0
        for name, p in estimate["parameters"].items():
            assert p["role"] == "fixed" or abs(p["value"] - TRUTH[name]) < 3.3 * p["sd"]


def test_the_record_itself_is_sound(bench, ambid):
    found = ambid("identify", "record.csv", "--rig", "rig.toml", "--strict")
    assert found.code == 0, found.err + found.out
    assert found.err == ""


def test_the_name_of_a_file_does_not_break_the_line(ambid):
    found = ambid("info", "no\nsuch\x1b[31m.csv")
    assert found.code == 2
    assert r"no such\x1b[31m.csv" in found.err
    assert found.err.count("\n") == 1
