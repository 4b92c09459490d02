"""A bearing over time: what is shown of it, and that what nobody saw is never a number."""

import json

import numpy as np
import pytest

import ambid
from ambid.errors import AmbidError
from ambid.job import presentation
from ambid.ledger import open_ledger
from ambid.ledger.entry import Note
from tests.ledger.entries import BEGIN, DAY, entry, parameter


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A ledger of ten months: k_x twice not seen, one estimate not to be used, one new rig, one event."""
    path = tmp_path_factory.mktemp("ledger") / "l.db"
    entries = []
    for k in range(10):
        seen = k not in (3, 4)
        numbers = (
            parameter("m", 0.06, 0.0, unit="kg", role="fixed"),
            parameter("k_i", 80.0 - k, 0.5),
            parameter("k_x", -9e3, 100.0 if seen else 1e6, unit="N/m", seen=seen),
        )
        note = (Note(at=BEGIN + 30 * DAY * k, kind="change", text="it fell", parameter="k_i"),) if k == 5 else ()
        entries.append(
            entry(k, day=30 * k, parameters=numbers, verdict="unusable" if k == 7 else "usable", events=note,
                  failed=("plausible",) if k == 7 else (), rig="one" if k < 6 else "two")
        )  # fmt: skip
    with open_ledger(path) as ledger:
        ledger.add(entries)
    return path


@pytest.fixture(scope="module")
def history(place):
    return ambid.history("A", ledger=place)


def test_gaps_are_where_nothing_was_seen_or_nothing_may_be_used(history):
    assert np.flatnonzero(np.isnan(history["k_x"].value)).tolist() == [3, 4, 7]
    assert np.flatnonzero(np.isnan(history["k_i"].value)).tolist() == [7]
    assert list(history.measured) == ["k_x", "k_i"]  # as models have them


def test_nothing_that_was_not_seen_comes_out_as_a_number_anywhere(history):
    table, text = history.to_dataframe(), presentation.document(history)
    assert table["k_x"].isna().sum() == 3
    assert "1000000" not in text
    drawn = [line.get_ydata() for axes in history.plot().axes for line in axes.lines if len(line.get_ydata()) == 10]
    assert [int(np.isnan(y).sum()) for y in drawn] == [3, 1]


@pytest.mark.parametrize(
    ("measured", "zone"), [((9.496, 0.08), "zone A or B"), (None, "zone A (98 %)"), ((8.0, 0.1), "zone A (98 %)")]
)
def test_the_zone_of_a_loop_is_that_of_its_latest_peak(tmp_path, measured, zone):
    """Measured where it was measured; a predicted peak that is surely higher counts instead."""
    numbers = [parameter("x.sensitivity", 9.466, 0.037, unit="dB")]
    if measured is not None:
        numbers.append(parameter("x.sensitivity_measured", *measured, unit="dB"))
    with open_ledger(tmp_path / "l.db") as ledger:
        ledger.add([entry(0, day=0, parameters=tuple(numbers))])
    shown = presentation.text(ambid.history("A", ledger=tmp_path / "l.db"), width=120)
    assert f"9.466 ± 0.037 dB, {zone}" in shown


def test_events_and_changes_of_the_rig_stand_in_order_of_time(history):
    assert [(e.kind, e.text) for e in history.events] == [
        ("change", "it fell"), ("rig", 'name = "one" became name = "two"'),
    ]  # fmt: skip
    assert history.events[1].at == BEGIN + 180 * DAY


def test_the_verdict_is_that_of_the_latest_estimate(place, history):
    assert history.verdict.word == "usable"
    with open_ledger(place) as ledger:
        ledger.add(
            [entry(0, "B"), entry(1, "B", verdict="unusable", failed=("in_time",)), entry(0, "C", verdict="unusable")]
        )
        (latest,) = ledger.history("B").reasons
        assert (latest.check, "in_time" in latest.text) == ("latest", True)
        assert [ledger.history(name).verdict.word for name in "BC"] == ["caution", "unusable"]


@pytest.mark.drawn
@pytest.mark.drawn
def test_it_is_told_with_dates_and_comes_back_from_its_file(history, tmp_path):
    text = history.summary()
    assert text.startswith("verdict: usable\n\nA: 10 estimates, 2026-01-01 00:00 to 2026-09-28 00:00 UTC")
    assert "-11.25 ± 0.88 %" in text
    assert "7 of 10" in text
    history.save(tmp_path / "h.json")
    again = ambid.load(tmp_path / "h.json")
    assert again.summary() == text
    assert presentation.document(again) == presentation.document(history)
    assert again["k_i"].estimate.tolist() == list(range(10))
    history.report(tmp_path / "h.html")
    assert "not identifiable" in (tmp_path / "h.html").read_text()


def test_the_table_has_a_row_for_each_estimate(history):
    table = history.to_dataframe()
    assert table.shape == (10, 7)
    assert str(table.index[1]) == "2026-01-31 00:00:00"
    assert table["k_i sd"].iloc[0] == 0.5


def test_a_slip_in_a_name_is_told(place):
    with pytest.raises(AmbidError, match="has no bearing 'Q'"):
        ambid.history("Q", ledger=place)
    with pytest.raises(AmbidError, match="Did you mean 'k_i'"):
        ambid.history("A", ledger=place)["ki"]


def again(k, version, job="identify", **more):
    """The estimate of a record by another version."""
    return entry(k, version=version, job=job, settings=f'{{"job": "{job}"}}', **more)


def test_of_a_record_and_job_the_estimate_of_the_newest_version_counts(tmp_path):
    note = Note(at=BEGIN, kind="change", text="seen twice")
    numbers = {v: (parameter("k_i", x, 0.5),) for v, x in (("1.10.0", 1.0), ("1.9.0", 2.0), ("1.10.0rc1", 3.0))}
    with open_ledger(tmp_path / "l.db") as ledger:
        for version in ("1.10.0", "1.9.0", "1.10.0rc1"):  # the newest first
            ledger.add([again(k, version, parameters=numbers[version], events=(note,)) for k in range(3)])
        ledger.add([again(1, "1.9.0", "track", parameters=(parameter("R", 4.0, 0.1),)), entry(5)])
        found, every = ledger.history("A"), ledger.history("A", every=True)
        (bearing,) = ledger.bearings()
    assert [(e.sha, e.job, e.version) for e in found.estimates] == [
        ("A0", "identify", "1.10.0"), ("A1", "identify", "1.10.0"), ("A1", "track", "1.9.0"),
        ("A2", "identify", "1.10.0"), ("A5", "identify", "0.1.0"),
    ]  # fmt: skip
    assert (bearing.estimates, found.left_out, len(found.events)) == (5, 6, 3)
    assert found["k_i"].value.tolist() == [1.0, 1.0, 1.0, 79.5]
    assert [found.estimates[k].job for k in found["R"].estimate] == ["track", "identify"]
    assert (len(every.estimates), every.left_out, every["k_i"].value.size) == (11, 0, 10)
    assert sum(e.superseded for e in every.estimates) == 6
    assert "6 estimates superseded (left out;" in str(found.summary())


def test_of_several_by_one_version_the_latest_counts(tmp_path, monkeypatch):
    with open_ledger(tmp_path / "l.db") as ledger:
        for at, rig in ((30.0, "first"), (20.0, "second")):
            monkeypatch.setattr("time.time", lambda at=at: at)
            ledger.add([entry(0, rig=rig)])
        assert [e.rig_sha for e in ledger.history("A").estimates] == ["first"]


def test_a_file_of_a_history_without_what_came_later_is_read(tmp_path, history):
    document = json.loads(presentation.document(history))
    for name in ("left_out", "corrections"):
        del document[name]
    for e in document["estimates"]:
        del e["superseded"]
    (tmp_path / "h.json").write_text(json.dumps(document))
    assert ambid.load(tmp_path / "h.json").estimates == history.estimates
