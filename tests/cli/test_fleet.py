"""``ambid fleet``: exit codes for schedulers, and what is refused before anything runs."""

from importlib import import_module

import pytest

from ambid.ledger.store import FleetRow, FleetRun


@pytest.mark.parametrize(
    ("states", "strict", "code"),
    [
        (("done", "known"), (), 0),
        (("done", "failed"), (), 3),
        (("known", "failed"), (), 3),
        (("failed", "failed"), (), 4),
        (("failed", "failed"), ("--strict",), 4),
        (("done", "doubtful"), (), 0),
        (("done", "doubtful"), ("--strict",), 3),
    ],
)
def test_the_exit_code_says_how_many_failed(ambid, monkeypatch, states, strict, code):
    rows = tuple(
        FleetRow(record=f"{k}.h5", bearing="b", rig="r", taken_at=1.0, state="done" if s == "doubtful" else s,
                 reason="no" if s == "failed" else "", verdict="caution" if s == "doubtful" else "", values={})
        for k, s in enumerate(states)
    )  # fmt: skip
    run = FleetRun(job="info", settings="{}", ledger="l.db", workers=1, seconds=1.0, records=2, units={}, rows=rows)
    monkeypatch.setattr(import_module("ambid.fleet.run"), "run_fleet", lambda *_, **__: run)
    assert ambid("fleet", "run", "x.h5", "--ledger", "l.db", *strict).code == code


def test_no_time_costs_no_run_and_is_not_remembered(ambid, bench):
    words = ("fleet", "run", "record.csv", "--ledger", "l.db", "--job", "info", "--workers", "1")
    refusal = ambid(*words)
    assert refusal.code == 2
    assert refusal.err == (
        "ambid: record record.csv does not say when taken, and the ledger has to know. Give --taken-at TIME, "
        "--taken-at file for the time of the file, or name records by {taken_at}\n"
    )
    assert not (bench / "l.db").exists()
    assert ambid(*words, "--taken-at", "file").code == 0
