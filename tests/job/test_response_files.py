"""Physical parameters from files of frequency responses: within their intervals, calibrated, and judged."""

import numpy as np
import pytest

from ambid import frf, load
from ambid.errors import AmbidError
from tests.signals.response_files import TRUTH, F, noisy, plant, uff

RIG = """schema = "ambid.rig/1"
model = "{model}"
[channels.{source}]
column = "7Z"
[channels.position]
column = "1Z"
{more}
[parameters]
c = {{ value = 0.0, unit = "N s/m", role = "fixed" }}
"""


@pytest.fixture
def rig(tmp_path):
    def made(model, more="", mass=""):
        source = "voltage" if model == "one-axis" else "current"
        current = '[channels.current]\ncolumn = "2Z"\n' if model == "one-axis" else ""
        path = tmp_path / "rig.toml"
        path.write_text(RIG.format(model=model, source=source, more=more + "\n" + current) + mass)
        return path

    return made


@pytest.fixture
def files(tmp_path):
    """Position and current to voltage, and position to current, 2 % of noise."""
    both = noisy(plant(), 0.02)
    (tmp_path / "voltage.uff").write_bytes(
        uff([(4, 1, 7, F, 1e6 * both[:, 0], ("um", "V")), (4, 2, 7, F, both[:, 1], ("A", "V"))])
    )
    (tmp_path / "current.uff").write_bytes(uff([(4, 1, 7, F, noisy(plant("rotor"), 0.02)[:, 0], ("m", "A"))]))
    return tmp_path


def test_parameters_of_an_axis_from_voltage(files, rig):
    found = frf(files / "voltage.uff", rig=rig("one-axis"), open_loop=True)
    assert found.response.outputs == ("position", "current")
    for name in ("m", "k_x", "k_i", "R", "L"):
        p = found[name]
        assert abs(p.value - TRUTH[name]) < 3.3 * p.sd < 0.15 * abs(p.value), name
    assert (found.verdict.word, [r.check for r in found.reasons]) == ("caution", ["noise"])
    found.save(files / "a.json")
    assert load(files / "a.json")["m"].value == pytest.approx(found["m"].value)
    feedback = frf(files / "voltage.uff", rig=rig("one-axis"), delay=0.0).reasons
    assert "feedback" in [r.check for r in feedback]


def test_position_over_current_shows_ratios_to_the_mass(files, rig):
    free = frf(files / "current.uff", rig=rig("rotor"), open_loop=True)
    assert not free.estimate.checks["identifiable"].passed
    mass = 'm = { value = 4.0, unit = "kg", role = "fixed" }\n'
    held = frf(files / "current.uff", rig=rig("rotor", mass=mass), open_loop=True)
    for name in ("k_x", "k_i"):
        assert abs(held[name].value - TRUTH[name]) < 3.3 * held[name].sd < 0.1 * abs(held[name].value), name


def test_gains_of_the_rig_are_applied(files, rig):
    mass = 'm = { value = 4.0, unit = "kg", role = "fixed" }\n'
    plain = frf(files / "current.uff", rig=rig("rotor", mass=mass), open_loop=True, delay=0.0)
    gain = 'unit = "V"\ngain = -2e-3\n'
    scaled = frf(files / "current.uff", rig=rig("rotor", gain, mass), open_loop=True, delay=0.0)
    np.testing.assert_allclose(scaled.response.G, -2e-3 * plain.response.G, rtol=1e-12)
    np.testing.assert_allclose(scaled.response.sd, 2e-3 * plain.response.sd, rtol=1e-12)
    with pytest.raises(AmbidError, match=r"channels\.position has a table or a delay"):
        frf(files / "current.uff", rig=rig("rotor", "delay = 1\n", mass))
    with pytest.raises(AmbidError, match=r"no response 7Z → 2Z; it has 7Z → 1Z"):
        frf(files / "current.uff", rig=rig("one-axis"))


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"modes": "auto"}, "modes is for records in time"),
        ({"method": "random"}, "method is for records in time"),
        ({"hold": "zoh"}, "a held input needs the rate"),
        ({"rate_hz": 500.0}, "shows less than half"),
        ({"layout": {"group": "a"}}, "layout 'group' of a frequency response"),
        ({"layout": {"averages": "many"}}, "it is a number of spectra"),
    ],
)
def test_what_does_not_apply_is_refused(files, more, said):
    with pytest.raises(AmbidError, match=said):
        frf(files / "current.uff", **more)


def test_models_are_fitted_to_files(files):
    found = frf(files / "current.uff", orders="nf=2,nb=1", open_loop=True)
    assert found.fit.checks["cost"].passed
    assert max(found.fit.model.poles().real) == pytest.approx(np.sqrt(-TRUTH["k_x"] / TRUTH["m"]), rel=0.01)
