"""The firmware and the emulated bench, built once, are those of tests/firmware."""

from tests.firmware.conftest import avr_gcc, bench_program, firmware_elf, native_cc

__all__ = ["avr_gcc", "bench_program", "firmware_elf", "native_cc"]
