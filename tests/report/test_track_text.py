"""The table of a track: what it says of values, intervals, changes and of what is wrong at the end."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest

from ambid.recursive.lines import Event, Latency, Track, TrackedValue, TrackLine
from ambid.report.document import sections_text
from ambid.report.track import change_words, speed_words, track_sections, value_words
from tests.tracking.tracks import header, track_of


def track_text(track, events=(), width=80):
    return sections_text(track_sections(track, events), width=width)


@pytest.fixture(scope="module")
def track():
    return track_of(seconds=12.0, every_s=0.05)


def test_the_table_holds_values_intervals_and_the_way_from_the_start(track):
    text = track_text(track)
    assert max(map(len, text.splitlines())) <= 80
    (row,) = re.findall(
        r"^k_i +([\d.]+) ± ([\d.]+) N/A +([\d.]+) … ([\d.]+) +(-[\d.]+) % +tracked$", text, re.MULTILINE
    )
    value, sd, low, high, percent = map(float, row)
    p = track.lines[-1].parameters["k_i"]
    assert value == pytest.approx(p.value, abs=0.006)
    assert (high - low) / 2 == pytest.approx(1.96 * sd, rel=0.05)
    assert percent == pytest.approx(100 * (p.value / 55.734 - 1), abs=0.006)
    assert "14 samples rejected in 1 place" in text
    assert "1 change," in text
    assert "50 times real time" in text
    assert "change k_i: k_i fell by 15 %" in text


def test_stale_parameters_and_a_run_that_was_stopped_are_told(track):
    line = next(x for x in track.lines if x.state == "frozen")
    text = track_text(replace(track, lines=(line,), totals=replace(track.totals, complete=False)), width=60)
    assert len(re.findall("STALE$", text, re.MULTILINE)) == 5
    assert "stopped before its end" in text
    assert "…" not in text.split("\n\n")[1]  # the interval is left out where there is no room
    assert max(map(len, text.split("\n\n")[1].splitlines())) <= 60


def test_lost_blocks_are_told(track):
    latency = Latency(median=1e-4, p99=2e-4, largest=1e-3, overruns=2, late=5, start=0.3)
    text = track_text(replace(track, totals=replace(track.totals, latency=latency)))
    assert "2 blocks LOST" in text
    assert "largest 1 ms, 300 ms at the start; 5 late" in text


def test_many_events_are_not_all_listed(track):
    events = [Event(kind="accepted", t=0.1 * k, why=f"number {k}", parameter="R") for k in range(50)]
    text = track_text(track, events=events)
    assert "30 earlier events are omitted" in text
    assert "number 29" not in text
    assert "number 30" in text
    assert "number 49" in text


TROUBLES = {
    "none": (1.0, "tracking", (), ()),
    "frozen": (1.0, "frozen", (), ("without excitation",)),
    "error": (1.6, "tracking", (), ("at the end is 1.6, above the limit 1.5",)),
    "unknown error": (math.nan, "tracking", (), ("unknown",)),
    "open change": (1.0, "tracking", ("k_i", None), ("of k_i at 3 s was not followed", "the change at 3 s")),
    "contradicted": (1.0, "changed", (), ("contradict",)),
    "held": (1.0, "hold", (), ()),
}


@pytest.mark.parametrize(("error", "state", "open_changes", "said"), TROUBLES.values(), ids=TROUBLES.keys())
def test_what_is_wrong_at_the_end(track, error, state, open_changes, said):
    line = TrackLine(t=4.0, parameters={}, error=error, state=state)
    changes = tuple(Event(kind="change", t=3.0, why="", parameter=name) for name in open_changes)
    totals = replace(track.totals, unanswered=changes)
    found = Track(header=header(), lines=(line,), totals=totals)
    assert len(found.verdict.reasons) == len(said)
    assert all(words in r.text for words, r in zip(said, found.verdict.reasons, strict=True))
    grave = state == "changed" or error > 1.5 or bool(open_changes)
    assert found.verdict.word == ("unusable" if grave else "caution" if said else "usable")


def test_numbers_that_are_not_known_are_not_invented():
    assert value_words(TrackedValue(value=math.nan, sd=1.0), "ohm") == ("unknown", "")
    assert value_words(TrackedValue(value=1.6, sd=math.inf), "ohm") == ("1.6 ohm ± ?", "")
    assert change_words(TrackedValue(value=1.0, sd=0.1), None) == ""
    assert change_words(TrackedValue(value=1.0, sd=0.1), TrackedValue(value=0.0, sd=0.1)) == ""
    assert change_words(TrackedValue(value=1.0, sd=0.1), TrackedValue(value=1e-12, sd=0.1)) == ""
    assert change_words(TrackedValue(value=-1.1, sd=0.1), TrackedValue(value=-1.0, sd=0.1)) == "+10.00 %"
    assert speed_words(100, 1.0, math.nan) == ""
    assert speed_words(2_400_000, 120.0, 2.0) == "1.2 million samples/s, 60 times real time"


def test_warnings_of_the_start_are_reasons_and_no_parameter_is_green(track):
    head = replace(track.header, warnings=("the residuals are not white", "two fits disagree"))
    found = replace(track, header=head)
    assert [r.text for r in found.verdict.reasons if r.check == "start"] == list(head.warnings)
    assert "use with caution" in track_text(found)
    assert "tracked" not in track_text(found)
