"""From a record at a speed off every line to the machine, its unbalance, and what is shown of both."""

import dataclasses
import functools

import numpy as np
import pytest

import ambid
from ambid.physics.linear_model import Parameter
from ambid.report.document import sections_text
from ambid.report.drawing import WIDE, stacked
from ambid.report.rotor_drawing import balance_block, orbit_blocks, synchronous_sections
from ambid.rig.rig import RigChannel
from ambid.rig.rotor import RigModes
from tests.rotor.test_synchronous import planes_of, spinning, without
from tests.rotor_benches import needs_simulator, rig_of

pytestmark = needs_simulator
RPM = 17777.0


@functools.cache
def identified():
    """Return the estimate of a strongly unbalanced rotor, its bench and true numbers."""
    bench, _, theta, record = spinning(RPM, unbalance=4e-5)
    known = rig_of(bench)
    free = tuple(
        p if p.name.startswith(("A.", "B.")) else Parameter(name=p.name, unit=p.unit, role="free")
        for p in known.parameters
    )
    channels = (*known.channels, RigChannel(role="angle", column="angle"))
    rig = dataclasses.replace(
        known, parameters=free, unbalance=(), runout=(), modes=RigModes(count=0), channels=channels
    )
    return ambid.identify(record, rig), bench, theta, record, rig


def test_a_strong_unbalance_between_the_lines_biases_no_parameter():
    e, bench, theta, _, _ = identified()
    z = {p.name: (p.value - theta[p.name]) / p.sd for p in e.parameters if p.role == "free"}
    assert max(map(abs, z.values())) < 3.5, z
    assert e["Ip"].value == pytest.approx(bench.Ip, rel=5e-3)
    assert e.speed == pytest.approx(RPM * np.pi / 30, rel=1e-9)
    assert "without_synchronous" in e.records[0]["history"][-1]
    assert e.checks["residuals_white"].passed


def test_the_unbalance_is_found_with_the_identified_plant():
    e, bench, _, _, _ = identified()
    for p, true in zip(e.synchronous["unbalance"]["planes"].values(), planes_of(bench), strict=True):
        assert abs(p["value"] - abs(true)) < min(3.5 * p["sd"], 0.01 * abs(true))
        assert abs(p["phase"] - bench.phase_unbalance) < min(3.5 * p["phase_sd"], 0.01)
    for r in e.synchronous["runout"].values():
        assert abs(r["value"] - bench.runout) < 3.5 * r["sd"]
        assert abs(r["phase"] - 1.1) < 3.5 * r["phase_sd"]
    for x in e.synchronous["balancing"]["vibration"]:
        assert x["at_most"] < 0.1 * x["before"]


def test_what_turns_is_told_and_drawn(tmp_path):
    e, bench, _, _, _ = identified()
    lines = sections_text(synchronous_sections(e)).splitlines()
    assert max(map(len, lines)) <= 80
    (static,) = (line.split() for line in lines if line.startswith("  unbalance, static"))
    assert float(static[2]) == pytest.approx(1e6 * bench.unbalance, rel=0.01)
    assert float(static[7]) == pytest.approx(np.degrees(bench.phase_unbalance), abs=0.5)
    (one,) = (line.split() for line in lines if line.startswith("  all in one plane"))
    assert float(one[4]) == pytest.approx(250.0, abs=1.0)
    assert e.summary().count("turns with the rotor") == 1
    e.save(tmp_path / "e.json")
    again = ambid.load(tmp_path / "e.json")
    assert again.dumps() == e.dumps()
    drawn = stacked("", [*orbit_blocks(again), balance_block(again.synchronous)], WIDE)
    titles = [a.get_title(loc="left") for a in drawn.axes]
    assert any("synchronous" in t and "forward" in t for t in titles)
    assert any(f"G {again.synchronous['unbalance']['static']['grade_mm_s']:.3g}" in t for t in titles)


def test_without_a_mark_the_phase_counts_from_the_first_sample():
    """The rig's speed is 1 % off; the line of the record says which it is."""
    _, _, _, record, rig = identified()
    roughly = dataclasses.replace(
        rig, rotor=dataclasses.replace(rig.rotor, speed=1.01 * rig.rotor.speed),
        channels=tuple(c for c in rig.channels if c.role != "angle"),
    )  # fmt: skip
    fixed = tuple(
        dataclasses.replace(p, role="fixed", value=identified()[2][p.name]) if p.name != "Ip" else p
        for p in rig.parameters
    )
    e = ambid.identify(without(record, "angle"), dataclasses.replace(roughly, parameters=fixed))
    assert e.synchronous["records"][0]["source"] == "lines"
    assert e.speed == pytest.approx(RPM * np.pi / 30, rel=1e-5)
    assert "first sample" in e.synchronous["hint"]
