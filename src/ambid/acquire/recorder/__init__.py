"""The recorder: an append-only journal that survives kills and power cuts, and becomes a record at the end."""

from __future__ import annotations

from ambid.acquire.recorder.convert import Recorded, read_acquisition, recorded_already, recorded_from
from ambid.acquire.recorder.layout import Event, JournalHeader, journal_path, record_path
from ambid.acquire.recorder.reader import Damage, JournalReader, Survey, survey
from ambid.acquire.recorder.recorder import Recorder

__all__ = [
    "Damage",
    "Event",
    "JournalHeader",
    "JournalReader",
    "Recorded",
    "Recorder",
    "Survey",
    "journal_path",
    "read_acquisition",
    "record_path",
    "recorded_already",
    "recorded_from",
    "survey",
]
