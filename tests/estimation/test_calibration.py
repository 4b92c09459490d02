"""What errors of calibration do to estimates: against identifying records whose channels are scaled, and by formula."""

import json
from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.estimation.result import NORMAL_95
from ambid.physics.linear_model import model
from ambid.physics.sensor_errors import unit_powers
from ambid.rig import default_rig

SD = {"voltage": 0.01, "current": 0.005, "position": 0.02, "rate": 1e-3}


def wrong(record, channel, factor):
    """The record as it is logged with one scale wrong."""
    if channel == "rate":
        return replace(record, rate_hz=record.rate_hz * factor)
    return replace(
        record,
        channels=tuple(replace(c, values=c.values * factor) if c.name == channel else c for c in record.channels),
    )


def rig_of(sd, **known):
    """A rig of one axis that says how well its channels are known; `known`: parameters by name."""
    rig = default_rig()
    return replace(
        rig,
        channels=tuple(replace(c, gain_sd=sd.get(c.role)) for c in rig.channels),
        record=replace(rig.record, rate_sd=sd.get("rate")),
        parameters=tuple(replace(p, **known.get(p.name, {})) for p in rig.parameters),
    )


@pytest.fixture(scope="module")
def record():
    return ambid.simulate("unstable-bearing", duration=1.0, seed=4)


@pytest.fixture(scope="module")
def plain(record):
    return ambid.identify(record)


def known_mass(plain, role):
    m = plain["m"]
    return {"m": {"role": role, "value": m.value, **({"sd": m.sd} if role == "prior" else {})}}


@pytest.mark.parametrize("role", ["free", "fixed", "prior"])
@pytest.mark.parametrize("channel", SD)
def test_a_scale_that_is_wrong_moves_the_estimate_as_it_says(record, plain, role, channel):
    rig = rig_of({}, **({} if role == "free" else known_mass(plain, role)))
    right, off = ambid.identify(record, rig), ambid.identify(wrong(record, channel, 1.01), rig)
    for name, per_cent in right.calibration[channel].items():
        seen = np.log(off[name].value / right[name].value) / np.log(1.01)
        assert seen == pytest.approx(per_cent, abs=0.05), name


def test_where_nothing_is_known_a_scale_moves_parameters_by_whole_powers(plain):
    powers = unit_powers(model("one-axis"))
    assert set(plain.calibration) == set(SD)
    for name in ("m", "k_x", "k_i", "R", "L"):
        *gains, time = powers[name]
        found = [plain.calibration[channel][name] for channel in SD]
        np.testing.assert_allclose(found, [*gains, -time], atol=1e-6)


def test_the_interval_is_that_of_the_record_and_of_each_scale(record, plain):
    estimate = ambid.identify(record, rig_of(SD))
    assert estimate.calibration_sd == SD
    for p in estimate.parameters:
        spread = sum((p.value * estimate.calibration[c].get(p.name, 0.0) * sd) ** 2 for c, sd in SD.items())
        assert p.sd_calibrated == pytest.approx(np.sqrt(p.sd**2 + spread), rel=1e-9, abs=0.0)
        half = NORMAL_95 * p.sd_calibrated
        assert p.ci95_calibrated == pytest.approx((p.value - half, p.value + half))
        assert (p.value, p.sd, p.ci95) == (plain[p.name].value, plain[p.name].sd, plain[p.name].ci95)
    assert all(p.sd_calibrated is None and p.ci95_calibrated is None for p in plain.parameters)


def test_it_comes_back_from_its_file_and_older_files_are_read(record, plain, tmp_path):
    estimate = ambid.identify(record, rig_of(SD))
    estimate.save(path := tmp_path / "e.json")
    back = ambid.load(path)
    assert back.parameters == estimate.parameters
    assert (back.calibration, back.calibration_sd) == (estimate.calibration, estimate.calibration_sd)
    document = json.loads(path.read_text())
    for entry in document["parameters"].values():
        del entry["sd_calibrated"], entry["ci95_calibrated"]
    del document["calibration"], document["calibration_sd"]
    path.write_text(json.dumps(document))
    assert [(p.value, p.sd, p.sd_calibrated) for p in ambid.load(path).parameters] == [
        (p.value, p.sd, None) for p in plain.parameters
    ]
    plain.save(path)
    assert json.loads(path.read_text())["parameters"]["m"]["sd_calibrated"] is None
