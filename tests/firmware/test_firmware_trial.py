"""A law on trial, command by command: words in parts, arm, confirm, and the ways back to what ran before."""

import binascii
import struct

import pytest

from ambid.acquisition.law_words import law_words
from ambid.acquisition.protocol.codec import unpack
from tests.firmware.native.console import (
    EXCITATION,
    FAULT,
    IDLE,
    LEVITATING,
    Console,
    answer,
    build,
    code,
    command,
    ready,
    stand,
    way_to,
)
from tests.firmware.test_firmware_law import PID, of_six_states

RANGE, STATE = 3, 4
GAINS, LAW = 0, 1
BOUNDS, UNCONFIRMED, ASKED, ENDED = 1, 2, 3, 4
WORDS = law_words(of_six_states()).words
OTHERS = law_words(PID).words
INSIDE, OUTSIDE = "tick 512 512 0 0", "tick 620 512 0 0"


@pytest.fixture(scope="module")
def console(native_cc, tmp_path_factory):
    """The C of the firmware on this machine."""
    return Console(build(native_cc, tmp_path_factory.mktemp("console")))


def checksum(words):
    """CRC of the words, another way than the product's."""
    return binascii.crc_hqx(struct.pack(f"<{len(words)}h", *words), 0)


def parts(words, number=50, size=24):
    """Return the requests that bring the words."""
    return [
        command("law", number + k, offset=at, values=words[at : at + size])
        for k, at in enumerate(range(0, len(words), size))
    ]


def arm(words, number=60, **other):
    """Return the request that arms them."""
    fields = {"period": 10, "checksum": checksum(words), "position_low": 450, "position_high": 600, "confirm_ms": 50}
    return command("arm", number, **(fields | other))


def law_status(line):
    """Read running, trial and cause."""
    told = unpack(answer(line))
    return told["running"], told["trial"], told["cause"]


def asked(console, requests):
    """Return what runs after some requests."""
    return law_status(console([*requests, command("ask_law", 99)])[-1])


def on_trial(words=WORDS):
    """Return the requests that lead to a law on trial, while levitating with gains."""
    return [*way_to(LEVITATING), "tick 512 512 0 0", *parts(words), arm(words), INSIDE]


def test_a_law_of_idle_runs_from_the_next_start(console):
    requests = [*ready(), *parts(WORDS), arm(WORDS, confirm_ms=0)]
    assert code(console(requests)[-1]) == (0, 0)
    assert asked(console, requests) == (LAW, 0, 0)
    lines = console([*requests, command("start", 61, mode=3), INSIDE, INSIDE])
    assert stand(lines[-1]).state == LEVITATING
    # Gains that come again, as from a host that knows no law, take its place.
    assert asked(console, [*requests, ready()[2].replace("command 1303", "command 1370")]) == (GAINS, 0, 0)


def test_a_half_sent_law_never_runs(console):
    whole = parts(WORDS)
    for damaged in ([whole[0]], [whole[1]], [], [whole[0], parts(OTHERS)[0]]):
        lines = console([*way_to(LEVITATING), *damaged, arm(WORDS)])
        assert code(lines[-1]) == (RANGE, 3)
    for sound in (whole, whole[::-1], [whole[0], *whole, whole[1]]):  # in any order, and twice
        lines = console([*way_to(LEVITATING), *sound, arm(WORDS)])
        assert code(lines[-1]) == (0, 0)


@pytest.mark.parametrize(
    ("other", "field"),
    [
        ({"period": 8}, 2),
        ({"checksum": 1}, 3),
        ({"position_low": 112}, 4),
        ({"position_low": 512}, 4),
        ({"position_high": 912}, 5),
        ({"position_high": 512}, 5),
        ({"confirm_ms": 0}, 6),
        ({"confirm_ms": 20_001}, 6),
    ],
)
def test_an_arm_that_does_not_fit_is_refused(console, other, field):
    requests = [*way_to(LEVITATING), *parts(WORDS), arm(WORDS, **other)]
    assert code(console(requests)[-1]) == (RANGE, field)
    assert asked(console, [*requests, INSIDE]) == (GAINS, 0, 0)


def test_words_that_could_overflow_and_laws_too_long_for_the_tick_are_refused(console):
    wrong = (*OTHERS[:4], 32767, 0, 16385, *OTHERS[7:])
    assert code(console([*way_to(LEVITATING), *parts(wrong), arm(wrong)])[-1]) == (RANGE, 1)
    lines = console([*ready(period=8), *parts(WORDS), arm(WORDS, confirm_ms=0, period=8)])
    assert code(lines[-1]) == (RANGE, 1)
    for values, offset in (((), 0), ((1,) * 3, 43), ((1,), 45)):
        lines = console([*ready(), command("law", 50, offset=offset, values=values)])
        assert code(lines[-1])[0] == RANGE
    assert code(console([*ready(), "command 1e320000"])[-1]) == (2, 0)  # half a word


def test_the_trial_ends_as_it_should(console):
    trial = on_trial()
    assert asked(console, trial) == (LAW, 1, 0)
    assert asked(console, [*trial, command("settle", 70, keep=1)]) == (LAW, 0, 0)
    assert asked(console, [*trial, command("settle", 70, keep=0), INSIDE]) == (GAINS, 0, ASKED)
    assert asked(console, [*trial, OUTSIDE]) == (GAINS, 0, BOUNDS)
    assert asked(console, [*trial, *[INSIDE] * 99]) == (LAW, 1, 0)
    assert asked(console, [*trial, *[INSIDE] * 101]) == (GAINS, 0, UNCONFIRMED)
    assert asked(console, [*trial, command("stop", 70)]) == (GAINS, 0, ENDED)
    assert asked(console, [*trial, command("settle", 70, keep=1), *[INSIDE] * 150, OUTSIDE]) == (LAW, 0, 0)
    lines = console([*trial, OUTSIDE])
    assert stand(lines[-1]).state == LEVITATING
    assert stand(console([*trial, "tick 1000 512 0 0", "tick 1000 512 0 0"])[-1]).state in (LEVITATING, FAULT)


def test_a_return_is_told_with_its_cause_and_tick(console):
    lines = console([*on_trial(), OUTSIDE, "loop"])
    frames = [f for f in bytes.fromhex(lines[-1].split()[0]).split(b"\0") if f]
    from tests.firmware.native.line_code import opened

    told = [unpack(opened(f)) for f in frames]
    back = next(t for t in told if t.name == "law_status")
    assert (back["id"], back["running"], back["cause"], back["position"]) == (0, GAINS, BOUNDS, 620)


def test_the_same_tick_is_ordered_by_the_old_law(console):
    """The rotor leaves its bounds: the gains order at once; their derivative begins anew, their integral is small."""
    lines = console([*on_trial(), "tick 601 512 0 0"])
    duty = int(lines[-1].split()[0].split(":")[5])
    assert abs(duty - (400 - 8000 / 4096 * 89)) <= 2


def test_a_law_after_a_law_keeps_the_first_until_it_is_confirmed(console):
    first = [*on_trial(OTHERS), command("settle", 70, keep=1)]
    second = [*first, *parts(WORDS, 80), arm(WORDS, 90), INSIDE]
    assert asked(console, second) == (LAW, 1, 0)
    # The words on trial stand in the table's end: nothing may overwrite them.
    refused = [
        (command("table", 91, offset=950, values=(1,) * 4), (RANGE, 2)),
        (command("excitation", 91, **(EXCITATION | {"kind": 3, "length": 1000})), (RANGE, 5)),
        (parts(OTHERS, 91)[0], (STATE, LEVITATING)),
        (arm(OTHERS, 91), (STATE, LEVITATING)),
        (command("gains", 91, **dict.fromkeys(("kp", "ki", "kd", "pole", "kc"), 0), setpoint=512, current_rest=512,
                 duty_bias=400), (STATE, LEVITATING)),
    ]  # fmt: skip
    for request, wanted in refused:
        assert code(console([*second, request])[-1]) == wanted
    assert asked(console, [*second, OUTSIDE]) == (LAW, 0, BOUNDS)
    kept = [*second, command("settle", 92, keep=1)]
    assert code(console([*kept, command("table", 93, offset=950, values=(1,) * 4)])[-1]) == (0, 0)
    lines = console([*second, INSIDE, command("settle", 92, keep=1), command("table", 93, offset=950, values=(1,) * 4)])
    assert stand(lines[-1]).state == LEVITATING


def test_words_forget_a_loaded_table(console):
    table = command("excitation", 20, **(EXCITATION | {"kind": 3, "length": 1000}))
    lines = console([*way_to(LEVITATING), table, *parts(WORDS), command("excite", 70, on=1), INSIDE])
    assert stand(lines[-1]).playing == 0


def test_settle_needs_a_trial_and_states_are_kept_to(console):
    assert code(console([*way_to(LEVITATING), command("settle", 70, keep=1)])[-1]) == (STATE, LEVITATING)
    assert code(console([*way_to(IDLE), *parts(WORDS), arm(WORDS)])[-1]) == (RANGE, 6)
    for state in (FAULT, 2):
        lines = console([*way_to(state), parts(WORDS)[0], arm(WORDS)])
        assert [code(line)[0] for line in lines[-2:]] == [STATE, STATE]
