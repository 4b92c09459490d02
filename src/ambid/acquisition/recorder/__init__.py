"""The recorder: an append-only journal that survives kills and power cuts, and becomes a record at the end."""

from __future__ import annotations

from ambid.acquisition.recorder.convert import JournalReader as JournalReader
from ambid.acquisition.recorder.convert import Recorded as Recorded
from ambid.acquisition.recorder.convert import read_acquisition as read_acquisition
from ambid.acquisition.recorder.convert import recorded_already as recorded_already
from ambid.acquisition.recorder.convert import recorded_from as recorded_from
from ambid.acquisition.recorder.journal import JournalHeader as JournalHeader
from ambid.acquisition.recorder.journal import journal_path as journal_path
from ambid.acquisition.recorder.journal import record_path as record_path
from ambid.acquisition.recorder.recorder import Recorder as Recorder
