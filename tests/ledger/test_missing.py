"""What is missing or wrong in the records of bearings is an alarm, what is usual none, and somebody may take note."""

import time

import numpy as np
import pytest

from ambid.errors import AmbidError
from ambid.ledger import RecordRule, Rule, open_ledger, read_rules, watch, write_metrics
from ambid.ledger.missing import _still, alarm_of, pauses
from ambid.ledger.silences import silences, take_note
from ambid.ledger.store import Failure
from tests.ledger.entries import BEGIN, DAY, entry, parameter
from tests.ledger.faults import FAULTS, YEARS, ill, quiet_alarms
from tests.ledger.simulated import BEGIN as START


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_of_records_is_an_alarm(fault):
    for k in range(3):
        histories, failures, kind, name = ill(fault, f"pump {k:02d}", np.random.default_rng([5, k]))
        found = watch(histories, failures=failures, now=START + 365.25 * YEARS * DAY).alarms
        assert (kind, name) in {(a.kind, a.bearing) for a in found}


def test_sound_histories_have_no_alarm():
    """Of seven habits, with wander, a shutdown a year and a record in a hundred missing."""
    assert [a.cause for a in quiet_alarms(14, 3)] == []


def test_overdue_is_learnt_and_a_new_habit_too():
    weekly = pauses(7 * DAY * np.arange(20), RecordRule())
    assert (weekly.usual_s, weekly.overdue_s, weekly.long) == (7 * DAY, 31.5 * DAY, ())
    given = pauses(7 * DAY * np.arange(20), RecordRule(every_s=DAY, late=2.0))
    assert (given.overdue_s, len(given.long)) == (2 * DAY, 19)
    slower = np.cumsum([*[1.0] * 60, *[10.0] * 200]) * DAY
    told = pauses(slower, RecordRule()).long
    assert 1 <= len(told) < 80  # until the tens are usual
    assert pauses(np.zeros(0), RecordRule()).overdue_s == pauses(np.zeros(1), RecordRule()).overdue_s


@pytest.fixture
def ledger(tmp_path):
    with open_ledger(tmp_path / "works.db") as opened:
        worn = [parameter("k_i", 80.0 - 8.0 * (k > 14) + 0.05 * (-1) ** k, 0.3) for k in range(30)]
        opened.add([entry(k, "worn", parameters=(p,)) for k, p in enumerate(worn)])
        yield opened


def look(ledger, now=BEGIN + 30 * DAY, **more):
    histories = [ledger.history(b.name) for b in ledger.bearings()]
    return watch(histories, silences=silences(ledger), now=now, **more)


def test_an_alarm_that_somebody_has_taken_note_of_is_shown_as_such_and_returns_when_it_grows(ledger):
    now = BEGIN + 30 * DAY
    (alarm,) = take_note(ledger, look(ledger).alarms, "k_i", now=now, who="A. Smith", why="magnet ordered")
    noted = look(ledger)
    assert (noted.passed, noted.standing[0].rule, noted.standing[0].raised) == (True, alarm.rule, alarm.raised)
    assert "acknowledged 2026-01-31 00:00 by A. Smith: magnet ordered" in noted.summary(width=300)
    ledger.add([entry(k, "worn", parameters=(parameter("k_i", 64.0, 0.3),)) for k in range(30, 40)])
    grown = look(ledger, BEGIN + 40 * DAY)
    assert [a.noted for a in grown.open] == [None]
    with pytest.raises(AmbidError, match="no alarm 'k_x' stands; those that stand: k_i -5 %"):
        take_note(ledger, grown.alarms, "k_x", now=now, who="A", why="b")


@pytest.mark.drawn
def test_a_silenced_rule_returns_when_the_time_is_over(ledger):
    now = BEGIN + 60 * DAY
    stale = look(ledger, now)
    assert {a.rule for a in stale.open} == {"k_i -5 %", "stale"}
    records, k_i = sorted(stale.plot().axes, key=lambda axes: len(axes.get_yticks()))
    assert [x.get_text() for x in records.get_yticklabels()] == ["do not use", "caution", "usable"]
    assert k_i.get_ylabel().startswith("k_i")
    take_note(ledger, stale.alarms, "stale", now=now, who="A. Smith", why="dismounted", until=BEGIN + 90 * DAY)
    assert {a.rule for a in look(ledger, BEGIN + 89 * DAY).open} == {"k_i -5 %"}
    assert {a.rule for a in look(ledger, BEGIN + 91 * DAY).open} == {"k_i -5 %", "stale"}


def test_a_bearing_of_which_every_record_failed_is_watched_too(ledger):
    failures = [
        Failure(bearing="new", record=f"{k}.h5", sha=str(k), rig_sha="", settings="", version="1",
                reason="it has a gap", failed_at=BEGIN + k * DAY) for k in range(3)
    ]  # fmt: skip
    found = look(ledger, failures=failures)
    (alarm,) = (a for a in found.open if a.bearing == "new")
    assert (alarm.kind, alarm.cause) == ("failed", "3 records in succession failed, 3 of them by it has a gap")
    assert {s.bearing: s.failures for s in found.states} == {"worn": 0, "new": 3}


def test_a_bearing_that_failed_once_and_went_silent_is_told(ledger):
    failure = Failure(bearing="new", record="0.h5", sha="0", rig_sha="", settings="", version="1",
                      reason="it has a gap", failed_at=BEGIN)  # fmt: skip
    told = [
        [a.cause for a in look(ledger, BEGIN + days * DAY, failures=[failure]).open if a.bearing == "new"]
        for days in (91, 93)
    ]
    assert told == [[], ["never an estimate, and no record for 93 days; the last one failed: it has a gap"]]
    state = next(s for s in look(ledger, failures=[failure]).states if s.bearing == "new")
    assert (state.latest, state.heard, state.overdue_s) == (None, BEGIN, 92 * DAY)  # as the alarm has it


@pytest.mark.parametrize("own", [[], [BEGIN], [BEGIN, BEGIN + 40 * DAY]], ids=["never", "open", "over"])
def test_what_others_gave_in_a_pause_counts_whole_and_the_bearing_s_own_records_do_not(own):
    others = [BEGIN + (k + 0.5) * DAY for k in (*range(-40, 0), 0)]
    pause = alarm_of("new", "stale", BEGIN, BEGIN + 40 * DAY, "", raised=BEGIN + DAY)
    assert _still(pause, np.sort([*others, *own])) == pytest.approx(39 * DAY)


def test_metrics_give_no_old_value_a_fresh_time(ledger, tmp_path):
    parser = pytest.importorskip("prometheus_client.parser", reason="prometheus-client is not installed")
    ledger.add([entry(k, "worn", verdict="unusable", parameters=(parameter("k_i", 1.0, 0.1),)) for k in range(30, 60)])
    found = look(ledger, BEGIN + 60 * DAY)
    write_metrics(found, tmp_path / "a.prom")
    text = (tmp_path / "a.prom").read_text()
    sample = {f.name: f.samples for f in parser.text_string_to_metric_families(text)}
    value = {name: samples[0].value for name, samples in sample.items() if len(samples) == 1}
    assert value["ambid_parameter_timestamp_seconds"] == value["ambid_success_timestamp_seconds"] == BEGIN + 29 * DAY
    assert value["ambid_record_timestamp_seconds"] == BEGIN + 59 * DAY
    assert value["ambid_parameter_age_seconds"] == 31 * DAY
    assert {x.labels["verdict"]: x.value for x in sample["ambid_verdict"]} == {"usable": 0, "caution": 0, "unusable": 1}
    assert {x.labels["rule"] for x in sample["ambid_alarm"] if x.value} == {"k_i -5 %", "unusable"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("every = 7", "must be a time such as"),
        ("every = '0 d'", "must be a time such as"),
        ("late = 0.5", "must be a number from 1"),
        ("unusable = 2.5", "must be a number from 1"),
        ("bearing = ''", "must be a name"),
        ("evry = '7 d'", "Did you mean 'every'?"),
        ("late = 4\n[[records]]\nlate = 5", "the same thing twice"),
    ],
)
def test_rules_of_records_that_are_none_are_refused(tmp_path, text, said):
    (tmp_path / "r.toml").write_text(f"[[records]]\n{text}\n")
    with pytest.raises(AmbidError) as refused:
        read_rules(tmp_path / "r.toml")
    assert said in str(refused.value)


def test_rules_of_records_are_by_bearing(ledger, tmp_path):
    (tmp_path / "r.toml").write_text("[[records]]\nbearing = 'worn'\nevery = '30 d'\n")
    own, everyone = read_rules(tmp_path / "r.toml")
    assert (own.every_s, everyone) == (30 * DAY, RecordRule())
    history = ledger.history("worn")
    late = BEGIN + 60 * DAY
    assert [a.kind for a in watch([history], [everyone], now=late).alarms] == ["stale"]
    assert watch([history], [own, everyone], now=late).alarms == ()
    assert watch([history], [Rule(parameter="k_i", change=-0.5)], now=time.time()).alarms == ()
    with pytest.raises(AmbidError, match="no bearing 'wron'"):
        watch([history, history], [RecordRule(bearing="wron")], now=late)
