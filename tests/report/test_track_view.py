"""The live view as a function of what is known: what it shows, on which terminal, how wide."""

from __future__ import annotations

import io
import math

import pytest
from rich.console import Console

from ambid.recursive.lines import Event
from ambid.report.track_text import TrackView, interval_bar, live_view, sparkline
from tests.tracking.tracks import track_of


@pytest.fixture(scope="module")
def track():
    return track_of(seconds=12.0, every_s=0.05)


def shown(view, width=80, ascii_only=False):
    console = Console(width=width, file=io.StringIO(), legacy_windows=False)
    console.print(live_view(view, ascii_only=ascii_only))
    return console.file.getvalue()


def view_of(track, k, **more):
    lines = track.lines[: k + 1]
    start = track.header.start
    return TrackView(
        header=track.header,
        line=lines[-1],
        errors=tuple(x.error for x in lines),
        decisions=tuple(e for x in lines for e in x.events),
        ranges={n: (v.value - 0.2 * abs(v.value), v.value + 0.2 * abs(v.value)) for n, v in start.items()},
        length_s=12.0,
        wall_s=0.5,
        **more,
    )


def test_everything_that_an_operator_needs_is_there(track):
    k = next(k for k, x in enumerate(track.lines) if x.state == "changed") + 1
    text = shown(view_of(track, k, keys=True, pressed="hold", open_changes=1, rejected=14, behind_s=0.003))
    for words in (
        "loop.csv: model one-axis, rpem",
        "changed",
        "of 12 s",
        "3 ms behind",
        "limit 1.5",
        "change k_i: k_i fell",
        "1 open change",
        "14 samples rejected",
        "times real time",
        "h hold",
        "(pressed: hold)",
    ):
        assert words in text, words
    for name in track.header.units:
        assert any(row.startswith(f"{name} ") and "±" in row and "●" in row for row in text.splitlines()), name
    assert "h hold" not in shown(view_of(track, k))


def test_it_fits_into_80_columns_and_plain_letters(track):
    view = view_of(track, 200, keys=True)
    assert max(map(len, shown(view).splitlines())) <= 80
    plain = shown(view, ascii_only=True)
    assert set(plain) - {"±", "…"} <= set(map(chr, range(10, 127)))


def test_stale_parameters_are_marked(track):
    k = next(k for k, x in enumerate(track.lines) if x.state == "frozen")
    assert shown(view_of(track, k)).count("STALE") == 5
    assert "STALE" not in shown(view_of(track, k - 10))


def test_only_the_last_decisions_are_shown(track):
    view = view_of(track, 5)
    many = tuple(Event(kind="accepted", t=float(k), why=f"number {k}.") for k in range(20))
    text = shown(TrackView(header=view.header, line=view.line, decisions=many))
    assert "number 13." not in text
    assert "number 14." in text
    assert "number 19." in text


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
    from dataclasses import replace

    view = view_of(track, 3)
    text = shown(replace(view, line=replace(view.line, error=math.nan)))
    assert "model error   ?" in text
