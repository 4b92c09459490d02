"""Records of LabVIEW, DAQmx and DIAdem: TDMS, read by npTDMS with its scaling."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ambid.errors import RecordError
from ambid.record.frames import imported
from ambid.record.record import Record
from ambid.record.sampling import GapPolicy
from ambid.record.streams import PIECE, Stream, chosen_group, is_time, library, record_of

_UNITS = ("unit_string", "NI_UnitDescription", "unit", "Unit", "units", "Units")


def read_tdms(
    path: Path, *, layout: Mapping[str, str], rate_hz: float | None = None, gaps: GapPolicy = "error"
) -> Record:
    """Read a record from a TDMS file: the channels of one group."""
    nptdms = imported("nptdms", "a TDMS file", "formats")
    for name in ("nptdms.reader", "nptdms.tdms_segment", "nptdms.base_segment", "nptdms.daqmx"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what it says of damage is refused below
    with library(path, "TDMS", (b"TDSm",)) as digest, nptdms.TdmsFile.open(path) as file:
        if file.file_status.incomplete_final_segment:
            raise RecordError(
                f"record {path} is cut off within its last segment: samples are missing at its end. Copy it again, or "
                "record again where the program that wrote it was stopped"
            )
        groups = {group.name: group.channels() for group in file.groups() if any(map(len, group.channels()))}
        group = chosen_group(path, {k: [c.name for c in v] for k, v in groups.items()}, layout.get("group"))
        numeric = [c for c in groups[group] if c.dtype.kind in "fiubM"]
        streams = [_stream(c) for c in numeric]
        left = [c.name for c in groups[group] if c not in numeric]
        settings = {"format": "tdms", "group": group, **({"left_out": left} if left else {})}
        return record_of(path, digest, streams, settings, layout, rate_hz, gaps)


def _stream(channel: Any) -> Stream:
    properties, time = channel.properties, is_time(channel.name)
    step = 0.0 if time else properties.get("wf_increment", 0.0)
    date = properties.get("wf_start_time")
    return Stream(
        name=channel.name, size=len(channel), time=time, pieces=lambda: _pieces(channel),
        units=frozenset(str(properties[k]).strip() for k in _UNITS if str(properties.get(k, "")).strip()),
        rate_hz=float(f"{1 / step:.10g}") if isinstance(step, float | int) and 0 < step < np.inf else None,
        start=(float(properties.get("wf_start_offset", 0.0)), "" if date is None else f"{date}Z"),
    )  # fmt: skip


def _pieces(channel: Any) -> Iterator[np.ndarray]:
    for at in range(0, len(channel), PIECE):
        yield channel.read_data(at, min(PIECE, len(channel) - at))
