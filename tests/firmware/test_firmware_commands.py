"""Commands: every one in every state, values out of range, repeated and malformed ones."""

import pytest

from ambid.acquisition.protocol.codec import unpack
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

STATES = (IDLE, SAMPLING, DRIVING, LEVITATING, FAULT)
DONE, UNKNOWN, LENGTH, RANGE, STATE, UNREADY, INTERLOCK = range(7)
FIELDS = {
    "configure": {"period": 10, "stream": 15},
    "limits": LIMITS,
    "gains": GAINS,
    "setpoint": {"setpoint": 500},
    "excitation": EXCITATION,
    "excite": {"on": 1},
    "start": {"mode": 3},
}
# In which states each is carried out, and the state after it.
TAKEN = {
    "identify": {s: s for s in STATES},
    "configure": {IDLE: IDLE},
    "limits": {s: s for s in (IDLE, SAMPLING, FAULT)},
    "gains": {s: s for s in (IDLE, SAMPLING, LEVITATING)},
    "setpoint": {s: s for s in (IDLE, SAMPLING, LEVITATING)},
    "excitation": {s: s for s in STATES},
    "table": {s: s for s in STATES},
    "excite": {DRIVING: DRIVING, LEVITATING: LEVITATING},
    "start": {IDLE: LEVITATING, SAMPLING: LEVITATING},
    "stop": {IDLE: IDLE, SAMPLING: IDLE, DRIVING: IDLE, LEVITATING: IDLE, FAULT: FAULT},
    "clear": {FAULT: IDLE},
    "ping": {s: s for s in STATES},
    "ask_status": {s: s for s in STATES},
    "self_test": {IDLE: IDLE},
}


@pytest.fixture(scope="module")
def console(native_cc, tmp_path_factory):
    """The C of the firmware on this machine."""
    return Console(build(native_cc, tmp_path_factory.mktemp("console")))


def _asked(name, number=77):
    if name == "table":
        return command("table", number, offset=0, values=[1, 2, 3])
    return command(name, number, **FIELDS.get(name, {}))


@pytest.mark.parametrize("name", sorted(TAKEN))
@pytest.mark.parametrize("state", STATES)
def test_every_command_in_every_state(console, name, state):
    lines = console([*way_to(state), _asked(name)])
    assert stand(lines[-2]).state == state
    after = stand(lines[-1])
    if state in TAKEN[name]:
        assert code(lines[-1]) == (DONE, 0)
        assert after.state == TAKEN[name][state]
    else:
        assert code(lines[-1]) == (STATE, state)
        assert after == stand(lines[-2])
    assert answer(lines[-1])[1] == 77
    assert after.ticking == (name != "stop" and after.state != IDLE)


@pytest.mark.parametrize(
    ("given", "mode", "missing"),
    [((), 1, 0), ((2, 3), 1, 6), ((1,), 2, 1), ((1, 2), 3, 3), ((1, 3), 3, 5)],
)
def test_start_waits_for_what_it_needs(console, given, mode, missing):
    said = [r for k, r in enumerate(ready(), start=1) if k in given]
    lines = console([*said, command("start", 9, mode=mode)])
    assert code(lines[-1]) == (UNREADY, missing)
    assert stand(lines[-1]).state == IDLE


def test_another_period_wants_new_gains(console):
    again = command("configure", 6, period=10, stream=1)
    other = command("configure", 7, period=8, stream=1)
    lines = console([*ready(), again, other, command("start", 8, mode=3), command("start", 9, mode=2)])
    assert stand(lines[-4]).ready == 7
    assert code(lines[-2]) == (UNREADY, 3)
    assert code(lines[-1]) == (DONE, 0)


@pytest.mark.parametrize(
    ("name", "changed", "field"),
    [
        ("configure", {"period": 3}, 2),
        ("configure", {"period": 20_001}, 2),
        ("configure", {"period": 4, "stream": 0x3F}, 2),  # would not go over the line
        ("configure", {"stream": 0}, 3),
        ("configure", {"stream": 0x40}, 3),
        ("limits", {"position_low": 912}, 3),
        ("limits", {"position_high": 1024}, 3),
        # What the converter cannot leave never trips.
        ("limits", {"position_low": 0}, 2),
        ("limits", {"position_high": 1023}, 3),
        ("limits", {"current_low": 0, "current_high": 1023}, 5),
        ("limits", {"current_high": 1024}, 5),
        ("limits", {"current_low": 900}, 5),
        ("limits", {"duty_high": 801}, 7),
        ("limits", {"duty_low": 760}, 7),
        ("limits", {"duty_off": 801}, 8),
        ("limits", {"host_ms": 19}, 9),
        ("limits", {"host_ms": 2001}, 9),
        ("limits", {"lift_ms": 2001}, 10),
        ("gains", {"kp": 1 << 20}, 2),
        ("gains", {"ki": -(1 << 20)}, 3),
        ("gains", {"kd": -(2**31)}, 4),
        ("gains", {"kc": 2**31 - 1}, 6),
        ("gains", {"setpoint": 111}, 7),
        ("gains", {"current_rest": 1024}, 8),
        ("gains", {"duty_bias": 39}, 9),
        ("gains", {"duty_bias": 65535}, 9),
        ("setpoint", {"setpoint": 913}, 2),
        ("excitation", {"amplitude": 801}, 3),
        ("start", {"mode": 0}, 2),
        ("start", {"mode": 4}, 2),
    ],
)
def test_values_out_of_range_are_refused_whole(console, name, changed, field):
    lines = console([*ready(), command(name, 9, **(FIELDS[name] | changed))])
    assert code(lines[-1]) == (RANGE, field)
    assert stand(lines[-1]) == stand(lines[-2])


def test_elements_of_the_table(console):
    inside = command("table", 9, offset=952, values=[-127, 127] * 24)
    beyond = command("table", 10, offset=953, values=[1] * 48)
    too_low = "command 160b" + "0000" + "80"
    none = "command 160c" + "0000"
    lines = console([inside, beyond, too_low, none])
    assert [code(line) for line in lines] == [(DONE, 0), (RANGE, 2), (RANGE, 3), (RANGE, 3)]


@pytest.mark.parametrize(
    ("period", "mode", "wanted"),
    [(21, 2, RANGE), (21, 3, RANGE), (21, 1, DONE), (20, 3, DONE), (8, 2, DONE), (7, 3, RANGE), (5, 1, DONE)],
)
def test_output_only_at_rates_that_are_safe(console, period, mode, wanted):
    lines = console([*ready(period=period), command("start", 9, mode=mode)])
    assert code(lines[-1])[0] == wanted


def test_limits_after_gains_that_leave_them_out(console):
    narrow = command("limits", 6, **(LIMITS | {"position_low": 600}))
    lines = console([*ready(), narrow, command("start", 7, mode=3)])
    assert code(lines[-1]) == (RANGE, 2)
    assert stand(lines[-1]).state == IDLE


def test_no_start_with_an_open_interlock(console):
    lines = console([*ready(), "set interlock 1", command("start", 6, mode=3), command("start", 7, mode=1)])
    assert [code(line)[0] for line in lines[-2:]] == [INTERLOCK, DONE]


def test_excitation_is_not_changed_while_it_plays(console):
    begun = [*way_to(LEVITATING), command("excite", 6, on=1), "tick 512 512 0 0"]
    lines = console(
        [
            *begun,
            command("excitation", 7, **EXCITATION),
            command("table", 8, offset=0, values=[1]),
            command("excite", 9, on=0),
            command("excitation", 10, **EXCITATION),
        ]
    )
    assert [code(line) for line in lines[-4:]] == [(STATE, LEVITATING)] * 2 + [(DONE, 0)] * 2
    assert stand(lines[-5]).playing == 1
    assert stand(lines[-1]).playing == 0


def test_a_repeated_command_is_answered_and_not_carried_out(console):
    stop, start = command("stop", 6), command("start", 5, mode=3)
    lines = console([*ready(), start, stop, command("start", 7, mode=1), stop, command("ping", 7), stop])
    # After another command the number of an old one is new again.
    assert [stand(line).state for line in lines[4:]] == [LEVITATING, IDLE, SAMPLING, IDLE, IDLE, IDLE]
    lines = console([*ready(), start, "tick 512 1000 0 0", start, "tick 512 512 0 0", command("ping", 8), start])
    again = [lines[4], lines[6], lines[9]]
    assert len({answer(line) for line in again}) == 1
    assert stand(lines[9]).state == FAULT
    # Refused for its state it would be without the rule: code 4.
    assert code(lines[9]) == (DONE, 0)


@pytest.mark.parametrize(("between", "carried_out"), [(199, False), (200, True), (254, True)])
def test_the_last_command_is_forgotten_before_numbers_come_round(console, between, carried_out):
    """Pings number on from it, and the next command of the same kind has its number once more."""
    pings = [command("ping", (6 + k) % 255 + 1) for k in range(between)]
    off = command("excite", 6, on=0)
    lines = console([*way_to(LEVITATING), command("excite", 6, on=1), *pings, off])
    assert code(lines[-1]) == (DONE, 0)
    assert stand(lines[-1]).playing == (not carried_out)


def test_limits_that_leave_out_the_current_at_rest_are_put_right_in_the_fault(console):
    wrong = [*ready(limits={"current_low": 600}), command("start", 5, mode=2), "tick 512 512 0 0"]
    right = [command("clear", 6), command("limits", 7, **LIMITS), command("clear", 8), command("start", 9, mode=2)]
    lines = console([*wrong, *right])
    assert [stand(line).state for line in lines[5:]] == [FAULT, FAULT, FAULT, IDLE, DRIVING]
    assert [code(line) for line in lines[6:]] == [(STATE, FAULT), (DONE, 0), (DONE, 0), (DONE, 0)]
    assert {stand(line).output for line in lines} == {0}


def test_the_safe_pulse_width_keeps_to_what_is_compiled_in(native_cc, tmp_path):
    capped = Console(build(native_cc, tmp_path, "-DCAP_DUTY_HIGH=600"))
    wanted = [(600, 601), (600, 600), (601, 400)]
    lines = capped([command("limits", 1 + k, **(LIMITS | {"duty_high": high, "duty_off": off}))
                    for k, (high, off) in enumerate(wanted)])  # fmt: skip
    assert [code(line) for line in lines] == [(RANGE, 8), (DONE, 0), (RANGE, 7)]
    assert [stand(line).duty for line in lines] == [0, 600, 600]


def test_a_current_of_one_sign_trips_on_the_other_side_only(console):
    for k, ends in enumerate([{"current_low": 0}, {"current_high": 1023}]):
        assert code(console([command("limits", 1 + k, **(LIMITS | ends))])[0]) == (DONE, 0)


def test_a_coil_without_position_is_driven_and_not_levitated(console):
    none = ready(limits={"position_low": 0, "position_high": 1023})
    lines = console([*none, command("start", 5, mode=3), command("start", 6, mode=2), "tick 1023 512 0 0"])
    assert [code(lines[4]), code(lines[5])] == [(RANGE, 2), (DONE, 0)]
    assert stand(lines[-1]).state == DRIVING


def test_identify_forgets_the_last_number(console):
    stop = command("stop", 6)
    lines = console([stop, *ready(), command("start", 6, mode=1), command("identify", 6), command("start", 6, mode=1)])
    assert code(lines[-1]) == (STATE, SAMPLING)


def test_malformed_commands_are_answered_and_counted(console):
    requests = ["command 30ff", "command 7f050000", "command 1b", "command 1b0500", "command 1805", "command 1b00"]
    lines = console(requests)
    assert [code(line) for line in lines] == [(UNKNOWN, 0)] * 2 + [(LENGTH, 0)] * 3 + [(RANGE, 1)]
    assert stand(lines[-1]).rx_errors == 5


@pytest.mark.parametrize("first", range(16))
def test_a_message_to_the_host_is_counted_and_gets_no_answer(console, first):
    line = console([f"command {first:02x}050000"])[0]
    assert line.startswith(" ")
    assert stand(line).rx_errors == 1


def test_identity_and_status(console):
    lines = console([command("identify", 5), *way_to(SAMPLING), command("ask_status", 9)])
    identity, status = unpack(answer(lines[0])), unpack(answer(lines[-1]))
    assert (identity["id"], identity["protocol"], identity["pwm_top"], identity["pwm_hz"]) == (5, 1, 800, 20_000)
    assert (identity["table"], identity["shortest"], identity["digest"]) == (1000, 5, 0x1234)
    assert (status["id"], status["state"], status["ticks"], status["supply_mv"]) == (9, SAMPLING, 1, 5000)


def test_a_reset_by_the_watchdog_is_told(console):
    lines = console(["set watchdog 1", "reset", command("ask_status", 1), *way_to(SAMPLING)])
    assert unpack(answer(lines[2]))["cause"] == 8
    assert unpack(answer(lines[2]))["state"] == IDLE
    assert lines[-1].startswith("0:1:512:512:0:400 ")  # no cause in a sample without a fault


def test_self_test_with_broken_pulse_width_is_a_fault(console):
    lines = console(
        [
            "set pwm 1",
            command("self_test", 1),
            command("clear", 2),
            "set pwm 0",
            command("clear", 3),
            command("self_test", 4),
        ]
    )
    assert unpack(answer(lines[1]))["failed"] == 0x40
    assert stand(lines[1]).state == FAULT
    assert [code(lines[2])[0], code(lines[4])[0]] == [STATE, DONE]
    assert unpack(answer(lines[5]))["failed"] == 0
