"""A ledger of the version before: brought up whole or not at all, by one of two writers; and versions that are none."""

import re
import signal
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sqlalchemy import inspect, text

from ambid.errors import AmbidError
from ambid.ledger import entry as entries
from ambid.ledger import open_ledger
from tests.ledger import version1
from tests.ledger.entries import entry


@pytest.fixture
def old(place):
    version1.make(place)
    return place


def tables_of(place):
    """Columns, keys and indexes of every table."""
    with open_ledger(place) as ledger:
        seen = inspect(ledger._engine)
        return {
            name: (
                [(c["name"], re.sub(r"\W.*", "", str(c["type"])), c["nullable"]) for c in seen.get_columns(name)],
                seen.get_pk_constraint(name)["constrained_columns"],
                sorted((i["name"], i["column_names"]) for i in seen.get_indexes(name)),
            )
            for name in seen.get_table_names()
        }


def whole(place):
    with open_ledger(place, write=False) as ledger:
        histories = [ledger.history(b.name) for b in ledger.bearings()]
        assert [f.reason for f in ledger.failures().values()] == ["out of memory"]
    assert [h.bearing for h in histories] == ["A", "B"]
    assert histories[0]["k_i"].value.tolist() == [80.0, 78.0, 76.0]
    assert (histories[0].events[0].text, histories[0]["R"].identifiable.any()) == ("it fell", False)


def read_as_it_is(old):
    """A file is read as it is, by a copy; a server's database is refused, with what brings it up."""
    if "://" in old:
        with pytest.raises(AmbidError, match=r"is of version 1, and is read as 2\. 'ambid ledger check"):
            open_ledger(old, write=False)
        return
    before = Path(old).read_bytes()
    whole(old)
    with open_ledger(old, write=False) as ledger, pytest.raises(AmbidError, match="readonly database"):
        ledger.add([entry(3)])
    assert Path(old).read_bytes() == before


def test_an_older_ledger_gets_the_tables_of_a_new_one_and_keeps_its_rows(old, tmp_path_factory):
    read_as_it_is(old)
    brought_up = tables_of(old)
    whole(old)
    with open_ledger(old) as ledger:
        assert len(ledger.add([entry(3)])) == 1
    if "://" not in old:
        assert brought_up == tables_of(tmp_path_factory.mktemp("new") / "new.db")


def test_the_tables_are_the_same_on_a_server(postgres):
    from tests.ledger.server import new_database

    version1.make(old := new_database(postgres, "old_tables"))
    assert tables_of(old) == tables_of(new_database(postgres, "new_tables"))


KILLED = """
import sys
from ambid.ledger import entry, open_ledger
step = entry.STEPS[1]
class Halting(str):
    def format(self, **_):
        print("half", flush=True)
        sys.stdin.read()
entry.STEPS = {1: (*step[:3], Halting())}
open_ledger(sys.argv[1])
"""


def test_a_migration_killed_in_the_middle_leaves_the_old_ledger(old):
    run = subprocess.Popen(
        [sys.executable, "-c", KILLED, old], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert run.stdout.readline() == "half\n"
    run.send_signal(signal.SIGKILL)
    run.communicate()
    read_as_it_is(old)
    open_ledger(old).close()
    whole(old)


def test_two_writers_bring_it_up_once(old):
    with ThreadPoolExecutor(2) as pool:
        for opening in [pool.submit(open_ledger, old) for _ in range(2)]:
            opening.result().close()
    whole(old)


def test_a_version_that_is_none_is_refused_on_one_line(place):
    for said in ("abc", "0", "-1", "1.0", "٢", "9" * 5000, None):
        with open_ledger(place) as ledger, ledger._engine.begin() as c:
            c.execute(text("DELETE FROM meta WHERE name = 'version'"))
            if said is not None:
                c.execute(text("INSERT INTO meta VALUES ('version', :said)"), {"said": said})
        for write in (True, False):
            with pytest.raises(AmbidError, match=r"it must be a number from 1 to 2\. Restore it") as refused:
                open_ledger(place, write=write)
            assert len(str(refused.value).splitlines()) == 1
            assert len(str(refused.value)) < 300
        repair(place)


def repair(place):
    """Write the version as it was, past what opens a ledger."""
    if "://" in place:
        import psycopg

        with psycopg.connect(place) as c:
            c.execute("DELETE FROM meta WHERE name = 'version'")
            c.execute("INSERT INTO meta VALUES ('version', '2')")
        return
    c = sqlite3.connect(place)
    c.execute("INSERT OR REPLACE INTO meta VALUES ('version', '2')")
    c.commit()
    c.close()


def test_steps_lead_to_the_present_version():
    assert sorted(entries.STEPS) == list(range(1, entries.VERSION))
