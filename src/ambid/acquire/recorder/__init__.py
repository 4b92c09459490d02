"""The recorder: an append-only journal that survives kills and power cuts, and becomes a record at the end."""

from __future__ import annotations

from ambid.acquire.recorder.convert import Recorded as Recorded
from ambid.acquire.recorder.convert import read_acquisition as read_acquisition
from ambid.acquire.recorder.convert import recorded_already as recorded_already
from ambid.acquire.recorder.convert import recorded_from as recorded_from
from ambid.acquire.recorder.layout import JournalHeader as JournalHeader
from ambid.acquire.recorder.layout import journal_path as journal_path
from ambid.acquire.recorder.layout import record_path as record_path
from ambid.acquire.recorder.reader import JournalReader as JournalReader
from ambid.acquire.recorder.recorder import Recorder as Recorder
