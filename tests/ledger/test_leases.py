"""Leases on records that a fleet has in hand: whose they are, and when they are taken over."""

import subprocess
import sys

import pytest
from sqlalchemy import text

from ambid.ledger import leases, open_ledger
from ambid.ledger.leases import Leases

THREE = {"1": "a.h5", "2": "b.h5", "3": "c.h5"}


@pytest.fixture
def two(place):
    with open_ledger(place) as here, open_ledger(place) as there:
        yield Leases(here), Leases(there)


def rows(lease, what="key"):
    with lease._ledger._reading() as c:
        return c.execute(text(f"SELECT {what} FROM claim ORDER BY key")).scalars().all()


def test_a_record_is_in_one_hand(two):
    first, second = two
    assert first.take({"1": "a.h5", "2": "b.h5"}) == {"1", "2"}
    assert second.take(THREE) == {"3"}
    assert (first.others, second.others) == (0, 1)
    first.release(["1", "3"])
    first.take({})
    assert second.take({"1": "a.h5", "2": "b.h5"}) == {"1"}
    assert rows(second, "record") == ["a.h5", "b.h5", "c.h5"]
    first.close()
    assert rows(second) == ["1", "3"]


@pytest.mark.parametrize("age_s", [leases.LIMIT_S + 1, -leases.LIMIT_S - 1])
def test_a_lease_without_a_heartbeat_is_taken_over(two, age_s):
    first, second = two
    first.take(THREE)
    with first._ledger._leasing() as (c, now):
        c.execute(text(f"UPDATE claim SET heartbeat_at = {now - age_s} WHERE key = '2'"))
    assert second.take(THREE) == {"2"}
    assert rows(second, "tries") == [1, 2, 1]
    first.close()
    assert rows(second) == ["2"]


def test_a_heartbeat_keeps_it(two, monkeypatch):
    first, second = two
    first.take(THREE)
    with first._ledger._leasing() as (c, now):
        c.execute(text(f"UPDATE claim SET heartbeat_at = {now - leases.LIMIT_S - 1}"))
    monkeypatch.setattr(leases, "HEARTBEAT_S", 0.0)
    first.beat()
    assert second.take(THREE) == set()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells when a process began")
def test_of_a_process_that_is_gone_it_is_taken_over_at_once(two):
    first, second = two
    with subprocess.Popen(["sleep", "60"]) as process:
        first.owner = f"{leases._process_of(process.pid)} x"
        first.take(THREE)
        assert second.take(THREE) == set()
        process.kill()
        process.wait()
    assert second.take(THREE) == set(THREE)
    first.owner = first.owner.replace("/", "x/", 1)  # another machine's processes are not seen from here
    first._ledger.add(())
    assert not leases._is_gone(first.owner)
