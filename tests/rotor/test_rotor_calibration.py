"""Errors of a rotor's channels and planes: what they move against identifying with each, and what intervals hold."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.estimation.calibration import moved_by_sd
from tests.estimation.test_calibration import wrong
from tests.report import rotor_record
from tests.tiers import sample

SPAN = 0.27  # m, between the bearings
SMALL = 5e-4  # the error that is tried: a larger one is not of first order
KINDS = ("voltage", "current", "position")


def moved_planes(rig, places, by):
    """The rig with planes that are taken too large."""
    bearings = tuple(
        replace(
            b,
            z=b.z + by * (f"{b.name}.z" in places),
            z_sensors=(b.z_sensors[0] + by * (f"{b.name}.z_sensor" in places),),
        )
        for b in rig.rotor.bearings
    )
    known = tuple(replace(p, value=p.value + by) if p.name in places else p for p in rig.parameters)
    return replace(rig, rotor=replace(rig.rotor, bearings=bearings), parameters=known)


def compared(record, right, source, rig):
    """Estimated parameters: per cent that an error of 1 % moves them, as seen and as said."""
    if source.startswith("A."):
        places = {"A.z": {"A.z", "A.z_sensor"}, "A.z_magnet": {"A.z"}, "A.z_sensor": {"A.z_sensor"}}[source]
        off = ambid.identify(record, moved_planes(rig, places, SMALL * SPAN))
    else:
        off = ambid.identify(wrong(record, source, 1.0 + SMALL), rig)
    for name, said in right.calibration[source].items():
        size = SPAN if right[name].unit == "m" else right[name].value
        yield name, (off[name].value - right[name].value) / size / SMALL, said


@pytest.mark.parametrize(
    "source", sample(["ax_position", "ax_voltage", "rate", "A.z", "A.z_magnet", "A.z_sensor"], 0, 3)
)
def test_an_error_moves_the_estimate_as_it_says(source):
    for name, seen, said in compared(
        rotor_record.record(), rotor_record.estimate(), source, rotor_record.rig(known=False)
    ):
        assert seen == pytest.approx(said, abs=0.05), name


@pytest.mark.parametrize("source", sample(["ax_position", "rate", "A.z"]))
def test_it_does_so_without_periods(source):
    record, rig = rotor_record.record()[0.0:0.9], rotor_record.rig(known=False)
    right = ambid.identify(record, rig)
    assert right.method == "predictor"
    for name, seen, said in compared(record, right, source, rig):
        assert seen == pytest.approx(said, abs=0.1), name


def calibrated_rig(**sd):
    """The rig with standard deviations of all gains of a kind, of the rate and of planes."""
    rig = rotor_record.rig(known=False)
    return replace(
        rig,
        channels=tuple(replace(c, gain_sd=sd.get(c.role.rpartition("_")[2])) for c in rig.channels),
        record=replace(rig.record, rate_sd=sd.get("rate")),
        plane_sd={k.replace("__", "."): x for k, x in sd.items() if "__" in k},
    )


def true(name):
    """The truth of the simulated rotor."""
    return rotor_record.rig(known=True).parameter(name).value


def test_both_planes_of_a_bearing_off_are_within_intervals_that_count_them():
    """2 mm: from the record alone parameters are many deviations off."""
    rig = moved_planes(calibrated_rig(A__z_sd=0.002), {"A.z", "A.z_sensor"}, 0.002)
    estimate = ambid.identify(rotor_record.record(), rig)
    estimated = [p for p in estimate.parameters if p.role == "free"]
    assert max(abs(p.value - true(p.name)) / p.sd for p in estimated) > 3.0
    assert max(abs(p.value - true(p.name)) / p.sd_calibrated for p in estimated) < 3.0
    assert estimate.calibration_sd == {"A.z": 0.002}


def test_variance_is_that_of_the_record_and_of_each_error():
    sd = {"position": 0.01, "current": 0.005, "rate": 1e-3}
    rig = calibrated_rig(**sd, A__z_sensor_sd=5e-4, B__z_magnet_sd=1e-3)
    estimate = ambid.identify(rotor_record.record(), rig)
    assert estimate.calibration_sd["A.z_sensor"] == 5e-4
    assert {"A.z", "bx_voltage"}.isdisjoint(estimate.calibration_sd)
    names = [p.name for p in estimate.parameters if p.sd]
    moved = moved_by_sd(estimate, names)
    for p in estimate.parameters:
        size, variance = SPAN if p.unit == "m" else p.value, p.sd**2
        for source, x in estimate.calibration_sd.items():
            by = estimate.calibration[source].get(p.name, 0.0) * size
            variance += (by * x / (SPAN if "." in source else 1.0)) ** 2
        assert p.sd_calibrated == pytest.approx(np.sqrt(variance), rel=1e-6)
        if p.sd:  # as estimates are compared
            apart = sum(x[names.index(p.name)] ** 2 for x in moved.values())
            assert apart == pytest.approx(variance - p.sd**2, rel=1e-6)


def test_it_comes_back_from_its_file(tmp_path):
    estimate = ambid.identify(rotor_record.record(), calibrated_rig(voltage=0.01, A__z_sd=1e-3))
    estimate.save(path := tmp_path / "e.json")
    back = ambid.load(path)
    assert back.parameters == estimate.parameters
    assert (back.calibration, back.calibration_sd) == (estimate.calibration, estimate.calibration_sd)


def test_the_text_says_what_counts():
    text = " ".join(rotor_record.estimate().summary(width=110).split())
    assert "from this record alone" in text
    assert "voltage m, Id, R, L, k_i, k_x +1 %" in text
    assert "2.7 mm along the shaft moves most: A.z_magnet ay.k_x +2.3 %" in text
    said = dict.fromkeys(KINDS, 0.01) | {"rate": 1e-4, "A__z_sd": 1e-3, "B__z_sensor_sd": 1e-3}
    text = ambid.identify(rotor_record.record(), calibrated_rig(**said)).summary(width=110)
    assert "with calibration" in text
    assert "moves most" not in text
    assert "In brackets" in text
