"""What is not good enough in a stream, one line each with its remedy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ambid.acquire.device import DeviceInfo
    from ambid.acquire.quality import ColumnQuality, QualityReport

MEASURED = ("position", "current", "extra")
"""Roles that a sensor gives; the others are what the controller orders."""

_FEWEST = 100  # samples from which on anything is said
_SATURATED = 1e-4  # of a sensor's samples
_LIMITED = 0.01  # of the samples of the voltage: the loop is not linear there
_USED = 0.05  # of the converter's range
_STILL_S = 0.5
_SNR_DB = 10.0
_RATE = 0.01
_SURE = 5.0  # standard deviations


def verdict(report: QualityReport, info: DeviceInfo) -> tuple[str, ...]:
    """Say what is not good enough.

    `report`: all but its verdict; `info`: of the device. Returns empty where all is well, or where there are too few
    samples to tell.
    """
    lines = list(_stream(report, info))
    if report.samples >= _FEWEST:
        for column in report.columns:
            if not math.isfinite(column.rms):
                lines.append(_absurd(column))
                continue
            lines += _range(column) if column.role in MEASURED else _ordered(column, report.excited)
            lines += _content(column, report) if column.role in MEASURED else []
    return tuple(lines)


def _absurd(column: ColumnQuality) -> str:
    return (
        f"{column.name} goes from {column.least:.4g} to {column.most:.4g}: too large for its mean and spread to be"
        " numbers. Look at what gives it"
    )


def _stream(report: QualityReport, info: DeviceInfo) -> Iterator[str]:
    replay = info.kind == "replay"  # what was is over: nothing of it is mended at a line or a device
    if report.lost:
        share = report.lost / (report.lost + report.samples)
        yield f"{report.lost} samples lost in {report.gaps} gaps ({share:.2%}): " + (
            "they are missing in the record that is replayed. Read it with --gaps"
            if replay
            else "the line or the host is too slow. Lower daq.rate_hz, or free the machine"
        )
    if report.repeated:
        yield f"{report.repeated} samples came twice and were left out: " + (
            "the time of the record that is replayed runs back. Look at its time column"
            if replay
            else "the device counts wrongly. Restart it"
        )
    if report.damaged:
        where = "record that is replayed" if replay else "device"
        yield f"{report.damaged} samples hold a value that is no number: left out. Look at the {where}"
    off = abs(report.measured_hz - report.rate_hz)
    # only hardware keeps the time of this world; NaN compares false
    if info.kind == "serial" and off > _RATE * report.rate_hz and off > _SURE * report.measured_sd:
        yield (
            f"{report.measured_hz:.6g} samples a second come, not {report.rate_hz:g}: the controller's clock is wrong."
            " Look at its crystal, or at the firmware's build"
        )


def _range(column: ColumnQuality) -> Iterator[str]:
    """Judge how a sensor fills its converter."""
    if column.saturated > _SATURATED:
        yield (
            f"{column.name} is at an end of the converter's range in {column.saturated:.2%} of the samples: there it is"
            " not measured. Lower the sensor's gain, shift its offset, or excite less"
        )
    elif column.used is not None and 0.0 < column.used < _USED:
        yield (
            f"{column.name} uses {column.used:.1%} of the converter's range: its steps are coarse. Raise the"
            " sensor's gain, or excite more"
        )


def _ordered(column: ColumnQuality, excited: bool) -> Iterator[str]:
    """Judge what the controller orders."""
    if column.role != "voltage":
        return
    if column.saturated > _LIMITED:
        yield (
            f"{column.name} is at its limit in {column.saturated:.1%} of the samples: the loop is not linear there."
            " Excite less, or widen daq.duty"
        )
    if excited and column.sd == 0.0:
        yield f"{column.name} stands still although an excitation was ordered. Drive or levitate to play it"


def _content(column: ColumnQuality, report: QualityReport) -> Iterator[str]:
    """Judge what is in a sensor's signal."""
    if column.sd == 0.0:
        yield f"{column.name} stands still at {column.mean:.6g}: no sensor there? Look at its cable and supply"
        return
    if report.excited and column.still_s > _STILL_S:
        yield (
            f"{column.name} stood still for {column.still_s:.2g} s although an excitation plays: the rotor rests on a"
            " stop, or a cable is loose. Look at it"
        )
    told = report.excited and column.noise_by == "periods" and column.role != "extra"
    if told and column.snr_db is not None and column.snr_db < _SNR_DB:
        rest = 1.0 / (1.0 + 10.0 ** (column.snr_db / 10.0))
        yield (
            f"{column.name}: signal over noise is {column.snr_db:.0f} dB, under {_SNR_DB:.0f}: {rest:.0%} of its power"
            " does not come from the excitation. Excite more, or in a band that the plant follows"
        )
