"""What is known of many records: estimates of bearings over time in SQLite or PostgreSQL, and their history."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.ledger.alarm import Alarm as Alarm
    from ambid.ledger.alarm import Silence as Silence
    from ambid.ledger.entry import Correction as Correction
    from ambid.ledger.entry import Entry as Entry
    from ambid.ledger.entry import entry_of as entry_of
    from ambid.ledger.history import History as History
    from ambid.ledger.history import Series as Series
    from ambid.ledger.monitor import Watched as Watched
    from ambid.ledger.monitor import watch as watch
    from ambid.ledger.rules import RecordRule as RecordRule
    from ambid.ledger.rules import Rule as Rule
    from ambid.ledger.rules import read_rules as read_rules
    from ambid.ledger.store import FleetRun as FleetRun
    from ambid.ledger.store import Ledger as Ledger
    from ambid.ledger.store import open_ledger as open_ledger
    from ambid.ledger.telling import write_metrics as write_metrics
    from ambid.ledger.trends import Trend as Trend

__getattr__, __dir__, __all__ = exports(__name__)
