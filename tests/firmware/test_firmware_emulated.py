"""The firmware's own binary on the emulated bench: self-test, flow, levitation, and the safe state within 2 ms."""

import binascii
import subprocess

import pytest

from ambid.acquisition.devices.emulated import Emulator
from ambid.physics.loop import placed_loop
from tests.firmware.conftest import AVR
from tests.firmware.controller_host import Host
from tests.firmware.native.console import FAULT, FIRMWARE, IDLE, LEVITATING

PLANT = {"m": 0.1, "k_x": -2000.0, "k_i": 20.0, "R": 4.0, "L": 0.02, "c": 0.0}
BENCH = {
    "stop_low": -5e-4,
    "stop_high": 5e-4,
    "start_position": -4e-4,
    "high_voltage": 12.0,
    "low_voltage": -12.0,
    "position_gain": 4000.0,
    "position_offset": 2.5,
    "current_gain": 0.8,
    "current_offset": 2.5,
    "third_position_gain": 4000.0,
    "third_offset": 2.5,
    "position_noise": 5e-7,
}
OVER_CURRENT, OUT_OF_GAP, INTERLOCK, LINE_BREAK, SILENT = 3, 4, 5, 6, 2


def gains_for(rate_hz):
    """Return those of the protocol for a loop with poles at some 30 Hz."""
    loop = placed_loop(PLANT, (-150, -180, -200 + 100j, -200 - 100j), derivative_cutoff_hz=1000.0)
    count_m, count_a, count_v = 5 / 1024 / 4000, 5 / 1024 / 0.8, 24 / 800
    period, tau = 1 / rate_hz, loop.filter_s
    return {
        "kp": round(loop.kp * count_m / count_v * 4096),
        "ki": round(loop.ki * period * count_m / count_v * 65536),
        "kd": round(loop.kd / (tau + period) * count_m / count_v * 4096),
        "pole": round(tau / (tau + period) * 65536),
        "kc": round(loop.kc * count_a / count_v * 4096),
    }


@pytest.fixture
def bench(tmp_path, firmware_elf, bench_program):
    """Start benches that end with the test."""
    running = []

    def start(*, script=None, firmware=firmware_elf):
        plant = tmp_path / "bench.plant"
        numbers = "".join(f"{k} {v}\n" for k, v in (PLANT | BENCH).items())
        plant.write_text("kind linear\n" + numbers, encoding="utf-8")
        emulator = Emulator(plant, firmware=firmware, program=bench_program, script=script, folder=tmp_path)
        emulator.start()
        running.append(emulator)
        host = Host(emulator.port)
        running.append(host)
        return emulator, host

    yield start
    for one in reversed(running):
        one.close()


def _image(elf, tmp_path):
    """The bytes of the program memory."""
    path = tmp_path / "image.bin"
    subprocess.run(["avr-objcopy", "-O", "binary", "-R", ".eeprom", str(elf), str(path)], check=True)
    return path.read_bytes()


def test_identity_and_self_test(bench, firmware_elf, tmp_path):
    _, host = bench()
    identity = host.ask("identify")
    assert identity["digest"] == binascii.crc_hqx(_image(firmware_elf, tmp_path), 0)
    result = host.ask("self_test")
    assert result["failed"] == 0
    assert abs(result["supply_mv"] - 5000) < 30
    assert result["position"] == pytest.approx(102, abs=2)  # on the lower stop
    assert result["current"] == pytest.approx(512, abs=2)
    assert result["free_bytes"] > 150


@pytest.mark.parametrize(("period", "stream"), [(10, 0x0F), (5, 0x0F), (5, 0x3F)])
def test_samples_flow_without_loss(bench, period, stream):
    emulator, host = bench()
    host.make_ready(period=period, stream=stream)
    host.done("start", mode=1)
    host.flow(5000)
    status = host.ask("ask_status")
    assert host.lost() == 0
    assert [status[k] for k in ("overruns", "dropped", "rx_errors", "rx_lost")] == [0, 0, 0, 0]
    assert 0 < status["busy_us"] < period * 50
    counters = host.decoder.counters
    assert counters.discarded_bytes == 0
    assert all(len(s.values) == bin(stream).count("1") for s in host.samples)
    _all_was_heard_in_time(emulator)


def _all_was_heard_in_time(emulator):
    """No byte found the receiver with two unread ones: on hardware it would have been lost."""
    emulator.close(keep=True)
    assert emulator.events("end")[0]["late"] == 0


def test_the_unstable_rotor_is_held(bench):
    emulator, host = bench()
    host.make_ready(gains=gains_for(2000.0), stream=0x1F)
    host.done("excitation", kind=2, amplitude=10, hold=4, length=8, cycles=2, seed=1)
    host.done("start", mode=3)
    host.flow(1000)
    quiet = [s.values[0] for s in host.samples[600:1000]]
    assert abs(sum(quiet) / len(quiet) - 512) < 5
    assert max(abs(x - 512) for x in quiet) < 60  # of 410 counts to either stop
    host.done("excite", on=1)
    host.flow(3000)
    played = [s.values[4] for s in host.samples if s.values[4]]
    assert len(played) == 2 * 255 * 4
    assert {v - 65536 if v > 32767 else v for v in played} <= {-10, 10}
    status = host.ask("ask_status")
    assert (status["state"], status["dropped"], host.lost()) == (LEVITATING, 0, 0)
    assert status["overruns"] <= 0.001 * len(host.samples)  # a command may make a pulse width act a period later
    assert status["busy_us"] < 400
    host.done("stop")
    assert [e["level"] for e in emulator.events("enable")] == [1, 0]
    _all_was_heard_in_time(emulator)


@pytest.mark.parametrize("off", [0, 800])
def test_the_safe_pulse_width_never_drives(bench, off):
    """It may lie outside what the output may have: ENABLE rises once another one acts, and falls before it does."""
    emulator, host = bench()
    host.make_ready(period=10, limits={"position_low": 60, "duty_low": 300, "duty_high": 600, "duty_off": off})
    for mode in (2, 3, 2):
        host.done("start", mode=mode)
        host.flow(30)
        host.done("stop")
    edges = emulator.events("enable")
    assert [e["level"] for e in edges] == [1, 0] * 3
    assert all(300 <= e["duty"] <= 600 for e in edges)


@pytest.mark.parametrize("period", [20, 11, 10, 8])
@pytest.mark.parametrize(
    ("event", "cause"),
    [
        ("interlock open", INTERLOCK),
        ("cable cut low", LINE_BREAK),
        ("override current 4.9", OVER_CURRENT),
        ("override position 0.1", OUT_OF_GAP),
    ],
)
def test_safe_state_within_two_milliseconds(bench, period, event, cause):
    emulator, host = bench(script=f"+0.0503 {event}\n+1.5 cable mend\n")
    host.make_ready(period=period, limits={"position_low": 60, "lift_ms": 0})
    host.done("start", mode=2)
    # With the cable cut nothing is heard until it is mended; then the samples say it.
    host.wait(lambda: host.samples and host.samples[-1]["state"] & 15 == FAULT)
    assert host.samples[-1]["state"] >> 4 == cause
    first = [e for e in emulator.events("script") if "mend" not in str(e)][-1]["t"]
    down = next(e["t"] for e in emulator.events("enable") if e["level"] == 0)
    assert 0 < (down - first) * 1e3 < 2.0


def test_silent_host(bench):
    emulator, host = bench(script="+0.05 lockstep 0\n+0.05 cable cut\n+1.0 cable mend\n")
    host.make_ready(limits={"position_low": 60, "host_ms": 250})
    host.done("start", mode=2)
    host.wait(lambda: host.samples and host.samples[-1]["state"] & 15 == FAULT)
    assert host.samples[-1]["state"] >> 4 == SILENT
    up, down = (e["t"] for e in emulator.events("enable"))
    # Its last frame came at most 100 ms, for which emulated time waits, before the cut, and at the latest with it.
    assert 0.05 + 0.250 - 0.1 < down - up < 0.05 + 0.250 + 0.002


HANG = """
#include <avr/interrupt.h>
#include <avr/io.h>
#include "app.h"
static unsigned passes __attribute__((section(".noinit")));
static unsigned hung __attribute__((section(".noinit")));
int main(void)
{
    amb_setup();
    if (hung != 0x5aa5)
        for (passes = 0; passes < 3000 || !(PORTB & 1); passes++)
            amb_loop();
    if (hung != 0x5aa5) {
        hung = 0x5aa5;
        HOW;
        PORTB &= ~1; /* the log tells the time */
        PORTB |= 1;
        for (;;)
            ;
    }
    for (;;)
        amb_loop();
}
"""


def _hears_again(host):
    """Ping until answers come: what is sent while the controller starts is lost."""
    host.told.clear()
    host.wait(lambda: len(host.told) >= 3)


@pytest.mark.parametrize(
    ("how", "off_ms", "reset_ms"),
    [("", 12.0, 16.0), ("MCUSR = 0", 12.0, 16.0), ("TIMSK2 = 0", 16.0, 16.0), ("cli()", 16.0, 16.0)],
)
def test_a_hanging_program_is_switched_off_and_restarted(bench, tmp_path, avr_gcc, how, off_ms, reset_ms):
    main = tmp_path / "hang.c"
    main.write_text(HANG.replace("HOW", how), encoding="utf-8")
    elf = tmp_path / "hang.elf"
    sources = [str(p) for p in sorted(FIRMWARE.glob("*.c")) if p.name != "main.c"]
    subprocess.run([avr_gcc, *AVR, f"-I{FIRMWARE}", "-o", str(elf), str(main), *sources], check=True)
    emulator, host = bench(firmware=elf)
    host.make_ready(limits={"position_low": 60})
    host.done("start", mode=2)
    host.wait(lambda: emulator.events("reset"))
    _hears_again(host)
    _, hangs, _, off = (e["t"] for e in emulator.events("enable"))
    reset = emulator.events("reset")[0]["t"]
    # The watchdog was fed a little before.
    assert off_ms - 1.0 < 1e3 * (off - hangs) < off_ms + 1.0
    assert reset_ms - 1.0 < 1e3 * (reset - hangs) < reset_ms + 1.0
    status = host.ask("ask_status")
    assert (status["state"], status["cause"]) == (IDLE, 8)
    assert host.ask("start", mode=1)["code"] == 5  # nothing of before is there
    host.make_ready()
    host.done("start", mode=1)
    host.flow(200)  # longer than the watchdog that the reset left running
    assert len(emulator.events("reset")) == 1


BUTTON = """
#include <avr/io.h>
#include <avr/wdt.h>
#include "app.h"
static unsigned boots __attribute__((section(".noinit")));
static unsigned began __attribute__((section(".noinit")));
/* A bootloader that clears the cause and lets the program begin by its own watchdog, as after the reset button. */
static void bootloader(void) __attribute__((naked, used, section(".init1")));
static void bootloader(void)
{
    if (began != 0x5aa5) {
        began = 0x5aa5;
        boots = 0;
    }
    MCUSR = 0;
    boots++;
}
int main(void)
{
    amb_setup();
    if (boots == 1) {
        __asm__ volatile("cli");
        for (;;)
            ;
    }
    for (;;)
        amb_loop();
}
"""


def test_a_bootloaders_own_watchdog_is_no_hang(bench, tmp_path, avr_gcc):
    main = tmp_path / "button.c"
    main.write_text(BUTTON, encoding="utf-8")
    elf = tmp_path / "button.elf"
    sources = [str(p) for p in sorted(FIRMWARE.glob("*.c")) if p.name != "main.c"]
    subprocess.run([avr_gcc, *AVR, f"-I{FIRMWARE}", "-o", str(elf), str(main), *sources], check=True)
    emulator, host = bench(firmware=elf)
    host.wait(lambda: emulator.events("reset"))
    _hears_again(host)
    status = host.ask("ask_status")
    assert (status["state"], status["cause"]) == (IDLE, 0)
