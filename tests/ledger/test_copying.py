"""Ledgers copied: merged, backed up, restored, thinned into an archive; between files and servers, and an older one."""

import sqlite3

import pytest
from sqlalchemy import text

from ambid.errors import AmbidError
from ambid.ledger import open_ledger
from ambid.ledger.entry import REMOVED, Note
from ambid.ledger.store import Failure
from tests.ledger import version1
from tests.ledger.contents import contents
from tests.ledger.entries import BEGIN, DAY, entry

LACK = {"bearing": "A", "record": "d.h5", "rig_sha": "", "settings": "", "version": "", "reason": "no"}


def fill(place):
    """A ledger with all that one can hold."""
    with open_ledger(place) as ledger:
        notes = (Note(at=BEGIN + 5.0, kind="change", text="it fell", parameter="k_i"),)
        ledger.add([entry(k, name, document=f'{{"a": {k}}}', events=notes) for k in range(4) for name in ("A", "B")])
        ledger.fail([Failure(**LACK, sha="f")])
        ledger.correct("rename", "B", "pump 1", who="anna", why="misspelt")
        ledger.correct("remove", "A", record="day0.h5")
        with ledger._engine.begin() as c:
            c.execute(
                text(f"INSERT INTO silence VALUES (1, 5, 'silenced', 'A', 'k_i -5 %', 'k_i', {BEGIN}, NULL, 'x', 'y')")
            )
    return contents(place)


def test_a_backup_holds_all_and_is_restored(place, tmp_path):
    before, backup = fill(place), tmp_path / "backup.db"
    with open_ledger(place) as ledger:
        assert ledger.backup(backup) == 8
        assert contents(backup) == before
        assert [p.name for p in tmp_path.glob("backup*")] == ["backup.db"]
        ledger.correct("remove", "pump 1")
        ledger.add([entry(9, "C")])
        done = ledger.restore(backup, who="anna")
        after = contents(place)
        assert after.pop("correction") - before.pop("correction") == {(done.at, "anna", "restore", "", done.text, "")}
        assert after == before
        assert len(ledger.add([entry(k, "D") for k in range(3)])) == 3  # numbers go on
        assert (ledger.check(), ledger.backup(backup)) == ((), 11)


def test_two_ledgers_become_one_and_what_both_have_stays(place, tmp_path):
    fill(place)
    with open_ledger(tmp_path / "other.db") as other:
        other.add([entry(k, "B") for k in range(2, 7)] + [entry(0, "A"), entry(0, "E", document="{}")])
        other.correct("rename", "E", "pump 5")
        other.fail([Failure(**LACK, sha="g")])
    with open_ledger(place) as ledger:
        done = ledger.merge(tmp_path / "other.db")
        assert done.text == f"4 estimates of {tmp_path / 'other.db'} added"
        assert [(b.name, b.estimates) for b in ledger.bearings()] == [("A", 3), ("B", 3), ("pump 1", 4), ("pump 5", 1)]
        assert ledger.stored([entry(0, "A").key])[entry(0, "A").key].bearing == REMOVED  # it stays removed
        assert ledger.documents([entry(0, "E").key])[entry(0, "E").key][-1] == "{}"
        assert sorted(f.sha for f in ledger.failures().values()) == ["f", "g"]
        whole = contents(place)
        assert ledger.merge(tmp_path / "other.db").text.startswith("0 estimates")
        ledger.undo(done.number)
        assert [b.name for b in ledger.bearings()] == ["A", "pump 1"]
        again = contents(place)
        assert again["estimate"] != whole["estimate"]
        assert ledger.check() == ()


def test_what_is_old_moves_into_an_archive_and_comes_back(place, tmp_path):
    with open_ledger(place) as ledger:
        verdicts = {3: "usable", 40: "usable"}
        days = (0, 3, 10, 31, 40, 59, 70, 80)
        ledger.add([entry(k, verdict=verdicts.get(k, "caution"), document="{}") for k in days])
        ledger.add([entry(3, version="0.0.1")])
        before = contents(place)
        done = ledger.retain(tmp_path / "old.db", before=BEGIN + 59.5 * DAY, keep="month")
        assert (
            done.text
            == f"4 estimates from before 2026-03-01 12:00, but for one a month, moved to {tmp_path / 'old.db'}"
        )
        assert [e.record for e in ledger.history("A").estimates] == [f"day{k}.h5" for k in (3, 40, 59, 70, 80)]
        assert len(contents(place)["document"]) == 5
        assert ledger.add([entry(k) for k in days]) == frozenset()  # none is done again
        assert ledger.documents([entry(0).key])[entry(0).key] == ("converged", "caution", "", "")
        assert ledger.check() == ()
        with open_ledger(tmp_path / "old.db") as old:
            assert [e.record for e in old.history("A", every=True).estimates] == [f"day{k}.h5" for k in (0, 3, 10, 31)]
            assert old.check() == ()
        with pytest.raises(AmbidError, match="'ambid ledger merge'"):
            ledger.undo(done.number)
        ledger.merge(tmp_path / "old.db")
        after = contents(place)
        assert {k: v for k, v in after.items() if k != "correction"} == {
            k: v for k, v in before.items() if k != "correction"
        }


def test_a_ledger_of_the_version_before_is_copied_from_and_stays(tmp_path):
    version1.make(str(tmp_path / "old.db"))
    bytes_before = (tmp_path / "old.db").read_bytes()
    with open_ledger(tmp_path / "new.db") as ledger:
        assert ledger.merge(tmp_path / "old.db").text.startswith("6 estimates")
    assert (tmp_path / "old.db").read_bytes() == bytes_before


def test_nothing_is_copied_onto_itself_or_onto_what_is_no_ledger(place, tmp_path):
    before = fill(place)
    (tmp_path / "text.txt").write_text("notes")
    with open_ledger(place) as ledger, open_ledger(tmp_path / "open.db") as other:
        other.add([entry(0)])
        for do in (ledger.merge, ledger.restore, lambda x: ledger.retain(x, before=2 * BEGIN)):
            with pytest.raises(AmbidError, match="is the ledger itself"):
                do(place)
        with pytest.raises(AmbidError, match="is not a ledger of ambid"):
            ledger.backup(tmp_path / "text.txt")
        with pytest.raises(AmbidError, match="that a program has open"):
            ledger.backup(tmp_path / "open.db")
        with pytest.raises(AmbidError, match="there is no folder"):
            ledger.backup(tmp_path / "none" / "b.db")
    assert contents(place) == before


DAMAGE = {
    "UPDATE value SET taken_at = taken_at + 1 WHERE estimate = ": "with values under another bearing or time",
    "UPDATE estimate SET version = '9' WHERE id = ": "1 estimate with another key than their record and rig: number ",
    "UPDATE document SET json = '' WHERE estimate = ": "1 estimate with a document that cannot be read: number ",
    "DELETE FROM rig WHERE 0 < ": "8 estimates with no text of their rig: number ",
    "UPDATE event SET bearing = (SELECT max(id) FROM bearing) WHERE estimate = ": "events under another bearing",
}


def test_a_check_names_what_does_not_agree_and_a_damaged_backup_is_not_restored(place, tmp_path):
    with open_ledger(place) as ledger:
        notes = (Note(at=BEGIN, kind="change", text="it fell"),)
        ledger.add([entry(k, name, document="{}", events=notes) for k in range(4) for name in ("A", "B")])
        assert ledger.check() == ()
        for damage, said in DAMAGE.items():
            ledger.backup(tmp_path / "b.db")
            with ledger._engine.begin() as c:
                c.execute(text(f"{damage} (SELECT min(id) FROM estimate)"))
            (wrong,) = ledger.check()
            assert said in wrong
            ledger.restore(tmp_path / "b.db")
            assert ledger.check() == ()


def test_a_file_with_a_broken_page_is_told_and_not_restored(tmp_path):
    with open_ledger(tmp_path / "l.db") as ledger:
        ledger.add([entry(k, document="x" * 50) for k in range(300)])
        ledger.backup(tmp_path / "b.db")
    c = sqlite3.connect(tmp_path / "b.db")
    size, page = (
        c.execute("PRAGMA page_size").fetchone()[0],
        c.execute("SELECT rootpage FROM sqlite_master WHERE name = 'document'").fetchone()[0],
    )
    c.close()
    with (tmp_path / "b.db").open("r+b") as file:
        file.seek((page - 1) * size)
        file.write(b"\xff" * size)
    with open_ledger(tmp_path / "b.db") as broken:
        assert "malformed" in " ".join(broken.check()) or "SQLite" in " ".join(broken.check())
    with open_ledger(tmp_path / "l.db") as ledger, pytest.raises(AmbidError, match=r"is damaged: .* Restore another"):
        ledger.restore(tmp_path / "b.db")
    with open_ledger(tmp_path / "l.db") as ledger:
        assert len(ledger.history("A").estimates) == 300
