"""The ledger on both engines: stored once, all or nothing, by several writers at once, and only what it is."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np
import pytest

from ambid.errors import AmbidError
from ambid.ledger import open_ledger, opening, store
from ambid.ledger.entry import Note, key_of, moment, settings_text
from ambid.ledger.store import Failure
from tests.ledger.entries import entry, parameter


def test_what_is_stored_comes_back(place):
    note = Note(at=5.0, kind="change", text="it fell", parameter="k_i")
    made = [entry(k, events=(note,) if k == 1 else (), document='{"a": 1}' if k == 2 else "") for k in range(3)]
    with open_ledger(place) as ledger:
        assert len(ledger.add(made)) == 3
    with open_ledger(place, write=False) as ledger:
        found = ledger.history("A")
        (known,) = ledger.bearings()
        assert "secret" not in ledger.shown
    assert found["k_i"].value == pytest.approx([80.0, 79.9, 79.8])
    assert (found["R"].unit, found["R"].sd[0], found["R"].identifiable.all()) == ("ohm", 0.02, True)
    assert (known.name, known.plant, known.estimates) == ("A", "bench A", 3)
    assert found.events == (note,)


def test_the_same_estimate_counts_once(place):
    with open_ledger(place) as ledger:
        first = ledger.add([entry(0), entry(1), entry(1)])
        again = ledger.add([entry(1), entry(2)])
        assert first == set(ledger.documents([entry(0).key, entry(1).key, "none"]))
        assert again == {entry(2).key}
        assert ledger.history("A")["k_i"].value.size == 3
        assert ledger.add([]) == frozenset()


def test_what_failed_is_named_until_it_is_estimated(place):
    failed = {"bearing": "A", "record": "day0.h5", "rig_sha": "one", "settings": "{}", "version": "0.1.0"}
    with open_ledger(place) as ledger:
        for reason in ("killed", "out of memory"):
            ledger.fail([Failure(**failed, sha="A0", reason=reason), Failure(**failed, sha="A9", reason=reason)])
        assert {f.reason for f in ledger.failures().values()} == {"out of memory"}
        ledger.add([entry(0)])
        assert [f.sha for f in ledger.failures().values()] == ["A9"]


def test_what_is_not_identifiable_is_no_value(place):
    seen = [parameter("k_i", 80.0, 0.5), parameter("k_i", 5.0, 90.0, seen=False), parameter("k_i", 3.0, 0.1)]
    seen += [parameter("k_i", 7.0, np.inf), parameter("k_i", np.nan, 1.0)]
    verdicts = ["usable", "caution", "unusable", "usable", "usable"]
    with open_ledger(place) as ledger:
        ledger.add([entry(k, parameters=(p,), verdict=v) for k, (p, v) in enumerate(zip(seen, verdicts, strict=True))])
        found = ledger.history("A")
    assert found["k_i"].identifiable.tolist() == [True, False, True, False, False]
    assert np.isnan(found["k_i"].value).tolist() == [False, True, True, True, True]


WRITER = """
import sys
from ambid.ledger import open_ledger
from tests.ledger.entries import entry
place, first = sys.argv[1], int(sys.argv[2])
with open_ledger(place) as ledger:
    new = sum(len(ledger.add([entry(k, f"B{k % 7}") for k in range(a, a + 25)])) for a in range(first, first + 500, 25))
print(new)
"""


def writer(*words):
    return subprocess.Popen([sys.executable, "-c", WRITER, *map(str, words)], stdout=subprocess.PIPE, text=True)


def test_a_number_that_some_estimates_lack_stands_at_the_times_of_the_others(place):
    with open_ledger(place) as ledger:
        for k in range(8):
            names = ("k_i", "k_x") if k % 3 else ("k_i",)
            numbers = tuple(parameter(n, 100.0 + k, 0.5, role="prior" if k == 7 else "free") for n in names)
            ledger.add([entry(k, day=k // 2, parameters=numbers)])  # two records of each day
        found = ledger.history("A")
    for name, there in (("k_i", range(8)), ("k_x", (1, 2, 4, 5, 7))):
        s = found[name]
        records = [found.estimates[at].record for at in s.estimate]
        assert sorted(records) == [f"day{k}.h5" for k in there]
        assert [f"day{x - 100:.0f}.h5" for x in s.value] == records
        assert s.taken_at.tolist() == [found.estimates[at].taken_at for at in s.estimate]
        assert s.role == "prior"  # as the last one


def test_two_writers_at_once_lose_nothing_and_repeat_nothing(place):
    """Both begin where there is no ledger yet."""
    runs = [writer(place, first) for first in (0, 250)]
    new = [int(run.communicate(timeout=300)[0]) for run in runs]
    assert sum(new) == 750
    with open_ledger(place, write=False) as ledger:
        assert sum(b.estimates for b in ledger.bearings()) == 750
        found = [ledger.history(f"B{k}") for k in range(7)]
    assert sorted(e.record for h in found for e in h.estimates) == sorted(f"day{k}.h5" for k in range(750))
    assert sum(h["k_i"].value.size for h in found) == 750


def test_an_empty_database_is_one_that_another_writer_is_about_to_fill(tmp_path):
    sqlite3.connect(tmp_path / "l.db").execute("PRAGMA journal_mode = WAL").close()
    with open_ledger(tmp_path / "l.db") as ledger:
        assert len(ledger.add([entry(0)])) == 1


@pytest.mark.skipif(not hasattr(os, "seteuid"), reason="file rights as Linux and macOS have them")
def test_a_ledger_in_a_folder_that_may_not_be_written_to_is_read(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shared")
    with open_ledger(folder / "l.db") as ledger:
        ledger.add([entry(0)])
    log, who = folder / "l.db-wal", os.geteuid()
    log.touch()
    with ExitStack() as stack:
        for place in (folder, *folder.parents[:3]):
            stack.callback(place.chmod, place.stat().st_mode)
            place.chmod(place.stat().st_mode | 0o755)
        folder.chmod(0o555)
        if who == 0:  # to whom no right is refused
            stack.callback(os.seteuid, 0)
            os.seteuid(65534)
        with open_ledger(folder / "l.db", write=False) as ledger:
            assert [b.estimates for b in ledger.bearings()] == [1]
        with pytest.raises(AmbidError, match="Nothing of this was stored"), open_ledger(folder / "l.db") as ledger:
            ledger.add([entry(1)])
        os.seteuid(who)
        log.write_bytes(b"what a writer left")
        if who == 0:
            os.seteuid(65534)
        with pytest.raises(AmbidError, match="a writer has left"):
            open_ledger(folder / "l.db", write=False)


def test_a_batch_that_fails_in_the_middle_leaves_nothing(place, monkeypatch):
    with open_ledger(place) as ledger:
        ledger.add([entry(0)])
        monkeypatch.setattr(
            store, "_document", lambda *_: {"estimate": -1, "json": b"", "covariance": b""}
        )  # no such one
        with pytest.raises(AmbidError, match="Nothing of this was stored"):
            ledger.add([entry(k, "new", document="{}") for k in range(1, 5)])
        assert [b.name for b in ledger.bearings()] == ["A"]
        assert ledger.documents([entry(k, "new").key for k in range(5)]) == {}


def test_a_newer_ledger_is_refused(place, monkeypatch):
    with open_ledger(place) as ledger:
        ledger.add([entry(0)])
    monkeypatch.setattr("ambid.ledger.entry.VERSION", 3)
    monkeypatch.setattr("ambid.ledger.entry.STEPS", {2: ("ALTER TABLE event ADD COLUMN more TEXT",)})
    open_ledger(place).close()
    monkeypatch.undo()
    for write in (True, False):
        with pytest.raises(AmbidError, match="is of version 3; this ambid reads 2"):
            open_ledger(place, write=write)


def test_covariance_and_document_stand_beside(tmp_path):
    covariance = np.array([[1.0, 0.5], [0.5, 2.0]])
    with open_ledger(tmp_path / "l.db") as ledger:
        ledger.add([entry(0, covariance=covariance, covariance_names=("k_i", "R"), document='{"schema": "x"}')])
    c = sqlite3.connect(tmp_path / "l.db")
    text, matrix = (zlib.decompress(x) for x in c.execute("SELECT json, covariance FROM document").fetchone())
    c.close()
    assert (json.loads(text), json.loads(matrix)["matrix"]) == ({"schema": "x"}, covariance.tolist())


def test_a_foreign_file_is_refused_and_left_as_it_was(tmp_path):
    other = tmp_path / "other.db"
    c = sqlite3.connect(other)
    c.execute("CREATE TABLE estimate (x)")
    c.commit()
    c.close()
    (tmp_path / "text.db").write_text("no database")
    (tmp_path / "cut.db").write_bytes(other.read_bytes()[:600])
    for path in (other, tmp_path / "text.db", tmp_path / "cut.db"):
        before = path.read_bytes()
        with pytest.raises(AmbidError, match="is not a ledger of ambid"):
            open_ledger(path)
        assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 3


def test_a_foreign_database_on_a_server_is_refused(postgres):
    import psycopg

    from tests.ledger.server import new_database

    url = new_database(postgres, "foreign")
    with psycopg.connect(url, autocommit=True) as c:
        c.execute("CREATE TABLE value (x integer)")
    with pytest.raises(AmbidError, match="is not a ledger of ambid"):
        open_ledger(url)
    with pytest.raises(AmbidError, match="holds no ledger yet"):
        open_ledger(new_database(postgres, "empty"), write=False)
    with pytest.raises(AmbidError, match='database "none" does not exist') as refused:
        open_ledger(postgres.format("none").replace("ambid@", "ambid:secret@"))
    assert "secret" not in str(refused.value)


def test_a_server_that_ends_the_connection_is_told_in_one_line(postgres, caplog):
    import psycopg

    from ambid.ledger.history import history_of
    from tests.ledger.server import new_database

    url = new_database(postgres, "ended")

    def read_while_the_server_ends_it():
        with ledger._reading() as connection:
            with psycopg.connect(url, autocommit=True) as other:
                others = "pg_stat_activity WHERE pid <> pg_backend_pid() AND datname = current_database()"
                other.execute(f"SELECT pg_terminate_backend(pid) FROM {others}")
            history_of(connection, "A", "it")

    with open_ledger(url) as ledger:
        ledger.add([entry(0)])
        with pytest.raises(AmbidError, match=r"ledger postgresql://.*terminat"):
            read_while_the_server_ends_it()
    assert not caplog.records  # no traceback of the pool's beside it


def test_a_full_disk_leaves_what_was_there(tmp_path):
    with open_ledger(tmp_path / "l.db") as ledger:
        ledger.add([entry(0)])
        with ledger._engine.connect() as c:
            c.exec_driver_sql(f"PRAGMA max_page_count = {c.exec_driver_sql('PRAGMA page_count').scalar_one() + 2}")
        with pytest.raises(AmbidError, match="disk is full"):
            ledger.add([entry(k, document="x") for k in range(1, 2000)])
        assert len(ledger.history("A").estimates) == 1


def test_a_writer_waits_for_another(tmp_path, monkeypatch):
    path = tmp_path / "l.db"
    open_ledger(path).close()
    other = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
    other.execute("BEGIN IMMEDIATE")
    with open_ledger(path, write=False) as ledger:  # readers do not wait
        assert ledger.bearings() == ()
    with ThreadPoolExecutor(1) as pool:
        writing = pool.submit(lambda: open_ledger(path).add([entry(0)]))
        with pytest.raises(TimeoutError):
            writing.result(timeout=0.8)  # longer than one try
        other.execute("ROLLBACK")
        assert len(writing.result(timeout=60)) == 1
    monkeypatch.setattr(opening, "PATIENCE_S", 0.1)
    other.execute("BEGIN IMMEDIATE")
    with pytest.raises(AmbidError, match="another program has been writing"):
        open_ledger(path)
    other.close()


KILLED = """
import os, sys
from ambid.ledger import open_ledger, opening, store
from tests.ledger.entries import entry
store._document = lambda *_: print("half", flush=True) or sys.stdin.read()
with open_ledger(sys.argv[1]) as ledger:
    ledger.add([entry(k, document="{}") for k in range(1, 200)])
"""


def test_a_writer_killed_in_the_middle_leaves_nothing_of_its_batch(place):
    with open_ledger(place) as ledger:
        ledger.add([entry(0)])
    run = subprocess.Popen(
        [sys.executable, "-c", KILLED, place], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert run.stdout.readline() == "half\n"
    run.send_signal(signal.SIGKILL)
    run.communicate()
    with open_ledger(place) as ledger:
        assert len(ledger.history("A").estimates) == 1
        assert len(ledger.add([entry(k) for k in range(200)])) == 199


def test_the_key_counts_what_was_asked_for_and_nothing_else():
    assert settings_text("identify", from_s=None, nonlinear=False, held=()) == settings_text("identify")
    assert (
        settings_text("identify", a=1, b=2) == settings_text("identify", b=2, a=1) != settings_text("track", a=1, b=2)
    )
    keys = {key_of(*parts, "1") for parts in (("a", "b", "c"), ("ab", "", "c"), ("a", "bc", ""))}
    assert len(keys) == 3


def test_times_are_read_as_utc_unless_they_say_otherwise():
    assert moment("2026-03-01T14:30") == moment("2026-03-01T15:30+01:00") == moment("2026-03-01 14:30:00Z")
    with pytest.raises(AmbidError, match="must be a date and time"):
        moment("01.03.2026")
    with pytest.raises(AmbidError, match="from 1900 to 2999"):
        moment("0001-01-01T00:00+14:00")
