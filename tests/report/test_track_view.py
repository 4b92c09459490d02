"""The live view as a function of what is known: what it shows, on which terminal, how wide."""

from __future__ import annotations

import io
import math
from dataclasses import replace

import pytest
from rich.console import Console

from ambid.recursive.lines import Event
from ambid.report.track import interval_bar, live_view, sparkline
from ambid.tracking.lines_file import LiveState
from tests.tracking.tracks import track_of


@pytest.fixture(scope="module")
def track():
    return track_of(seconds=12.0, every_s=0.05)


def shown(state, width=80, **more):
    console = Console(width=width, file=io.StringIO(), legacy_windows=False)
    console.print(live_view(state, wall_s=0.5, **more))
    return console.file.getvalue()


def state_of(track, k):
    state = LiveState(replace(track.header, record={**track.header.record, "samples": 12 * track.header.rate_hz}))
    for line in track.lines[: k + 1]:
        state.add(line)
    return state


def test_everything_that_an_operator_needs_is_there(track):
    k = next(k for k, x in enumerate(track.lines) if x.state == "changed") + 1
    text = shown(state_of(track, k), behind_s=0.003)
    for words in (
        "loop.csv: model one-axis, rpem",
        "changed",
        "of 12 s",
        "3 ms behind",
        "limit 1.5",
        "change k_i: k_i fell",
        "1 open change",
        "0 samples rejected",
        "times real time",
    ):
        assert words in text, words
    for name in track.header.units:
        assert any(row.startswith(f"{name} ") and "±" in row and "●" in row for row in text.splitlines()), name
    assert "14 samples rejected" in shown(state_of(track, len(track.lines) - 1))


def test_it_fits_into_80_columns_and_plain_letters(track):
    state = state_of(track, 200)
    assert max(map(len, shown(state).splitlines())) <= 80
    plain = shown(state, ascii_only=True)
    assert set(plain) - {"±", "…"} <= set(map(chr, range(10, 127)))


def test_stale_parameters_are_marked(track):
    k = next(k for k, x in enumerate(track.lines) if x.state == "frozen")
    assert shown(state_of(track, k)).count("STALE") == 5
    assert "STALE" not in shown(state_of(track, k - 10))


def test_only_the_last_decisions_are_shown(track):
    state = LiveState(track.header)
    for k in range(20):
        event = Event(kind="change", t=float(k), why=f"number {k}.")
        state.add(replace(track.lines[0], t=float(k), events=(event,)))
    text = shown(state)
    assert "number 13." not in text
    assert "number 14." in text
    assert "number 19." in text


def test_changes_are_kept_with_what_was_decided_on_them_and_of_routine_the_last(track):
    state = LiveState(track.header)
    kinds = ["accepted", "accepted", "change", "refused", "accepted", "accepted", "excluded"]
    for k, kind in enumerate(kinds):
        state.add(replace(track.lines[0], t=float(k), events=(Event(kind=kind, t=float(k), why=""),)))
    assert [e.t for e in state.events] == [2.0, 3.0, 4.0, 5.0, 6.0]  # the acceptance at 5 s replaced that at 1 s
    ends = [state.widened()["k_i"]]
    value = state.line.parameters["k_i"]
    for factor in (2.0, 1.0):
        moved = replace(value, value=factor * value.value)
        state.add(replace(state.line, parameters={**state.line.parameters, "k_i": moved}, events=()))
        ends.append(state.widened()["k_i"])
    assert ends[1][1] > ends[0][1]
    assert ends[2] == ends[1]  # they stay


def test_a_bar_shows_value_interval_and_start_to_scale():
    bar = interval_bar(5.0, 1.0 / 1.96, 8.0, 0.0, 10.0, width=11)
    assert bar == "····━●━·│··"
    assert interval_bar(12.0, 0.1, 8.0, 0.0, 10.0, width=11)[-1] == "▶"
    assert interval_bar(-3.0, 0.1, 8.0, 0.0, 10.0, width=11)[0] == "◀"
    assert interval_bar(5.0, math.inf, math.nan, 0.0, 10.0, width=11) == "━━━━━●━━━━━"
    assert interval_bar(math.nan, 1.0, 1.0, 0.0, 1.0, width=4) == "    "
    assert interval_bar(5.0, 1.0 / 1.96, 8.0, 0.0, 10.0, width=11, ascii_only=True) == "....-o-.|.."


def test_a_spark_shows_the_largest_of_each_stretch_against_the_limit():
    assert sparkline([0.0, 1.49, 1.51, 3.0, 99.0], 1.5) == "▁▄▅██"
    assert sparkline([0.1] * 50 + [9.0] + [0.1] * 49, 1.5, width=10) == "▁▁▁▁▁█▁▁▁▁"
    assert sparkline([math.nan, 1.0], 1.5) == " ▃"
    assert sparkline([], 1.5) == ""


def test_an_error_that_is_not_known_is_no_good_error(track):
    state = state_of(track, 3)
    state.add(replace(track.lines[4], error=math.nan))
    assert "model error   ?" in shown(state)
