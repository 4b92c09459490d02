"""Ports that cannot be opened: each refusal has its own remedy."""

import errno
import os

import pytest
import serial

from ambid.acquisition.devices import controller as ports
from ambid.acquisition.devices.controller import candidate_ports, open_port
from ambid.errors import DeviceError
from tests.acquisition.fake import FakeController, PtyBoard


def refusal(name, **options):
    with pytest.raises(DeviceError) as caught:
        open_port(name, baud=1_000_000, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_port_that_is_not_there_and_those_that_are(monkeypatch):
    monkeypatch.setattr(ports, "candidate_ports", lambda: ("/dev/ttyACM7 (Uno)",))
    assert "does not exist; there are /dev/ttyACM7 (Uno)" in refusal("/dev/ttyACM0")
    monkeypatch.setattr(ports, "candidate_ports", tuple)
    assert "no serial port with a device is there" in refusal("/dev/ttyACM0")


def test_a_port_that_another_program_has_open():
    with PtyBoard(FakeController()) as board:
        first = open_port(board.port, baud=1_000_000)
        text = refusal(board.port)
        assert "is busy" in text
        assert "serial monitor" in text
        first.close()
        first.close()
        open_port(board.port, baud=1_000_000).close()


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EACCES, ("dialout", "usermod")),
        (errno.EBUSY, ("is busy",)),
        (errno.ENXIO, ("does not exist",)),
        (errno.EIO, ("cannot be opened", "cable")),
    ],
)
def test_each_refusal_of_the_system_has_its_remedy(monkeypatch, number, words):
    def refuse(self):
        raise serial.SerialException(number, f"could not open port: {os.strerror(number)}")

    monkeypatch.setattr(serial.Serial, "open", refuse)
    text = refusal("/dev/ttyUSB0")
    assert all(w in text for w in words), text


def test_a_file_is_no_port(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("x", encoding="utf-8")
    assert str(path) in refusal(str(path))


def test_a_board_that_is_unplugged_while_it_starts(monkeypatch):
    board = PtyBoard(FakeController())
    sit_out = ports._sit_out

    def unplugged(line, boot_s):
        os.close(board.master)
        sit_out(line, boot_s)

    monkeypatch.setattr(ports, "_sit_out", unplugged)
    assert "was lost while its board started" in refusal(board.port, boot_s=0.0)


def test_bytes_from_before_are_discarded_and_a_pulled_cable_is_an_os_error():
    board = PtyBoard(FakeController())
    os.write(board.master, b"boot loader noise\n")
    port = open_port(board.port, baud=1_000_000)
    assert port.read() == b""
    os.write(board.master, b"abc")
    seen = b""
    while len(seen) < 3:
        seen += port.read()
    assert seen == b"abc"
    board.thread.start()
    board.pull()
    with pytest.raises(OSError):  # noqa: PT012 - it may take some reads
        for _ in range(1000):
            port.read()
    port.close()


def test_a_board_that_resets_when_its_port_is_opened_is_waited_for_in_silence(monkeypatch):
    board = PtyBoard(FakeController())
    slept = []

    def sleep(seconds):
        if not slept:
            os.write(board.master, b"boot loader noise")
        slept.append(seconds)

    monkeypatch.setattr(ports.time, "sleep", sleep)
    port = open_port(board.port, baud=1_000_000, boot_s=0.01)
    monkeypatch.undo()
    assert slept
    assert port.read() == b""
    with pytest.raises(BlockingIOError):
        os.read(board.master, 1)  # nothing was said to the boot loader
    port.close()
    board.thread.start()
    board.pull()


def test_a_closed_port_raises_what_a_lost_one_does():
    with PtyBoard(FakeController()) as board:
        port = open_port(board.port, baud=1_000_000)
        port.close()
        for call, arguments in ((port.read, ()), (port.write, (b"x",))):
            with pytest.raises(OSError):
                call(*arguments)


def test_candidates_are_one_line_each():
    assert all("\n" not in c for c in candidate_ports())
