"""Corrections: names and times mended, records removed, what was before kept, undone, and held for later estimates."""

import math
import signal
import subprocess
import sys

import pytest

from ambid.errors import AmbidError
from ambid.ledger import open_ledger
from ambid.ledger.entry import REMOVED, Note
from ambid.ledger.store import Failure
from tests.ledger.entries import BEGIN, DAY, entry

LATE = BEGIN + 36 * 365 * DAY  # 2061


@pytest.fixture
def ledger(place):
    """Three records of "pmup 1", the last in the wrong year, and one of "pump 1"."""
    note = Note(at=LATE + 5.0, kind="change", text="it fell", parameter="k_i")
    with open_ledger(place) as opened:
        opened.add([entry(k, "pmup 1") for k in range(2)] + [entry(2, "pmup 1", taken_at=LATE, events=(note,))])
        opened.add([entry(9, "pump 1")])
        opened.fail(
            [Failure(bearing="pmup 1", record="d.h5", sha="f", rig_sha="", settings="", version="", reason="no")]
        )
        yield opened


def contents(ledger):
    """All that histories show, but for who corrected when."""
    histories = [ledger.history(b.name) for b in ledger.bearings()]
    return [
        (
            h.bearing,
            h.estimates,
            {name: (s.taken_at.tolist(), s.value.tolist()) for name, s in h.series.items()},
            h.events,
        )
        for h in histories
    ]


def test_a_bearing_gets_its_right_name_and_the_records_right_time(ledger):
    before = contents(ledger)
    renamed = ledger.correct("rename", "pmup 1", " pump  1", who="anna", why="misspelt")
    redated = ledger.correct("redate", "pump 1", BEGIN + 2 * DAY, record="day2.h5")
    assert [b.name for b in ledger.bearings()] == ["pump 1"]
    h = ledger.history("pump 1")
    assert [e.taken_at for e in h.estimates] == [BEGIN + k * DAY for k in (0, 1, 2, 9)]
    assert h["k_i"].value.tolist() == pytest.approx([80.0, 79.9, 79.8, 79.1])
    assert [n.at for n in h.events] == [BEGIN + 2 * DAY + 5.0]
    assert [f.bearing for f in ledger.failures().values()] == ["pump 1"]
    assert h.corrections == ledger.corrections() == (renamed, redated)
    assert (renamed.kind, renamed.who, renamed.why) == ("rename", "anna", "misspelt")
    assert renamed.text == "'pmup 1' became 'pump 1' (3 estimates of 3 records)"
    assert redated.text == "day2.h5 of 2061-12-23 00:00 was taken 2026-01-03 00:00 (1 estimate of 1 record)"
    assert "by anna: misspelt" in " ".join(str(h.summary()).split())
    for number in (redated.number, renamed.number):
        ledger.undo(number)
    assert contents(ledger) == before
    again = ledger.undo(4)  # the undoing of the renaming
    assert again.text.startswith("correction 4 undone (correction 1 undone")
    assert [b.name for b in ledger.bearings()] == ["pump 1"]


def test_one_record_goes_to_the_bearing_whose_it_is(ledger):
    ledger.correct("rename", "pmup 1", "pump 2", record="day1.h5")
    assert [(b.name, b.estimates) for b in ledger.bearings()] == [("pmup 1", 2), ("pump 1", 1), ("pump 2", 1)]
    assert [f.bearing for f in ledger.failures().values()] == ["pmup 1"]


def test_what_was_removed_is_seen_nowhere_and_comes_back(ledger):
    before = contents(ledger)
    gone = ledger.correct("remove", "pmup 1", why="another machine")
    assert [b.name for b in ledger.bearings()] == ["pump 1"]
    for name in ("pmup 1", REMOVED):
        with pytest.raises(AmbidError, match="has no bearing"):
            ledger.history(name)
    assert ledger.add([entry(0, "pmup 1")]) == frozenset()  # it is there
    assert ledger.stored([entry(0, "pmup 1").key])[entry(0, "pmup 1").key].bearing == REMOVED
    ledger.undo(gone.number)
    assert contents(ledger) == before
    with pytest.raises(AmbidError, match="nothing is left to be undone"):
        ledger.undo(gone.number)


def test_a_correction_holds_for_later_estimates_of_its_records(ledger):
    ledger.correct("rename", "pmup 1", "pump 1")
    ledger.correct("redate", "pump 1", BEGIN + 2 * DAY, record="day2.h5")
    ledger.correct("rename", "pump 1", "pump one")
    ledger.correct("remove", "pump one", record="day0.h5")
    newer = [entry(k, "pmup 1", version="9.0.0") for k in range(2)] + [entry(7, "pmup 1")]
    note = Note(at=LATE + 5.0, kind="change", text="it fell")
    newer.append(entry(2, "pmup 1", version="9.0.0", taken_at=LATE, events=(note,)))
    assert len(ledger.add(newer)) == 4
    h = ledger.history("pump one")
    assert [(e.record, e.version, e.taken_at) for e in h.estimates] == [
        ("day1.h5", "9.0.0", BEGIN + DAY), ("day2.h5", "9.0.0", BEGIN + 2 * DAY), ("day9.h5", "0.1.0", BEGIN + 9 * DAY),
    ]  # fmt: skip
    assert [n.at for n in h.events] == [BEGIN + 2 * DAY + 5.0]
    assert [b.name for b in ledger.bearings()] == ["pmup 1", "pump one"]  # a record of which nothing was said


def test_an_undo_takes_back_what_that_correction_changed_and_nothing_else(ledger):
    ledger.correct("rename", "pmup 1", "P")
    ledger.correct("redate", "P", BEGIN + 2 * DAY, record="day2.h5")
    ledger.undo(1)
    assert [e.taken_at for e in ledger.history("pmup 1").estimates] == [BEGIN, BEGIN + DAY, BEGIN + 2 * DAY]
    ledger.correct("rename", "pmup 1", "P")
    ledger.undo(2)
    assert [e.taken_at for e in ledger.history("P").estimates] == [BEGIN, BEGIN + DAY, LATE]


def test_an_undo_brings_back_what_came_to_the_removed_since(ledger):
    ledger.correct("remove", "pmup 1", record="day0.h5")
    ledger.add([entry(0, "pmup 1", version="9.0.0")])
    ledger.undo(1)
    assert ledger.history("pmup 1").estimates[0].version == "9.0.0"
    assert ledger.history("pmup 1").left_out == 1


def test_there_and_back_leaves_names_as_they_are(ledger):
    for names in (("pmup 1", "B"), ("B", "pmup 1"), ("pmup 1", "B"), ("B", "C")):
        ledger.correct("rename", *names)
    ledger.add([entry(0, name, sha="pmup 10", version="9.0.0", rig=name) for name in ("pmup 1", "B", "C", "D")])
    names = {b.name: b.estimates for b in ledger.bearings()}
    assert names == {"C": 3, "D": 1, "pump 1": 1}


def test_a_record_that_stands_there_already_is_told(ledger):
    ledger.add([entry(1, "pump 1", sha="pmup 11", version="0.0.9")])
    done = ledger.correct("rename", "pmup 1", "pump 1")
    assert "1 record stood there already, such as day1.h5 of 2026-01-02 00:00" in done.text
    assert [e.version for e in ledger.history("pump 1").estimates if e.record == "day1.h5"] == ["0.1.0"]


@pytest.mark.parametrize(
    ("do", "why"),
    [
        (lambda x: x.correct("rename", "pump 3", "pump 1"), r"has no bearing 'pump 3'\. Did you mean 'pump 1'\?"),
        (lambda x: x.correct("rename", "pump 1", "  "), "a bearing must have a name"),
        (lambda x: x.correct("rename", "pump 1", "pump  1"), "has that name already"),
        (lambda x: x.correct("redate", "pmup 1", BEGIN), "'pmup 1' has 3 records, and a time is that of one"),
        (lambda x: x.correct("redate", "pump 1", BEGIN + 9 * DAY), "has that time already"),
        (
            lambda x: x.correct("remove", "pmup 1", record="day3.h5"),
            "has no such record; it has day0.h5, day1.h5, day2.h5",
        ),
        (lambda x: x.correct("delete", "pump 1"), "kind is 'delete'; it is rename, redate, remove"),
        *(
            (lambda x, to=to: x.correct("redate", "pump 1", to, record="day2.h5"), "a time is a finite number")
            for to in ("", "2026", math.nan, -math.inf)
        ),
        (lambda x: x.undo(7), "has no such correction; it has none"),
    ],
)
def test_what_cannot_be_done_is_refused(ledger, do, why):
    before = contents(ledger)
    with pytest.raises(AmbidError, match=why):
        do(ledger)
    assert (contents(ledger), ledger.corrections()) == (before, ())


def test_records_of_one_name_are_told_apart_by_their_digits(tmp_path):
    with open_ledger(tmp_path / "l.db") as ledger:
        ledger.add([entry(k, record="x/day.h5", sha=f"{k}abcdef0123") for k in range(2)])
        with pytest.raises(AmbidError, match="2 records of 'A' have that name: 0abcdef0123 of 2026-01-01"):
            ledger.correct("remove", "A", record="day.h5")
        assert ledger.correct("remove", "A", record="1abcde").text == "1 estimate of 1 record of 'A' removed"


KILLED = """
import sys
from ambid.ledger import copying, correcting, open_ledger
halt = lambda *_, **__: print("half", flush=True) or sys.stdin.read()
correcting._follow = correcting.note = halt
with open_ledger(sys.argv[1]) as ledger:
    {}
"""


@pytest.mark.parametrize("do", ["ledger.correct('remove', 'pmup 1')", "ledger.restore(sys.argv[2])"])
def test_one_killed_in_the_middle_leaves_all_as_before(ledger, place, tmp_path, do):
    ledger.backup(tmp_path / "b.db")
    ledger.correct("rename", "pump 1", "pump 2")
    before = contents(ledger)
    run = subprocess.Popen(
        [sys.executable, "-c", KILLED.format(do), place, str(tmp_path / "b.db")], stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert run.stdout.readline() == "half\n"
    assert contents(ledger) == before  # while it is at work
    run.send_signal(signal.SIGKILL)
    run.communicate()
    assert (contents(ledger), len(ledger.corrections()), ledger.check()) == (before, 1, ())
    ledger.correct("remove", "pmup 1")
