"""Excitations as the firmware plays them, element by element."""

import numpy as np
import pytest

from tests.firmware.native.console import Console, build, command

STEP, PRBS, TABLE = 1, 2, 3
N_TABLE = 1000


@pytest.fixture(scope="module")
def console(native_cc, tmp_path_factory):
    """The C of the firmware on this machine."""
    return Console(build(native_cc, tmp_path_factory.mktemp("console")))


def _played(line):
    numbers = [int(v) for v in line.split()]
    assert numbers[0] == 0
    return np.array(numbers[1:-1]), numbers[-1]


@pytest.mark.parametrize("bits", range(3, 16))
def test_every_register_has_the_greatest_period(console, bits):
    period = 2**bits - 1
    values, playing = _played(console([f"play {PRBS} 10 1 {bits} 0 1 {2 * period}"])[0])
    assert playing == 1
    assert set(values) == {-10, 10}
    assert np.array_equal(values[:period], values[period:])
    # Of a sequence of greatest length, and of no shorter one, the autocorrelation has one peak and is -1 elsewhere.
    spectrum = np.abs(np.fft.fft(values[:period] / 10)) ** 2
    correlation = np.rint(np.fft.ifft(spectrum).real).astype(int)
    assert correlation[0] == period
    assert set(correlation[1:]) == {-1}


def test_hold_cycles_and_end(console):
    values, playing = _played(console([f"play {PRBS} 7 3 4 2 5 120"])[0])
    assert playing == 0
    assert np.all(np.abs(values[:90]) == 7)
    assert not values[90:].any()
    assert np.array_equal(values[:45], values[45:90])
    assert all(len(set(values[k : k + 3])) == 1 for k in range(0, 90, 3))
    assert [int(v > 0) for v in values[:12:3]] == [1, 0, 1, 0]  # the seed 5, lowest bit first


def test_square_wave(console):
    values, playing = _played(console([f"play {STEP} 25 4 1 1 1 12"])[0])
    assert values.tolist() == [25] * 4 + [-25] * 4 + [0] * 4
    assert playing == 0


def test_table_is_rounded_to_the_nearest_count(console):
    table = list(range(-127, 128))
    loads = [
        command("table", 1 + k, offset=48 * k, values=table[48 * k : 48 * k + 48]) for k in range(-(-len(table) // 48))
    ]
    amplitudes = [0, 1, 63, 127, 254, 333, 800]
    lines = console([*loads, *(f"play {TABLE} {a} 1 {len(table)} 1 0 {len(table)}" for a in amplitudes)])
    for amplitude, line in zip(amplitudes, lines[len(loads) :], strict=True):
        exact = np.array(table) * amplitude / 127
        values, _ = _played(line)
        assert np.array_equal(values, np.sign(exact) * np.floor(np.abs(exact) + 0.5))


@pytest.mark.parametrize(
    ("fields", "refused"),
    [
        ((4, 10, 1, 5, 0, 1), 2),
        ((PRBS, 801, 1, 5, 0, 1), 3),
        ((PRBS, 10, 0, 5, 0, 1), 4),
        ((PRBS, 10, 1, 2, 0, 1), 5),
        ((PRBS, 10, 1, 16, 0, 1), 5),
        ((PRBS, 10, 1, 5, 0, 32), 7),
        ((TABLE, 10, 1, N_TABLE + 1, 0, 0), 5),
        ((TABLE, 10, 1, 0, 0, 0), 5),
        ((TABLE, 10, 1, N_TABLE, 0, 0), 0),
        ((0, 0, 1, 0, 0, 0), 0),
    ],
)
def test_what_cannot_be_played_is_refused(console, fields, refused):
    assert console(["play " + " ".join(map(str, (*fields, 0)))])[0].split()[0] == str(refused)
