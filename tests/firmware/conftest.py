"""The firmware, the emulated bench and the probe, built once; where tools are absent, one line says what to install."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from ambid.acquisition.devices.emulated import INSTALL, Emulator, find_firmware, find_program
from ambid.errors import DeviceError

HERE = Path(__file__).resolve().parent
BENCH = HERE.parents[1] / "firmware" / "bench"
AVR = ["-mmcu=atmega328p", "-DF_CPU=16000000UL", "-std=gnu99", "-Os", "-Wall", "-Wextra", "-Werror"]


def lacking(what):
    """Skip with what to install; in CI nothing is skipped."""
    line = f"{what}; to run it: {INSTALL}"
    if os.environ.get("CI", "").lower() in ("1", "true", "yes"):
        pytest.fail(line, pytrace=False)
    pytest.skip(line)


def _header_is_there(compiler, header, *flags):
    if shutil.which(compiler) is None:
        return False
    asked = subprocess.run(
        [compiler, *flags, "-E", "-"], input=f"#include <{header}>\n", capture_output=True, text=True
    )
    return asked.returncode == 0


@pytest.fixture(scope="session")
def avr_gcc():
    """The compiler for the controller, or a skip."""
    if not _header_is_there("avr-gcc", "avr/io.h", "-mmcu=atmega328p"):
        lacking("no avr-gcc with avr-libc")
    return "avr-gcc"


@pytest.fixture(scope="session")
def native_cc():
    """A C compiler for this machine, or a skip."""
    for name in (os.environ.get("CC"), "cc", "gcc"):
        if name and shutil.which(name):
            return name
    return lacking("no C compiler")


@pytest.fixture(scope="session")
def firmware_elf(avr_gcc):
    """The firmware as the controller runs it."""
    return _built(find_firmware)


@pytest.fixture(scope="session")
def bench_program(native_cc):
    """The emulated bench."""
    if not os.environ.get("AMBID_BENCH") and not _header_is_there(native_cc, "simavr/sim_avr.h"):
        lacking("no libsimavr")
    return _built(find_program)


def _built(find):
    try:
        return find()
    except DeviceError as error:
        pytest.fail(str(error), pytrace=False)


@pytest.fixture(scope="session")
def probe_elf(avr_gcc, tmp_path_factory):
    """The small firmware that tests the bench itself."""
    path = tmp_path_factory.mktemp("probe") / "probe.elf"
    subprocess.run([avr_gcc, *AVR, "-o", str(path), str(HERE / "probe" / "probe.c")], check=True)
    return path


@pytest.fixture
def emulated(bench_program, request, tmp_path):
    """Start emulated benches: ``emulated(plant=path, script=text, firmware=path, ...)`` gives a running `Emulator`.

    The firmware is the product's own unless told otherwise. All are ended with the test, whatever becomes of it.
    """
    running = []

    def start(plant, *, firmware=None, **options):
        elf = firmware or request.getfixturevalue("firmware_elf")
        options.setdefault("folder", tmp_path / f"bench-{len(running)}")
        one = Emulator(plant, firmware=elf, program=bench_program, **options)
        running.append(one)
        one.start()
        return one

    yield start
    for one in running:
        one.close()
