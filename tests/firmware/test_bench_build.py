"""What is said where the tools are absent: what to install, on one line; in CI nothing is skipped."""

import subprocess

import pytest

from ambid.acquisition.devices.emulated import INSTALL
from tests.firmware.conftest import BENCH, lacking

FIRMWARE = BENCH.parent


@pytest.mark.parametrize(
    ("target", "without", "what"),
    [
        ("need-avr", "AVR_CC=no-such-compiler", "firmware: no no-such-compiler"),
        ("need-simavr", "CC=no-such-compiler", "bench: no C compiler"),
        ("need-simavr", "CC=cc -nostdinc", "bench: no simavr/sim_avr.h"),
    ],
)
def test_make_names_what_to_install(native_cc, target, without, what):
    words = ["make", "-s", "-C", str(FIRMWARE), target, without]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    said = [line for line in done.stderr.splitlines() if not line.startswith("make")]
    assert done.returncode != 0
    assert len(said) == 1
    assert said[0].startswith(what)
    assert "apt-get install" in said[0]


def test_absent_tools_skip_with_the_command_that_installs_them(monkeypatch):
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match=INSTALL):
        lacking("no avr-gcc")


def test_absent_tools_fail_in_ci(monkeypatch):
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match=INSTALL):
        lacking("no avr-gcc")


def test_make_builds_anew_with_other_flags(avr_gcc, tmp_path):
    def built(*flags):
        words = ["make", "-s", "-C", str(FIRMWARE), f"BUILD={tmp_path}", "firmware", *flags]
        subprocess.run(words, check=True, capture_output=True, timeout=60)
        return (tmp_path / "amb_daq.hex").read_bytes(), (tmp_path / "amb_daq.elf").stat().st_mtime_ns

    plain = built()
    assert built() == plain  # nothing to do
    assert built("AVR_CFLAGS=-std=gnu99 -Os -DCAP_DUTY_HIGH=600")[0] != plain[0]
