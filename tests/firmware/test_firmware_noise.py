"""What comes over the line and is no command, at its full rate, into the firmware that holds the emulated rotor."""

import os
import select
import time

import numpy as np
import pytest

from ambid.acquisition.protocol.codec import encode, message, unpack
from tests.firmware.controller_host import LIMIT_S
from tests.firmware.native.console import FAULT, LEVITATING
from tests.firmware.test_firmware_emulated import SILENT, bench, gains_for  # noqa: F401

STREAM = 0x0B  # position, current, pulse width


@pytest.fixture
def levitating(bench):  # noqa: F811
    """Start a bench that levitates; returns the emulator and the host."""

    def start(**limits):
        emulator, host = bench()
        host.make_ready(stream=STREAM, gains=gains_for(2000.0), limits=limits)
        host.done("start", mode=3)
        host.flow(1000)
        return emulator, host

    return start


def _feed(host, data):
    """Write all of it as fast as the line takes it, and hear meanwhile."""
    os.set_blocking(host.fd, False)
    end = time.monotonic() + LIMIT_S
    while data:
        assert time.monotonic() < end, "the line takes nothing"
        if select.select([], [host.fd], [], 0.05)[1]:
            data = data[os.write(host.fd, data) :]
        while host.hear(0.0):
            pass
    os.set_blocking(host.fd, True)


def _status(host):
    """Ask behind whatever came before, again where that swallowed the question; then nothing is left of it."""
    os.write(host.fd, b"\0")
    for _ in range(120):
        number, end = host.send("ask_status"), time.monotonic() + 0.3
        while time.monotonic() < end:
            host.hear()
            for one in host.told:
                if one.name == "status" and one["id"] == number:
                    return one
    raise AssertionError("the controller does not answer")


def _random(n, zeros=True):
    return np.random.default_rng(n).integers(0 if zeros else 1, 256, n, dtype=np.uint8).tobytes()


@pytest.mark.parametrize(
    "data",
    [bytes(1500), bytes(15_000), _random(15_000), _random(15_000, zeros=False), b"\1\1\0" * 5000],
    ids=["1500 zeros", "15000 zeros", "random", "random without zeros", "shortest damaged frames"],
)
def test_noise_at_full_rate_neither_drops_nor_stops_anything(levitating, data):
    emulator, host = levitating(host_ms=2000)  # the first questions after it may be lost
    before = len(host.samples)
    _feed(host, data)
    status = _status(host)
    assert status["state"] == LEVITATING
    assert (status["dropped"], host.lost()) == (0, 0)
    assert len(host.samples) > before + len(data) * 10e-6 * 2000  # the line took no less time than that
    # Bytes interrupt the law: some pulse widths act a period later, and each is counted.
    assert status["overruns"] < 0.25 * len(data) * 10e-6 * 2000 + 1
    assert [e["level"] for e in emulator.events("enable")] == [1]
    assert emulator.events("reset") == []
    host.done("stop")
    assert host.ask("self_test")["free_bytes"] >= 190


def test_zeros_are_no_sign_of_the_host(levitating):
    emulator, host = levitating()
    _feed(host, bytes(40_000))  # 0.4 s
    host.wait(lambda: host.samples[-1]["state"] & 15 == FAULT)
    assert host.samples[-1]["state"] >> 4 == SILENT
    assert (host.lost(), emulator.events("reset")) == (0, [])


def test_an_echo_is_no_sign_of_the_host(levitating):
    """All that the controller says comes back to it, and nothing else: it gives no answer to itself, and is alone."""
    emulator, host = levitating(host_ms=100)
    host.told.clear()
    end = time.monotonic() + LIMIT_S
    while host.samples[-1]["state"] & 15 != FAULT:
        assert time.monotonic() < end, "it takes its echo for a host"
        if select.select([host.fd], [], [], 0.2)[0]:
            heard = os.read(host.fd, 4096)
            os.write(host.fd, heard)
            for body in host.decoder.feed(heard):
                one = unpack(body)
                (host.samples if one.name == "sample" else host.told).append(one)
    assert host.samples[-1]["state"] >> 4 == SILENT
    assert not [t for t in host.told if t.name == "ack" and t["code"]]
    up, down = (e["t"] for e in emulator.events("enable"))
    assert down > up


def test_a_line_full_of_pings_is_survived_and_what_is_lost_is_told(levitating):
    """More than the controller can answer, and than any host sends."""
    emulator, host = levitating(host_ms=2000)
    _feed(host, encode(message("ping", id=255)) * 1500)
    status = _status(host)
    assert status["state"] == LEVITATING
    assert status["dropped"] >= host.lost()
    assert host.lost() < 5  # of 180
    assert status["rx_lost"] or not status["rx_errors"]
    assert emulator.events("reset") == []
