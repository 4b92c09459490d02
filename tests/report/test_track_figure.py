"""Figure of a track: values, bands, truth, stale stretches, changes, error and state are where they belong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex

from ambid.recursive.lines import Event, TrackedValue
from ambid.report.drawing import BAND, save
from ambid.report.track_figures import STATES, TrackHistory, event_words, runs, track_figure, truth_words
from tests.tracking.tracks import track_of, truth_of


@pytest.fixture(scope="module")
def track():
    return track_of(seconds=30.0, every_s=0.1)


@pytest.fixture(scope="module")
def figure(track):
    return track_figure(track, truth=truth_of(30.0))


def panel(figure, label):
    (found,) = (a for a in figure.axes if a.get_ylabel().split(" [")[0] == label)
    return found


def band(axes):
    """Lower and upper edge of the 95 % band, both over its times."""
    (found,) = (c for c in axes.collections if isinstance(c, PolyCollection) and to_hex(c.get_facecolor()[0]) == BAND)
    return found.get_paths()[0].vertices


def test_each_parameter_has_a_panel_with_value_band_and_truth(track, figure):
    labels = [a.get_ylabel() for a in figure.axes]
    assert labels == ["m [kg]", "k_x [kN/m]", "k_i [N/A]", "R [ohm]", "L [mH]", "model error", "state"]
    axes = panel(figure, "L")
    p = [x.parameters["L"] for x in track.lines]
    (value, truth) = (line for line in axes.lines if len(line.get_xdata()) > 2)
    np.testing.assert_allclose(value.get_ydata(), [1e3 * v.value for v in p])
    np.testing.assert_allclose(truth.get_ydata(), 1e3 * truth_of(30.0)["L"][1])
    edges = band(axes)[:, 1]
    assert edges.max() == pytest.approx(1e3 * max(v.value + 1.959964 * v.sd for v in p))
    assert edges.min() == pytest.approx(1e3 * min(v.value - 1.959964 * v.sd for v in p))
    assert "truth inside the band in" in axes.get_title(loc="right")


def test_stale_stretches_changes_and_states_are_marked(track, figure):
    axes = panel(figure, "k_i")
    grey = [p for p in axes.patches if to_hex(p.get_facecolor()) == "#d9d9d9"]
    assert [(round(p.get_x(), 6), round(p.get_x() + p.get_width(), 6)) for p in grey] == [(17.9, 22.4)]
    marks = [line.get_xdata()[0] for line in axes.lines if len(line.get_xdata()) == 2]
    assert marks == [10.0]
    assert [t.get_text() for t in axes.texts] == ["k_i change at 10 s"]
    assert not panel(figure, "R").texts  # the mark is there, its name where it belongs
    hatches = {p.get_hatch() for p in panel(figure, "state").patches}
    assert len(hatches) == 3  # states differ by more than colour


def test_a_short_state_is_not_lost_in_a_long_track():
    long = track_of(seconds=2000.0, every_s=0.5, names=("R",))
    axes = panel(track_figure(long), "state")
    narrow = [p.get_width() for p in axes.patches if p.get_hatch() == "xxx"]
    assert narrow == [pytest.approx(0.004 * 2000.0)]


def test_a_long_track_is_drawn_as_its_extremes():
    long = track_of(seconds=400.0, every_s=0.1, names=("R",))
    k = 2345
    outlier = TrackedValue(value=3.0, sd=0.004)
    lines = (*long.lines[:k], replace(long.lines[k], parameters={"R": outlier}), *long.lines[k + 1 :])
    page = track_figure(replace(long, lines=lines))
    axes = panel(page, "R")
    points = np.concatenate([c.get_paths()[0].vertices for c in axes.collections])
    assert points.shape[0] < 12_000
    assert points[:, 1].max() == pytest.approx(3.0 + 1.959964 * 0.004)  # one line in 4000 is not smoothed away
    (legend,) = page.legends
    assert "extremes of 8 lines each" in legend.get_texts()[0].get_text()


def test_a_band_that_begins_wide_does_not_hide_the_rest(track):
    first = track.lines[0]
    wide = {n: TrackedValue(value=v.value, sd=100 * abs(v.value)) for n, v in first.parameters.items()}
    page = track_figure(replace(track, lines=(replace(first, parameters=wide), *track.lines[1:])))
    low, high = panel(page, "m").get_ylim()
    assert 3.5 < low < high < 4.5


def test_names_of_events_do_not_lie_on_each_other(track):
    changes = tuple(Event(kind="change", t=5.0 + 0.2 * k, why="", parameter="R") for k in range(12))
    lines = (*track.lines[:70], replace(track.lines[70], events=changes), *track.lines[71:])
    axes = panel(track_figure(replace(track, lines=lines)), "R")
    axes.figure.canvas.draw()
    boxes = [t.get_window_extent() for t in axes.texts]
    assert 2 <= len(boxes) < 12
    assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])


def test_awkward_tracks_are_drawn(tmp_path):
    track = track_of(seconds=10.0, every_s=0.1, names=("R",))
    one = replace(track, lines=track.lines[:1])
    late = replace(track.lines[50], extra={"unbalance": TrackedValue(value=float("nan"), sd=float("inf"))})
    mixed = replace(track, lines=(*track.lines[:20], replace(track.lines[20], error=float("nan")), late))
    off = replace(track, lines=(replace(track.lines[0], error=400.0), *track.lines[1:4]))
    for k, awkward in enumerate((one, mixed, off)):
        save(track_figure(awkward), tmp_path / f"{k}.png")
        assert (tmp_path / f"{k}.png").stat().st_size > 10_000
    assert panel(track_figure(off), "model error").get_yscale() == "log"
    assert "not known in 4.5 %" in panel(track_figure(mixed), "model error").get_title(loc="right")


def test_a_history_holds_what_the_lines_hold(track):
    history = TrackHistory.of(track)
    assert history.n_lines == len(track.lines)
    value, sd, stale = history.values("R")
    np.testing.assert_array_equal(value, [x.parameters["R"].value for x in track.lines])
    np.testing.assert_array_equal(sd, [x.parameters["R"].sd for x in track.lines])
    np.testing.assert_array_equal(stale, [x.parameters["R"].stale for x in track.lines])
    assert [STATES[k] for k in history.state] == [x.state for x in track.lines]
    assert len(history.events) == 5


def test_what_is_tracked_for_a_time_only_is_unknown_elsewhere(track):
    extra = {"unbalance": TrackedValue(value=1e-5, sd=1e-6, stale=True)}
    lines = [replace(x, extra=extra if 5 <= k < 8 else {}) for k, x in enumerate(track.lines[:12])]
    history = TrackHistory.of(replace(track, lines=tuple(lines)))
    value, sd, stale = history.values("unbalance")
    assert np.flatnonzero(np.isfinite(value)).tolist() == [5, 6, 7]
    assert np.flatnonzero(stale).tolist() == [5, 6, 7]
    assert sd[6] == 1e-6


def test_the_words_beside_the_truth_count_lines_that_are_not_stale():
    t = np.arange(1.0, 101.0)
    truth = (np.array([0.0, 101.0]), np.array([2.0, 2.0]))
    value = np.where(t <= 80, 2.01, 2.5)
    assert truth_words(t, value, np.full(100, 0.1), t > 90, truth).startswith("truth inside the band in 89 %")
    assert "median distance 0.5 % (0.1 sd)" in truth_words(t, value, np.full(100, 0.1), t > 90, truth)
    assert truth_words(t, value, np.full(100, 0.1), t > 0, truth) == ""


def test_runs_and_words():
    assert list(runs(np.array([True, False, True, True, False, True]))) == [(0, 0), (2, 3), (5, 5)]
    assert list(runs(np.zeros(3, dtype=bool))) == []
    assert event_words(Event(kind="disturbed", t=12.3456, why="")) == "disturbed at 12.35 s"


def test_the_change_of_a_negative_parameter_is_told_as_the_table_tells_it():
    track = track_of(seconds=5.0, every_s=0.1, names=("k_x",))
    axes = panel(track_figure(track), "k_x")
    start, last = track.header.start["k_x"].value, track.lines[-1].parameters["k_x"].value
    assert start < 0
    assert axes.get_title(loc="left") == f"{100 * (last / start - 1):+.3g} % from start"
    assert not axes.child_axes  # a second axis in per cent would run downward
