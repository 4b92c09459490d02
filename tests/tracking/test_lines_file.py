"""JSON lines of a track: what is written is what is read, damage at the end is met, elsewhere refused."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace

import pytest

from ambid.errors import AmbidError, RecordError
from ambid.estimation.result import Verdict
from ambid.recursive.lines import Event, TrackedValue, TrackLine
from ambid.tracking.lines_file import (
    Tally,
    TrackWriter,
    event_json,
    header_json,
    line_json,
    most_important,
    read_track,
    summary_json,
)
from tests.tracking.tracks import header, track_of


def written(track, target):
    with TrackWriter(target) as writer:
        writer.header(track.header)
        for line in track.lines:
            writer.line(line)
        writer.summary(track.totals)


@pytest.fixture(scope="module")
def track():
    return track_of(seconds=3.0, every_s=0.05)


@pytest.fixture
def file(track, tmp_path):
    path = tmp_path / "track.jsonl"
    written(track, path)
    return path


def test_what_is_written_is_read_back(track, file):
    assert read_track(file) == track


def test_the_contract_s_keys_are_there(file):
    rows = [json.loads(row) for row in file.read_text(encoding="utf-8").splitlines()]
    assert rows[0]["schema"] == "ambid.track/1"
    assert {"rate_hz", "limit", "method", "units"} <= rows[0].keys()
    for row in rows[1:-1]:
        assert {"t", "parameters", "error", "state", "event"} <= row.keys()
        for p in row["parameters"].values():
            assert p["ci95"] == pytest.approx([p["value"] - 1.959964 * p["sd"], p["value"] + 1.959964 * p["sd"]])
            assert isinstance(p["stale"], bool)
    kinds = [row["event"]["kind"] for row in rows[1:-1] if row["event"]]
    assert kinds == ["change", "accepted", "frozen", "thawed", "rejected"]
    names = {"samples", "seconds_of_record", "computing_s", "updates", "rejected_samples", "changes"}
    assert names <= rows[-1]["summary"].keys()
    assert rows[-1]["summary"]["changes"][0]["parameter"] == "k_i"
    assert rows[-1]["summary"]["rejected_samples"] == 14


def test_numbers_that_are_not_finite_are_null_and_come_back_as_nan(tmp_path):
    head = header(names=("R",))
    line = TrackLine(
        t=0.01,
        parameters={"R": TrackedValue(value=1.6, sd=math.inf)},
        error=math.nan,
        state="frozen",
        events=(Event(kind="disturbed", t=math.nan, why="?", values={"z": math.inf}),),
        extra={"unbalance": TrackedValue(value=math.nan, sd=math.nan, stale=True)},
    )
    found = line_json(line)
    assert found["parameters"]["R"] == {"value": 1.6, "sd": None, "ci95": None, "stale": False}
    assert found["error"] is None
    assert found["event"]["values"] == {"z": None}
    with TrackWriter(tmp_path / "t.jsonl") as writer:
        writer.header(head)
        writer.line(line)
    assert "NaN" not in (tmp_path / "t.jsonl").read_text()
    assert "Infinity" not in (tmp_path / "t.jsonl").read_text()
    (back,) = read_track(tmp_path / "t.jsonl").lines
    assert math.isnan(back.error)
    assert math.isnan(back.parameters["R"].sd)
    assert back.extra["unbalance"].stale


def test_the_most_important_event_stands_first_and_all_are_listed():
    rejected = Event(kind="rejected", t=1.0, why="NaN", samples=3)
    change = Event(kind="change", t=1.001, why="k_i fell", parameter="k_i")
    line = TrackLine(t=1.01, parameters={}, error=1.0, state="changed", events=(rejected, change))
    assert most_important(line.events) is change
    found = line_json(line)
    assert found["event"] == event_json(change)
    assert found["events"] == [event_json(rejected), event_json(change)]
    assert event_json(rejected) == {"kind": "rejected", "t": 1.0, "why": "NaN", "samples": 3}


def test_each_line_can_be_followed_while_it_is_written(track, tmp_path):
    path = tmp_path / "live.jsonl"
    writer = TrackWriter(path)
    assert not path.exists()  # a refused run leaves no file
    writer.header(track.header)
    for n, line in enumerate(track.lines[:5], start=1):
        writer.line(line)
        assert len(read_track(path).lines) == n
    writer.close()


def test_a_stream_is_written_and_left_open(track):
    stream = io.StringIO()
    written(track, stream)
    assert not stream.closed
    assert len(stream.getvalue().splitlines()) == len(track.lines) + 2


def test_a_file_that_was_cut_anywhere_gives_its_whole_lines(track, file, tmp_path):
    data = file.read_bytes()
    first = data.index(b"\n") + 1
    ends = [k + 1 for k, byte in enumerate(data) if byte == 10]
    cut = tmp_path / "cut.jsonl"
    for size in [first, first + 1, first + 400, *range(len(data) - 900, len(data) - 2, 37)]:
        cut.write_bytes(data[:size])
        found = read_track(cut)
        whole = sum(end <= size for end in ends) - 1
        assert len(found.lines) in (whole, whole + 1)  # one more where only the line feed is missing
        assert found.lines == track.lines[: len(found.lines)]
        assert not found.totals.complete
    assert found.totals.rejected_samples == track.totals.rejected_samples
    assert found.totals.changes == track.totals.changes
    assert found.totals.updates == track.totals.updates
    assert math.isnan(found.totals.computing_s)
    cut.write_bytes(data[: first - 20])
    with pytest.raises(RecordError, match="ends within its first line"):
        read_track(cut)


@pytest.mark.parametrize("kind", ["excluded", "restored"])
def test_events_of_the_release_before_on_sensors_are_read_as_disturbances(track, file, kind):
    event = Event(kind=kind, t=0.1, why="position_2 disagrees", parameter="position_2")
    old = replace(track, lines=(replace(track.lines[0], events=(event,)), *track.lines[1:]))
    rows = [header_json(old.header), *map(line_json_of_the_release_before, old.lines)]
    file.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    assert read_track(file).lines[0].events == (replace(event, kind="disturbed"),)


def line_json_of_the_release_before(line):
    events = [event_json(e) for e in line.events]
    return {**line_json(replace(line, events=())), "event": events[0] if events else None, "events": events}


def changed(text, row, old, new):
    rows = text.split("\n")
    assert old in rows[row]
    rows[row] = rows[row].replace(old, new, 1)
    return "\n".join(rows)


DAMAGE = {
    "another schema": (lambda x: changed(x, 0, "track/1", "fit/1"), "line 1: the schema is 'ambid.fit/1'"),
    "half a line in the middle": (lambda x: changed(x, 3, '"error"', '"err'), "line 4: it is not JSON"),
    "a missing key": (lambda x: changed(x, 3, '"error"', '"mistake"'), "line 4: 'error' is missing"),
    "a word for a number": (
        lambda x: changed(x, 2, '"sd": ', '"sd": "x", "y": '),
        "parameters.m.sd is 'x' instead of a number",
    ),
    "not a JSON number": (lambda x: changed(x, 2, '"sd": ', '"sd": NaN, "y": '), "line 3: it is not JSON"),
    "a word for a count": (lambda x: x.replace('"samples": 14', '"samples": "14"'), "instead of a whole number"),
    "nested without end": (lambda x: x.replace(x.split("\n")[3], "[" * 100_000), "line 4: it is not JSON"),
    "an unknown state": (lambda x: changed(x, 2, '"tracking"', '"asleep"'), "state is 'asleep' instead of 'tracking'"),
    "an unknown event": (
        lambda x: x.replace('"kind": "change"', '"kind": "miracle"'),
        "kind is 'miracle' instead of 'change'",
    ),
    "another parameter": (
        lambda x: changed(x, 2, '"k_x"', '"k_y"'),
        "parameter 'k_x' is either here or in the lines before",
    ),
    "a line twice": (lambda x: x.replace(x.split("\n")[4], "\n".join(2 * [x.split("\n")[4]])), "does not come after"),
    "something behind": (lambda x: x + x.split("\n")[4] + "\n", "follows the summary"),
    "a list": (lambda x: "[1]\n" + x, "line 1: the schema is None"),
    "no track at all": (lambda x: "time [s],a [V]\n0,1\n", "line 1: it is not JSON"),
}


@pytest.mark.parametrize(("damage", "said"), DAMAGE.values(), ids=DAMAGE.keys())
def test_other_damage_is_refused_on_one_line(file, damage, said):
    file.write_text(damage(file.read_text(encoding="utf-8")), encoding="utf-8")
    with pytest.raises(RecordError) as refused:
        read_track(file)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_missing_or_empty_file_is_refused(tmp_path):
    (tmp_path / "empty.jsonl").touch()
    for name, said in (("none.jsonl", "does not exist"), ("empty.jsonl", "is empty")):
        with pytest.raises(RecordError, match=said):
            read_track(tmp_path / name)


def test_a_place_that_cannot_be_written_is_one_line(track, tmp_path):
    with pytest.raises(AmbidError, match="cannot be written: Is a directory"):
        TrackWriter(tmp_path).header(track.header)
    with pytest.raises(RecordError, match="before its header"):
        TrackWriter(tmp_path / "t.jsonl").line(track.lines[0])


def test_a_tally_knows_which_changes_are_open():
    def line(k, *events):
        return TrackLine(t=0.01 * k, parameters={}, error=1.0, state="tracking", events=events)

    def event(kind, parameter):
        return Event(kind=kind, t=0.0, why="", parameter=parameter)

    tally = Tally(header(names=()))
    tally.add(line(1, event("change", "k_i"), event("change", "R")))
    tally.add(line(2, event("accepted", "k_i"), event("refused", "R")))
    assert [e.parameter for e in tally.open_changes] == ["R"]
    tally.add(line(3, event("change", None)))
    assert [e.parameter for e in tally.open_changes] == ["R", None]
    tally.add(line(4, event("accepted", None)))
    assert tally.open_changes == ()
    found = tally.summary(computing_s=1.0, complete=False)
    assert (found.samples, found.counts["change"], len(found.changes)) == (800, 3, 3)
    assert summary_json(found, Verdict(word="usable", reasons=()))["summary"]["complete"] is False


def test_the_header_names_units_and_start():
    found = header_json(header(names=("R",)))
    assert found["units"] == {"R": "ohm"}
    assert found["start"]["R"]["value"] == 1.6


def test_warnings_of_the_start_come_back_and_a_header_without_them_is_read(tmp_path):
    head = replace(
        track_of(seconds=1.0).header, warnings=("the residuals are not white",), grave=("it is no estimate",),
        notes=("1 % of gain moves: voltage R +1 %",), scale_sd={"R": 0.01},
    )  # fmt: skip
    document = header_json(head)
    (tmp_path / "t.jsonl").write_text(json.dumps(document) + "\n", encoding="utf-8")
    assert read_track(tmp_path / "t.jsonl").header == head
    for name in ("warnings", "grave", "notes", "scale_sd"):
        del document[name]
    (tmp_path / "t.jsonl").write_text(json.dumps(document) + "\n", encoding="utf-8")
    assert read_track(tmp_path / "t.jsonl").header == track_of(seconds=1.0).header


def noticed(*times, kind="disturbed", **values):
    """A line's events, noticed at times."""
    return [Event(kind=kind, t=t - 0.01, why="", parameter="k_x", values={"detected": t, **values}) for t in times]


def tallied(*events, until):
    """A track that is sound but for its events, each in the line of the time at which it was noticed."""
    line = TrackLine(t=until, parameters=header().start, error=1.0, state="tracking")
    tally = Tally(header())
    for e in events:
        tally.add(replace(line, t=e.values.get("named", e.values["detected"]), events=(e,)))
    tally.add(line)
    return replace(track_of(seconds=0.2, every_s=0.1), lines=(line,), totals=tally.summary())


def test_no_value_is_usable_while_disturbances_recur():
    assert tallied(*noticed(1.0, 1.3, 1.6), until=2.0).verdict.word == "caution"
    assert tallied(*noticed(1.0, 1.3, 1.6), until=3.2).verdict.word == "usable"
    together = tallied(*noticed(1.0, 1.05, 1.1, 1.14), until=1.2)  # one thing, seen again and again
    assert (together.totals.recurring, together.verdict.word) == (1, "usable")
    found = tallied(*noticed(1.0, 1.3, 1.6), until=2.0)
    assert [r.check for r in found.reasons] == ["disturbed"]
    assert "3 times in the last 2 s" in found.reasons[0].text


def test_a_change_that_turns_out_to_be_a_load_is_not_left_open():
    (change,), (load,) = noticed(1.0, kind="change"), noticed(1.0, named=1.1)
    assert tallied(change, until=2.0).verdict.word == "unusable"
    assert tallied(change, load, until=2.0).totals.unanswered == ()
    assert tallied(change, load, until=2.0).verdict.word == "usable"


def test_a_change_that_turns_out_to_be_another_counts_once():
    (change,), (other,) = noticed(1.0, kind="change"), noticed(1.0, kind="change", named=1.1)
    other = replace(other, parameter="k_i")
    assert change.parameter != other.parameter
    found = tallied(change, other, until=2.0).totals
    assert (found.changes, found.unanswered) == ((other,), (other,))
