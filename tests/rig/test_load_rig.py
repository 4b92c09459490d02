"""Rig files: every entry arrives in SI units, what is not said has its default, and writing loses nothing."""

import math

import numpy as np
import pytest

from ambid.errors import ModelError, RigError
from ambid.physics.linear_model import Parameter, model, model_names
from ambid.physics.loop import Limits, Loop, Noise
from ambid.rig import RecordSettings, default_rig, load_rig, write_rig

MINIMAL = 'schema = "ambid.rig/1"\nmodel = "one-axis"\n'


def test_every_entry_arrives_in_si(rig_file):
    rig = load_rig(rig_file())
    assert (rig.name, rig.model, rig.open_loop) == ("ball", "one-axis", False)
    assert [c.role for c in rig.channels] == ["voltage", "position", "current"]  # the model's order
    assert rig.channel("voltage").delay == 2
    np.testing.assert_array_equal(rig.channel("voltage").calibration.out, [0.0, 5.0, 12.0])
    assert rig.channel("current").calibration.gain == 0.5
    assert rig.channel("position").unit == "um"
    assert rig.parameters == (
        Parameter(name="m", unit="kg", role="fixed", value=0.06054),
        Parameter(name="k_x", unit="N/m"),
        Parameter(name="k_i", unit="N/A", value=-55.7),
        Parameter(name="R", unit="ohm", role="prior", value=4.2, sd=0.5),
        Parameter(name="L", unit="H"),
        Parameter(name="c", unit="N s/m", role="fixed", value=0.0),
    )
    assert dict(rig.operating_point) == {"position": 0.01}
    assert rig.loop == Loop(kp=1.5e4, ki=3.0, kd=20.5, kc=1.0, derivative_cutoff_hz=2000.0, delay=1.5)
    assert rig.limits == Limits(voltage=(0.0, 12.0), position=(-4e-4, 4e-4))
    assert rig.noise == Noise(position=1e-6, force=0.01, current_resolution=0.005)
    assert rig.record == RecordSettings(rate_hz=1000.0, gaps="cut", from_s=2.0, to_s=14.5)


def test_units_convert_values_and_sd_alike(rig_file):
    inductance = 'L = { value = 59.6, unit = "mH", role = "prior", sd = 0.3 }\n'
    rig = load_rig(rig_file(f'{MINIMAL}[parameters]\n{inductance}k_x = {{ value = -0.129, unit = "N/um" }}\n'))
    assert (rig.parameter("L").value, rig.parameter("L").sd) == (0.0596, 0.0003)
    assert rig.parameter("k_x").value == pytest.approx(-1.29e5, rel=1e-14)


def test_what_is_not_said_has_its_default(rig_file):
    rig = load_rig(rig_file(MINIMAL))
    assert [(c.role, c.column, c.delay) for c in rig.channels] == [
        ("voltage", "voltage", "auto"),
        ("position", "position", 0),
        ("current", "current", 0),
    ]
    assert [p.role for p in rig.parameters] == ["free"] * 5 + ["fixed"]
    assert (rig.loop, rig.limits, rig.noise, rig.record) == (None, None, None, RecordSettings())
    assert rig.operating_point == {}
    assert load_rig(rig_file(MINIMAL + 'operating_point = "auto"\n')).operating_point == {}


def test_a_parameter_that_is_named_is_free_unless_it_says_otherwise(rig_file):
    rig = load_rig(rig_file(MINIMAL + '[parameters]\nc = { unit = "N s/m" }\n'))
    assert rig.parameter("c") == Parameter(name="c", unit="N s/m")


@pytest.mark.parametrize("name", model_names())
def test_default_rig_is_complete_for_every_model(name):
    rig, plant = default_rig(name), model(name)
    assert [c.role for c in rig.channels] == [*plant.inputs, *plant.outputs]
    assert [c.column for c in rig.channels] == [*plant.inputs, *plant.outputs]
    for spec, p in zip(plant.parameters, rig.parameters, strict=True):
        assert (p.name, p.unit, p.value) == (spec.name, spec.unit, spec.default)
        assert p.role == ("free" if spec.default is None else "fixed")


def test_default_rig_of_an_unknown_model_names_the_nearest():
    with pytest.raises(ModelError, match="'one-axis'"):
        default_rig("oneaxis")


def test_reference_may_stand_beside_the_models_roles(rig_file, rig_text):
    rig = load_rig(rig_file(rig_text + '[channels.reference]\ncolumn = "set_point"\n'))
    assert rig.channels[-1].role == "reference"


def test_writing_loses_nothing(rig_file, tmp_path):
    rig = load_rig(rig_file())
    (tmp_path / "elsewhere").mkdir()
    write_rig(rig, tmp_path / "elsewhere" / "copy.toml")
    copy = load_rig(tmp_path / "elsewhere" / "copy.toml")
    for name in ("name", "model", "parameters", "operating_point", "loop", "limits", "noise", "record", "open_loop"):
        assert getattr(copy, name) == getattr(rig, name), name
    for a, b in zip(copy.channels, rig.channels, strict=True):
        assert (a.role, a.column, a.unit, a.delay) == (b.role, b.column, b.unit, b.delay)
        if b.calibration is not None:
            assert (a.calibration.gain, a.calibration.offset) == (b.calibration.gain, b.calibration.offset)
            assert (a.calibration.unit_in, a.calibration.sha256) == (b.calibration.unit_in, b.calibration.sha256)


def test_writing_odd_names_and_one_sided_limits(rig_file, tmp_path):
    from dataclasses import replace

    rig = replace(load_rig(rig_file(MINIMAL)), name='a "quoted" \\ name, µm\n\x7f', open_loop=True)
    write_rig(rig, tmp_path / "copy.toml")
    copy = load_rig(tmp_path / "copy.toml")
    assert (copy.name, copy.open_loop) == (rig.name, True)
    with pytest.raises(RigError, match="Give both"):
        write_rig(replace(rig, limits=Limits(voltage=(0.0, math.inf))), tmp_path / "copy.toml")
    with pytest.raises(RigError, match="cannot be written"):
        write_rig(rig, tmp_path / "no" / "copy.toml")


def test_lookups_name_the_nearest(rig_file):
    rig = load_rig(rig_file())
    with pytest.raises(RigError, match="'voltage'"):
        rig.channel("volts")
    with pytest.raises(RigError, match="'k_x'"):
        rig.parameter("kx")
