"""The rotor from the side, its mode shapes and its Campbell diagram show the numbers that they are given."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ambid.estimation.modes import EstimatedNumber, Mode
from ambid.physics import campbell
from ambid.report.drawing import Block, single
from ambid.report.rotor import mode_rows
from ambid.report.rotor_drawing import campbell_panel, shapes_block
from tests.physics.test_shaft import RPM, TWO_SLEEVES

PLANES = {"A.z": 0.10, "A.z_sensor": 0.13, "B.z": 0.65, "B.z_sensor": 0.62}


def identified(side: float) -> Mode:
    rotor = TWO_SLEEVES.free_rotor(1, planes=list(PLANES.values()))
    shape = rotor.deflection(list(PLANES.values()))[:, 2] * side
    return Mode(
        frequency_hz=EstimatedNumber.of(146.2, 0.02),
        damping=EstimatedNumber.of(0.004, 1e-4),
        shape={name: EstimatedNumber.of(x, 0.01) for name, x in zip(PLANES, shape, strict=True)},
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_shapes_stand_on_the_line_of_the_drawing_whatever_their_sign(side: float) -> None:
    axes = single(shapes_block(PLANES, [identified(side)], shaft=TWO_SLEEVES)).axes
    assert [a.get_title(loc="left") for a in axes] == [
        "rotor from the side, 8.11 kg, 750 mm long",
        "mode 1: 146.2 Hz ± 0.039, damping 0.4 %; drawing 145.66 Hz",
    ]
    line = next(x for x in axes[1].lines if x.get_label() == "from the drawing")
    points = axes[1].containers[0].lines[0]
    np.testing.assert_allclose(points.get_ydata(), np.interp(points.get_xdata(), *line.get_data()), atol=1e-3)
    assert [t.get_text() for t in axes[0].texts] == ["A", "B"]


def test_a_mode_that_the_record_does_not_show_stands_where_the_drawing_expects_it() -> None:
    third = replace(identified(1.0), frequency_hz=EstimatedNumber.of(990.0, 0.1))
    titles = [a.get_title(loc="left") for a in single(shapes_block(PLANES, [third], shaft=TWO_SLEEVES)).axes]
    assert [x.split(";")[-1] for x in titles[1:]] == [" drawing 145.66 Hz", " drawing 516.18 Hz", " drawing 997.17 Hz"]
    assert [x.split(";")[0][:14] for x in titles[1:]] == ["not identified", "not identified", "mode 1: 990 Hz"]
    assert len(single(shapes_block(PLANES, shaft=TWO_SLEEVES)).axes) == 1 + 3


def test_without_a_drawing_only_what_was_identified_is_shown() -> None:
    axes = single(shapes_block(PLANES, [identified(1.0)])).axes
    assert len(axes) == 2
    assert not any(x.get_label() == "from the drawing" for x in axes[1].lines)


def test_the_campbell_diagram_marks_the_critical_speeds_of_the_identified_lines() -> None:
    speeds = np.linspace(0.0, 20_000 * RPM, 21)
    drawn = campbell(TWO_SLEEVES, speeds, lines=5)
    rotor = TWO_SLEEVES.free_rotor(3)
    found = campbell(replace(rotor, omega=1.01 * rotor.omega), speeds)
    panel = campbell_panel(found, drawn=drawn, sd=np.full(found.frequency.shape, 6.0), speeds=[15_000 * RPM])
    (axes,) = single(Block(columns=[[panel]])).axes
    labels = {x.get_label() for x in axes.lines}
    assert {"forward", "backward", "from the drawing", "speed itself (1x)", "speed of a record"} <= labels
    marked = [float(x.get_xdata()[0]) for x in axes.lines if x.get_label() == "critical speed"]
    forward = [c.speed / RPM for c in found.critical_speeds() if c.direction > 0]
    assert marked == pytest.approx(forward)
    assert axes.get_title(loc="left") == f"critical speed {forward[0]:.0f} 1/min, without bearings"
    assert len(axes.collections) == found.frequency.shape[1]  # a band for every line


def test_the_table_of_modes_says_what_the_drawing_expects_of_each() -> None:
    third = replace(identified(1.0), frequency_hz=EstimatedNumber.of(990.0, 0.1))
    rows = mode_rows(SimpleNamespace(modes=(identified(1.0), third)), TWO_SLEEVES)
    assert [row[3] for row in rows] == ["from the drawing", "145.66 Hz", "997.17 Hz"]
    assert {len(row) for row in mode_rows(SimpleNamespace(modes=(third,)))} == {4}
