"""The safe state: entered for each cause, latched, left only when the cause is gone; and limits that nothing leaves."""

import numpy as np
import pytest

from ambid.acquisition.devices import _kernels as k_
from ambid.acquisition.protocol.codec import unpack
from ambid.acquisition.scales import LIFTED_MS
from tests.firmware.native.console import (
    DRIVING,
    EXCITATION,
    FAULT,
    GAINS,
    IDLE,
    LEVITATING,
    LIMITS,
    SAMPLING,
    Console,
    answer,
    build,
    code,
    command,
    ready,
    stand,
    way_to,
)
from tests.firmware.native.line_code import expected

OVERRUN, SILENT, OVER_CURRENT, OUT_OF_GAP, INTERLOCK, LINE_BREAK = range(1, 7)
REST = "tick 512 512 0 0"


@pytest.fixture(scope="module")
def console(native_cc, tmp_path_factory):
    """The C of the firmware on this machine."""
    return Console(build(native_cc, tmp_path_factory.mktemp("console")))


def _is_safe(line, cause):
    now = stand(line)
    assert (now.state, now.cause, now.output, now.duty) == (FAULT, cause, 0, LIMITS["duty_off"])
    assert now.playing == 0


@pytest.mark.parametrize("state", [DRIVING, LEVITATING])
@pytest.mark.parametrize(
    ("tick", "cause"),
    [("tick 512 901 0 0", OVER_CURRENT), ("tick 512 99 0 0", OVER_CURRENT), ("tick 512 512 0 1", OVERRUN)],
)
def test_one_bad_tick_is_enough(console, state, tick, cause):
    lines = console([*way_to(state), tick, REST])
    assert stand(lines[-3]).output == 1
    _is_safe(lines[-2], cause)
    _is_safe(lines[-1], cause)
    values = [int(v) for v in lines[-1].split()[0].split(":")]
    assert values[1] == FAULT | cause << 4  # samples flow on and say why
    assert values[-1] == LIMITS["duty_off"]


@pytest.mark.parametrize("position", [111, 913])
def test_out_of_gap_counts_after_the_lift(console, position):
    ticks = LIMITS["lift_ms"] * 2
    lines = console([*ready(), command("start", 5, mode=3), *[f"tick {position} 512 0 0"] * (ticks + 1)])
    assert all(stand(line).output == 1 for line in lines[5:-1])
    _is_safe(lines[-1], OUT_OF_GAP)


@pytest.mark.parametrize("short", [1, 0])
def test_the_lift_ends_once_the_position_stayed_inside(console, short):
    """A rotor that lies inside from the start is watched from then on, not only after lift_ms."""
    inside, out = "tick 512 512 0 0", "tick 1000 512 0 0"
    begun = [*ready(limits={"lift_ms": 2000}), command("start", 5, mode=3)]
    enough = 2 * LIFTED_MS  # ticks at 2 kHz
    lines = console([*begun, *[inside] * (enough - 1), out, *[inside] * (enough - short), out])
    assert [stand(line).state for line in lines[5:-1]] == [LEVITATING] * (2 * enough - short)
    assert stand(lines[-1]).state == (LEVITATING if short else FAULT)


@pytest.mark.parametrize("period", [8, 10, 11, 20])
def test_the_simulated_device_ends_the_lift_at_the_same_tick(console, period):
    rng = np.random.default_rng(period)
    inside = np.repeat(rng.random(60) < 0.8, rng.integers(1, 60, 60))
    positions = np.where(inside, 500, 1000)
    limits = LIMITS | {"lift_ms": 300, "host_ms": 2000}
    begun = [*ready(period=period, limits=limits), command("start", 5, mode=3)]
    lines = console([*begun, *[f"tick {x} 512 0 0" for x in positions]])
    tripped = next(k for k, line in enumerate(lines[5:]) if stand(line).state == FAULT)
    settings, memory = np.zeros(k_.N_SETTINGS, dtype=np.int64), np.zeros(k_.N_MEMORY, dtype=np.int64)
    places = (k_.POSITION_LOW, k_.POSITION_HIGH, k_.CURRENT_LOW, k_.CURRENT_HIGH)
    settings[list(places)] = [limits[n] for n in ("position_low", "position_high", "current_low", "current_high")]
    settings[k_.LIFT] = -(-300 * 20 // period)
    settings[k_.SETTLED] = -(-LIFTED_MS * 20 // period)
    memory[k_.STATE] = k_.LEVITATING
    causes = []
    for tick, x in enumerate(positions):
        memory[k_.TICK] = tick
        causes.append(k_.tripped(x, 512, settings, memory))
    assert 0 < tripped == causes.index(OUT_OF_GAP)


@pytest.mark.parametrize("noise", ["20ff", "01050000", "1b", "1b0500", "0309", "00"])
def test_only_a_command_is_a_sign_of_the_host(console, noise):
    ticks = LIMITS["host_ms"] * 2
    lines = console([*way_to(LEVITATING), *[REST] * 300, f"command {noise}", *[REST] * (ticks - 300)])
    assert stand(lines[-2]).output == 1
    _is_safe(lines[-1], SILENT)


def test_a_silent_host(console):
    ticks = LIMITS["host_ms"] * 2
    lines = console([*way_to(LEVITATING), *[REST] * 300, command("ping", 9), *[REST] * (ticks + 1)])
    assert all(stand(line).output == 1 for line in lines[-301 - ticks : -1])
    _is_safe(lines[-1], SILENT)


def test_no_ordinary_sample_is_a_fault_while_the_output_is_off(console):
    lines = console([*way_to(SAMPLING), *["tick 0 1023 0 1"] * 3000])
    assert {stand(line).state for line in lines[-3000:]} == {SAMPLING}
    assert {stand(line).output for line in lines} == {0}


def test_the_first_cause_stays_and_is_told_once(console):
    lines = console([*way_to(LEVITATING), "tick 512 1000 0 0", f"set fault {INTERLOCK}", "loop", "loop"])
    _is_safe(lines[-3], OVER_CURRENT)
    told = [unpack(bytes.fromhex(b)) for b in expected(bytes.fromhex(lines[-2]))]
    assert [(m["cause"], m["tick"], m["position"], m["current"]) for m in told] == [(OVER_CURRENT, 1, 512, 1000)]
    assert lines[-1] == ""


@pytest.mark.parametrize(
    ("cause", "still", "gone", "refused"),
    [
        (INTERLOCK, "set interlock 1", "set interlock 0", 6),
        (LINE_BREAK, "set line 1", "set line 0", 4),
        (OVER_CURRENT, "tick 512 1000 0 0", REST, 4),
    ],
)
def test_cleared_only_when_the_cause_is_gone(console, cause, still, gone, refused):
    fault = [*way_to(LEVITATING), still, f"set fault {cause}"]
    lines = console([*fault, command("clear", 8), gone, command("clear", 9)])
    assert code(lines[-3]) == (refused, FAULT)
    _is_safe(lines[-3], cause)
    assert code(lines[-1]) == (0, 0)
    now = stand(lines[-1])
    assert (now.state, now.cause, now.ticking) == (IDLE, 0, 0)


def test_over_current_is_measured_anew_where_no_ticks_come(console):
    stopped = [*way_to(FAULT), command("stop", 6), "set current 1000"]
    lines = console([*stopped, command("clear", 7), "set current 500", command("clear", 8)])
    assert stand(lines[-5]).ticking == 0
    assert [code(lines[-3])[0], code(lines[-1])[0]] == [4, 0]


def test_the_output_comes_on_with_the_first_checked_tick(console):
    lines = console([*ready(), command("start", 5, mode=3), "tick 512 1000 0 0"])
    assert [stand(line).output for line in lines] == [0] * 6
    lines = console([*ready(), command("start", 5, mode=3), REST])
    assert [stand(line).output for line in lines] == [0] * 5 + [1]


def test_driving_plays_about_the_bias(console):
    begun = [*way_to(DRIVING), command("excite", 6, on=1)]
    lines = console([*begun, *[REST] * 40])
    assert {stand(line).duty for line in lines[-40:]} == {380, 420}


def _any_command(rng, number, period):
    """A command with values at, inside and beyond what is allowed."""

    def pick(*values):
        return int(rng.choice(values))

    def around(least, most):
        return int(rng.integers(least, most + 1))

    match int(rng.integers(0, 12)):
        case 0:
            return command("configure", number, period=pick(period, 10, 20, 3), stream=pick(0x0F, 0x3F, 0x01, 0))
        case 1:
            low, high = sorted((around(0, 830), around(0, 830)))
            limits = {"duty_low": low, "duty_high": high, "duty_off": around(0, 810)}
            window = {"position_low": pick(0, 100), "position_high": pick(900, 1023, 1100), "current_high": 1023}
            return command("limits", number, **(LIMITS | limits | window | {"lift_ms": 100}))
        case 2 | 3:
            spread = 1 << 19
            wild = {k: pick(-spread, -5000, 0, 5000, spread, spread + 1) for k in ("kp", "ki", "kd", "kc")}
            return command("gains", number, **(GAINS | wild | {"duty_bias": around(0, 800)}))
        case 4:
            return command("setpoint", number, setpoint=around(0, 1023))
        case 5:
            kind = {"kind": pick(0, 1, 2, 3), "amplitude": pick(0, 60, 800, 900), "length": pick(3, 5, 15, 40)}
            return command("excitation", number, **(EXCITATION | kind | {"cycles": pick(0, 1)}))
        case 6:
            return command("table", number, offset=pick(0, 20, 960), values=rng.integers(-127, 128, 40).tolist())
        case 7:
            return command("excite", number, on=pick(0, 1, 2))
        case 8 | 9:
            return command("start", number, mode=pick(1, 2, 3))
        case 10:
            return command(str(rng.choice(["stop", "ping", "identify", "ask_status", "self_test"])), number)
        case _:
            return command("clear", number)


def _any_request(rng, number):
    if rng.random() < 0.5:
        x, i = (512, 512) if rng.random() < 0.9 else rng.integers(0, 1024, 2)
        return f"tick {x} {i} {int(rng.integers(0, 1024))} {int(rng.random() < 0.01)}"
    return _any_command(rng, number, 10)


def test_nothing_leaves_the_limits(console):
    """1e5 random requests, half of them commands: the pulse width keeps to the limits in force, whatever is asked."""
    rng = np.random.default_rng(7)
    requests = ready()
    while len(requests) < 100_000:
        requests.append(_any_request(rng, 1 + len(requests) % 255))
    seen, low, high, off, states = 0, None, None, 0, set()
    for request, line in zip(requests, console(requests), strict=True):
        now = stand(line)
        if request.startswith("command 12") and code(line) == (0, 0) and answer(line)[0] == 2:
            body = bytes.fromhex(request.split()[1])
            low, high, off = (int.from_bytes(body[k : k + 2], "little") for k in (10, 12, 14))
        states.add(now.state)
        if now.output:
            seen += 1
            assert now.state in (DRIVING, LEVITATING)
            assert 0 <= low <= now.duty <= high <= 800
        else:
            assert now.duty == off
        assert answer(line)[0] in (2, 3, 4, 5) if request.startswith("command") else True
    assert seen > 5_000
    assert states == {IDLE, SAMPLING, DRIVING, LEVITATING, FAULT}
