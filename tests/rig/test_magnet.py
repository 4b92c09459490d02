"""``[magnet]``: what a rig knows of the nonlinear law, in SI, written and read again, and what it refuses."""

import pytest

from ambid.bearing.magnet_problem import UNITS
from ambid.errors import RigError
from ambid.physics.law_magnet import BEARING_NUMBERS
from ambid.physics.linear_model import Parameter
from ambid.rig import RigMagnet, load_rig, rig_from_text, rig_text

HEAD = 'schema = "ambid.rig/1"\nmodel = "one-axis"\n'
MAGNET = """[magnet]
kind = "single"
rise = true
off_below = 0.05
[magnet.parameters]
k = { value = 130.0, unit = "N mm^2/A^2" }
L_leak = { value = 100.0, unit = "mH", role = "prior", sd = 10.0 }
i_offset = { value = -3, unit = "mA", role = "fixed" }
"""


def rig(text, head=HEAD):
    return rig_from_text(head + text, "rig.toml")


def test_units_become_si_and_a_number_tells_the_gap_law():
    magnet = rig(MAGNET).magnet
    assert (magnet.kind, magnet.gap, magnet.rise, magnet.off_below) == ("single", "hyperbolic", True, 0.05)
    assert magnet.parameters == (
        Parameter(name="k", unit="N m^2/A^2", value=1.3e-4),
        Parameter(name="L_leak", unit="H", role="prior", value=0.1, sd=0.01),
        Parameter(name="i_offset", unit="A", role="fixed", value=-3e-3),
    )


@pytest.mark.parametrize(
    "text",
    [
        MAGNET,
        "[magnet]\n",
        "[magnet]\nkind = 'pair'\neddy = true\ndrift = true\n",
        "[magnet]\nkind = 'pair'\nasymmetric = true\nsaturation = false\n",
    ],
)
def test_what_is_written_is_read_again(text, tmp_path):
    before = rig(text)
    path = tmp_path / "again.toml"
    path.write_text(rig_text(before, tmp_path), encoding="utf-8")
    assert load_rig(path).magnet == before.magnet


def test_without_it_nothing_is_known():
    assert rig("").magnet is None
    assert rig("[magnet]\n").magnet == RigMagnet()


def test_numbers_and_units_are_those_of_the_estimator():
    linear = {"m", "R", "c"}
    assert {p.name: p.unit for p in BEARING_NUMBERS} == {n: u for n, u in UNITS.items() if n not in linear}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[magnet]\nknd = 'pair'\n", "unknown key 'knd' in .magnet..*Did you mean 'kind'"),
        ("[magnet]\nkind = 'double'\n", "magnet.kind is 'double'; it must be 'auto', 'single' or 'pair'"),
        ("[magnet]\neddy = 1\n", "magnet.eddy is 1; it must be true or false"),
        ("[magnet]\noff_below = 'low'\n", "magnet.off_below is 'low'; it must be a number"),
        ("[magnet.parameters]\nL_leek = { unit = 'H' }\n", "unknown parameter 'L_leek'.*Did you mean 'L_leak'"),
        ("[magnet.parameters]\nk = 3\n", "magnet.parameters.k is 3; it must be { value"),
        ("[magnet.parameters]\nk = { vlue = 3 }\n", r"unknown key 'vlue' in \[magnet.parameters.k\]; known: value"),
        ("[magnet.parameters]\nk = { value = 3.0 }\n", "has a value but no unit"),
        ("[magnet.parameters]\nk = { value = 3.0, unit = 'H' }\n", "it is measured in .N m.2/A.2."),
        ("[magnet.parameters]\nk = { value = -3.0, unit = 'N m^2/A^2' }\n", "must be positive"),
        ("[magnet.parameters]\nL_leak = { value = -1.0, unit = 'H', role = 'fixed' }\n", "must not be negative"),
        ("[magnet.parameters]\nL_leak = { value = 0.0, unit = 'H' }\n", "must be positive unless it is fixed"),
        ("[magnet.parameters]\nm = { value = 1.0, unit = 'kg' }\n", r"Write it in \[parameters\]"),
        ("[magnet.parameters]\ni0 = { value = 1.0, unit = 'A' }\n", "kind = 'auto' leaves it out"),
        ("[magnet.parameters]\na = { value = 1.0, unit = 'rad/s' }\n", "eddy = false leaves it out"),
        ("[magnet.parameters]\nk = { unit = 'N m^2/A^2' }\nzeta = { unit = 'm' }\n", "both gap laws"),
        ("[magnet]\nkind = 'pair'\ngap = 'exponential'\n", "a pair has the hyperbolic law"),
    ],
)
def test_slips_are_named(text, said):
    with pytest.raises(RigError, match=said):
        rig(text)


def test_a_model_without_such_a_magnet_refuses_it():
    with pytest.raises(RigError, match="'coil' has no nonlinear magnet"):
        rig("[magnet]\n", 'schema = "ambid.rig/1"\nmodel = "coil"\n')
