"""``ambid ledger``: each verb says what it did and how that is undone."""

import sqlite3

import pytest

from ambid.ledger import open_ledger
from tests.ledger import version1
from tests.ledger.contents import contents
from tests.ledger.entries import entry


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with open_ledger("l.db") as ledger:
        ledger.add([entry(k) for k in range(5)])
    return tmp_path


def test_backed_up_restored_and_back(here, ambid):
    assert ambid("ledger", "backup", "l.db", "-o", "b.db").out == "b.db holds 5 estimates of l.db\n"
    ambid("history", "A", "--ledger", "l.db", "--remove")
    refused = ambid("ledger", "restore", "l.db", "b.db")
    assert (refused.code, "holds estimates, which would be replaced. Give -o FILE.db" in refused.err) == (2, True)
    for verb, out, why in (("restore", "b.db", "is read from"), ("backup", "l.db", "is the ledger itself")):
        refused = ambid("ledger", verb, "l.db", *(["b.db"] if verb == "restore" else []), "-o", out)
        assert (refused.code, why in refused.err) == (2, True)
    done = ambid("ledger", "restore", "l.db", "b.db", "-o", "now.db")
    said = "l.db: all replaced by 5 estimates of b.db. Undo: ambid ledger restore l.db now.db -o FILE.db\n"
    assert (done.code, done.out) == (0, said)
    assert "5 estimates" in ambid("history", "A", "--ledger", "l.db").out
    assert ambid("ledger", "restore", "l.db", "now.db", "-o", "b2.db").code == 0
    assert ambid("history", "A", "--ledger", "l.db").code == 2
    assert ambid("ledger", "restore", "new.db", "b.db").out == "new.db: all replaced by 5 estimates of b.db.\n"


def test_merged_and_thinned_and_back(here, ambid):
    before = contents("l.db")["estimate"]
    with open_ledger("m.db") as ledger:
        ledger.add([entry(k, "B") for k in range(2)])
    done = ambid("ledger", "merge", "l.db", "m.db", "--who", "anna")
    assert done.out == "l.db: 2 estimates of m.db added. Undo: ambid history --ledger l.db --undo 1\n"
    assert ambid("history", "--ledger", "l.db", "--undo", "1").code == 0
    done = ambid("ledger", "retain", "l.db", "--older-than", "1", "--keep", "year", "-o", "old.db")
    assert "6 estimates from before" in done.out
    assert done.out.endswith("but for one a year, moved to old.db. Undo: ambid ledger merge l.db old.db\n")
    assert "1 estimate," in ambid("history", "A", "--ledger", "l.db").out
    assert ambid("ledger", "merge", "l.db", "old.db").code == 0
    assert before < contents("l.db")["estimate"]


def test_checked(here, ambid):
    done = ambid("ledger", "check", "l.db")
    assert (done.code, done.out) == (0, "l.db is whole\n")
    c = sqlite3.connect("l.db")
    c.execute("UPDATE value SET taken_at = 1 WHERE estimate = 2 AND name = 'R'")
    c.commit()
    c.close()
    done = ambid("ledger", "check", "l.db")
    assert (done.code, done.out.startswith("l.db: 1 estimate with values under another bearing or time")) == (3, True)
    assert "ambid ledger restore" in done.err


def test_a_damaged_ledger_is_told_and_not_copied(here, ambid):
    c = sqlite3.connect("l.db")
    c.execute("DROP TABLE correction")
    c.close()
    done = ambid("ledger", "check", "l.db")
    assert (done.code, done.out) == (3, "l.db: table 'correction' is damaged: it lacks all of it\n")
    done = ambid("ledger", "merge", "new.db", "l.db")
    assert (done.code, "l.db is damaged: table 'correction'" in done.err) == (2, True)


def test_a_ledger_is_itself_by_any_name_and_a_folder_is_no_backup(here, ambid):
    (here / "link.db").hardlink_to("l.db")
    (here / "folder.db").mkdir()
    for words in (("merge", "l.db", "link.db"), ("retain", "l.db", "--older-than", "1", "-o", "link.db"),
                  ("backup", "l.db", "-o", "link.db")):  # fmt: skip
        done = ambid("ledger", *words)
        assert (done.code, "link.db is the ledger itself" in done.err) == (2, True)
    done = ambid("ledger", "backup", "l.db", "-o", "folder.db")
    assert (done.code, "folder.db exists, and is not a ledger" in done.err) == (2, True)


@pytest.mark.parametrize("words", [("check",), ("backup", "-o", "x.db"), ("retain", "--older-than", "1", "-o", "x.db")])
def test_a_ledger_that_is_not_there_is_not_made(here, ambid, words):
    done = ambid("ledger", words[0], "none.db", *words[1:])
    assert (done.code, done.err) == (2, "ambid: ledger none.db does not exist. Check the path\n")
    assert sorted(p.name for p in here.glob("*.db")) == ["l.db"]


@pytest.mark.parametrize("verb", ["merge", "restore"])
def test_another_ledger_that_is_not_there_leaves_no_new_one(here, ambid, verb):
    done = ambid("ledger", verb, "new.db", "none.db")
    assert (done.code, "none.db does not exist" in done.err) == (2, True)
    assert sorted(p.name for p in here.glob("*.db")) == ["l.db"]


def test_an_older_ledger_is_read_as_it_is_and_one_of_no_version_is_refused(here, ambid):
    version1.make("old.db")
    before = (here / "old.db").read_bytes()
    shown = ambid("history", "A", "--ledger", "old.db")
    assert (shown.code, ambid("history", "--ledger", "old.db", "--alarms", "usual").code) == (0, 0)
    assert (here / "old.db").read_bytes() == before
    assert ambid("ledger", "check", "old.db").out == "old.db is whole\n"
    assert ambid("history", "A", "--ledger", "old.db").out == shown.out
    for version in ("abc", "0"):
        c = sqlite3.connect("old.db")
        c.execute(f"UPDATE meta SET value = '{version}' WHERE name = 'version'")
        c.commit()
        c.close()
        refused = ambid("history", "A", "--ledger", "old.db")
        said = f"ambid: ledger old.db says that its version is '{version}'; it must be a number from 1 to 2."
        assert (refused.code, refused.err) == (2, f"{said} Restore it from a backup\n")
