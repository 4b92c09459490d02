"""Commands against a controller that answers late, wrongly or not at all."""

import threading
import time
from contextlib import suppress

import pytest

from ambid.acquisition.devices.controller import Controller
from ambid.acquisition.protocol.codec import encode, message
from ambid.errors import DeviceError
from tests.acquisition.fake import STATE, FakeController, PipePort

HANG_S = 60.0


class Session:
    """A controller with everything that it tells."""

    def __init__(self, board, port=None, **options):
        self.samples, self.told, self.lost = [], [], []
        self.port = port or PipePort(board)
        options.setdefault("answer_s", 0.05)
        self.controller = Controller(
            self.port,
            samples=lambda payloads, at: self.samples.extend(payloads),
            told=self.told.append,
            lost=self.lost.append,
            **options,
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.controller.close()


def until(true):
    end = time.monotonic() + HANG_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.002)


def refused(call, *arguments):
    with pytest.raises(DeviceError) as caught:
        call(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_command_whose_answer_is_lost_is_sent_again_and_carried_out_once():
    board = FakeController()
    with Session(board) as s:
        s.controller.identify()
        board.mute, before = 2, board.carried_out
        assert s.controller.ask("stop").name == "ack"
        assert s.controller.resent == 2
        assert board.carried_out == before + 1


def test_who_never_answers_is_given_up_with_a_remedy():
    board = FakeController()
    with Session(board) as s:
        s.controller.identify()
        board.mute = 10**9
        text = refused(s.controller.ask, "stop")
        assert "did not answer 'stop', sent 5 times" in text
        assert s.controller.resent == 4


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (("range", 9), ("host_ms = 250", "longest silence")),
        (("state", STATE["levitating"]), ("not in state levitating", "Stop it first")),
        (("unready", 0b001), ("limits, gains",)),
        (("interlock", 0), ("interlock loop is open", "emergency stop")),
        (("unknown", 0), ("no such command", "firmware of this ambid")),
    ],
)
def test_a_refusal_names_the_field_and_the_reason(answer, words):
    board = FakeController()
    fields = {"position_low": 1, "position_high": 2, "current_low": 1, "current_high": 2, "duty_low": 1}
    fields |= {"duty_high": 2, "duty_off": 1, "host_ms": 250, "lift_ms": 3}
    with Session(board) as s:
        board.refuse["limits"] = answer
        text = refused(s.controller.ask, "limits", fields)
        assert all(w in text for w in words), text
        assert "'limits'" in text


def test_a_mode_that_does_not_go_with_the_rate_is_not_blamed_on_its_number():
    board = FakeController()
    with Session(board) as s:
        board.refuse["start"] = ("range", 2)
        text = refused(s.controller.ask, "start", {"mode": 3})
        assert "'levitate'" in text
        assert "daq.rate_hz" in text


def test_another_version_is_refused_at_once():
    with Session(FakeController(version=2), answer_s=20.0) as s:
        assert "version 2" in refused(s.controller.identify)
        assert s.controller.resent == 0


@pytest.mark.parametrize(
    ("before", "words"),
    [
        (b"", ("no answer to 'identify'", "reset the board")),
        (bytes(range(1, 200)) * 4 + b"\0", ("no sound frame", "daq.baud")),
        (encode(message("ack", id=3, code=0, detail=0)), ("does not hear the host",)),
    ],
)
def test_what_stands_behind_a_port_that_gives_no_identity(before, words):
    board = FakeController()
    board.deaf = True
    port = PipePort(board)
    port.before = before
    with Session(board, port) as s:
        text = refused(s.controller.identify)
        assert all(w in text for w in words), text


def test_a_lost_line_is_told_once_and_at_once():
    board = FakeController()
    with Session(board, answer_s=HANG_S) as s:
        s.controller.identify()
        board.mute = 10**9
        threading.Timer(0.1, lambda: setattr(s.port, "lost", True)).start()
        text = refused(s.controller.ask, "stop")  # waits for no time limit
        assert "was lost" in text
        assert "by itself" in text
        assert "was lost" in refused(s.controller.ask, "stop")
        until(lambda: s.lost)
        assert len(s.lost) == 1
        assert "was lost" in str(s.controller.failure)
    assert s.port.closed


def test_a_defect_in_who_listens_is_told_and_ends_the_pings():
    class Broken:
        def extend(self, payloads):
            raise ZeroDivisionError("a tap")

    board = FakeController()
    with Session(board) as s:
        s.controller.identify()
        s.samples = Broken()
        s.controller.ask("configure", {"period": 10, "stream": 15})
        board.settings |= {"setpoint": 512, "duty_off": 400, "duty_bias": 400}
        s.controller.pace(2000.0)
        with suppress(DeviceError):  # the answer may stand behind the first sample
            s.controller.ask("start", {"mode": 1})
        until(lambda: s.lost)
        assert "ZeroDivisionError: a tap" in str(s.lost[0])
        until(lambda: not any(t.name == "ping a pipe" for t in threading.enumerate()))


def test_a_ping_takes_no_number_from_the_commands(monkeypatch):
    """Else the 255th number after a command is its own again, and what has it is taken for the same command."""
    monkeypatch.setattr("ambid.acquisition.devices.controller._PING_S", 0.001)
    board, numbers = FakeController(), []
    with Session(board) as s:
        s.controller.identify()
        carry_out = board.answer
        board.answer = lambda asked: (numbers.append((asked.name, asked["id"])), carry_out(asked))[1]
        s.controller.pace(2000.0)
        for setpoint in range(300):
            s.controller.ask("setpoint", {"setpoint": setpoint})
        until(lambda: board.pings > 300)
    pings = {number for name, number in numbers if name in ("ping", "ask_status")}
    commands = [number for name, number in numbers if name == "setpoint"]
    assert len(commands) == 300  # each was carried out
    assert not pings & set(commands)


def test_pings_come_by_samples_and_by_the_clock():
    board = FakeController()
    with Session(board) as s:
        s.controller.identify()
        assert board.pings == 0  # whoever is not known yet is not talked at
        s.controller.pace(2000.0)
        until(lambda: board.pings >= 3)  # by the clock: nothing is sampled
        s.controller.ask("configure", {"period": 10, "stream": 15})
        board.settings |= {"setpoint": 512, "duty_off": 400, "duty_bias": 400}
        s.controller.ask("start", {"mode": 1})
        until(lambda: board.ticks > 5000)
        with s.port.lock:
            pings, ticks = board.pings, board.ticks
        assert pings >= ticks / 2000.0 / 0.25  # the controller's patience is never used up
    assert threading.active_count() == 1 or not any("pipe" in t.name for t in threading.enumerate())


def test_closing_twice_is_harmless():
    with Session(FakeController()) as s:
        s.controller.close()
    assert not any("pipe" in t.name for t in threading.enumerate())
