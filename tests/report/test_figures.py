"""Figures show what they say: bounds, envelopes, every unstable pole; and can be written."""

import io

import numpy as np
import pytest

from ambid.report.drawing import autocorrelation, save, single
from ambid.report.figures import figures, overview


@pytest.fixture(scope="module")
def drawn(unstable):
    return figures(unstable)


@pytest.fixture(scope="module")
def stable_signals(stable):
    return single(*stable.drawings()["signals"])


def test_the_overview_has_all_parts(unstable):
    page = overview(unstable)
    titles = [axes.get_title() for axes in page.axes]
    for words in (
        "measured and predicted",
        "residuals",
        "autocorrelation",
        "voltage → position",
        "poles of the identified",
    ):
        assert any(words in title for title in titles), words
    labels = {axes.get_ylabel() for axes in page.axes}
    assert {"position [um]", "magnitude [m/V]", "magnitude [A/V]", "phase [°]"} <= labels


def test_measured_and_predicted_are_drawn_as_they_are(unstable, drawn):
    axes = drawn["signals"].axes[1]  # close view
    points, line = axes.lines[:2]
    t = np.asarray(points.get_xdata())
    first = int(np.argmin(np.abs(unstable.traces.time_s - t[0])))
    rows = slice(first, first + t.size)
    np.testing.assert_allclose(np.asarray(points.get_ydata()), 1e6 * unstable.run.measured[rows, 0])
    np.testing.assert_allclose(np.asarray(line.get_ydata()), 1e6 * unstable.run.predicted[rows, 0])
    # it is the worst stretch: none of that length has larger errors
    size = np.sum((unstable.run.innovations / unstable.run.innovations.std(axis=0)) ** 2, axis=1)
    sums = np.convolve(size, np.ones(t.size), mode="valid")
    assert sums[first] == pytest.approx(sums.max())


def test_long_records_are_drawn_by_their_extremes(stable, stable_signals):
    band = stable_signals.axes[0].collections[0]
    heights = np.concatenate([path.vertices[:, 1] for path in band.get_paths()])
    scale = np.max(np.abs(heights)) / np.max(np.abs(stable.run.measured[:, 0]))
    assert heights.min() == pytest.approx(scale * stable.run.measured[:, 0].min())
    assert heights.max() == pytest.approx(scale * stable.run.measured[:, 0].max())


def test_bounds_are_those_of_99_percent(unstable, drawn):
    axes = drawn["residuals"].axes[0]
    e, sd = unstable.run.innovations[:, 0], np.sqrt(unstable.estimate.noise.innovation_covariance[0, 0])
    (label,) = [text.get_text() for text in axes.texts]
    outside = float(label.split(" %")[0])
    assert outside == pytest.approx(100 * np.mean(np.abs(e) > 2.5758 * sd), rel=0.05)
    assert 0.2 < outside < 2.5  # 1 % of 3000, four standard errors


def test_autocorrelation_of_a_moving_average():
    w = np.random.default_rng(1).normal(size=200_000)
    rho = autocorrelation(w[1:] + 0.5 * w[:-1], 5)
    np.testing.assert_allclose(rho, [1.0, 0.4, 0.0, 0.0, 0.0, 0.0], atol=0.012)
    assert autocorrelation(np.ones(3), 50).size == 3


def test_simulation_is_shown_where_the_plant_is_stable(stable_signals, drawn):
    def labels(figure):
        return [line.get_label() for line in figure.axes[1].lines]

    assert "simulated from the input" in labels(stable_signals)
    assert "simulated from the input" not in labels(drawn["signals"])


def test_the_unstable_pole_is_named(drawn):
    (text,) = [t.get_text() for t in drawn["poles"].axes[1].texts]
    assert text.count("unstable, time constant") == 1


@pytest.mark.parametrize(("kind", "magic"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_figures_are_written_and_equal_ones_are_equal(unstable, drawn, kind, magic):
    files = []
    for figure in (drawn["poles"], single(*unstable.drawings()["poles"]))[: 2 if kind == "png" else 1]:
        buffer = io.BytesIO()
        save(figure, buffer, kind=kind)
        files.append(buffer.getvalue())
    assert files[0].startswith(magic)
    if kind == "png":
        assert files[0] == files[1]
