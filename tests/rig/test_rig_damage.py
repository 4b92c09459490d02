"""Damaged rig files: each is refused in one line that names the entry, the rule and the remedy."""

import pytest

from ambid.errors import RigError
from ambid.rig import load_rig

# name: (text in the sound file, what stands there instead, what the message has to say)
CASES = {
    "unknown key at the top": ("[noise]", "[nosie]", ["'nosie'", "'noise'"]),
    "unknown key of a channel": ('column = "gap"', 'colum = "gap"', ["'colum'", "channels.position", "'column'"]),
    "unknown key of a parameter": ("sd = 0.5", "sdev = 0.5", ["'sdev'", "parameters.R", "'sd'"]),
    "unknown key of the loop": ("kp = 1.5e4", "kpp = 1", ["'kpp'", "[loop]", "'kp'"]),
    "unknown limit": ("position = 4e-4 }", "positon = 1 }", ["'positon'", "loop.limits", "'position'"]),
    "unknown noise": ("force = 0.01", "forces = 0.01", ["'forces'", "[noise]", "'force'"]),
    "unknown resolution": ("{ current = 0.005", "{ curent = 0.005", ["'curent'", "noise.resolutions", "'current'"]),
    "unknown record setting": ("rate_hz = 1000.0", "rate = 1000.0", ["'rate'", "[record]", "'rate_hz'"]),
    "unknown operating role": ("[operating_point]", "[operating_point]\npositon = 'auto'", ["'positon'", "'position'"]),
    "unknown key of an operating value": ("value = 10.0, unit", "val = 10.0, unit", ["'val'", "'value'"]),
    "unknown role": ("[channels.current]", "[channels.curent]", ["channels.curent", "'current'"]),
    "unknown parameter": ("k_x =", "kx =", ["'kx'", "m, k_x, k_i, R, L, c", "'k_x'"]),
    "unknown model": ('"one-axis"', '"oneaxis"', ["'oneaxis'", "'one-axis'"]),
    "missing model": ('model = "one-axis"\n', "", ["model is missing"]),
    "missing schema": ('schema = "ambid.rig/1"\n', "", ["no schema", "ambid.rig/1"]),
    "newer schema": ("ambid.rig/1", "ambid.rig/2", ["'ambid.rig/2'", "'ambid.rig/1'"]),
    "missing role": ('[channels.position]\ncolumn = "gap"\nunit = "um"\n', "", ["channels.position", "missing"]),
    "number in quotes": ("value = 60.54", 'value = "60.54"', ["parameters.m.value", "'60.54'", "quotes"]),
    "bool for a number": ("value = 60.54", "value = true", ["parameters.m.value", "True"]),
    "value not a number": ("value = 60.54", "value = nan", ["parameters.m.value", "finite"]),
    "infinite sd": ("sd = 0.5", "sd = inf", ["parameters.R.sd", "finite"]),
    "infinite gain": ("gain = 0.5", "gain = inf", ["channels.current.gain", "finite"]),
    "bare number for a parameter": ('k_x = { unit = "N/m" }', "k_x = 5.0", ["parameters.k_x", "{ value = "]),
    "list for a number": ("kp = 1.5e4", "kp = [1]", ["loop.kp", "number"]),
    "number for a name": ('column = "gap"', "column = 3", ["channels.position.column", "3"]),
    "empty column name": ('column = "gap"', 'column = ""', ["channels.position.column", "not empty"]),
    "negative mass": ("value = 60.54", "value = -60.54", ["parameters.m", "-60.54 g", "positive"]),
    "zero mass": ("value = 60.54", "value = 0", ["parameters.m", "positive"]),
    "negative resistance prior": ("value = 4.2", "value = -4.2", ["parameters.R", "positive"]),
    "mass in newton": ('unit = "g"', 'unit = "N"', ["parameters.m", "[N]", "[kg]"]),
    "unknown unit": ('unit = "g"', 'unit = "gramm"', ["parameters.m.unit", "'gramm'", "nearest"]),
    "value without unit": ("value = 60.54, unit", "value = 60.54 } #", ["parameters.m", "no unit", 'unit = "kg"']),
    "fixed without value": ("value = 60.54, ", "", ["parameters.m", "fixed", "no value"]),
    "prior without value": ("value = 4.2, ", "", ["parameters.R", "prior", "no value"]),
    "prior without sd": (", sd = 0.5", "", ["parameters.R", "no sd"]),
    "prior with sd zero": ("sd = 0.5", "sd = 0", ["parameters.R", "positive standard deviation"]),
    "prior with negative sd": ("sd = 0.5", "sd = -0.5", ["parameters.R", "positive standard deviation"]),
    "sd of a free parameter": ('unit = "N/m" }', 'unit = "N/m", sd = 3 }', ["parameters.k_x", "has an sd"]),
    "unknown parameter role": ('role = "fixed"', 'role = "fix"', ["parameters.m.role", "'fix'", "'fixed'"]),
    "negative delay": ("delay = 2", "delay = -2", ["channels.voltage.delay", "-2", "negative"]),
    "broken delay": ("delay = 2", "delay = 1.5", ["channels.voltage.delay", "1.5", "whole number", "auto"]),
    "delay in words": ("delay = 2", 'delay = "one"', ["channels.voltage.delay", "'one'", "auto"]),
    "bool delay": ("delay = 2", "delay = true", ["channels.voltage.delay", "whole number"]),
    "delay of an output": ("gain = 0.5", 'delay = "auto"\ngain = 0.5', ["channels.current.delay", "inputs only"]),
    "table and gain": ("delay = 2", "gain = 2.0", ["channels.voltage", "both a table and a gain"]),
    "table missing": ("table.csv", "tabel.csv", ["channels.voltage.table", "does not exist", "table.csv"]),
    "gain of zero": ("gain = 0.5", "gain = 0", ["channels.current.gain", "0"]),
    "extrapolate without table": ("gain = 0.5", "extrapolate = true", ["channels.current.extrapolate", "no table"]),
    "unknown channel unit": ('unit = "um"', 'unit = "micron"', ["channels.position.unit", "'micron'"]),
    "column used twice": ('column = "coil"', 'column = "gap"', ["'gap'", "channels.position", "channels.current"]),
    "operating point in ampere": ('unit = "mm"', 'unit = "A"', ["operating_point.position", "[A]", "[m]"]),
    "operating point without unit": ("{ value = 10.0, unit = \"mm\" }", "0.01", ["operating_point.position", "unit"]),
    "operating point in words": ('current = "auto"', 'current = "mean"', ["operating_point.current"]),
    "unknown controller": ('kind = "pid"', 'kind = "lqr"', ["loop.kind", "'lqr'", "'pid'"]),
    "negative loop delay": ("delay = 1.5", "delay = -1.5", ["loop.delay", "negative"]),
    "limits upside down": ("[0, 12]", "[12, 0]", ["loop.limits.voltage", "lower comes first"]),
    "limits of three": ("[0, 12]", "[0, 1, 2]", ["loop.limits.voltage", "[low, high]"]),
    "negative noise": ("force = 0.01", "force = -0.01", ["noise.force", "negative"]),
    "unknown gap policy": ('gaps = "cut"', 'gaps = "cutt"', ["record.gaps", "'cutt'", "'cut'"]),
    "record ends before it begins": ("to = 14.5", "to = 1.5", ["record.to", "record.from"]),
    "rate of zero": ("rate_hz = 1000.0", "rate_hz = 0", ["record.rate_hz", "positive"]),
    "broken TOML": ('name = "ball"', "name = ball", ["not valid TOML", "line 2"]),
    "same key twice": ('name = "ball"', 'name = "ball"\nname = "b"', ["not valid TOML"]),
    "table for a text": ('name = "ball"', "name = {}", ["name is a table"]),
    "number for a table": ("resolutions = { current = 0.005 }", "resolutions = 3", ["noise.resolutions is 3", "table"]),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_damage_is_named_in_one_line(rig_file, rig_text, case):
    sound, damaged, said = CASES[case]
    assert rig_text.count(sound) >= 1
    with pytest.raises(RigError) as failure:
        load_rig(rig_file(rig_text.replace(sound, damaged, 1)))
    message = str(failure.value)
    assert "\n" not in message
    assert "rig.toml" in message
    for words in said:
        assert words in message


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "0 bytes"),
        (b"\n \n", "is empty"),
        (b"name = '\xb5'", "UTF-8"),
        (b"\0\0\0\0", "binary"),
        (b"a,b\n1,2\n", "TOML"),
    ],
)
def test_files_that_are_no_text(rig_file, data, said):
    with pytest.raises(RigError, match=said):
        load_rig(rig_file(data))


def test_missing_file_and_folder(tmp_path, rig_file):
    rig_file()
    with pytest.raises(RigError, match=r"does not exist \(rig\.toml does\)"):
        load_rig(tmp_path / "rig1.toml")
    with pytest.raises(RigError, match="folder"):
        load_rig(tmp_path)


def test_table_whose_second_column_is_not_the_role(tmp_path, rig_file):
    path = rig_file()
    (tmp_path / "table.csv").write_text("duty [1],current [A]\n0,0\n1,1\n")
    with pytest.raises(RigError, match=r"channels\.voltage\.table gives \[A\].*\[V\]"):
        load_rig(path)
