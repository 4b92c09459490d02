"""The position loop in fixed point against the law of `ambid.physics.loop`."""

import math

import numpy as np
import pytest

from ambid.physics.loop import Loop
from tests.firmware.native.console import Console, build

LARGEST = 1 << 19
PERIOD = 5e-4


@pytest.fixture(scope="module")
def console(native_cc, tmp_path_factory):
    """The C of the firmware on this machine."""
    return Console(build(native_cc, tmp_path_factory.mktemp("console")))


def _fixed(loop, *, setpoint=512, rest=512, bias=400):
    """Gains of the protocol for a loop in counts."""
    tau = loop.filter_s
    numbers = (
        round(loop.kp * 4096),
        round(loop.ki * PERIOD * 65536),
        round(loop.kd / (tau + PERIOD) * 4096),
        round(tau / (tau + PERIOD) * 65536),
        round(loop.kc * 4096),
        setpoint,
        rest,
        bias,
    )
    return "law " + " ".join(map(str, numbers))


def _steps(low, high, position, current, excitation):
    rows = " ".join(f"{x} {i} {e}" for x, i, e in zip(position, current, excitation, strict=True))
    return f"steps {low} {high} {rows}"


def _reference(loop, position, current, excitation, low, high, *, setpoint=512, rest=512, bias=400):
    """The law of the docstring of `Loop`, in floating point."""
    tau = loop.filter_s
    integral = derivative = 0.0
    last = position[0]
    wanted = np.empty(len(position))
    for k, (x, i, e) in enumerate(zip(position, current, excitation, strict=True)):
        error = setpoint - x
        derivative = (tau * derivative - loop.kd * (x - last)) / (tau + PERIOD)
        last = x
        wanted[k] = bias + loop.kp * error + integral + derivative - loop.kc * (i - rest) + e
        growth = loop.ki * PERIOD * error
        if not (wanted[k] > high and growth > 0) and not (wanted[k] < low and growth < 0):
            integral += growth
    return np.clip(wanted, low, high)


def _signals(rng, n, spread):
    walk = 512 + spread * np.sin(np.arange(n) * 2 * math.pi / 97) + rng.normal(0, 2, n)
    current = 512 + 3 * spread * np.sin(np.arange(n) * 2 * math.pi / 61) + rng.normal(0, 2, n)
    excitation = rng.choice([-20, 20], n)
    return (
        np.clip(np.rint(walk), 0, 1023).astype(int),
        np.clip(np.rint(current), 0, 1023).astype(int),
        excitation.astype(int),
    )


def _duties(console, loop, signals, low, high):
    lines = console([_fixed(loop), _steps(low, high, *signals)])
    assert lines[0] == "0"
    return np.array(lines[1].split(), dtype=int)


@pytest.mark.parametrize("cutoff", [300.0, math.inf])
def test_the_law_to_a_count(console, cutoff):
    loop = Loop(kp=2.5, ki=60.0, kd=0.01, kc=0.7, derivative_cutoff_hz=cutoff)
    signals = _signals(np.random.default_rng(1), 4000, 20)
    wanted = _reference(loop, *signals, 0, 800)
    got = _duties(console, loop, signals, 0, 800)
    # Rounding of the gains (2^-13 of a count per count of input) and of the sum (half a count).
    assert np.abs(got - wanted).max() < 0.5 + 0.1
    assert np.ptp(wanted) > 200
    assert wanted.min() > 0
    assert wanted.max() < 800


def test_each_gain_alone(console):
    signals = _signals(np.random.default_rng(2), 500, 30)
    for loop in (Loop(kp=-3.0), Loop(ki=200.0), Loop(kd=-0.004, derivative_cutoff_hz=200.0), Loop(kc=1.5)):
        wanted = _reference(loop, *signals, 0, 800)
        assert np.abs(_duties(console, loop, signals, 0, 800) - wanted).max() < 0.6


def test_clipping_and_anti_windup(console):
    loop = Loop(kp=2.0, ki=400.0, kc=0.0)
    away, back = np.full(400, 300), np.full(60, 520)
    position = np.concatenate([away, back, np.full(200, 700)])
    quiet = (np.full(position.size, 512), np.zeros(position.size, dtype=int))
    got = _duties(console, loop, (position, *quiet), 100, 700)
    wanted = _reference(loop, position, *quiet, 100, 700)
    assert np.abs(got - wanted).max() < 0.6
    assert got[50:400].min() == got.max() == 700
    # Without anti-windup the 400 ticks away would have wound the integral up by 10 000 counts or more.
    assert got[401] < 700
    assert got.min() == 100


def test_extremes_neither_overflow_nor_leave_the_limits(console):
    rng = np.random.default_rng(3)
    requests = []
    for trial in range(120):
        gain = [int(rng.choice([-LARGEST, LARGEST, 0])) for _ in range(4)]
        pole = int(rng.choice([0, 65535]))
        rails = [int(rng.choice([0, 1023])) for _ in range(2)]
        requests.append("law " + " ".join(map(str, (*gain[:3], pole, gain[3], *rails, int(rng.choice([0, 800]))))))
        position = np.tile([0, 1023], 150) if trial % 2 else rng.integers(0, 1024, 300)
        current = 1023 - position if trial % 3 else position
        requests.append(_steps(40, 760, position, current, rng.choice([-800, 800], 300)))
    lines = console(requests)  # the sanitizer ends it at a signed overflow
    assert set(lines[::2]) == {"0"}
    duties = np.array(" ".join(lines[1::2]).split(), dtype=int)
    assert duties.size == 120 * 300
    assert duties.min() >= 40
    assert duties.max() <= 760


def test_gains_that_could_overflow_are_refused(console):
    for place, field in ((0, 2), (1, 3), (2, 4), (4, 6)):
        for sign in (-1, 1):
            numbers = [0, 0, 0, 0, 0, 512, 512, 400]
            numbers[place] = sign * (LARGEST + 1)
            assert console(["law " + " ".join(map(str, numbers))]) == [str(field)]
