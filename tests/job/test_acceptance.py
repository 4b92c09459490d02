"""The acceptance report of a spindle on five axes, from simulated records, and what it says where one is missing."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest

import ambid
from ambid.control.acceptance import PARTS
from ambid.errors import EstimationError
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset
from ambid.rig.rotor import Operation

RPM = math.pi / 30.0
OPERATION = Operation(maximum_speed=30_000.0 * RPM, minimum_speed=25_000.0 * RPM, touch_down=0.2e-3)


@pytest.fixture(scope="module")
def spindle():
    """Records at rest and at speed, the machine identified from them, and its acceptance."""
    rig = replace(rig_of_preset(preset("spindle")), operation=OPERATION)
    still = replace(rig, rotor=rig.rotor.at_speed(0.0), unbalance=())
    how = {"duration": 0.5, "periods": 2, "excitation": "zippered", "band": (8.0, 500.0)}
    records = [ambid.simulate(still, seed=2, **how), ambid.simulate(rig, seed=3, **how)]
    estimate = ambid.identify(records, rig)
    return SimpleNamespace(
        rig=rig, records=records, estimate=estimate, accepted=ambid.accept(records, rig, estimate=estimate)
    )


def test_every_part_of_the_report_says_something(spindle):
    assert {x.part for x in spindle.accepted.items} == set(PARTS)
    for x in spindle.accepted.items:
        assert (x.value is None) == (x.outcome == "missing"), x
        assert x.words.endswith("would") or x.outcome != "missing", x


def test_sensitivities_are_those_of_margins(spindle):
    of_speed = ambid.margins(spindle.records[1], spindle.rig, estimate=spindle.estimate)
    items = spindle.accepted.of("sensitivity")
    assert len(items) == 10
    for item, axis in zip(items[5:], of_speed.sensitivity, strict=True):
        assert item.value == pytest.approx(of_speed.sensitivity[axis].rating.value)
        assert item.outcome == "passed"
        assert "zone A" in item.words


def test_stiffness_and_damping_are_those_of_the_true_bearings(spindle):
    """By the formula of a current loop without delay, which the controller is but for a sample: signs and sizes."""
    at = {x.what.split(",")[0]: x for x in spindle.accepted.of("bearings") if "axis ax at" in x.what}
    assert at["stiffness"].value > 0.0
    assert at["damping"].value > 0.0
    for x in at.values():
        assert 0.0 < x.sd < 0.05 * x.value


def test_the_displacement_is_within_the_clearance(spindle):
    for x in (x for x in spindle.accepted.of("vibration") if x.value is not None):
        assert x.limit == pytest.approx(0.4 * 0.2e-3)
        assert not x.confirmed
        assert x.value < 10e-6


def test_the_unbalance_is_that_of_the_bench(spindle):
    static = next(x for x in spindle.accepted.of("unbalance") if x.what == "unbalance, static")
    assert abs(static.value - spindle.rig.unbalance[0].value) < 4.0 * static.sd
    assert static.limit == pytest.approx(6350e-6 * spindle.estimate["m"].value / 30_000.0)


def test_what_no_record_shows_names_the_record_that_would(spindle):
    missing = {x.what: x.words for x in spindle.accepted.items if x.outcome == "missing"}
    assert "run-up or coast-down" in missing["critical speeds"]
    assert "stops" in missing["the clearance itself"]
    assert not spindle.accepted.checks["complete"].passed
    alone = ambid.accept(spindle.records[:1], spindle.rig, estimate=spindle.estimate)
    missing = {x.what: x.words for x in alone.items if x.outcome == "missing"}
    assert {"at speed", "steady operation", "vibration at the maximum speed"} <= set(missing)


def test_it_comes_back_from_its_file(spindle, tmp_path):
    spindle.accepted.save(tmp_path / "a.json")
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["schema"] == "ambid.acceptance/1"
    again = ambid.load(tmp_path / "a.json")
    assert again.items == spindle.accepted.items
    assert again.verdict == spindle.accepted.verdict
    assert again.summary() == spindle.accepted.summary()


def test_its_page_has_every_part_with_its_limit_and_source(spindle, tmp_path):
    spindle.accepted.report(tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text()
    for title in PARTS.values():
        assert title in page
    for word in ("unconfirmed", "ISO 14839-2:2004", "API 617, 9th edition", "SHA-256", "these records cannot show it"):
        assert word in page


def test_a_clearance_that_the_rig_does_not_give_is_that_of_its_limits(spindle):
    rig = replace(spindle.rig, operation=None)
    accepted = ambid.accept(spindle.records[1:], rig, estimate=spindle.estimate)
    assert accepted.clearance == pytest.approx(0.2e-3)
    assert any("loop.limits.position" in w for w in accepted.warnings)


def test_one_axis_is_refused():
    rig = rig_of_preset(preset("rmit-axis"))
    with pytest.raises(EstimationError, match="of one axis"):
        ambid.accept(ambid.simulate("rmit-axis", duration=0.2, seed=1), rig)
