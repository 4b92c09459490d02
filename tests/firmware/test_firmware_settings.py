"""What the host knows of the controller, against the firmware's own C: constants, excitations, settings."""

import re

import numpy as np
import pytest

from ambid.acquisition import scales as board
from ambid.acquisition.device import Program
from ambid.acquisition.program import expected, program
from ambid.acquisition.protocol import table
from ambid.acquisition.scales import scale_of
from ambid.acquisition.settings import controller_settings, in_si, realised, with_default_daq
from tests.acquisition.rigs import bench
from tests.acquisition.test_default_daq import of_preset
from tests.firmware.native.console import FIRMWARE, Console, build, code, command

TOLD = ("prototype", "unstable-bearing", "rmit-axis", "thesis")


@pytest.fixture(scope="module")
def console(native_cc, tmp_path_factory):
    """The C of the firmware on this machine."""
    return Console(build(native_cc, tmp_path_factory.mktemp("console")))


@pytest.fixture(scope="module")
def defined():
    """Numbers that the firmware's headers define."""
    text = "".join(p.read_text(encoding="utf-8") for p in sorted(FIRMWARE.glob("*.h")))
    found = re.findall(r"^#define (\w+) \(?(\d+)U?L?(?: << (\d+)\))?(?:\s|$)", text, re.MULTILINE)
    return {name: int(value) << int(shift or 0) for name, value, shift in found}


def test_the_host_knows_the_board(defined):
    assert defined["BOARD_PWM_TOP"] == board.PWM_TOP
    assert defined["BOARD_PWM_HZ"] == board.PWM_HZ
    assert defined["BOARD_ADC_TOP"] == board.ADC_TOP
    assert defined["BOARD_SHORTEST"] == board.SHORTEST_PERIOD
    assert defined["BOARD_LONGEST"] == board.LONGEST_PERIOD
    assert defined["EXCITATION_TABLE"] == board.TABLE_LENGTH
    assert defined["CONTROL_LARGEST"] == board.LARGEST_GAIN
    assert defined["CAP_OUTPUT_PERIOD"] == board.SLOWEST_OUTPUT
    assert defined["CAP_OUTPUT_FASTEST"] == board.FASTEST_OUTPUT
    assert defined["LIFTED_MS"] == board.LIFTED_MS
    assert defined["BOARD_BYTE_US"] == board.BYTE_BITS  # at 1 Mbaud a bit takes 1 us


PROGRAMS = {
    "multisine": program("multisine", amplitude_v=2.0, band=(4.0, 400.0), rate_hz=2000.0, seconds=10.0),
    "held multisine": program("schroeder", amplitude_v=2.0, band=(0.5, 200.0), rate_hz=2000.0, seconds=10.0),
    "prbs": program("prbs", amplitude_v=2.0, band=(4.0, 200.0), rate_hz=2000.0, seconds=10.0, seed=5),
    "long prbs": Program(kind="prbs", amplitude=1.0, length=15, seed=12345),
    "steps": program("steps", amplitude_v=2.0, rate_hz=2000.0, seconds=2.0),
    "twice": Program(kind="prbs", amplitude=1.0, hold=3, length=5, seed=0xFFE1, cycles=2),
    "table twice": Program(kind="table", amplitude=1.0, hold=2, length=5, table=(127, -127, 13, -64, 1), cycles=2),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_host_expects_what_the_controller_plays(console, name):
    p, n = PROGRAMS[name], 5000
    loads = [
        command("table", 1 + k, offset=48 * k, values=p.table[48 * k : 48 * k + 48])
        for k in range(-(-len(p.table) // 48))
    ]
    kind = table().value("kind", p.kind)
    for counts in (1, 67, 380):
        line = console([*loads, f"play {kind} {counts} {p.hold} {p.length} {p.cycles} {p.seed} {n}"])[-1]
        numbers = [int(v) for v in line.split()]
        assert numbers[0] == 0
        np.testing.assert_array_equal(numbers[1:-1], expected(p, n, counts=counts))


@pytest.mark.parametrize("name", TOLD)
def test_the_controller_takes_what_is_made_from_a_rig(console, name):
    s = controller_settings(with_default_daq(of_preset(name)))
    lines = console(
        [
            command("configure", 1, **s.fields("configure")),
            command("limits", 2, **s.fields("limits")),
            command("gains", 3, **s.fields("gains")),
        ]
    )
    assert [code(line) for line in lines] == [(0, 0)] * 3


def test_the_controller_takes_the_fastest_rate_that_the_line_allows(console):
    s = controller_settings(bench(("rate_hz = 2000.0", 'rate_hz = 4000.0\nthird = "hall"')))
    assert code(console([command("configure", 1, **s.fields("configure"))])[0]) == (0, 0)


def test_the_law_in_counts_is_the_loop_in_si(console):
    """What the firmware's law orders for counts is what the loop of the rig orders in volts, to a count."""
    rig = bench()
    s = controller_settings(rig)
    draw = np.random.default_rng(3)
    n = 2000
    k = np.arange(n)
    x = np.rint(512 + 15 * np.sin(k / 40) + draw.normal(0, 2, n)).astype(int)
    i = np.rint(512 + 60 * np.sin(k / 25) + draw.normal(0, 2, n)).astype(int)
    law = " ".join(map(str, (s.kp, s.ki, s.kd, s.pole, s.kc, s.setpoint, s.current_rest, s.duty_bias)))
    rows = " ".join(f"{a} {b} 0" for a, b in zip(x, i, strict=True))
    lines = console([f"law {law}", f"steps {s.duty_low} {s.duty_high} {rows}"])
    duty = np.array(lines[1].split(), dtype=int)
    assert duty.min() > 20
    assert duty.max() < 780  # never limited, or the test says nothing

    si = in_si(rig, s, np.column_stack([x, i, duty, np.zeros(n)]))
    loop, period = realised(s, rig), 1 / s.rate_hz
    rest = scale_of(rig, "position").to_si(s.setpoint)
    e = rest - si[:, 0]
    integral = loop.ki * period * np.concatenate(([0.0], np.cumsum(e)[:-1]))
    derivative = np.zeros(n)
    for m in range(1, n):
        moved = loop.filter_s * derivative[m - 1] - loop.kd * (si[m, 0] - si[m - 1, 0])
        derivative[m] = moved / (loop.filter_s + period)
    rest_current = scale_of(rig, "current").to_si(s.current_rest)
    u = loop.kp * e + integral + derivative - loop.kc * (si[:, 1] - rest_current)
    assert np.ptp(u) > 3.0
    np.testing.assert_allclose(si[:, 2], u, atol=0.52 * 0.03)
