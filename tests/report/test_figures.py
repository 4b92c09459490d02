"""Figures show what they say: bounds, envelopes, every unstable pole; and can be written."""

import io
import itertools
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from ambid.errors import AmbidError
from ambid.estimation.estimate import Check, Delay
from ambid.report.drawing import save, single
from ambid.report.estimate import poles_section
from ambid.report.estimate_figures import (
    figures,
    measured_beside,
    overview,
    poles,
    responses,
    unsampled,
    validation_figure,
)
from ambid.report.response_panels import Pole, poles_panel
from ambid.report.signals import autocorrelation, whiteness_panel
from ambid.validation.second_record import Validation


@pytest.fixture(scope="module")
def drawn(unstable):
    return figures(unstable)


@pytest.fixture(scope="module")
def stable_signals(stable):
    return single(stable.drawings()["signals"])


def test_the_overview_has_all_parts(unstable):
    page = overview(unstable)
    titles = [axes.get_title(loc="left") for axes in page.axes]
    for words in (
        "position, the whole record",
        "where the errors are largest",
        "position residual: ",
        "spectrum of the current residual",
        "autocorrelation: position residual is white",
        "current residual × past voltage: uncorrelated",
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


def test_bounds_are_those_of_95_percent(unstable, drawn):
    axes = drawn["residuals"].axes[0]
    e, sd = unstable.run.innovations[:, 0], np.sqrt(unstable.estimate.noise.innovation_covariance[0, 0])
    outside = float(axes.get_title(loc="left").split(": ")[1].split(" %")[0])
    assert outside == pytest.approx(100 * np.mean(np.abs(e) > 1.96 * sd), rel=0.05)
    assert 3.4 < outside < 6.6  # 5 % of 3000, four standard errors


def test_correlations_of_white_residuals_keep_their_bounds(drawn):
    own, cross = drawn["whiteness"].axes[:2]
    for axes in (own, cross):
        band, stems = axes.collections
        limit = band.get_paths()[0].vertices[:, 1].max()
        sizes = np.array([path[1, 1] for path in stems.get_segments()])
        assert sizes.size == 50
        assert np.mean(np.abs(sizes) <= limit) > 0.8


def test_a_failed_check_is_seen_in_its_panel(unstable):
    page = single(whiteness_panel(unstable.traces, ["residuals_white"]))
    assert page.axes[0].get_title(loc="left") == "✗ autocorrelation: position residual is not white"
    assert page.axes[1].get_title(loc="left") == "position residual × past voltage: uncorrelated"


def test_the_measured_response_of_a_loop_agrees_with_the_plant(unstable):
    found = measured_beside(unstable)
    radius = found.confidence_radius()
    plant = responses(unstable.estimate)
    for o in range(2):
        known = np.isfinite(radius[:, o, 0])
        assert 1500.0 < found.frequency_hz[known].max() < 2500.0  # excited up to 2000 Hz, told in lines of 53 Hz
        at = [np.interp(found.frequency_hz[known], plant.frequency_hz, f(plant.G[:, o, 0])) for f in (np.real, np.imag)]
        off = np.abs(found.G[known, o, 0] - (at[0] + 1j * at[1]))
        assert np.mean(off < radius[known, o, 0]) > 0.9


def test_hold_delay_and_sampling_are_taken_out_of_what_is_measured(unstable):
    """A sampled response is the sum of the held one's copies around all multiples of the rate (Poisson)."""
    late = Delay(samples=2, fraction=0.3, sd=None, how="given")
    estimate, c = replace(unstable.estimate, delay={"voltage": late}), unstable.estimate.continuous
    frequency, rate_hz = np.array([100.0, 2000.0, 4000.0, 9000.0]), 20_000.0

    def plant(f):
        s = 2j * np.pi * f[:, None, None] * np.eye(3)
        return c.C @ np.linalg.solve(s - c.A, np.broadcast_to(c.B, (f.size, 3, 1)))

    def held(f):
        return plant(f) * (np.sinc(f / rate_hz) * np.exp(-2j * np.pi * f / rate_hz * 2.8))[:, None, None]

    copies = sum(held(frequency + k * rate_hz) for k in range(-300, 301))
    np.testing.assert_allclose(unsampled(estimate, frequency, rate_hz) * copies, plant(frequency), rtol=2e-3)


def test_nothing_covers_anything_else(unstable):
    shown = {k: block for k, block in unstable.drawings().items() if k in ("signals", "whiteness", "poles")}
    for figure in (single(block) for block in shown.values()):
        figure.draw_without_rendering()
        boxes = [a.get_tightbbox() for a in figure.axes] + [x.get_window_extent() for x in figure.legends]
        page = figure.bbox.padded(1.0)
        for k, box in enumerate(boxes):
            assert min(box.x0 - page.x0, page.x1 - box.x1, box.y0 - page.y0, page.y1 - box.y1) >= 0
            for other in boxes[:k]:
                shared = Bbox.intersection(box.padded(-1.0), other.padded(-1.0))
                assert shared is None or min(shared.width, shared.height) < 1.0
        for axes in figure.axes:
            ticks = [t.get_window_extent() for t in axes.get_xticklabels() if t.get_text() and t.get_visible()]
            assert all(a.x1 <= b.x0 + 0.5 for a, b in itertools.pairwise(sorted(ticks, key=lambda b: b.x0)))


def test_poles_that_overlap_are_drawn_again_larger():
    near = [Pole(value=x, covariance=None) for x in (1.02 + 0j, 0.98 + 0.004j, 0.98 - 0.004j, 0.1 + 0j)]
    _, close = single(poles_panel(near, "all", discrete=True)).axes
    left, right = close.get_xlim()
    assert left < 0.98 < 1.02 < right < 1.1
    assert close.get_title(loc="left") == "close view of 3 of them"
    apart = [Pole(value=x, covariance=None) for x in (-40 + 9j, -40 - 9j, 43 + 0j)]
    assert len(single(poles_panel(apart, "all")).axes) == 1


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


def test_the_unstable_pole_is_named(unstable):
    (table,) = poles_section(poles(unstable.estimate)).parts
    assert sum("unstable, time constant" in row[3][0] for row in table.rows) == 1


@pytest.mark.drawn
@pytest.mark.parametrize(("kind", "magic"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_figures_are_written_and_equal_ones_are_equal(unstable, drawn, kind, magic):
    files = []
    for figure in (drawn["poles"], single(unstable.drawings()["poles"]))[: 2 if kind == "png" else 1]:
        buffer = io.BytesIO()
        save(figure, buffer, kind=kind)
        files.append(buffer.getvalue())
    assert files[0].startswith(magic)
    if kind == "png":
        assert files[0] == files[1]


def test_a_second_record_is_drawn_with_predictions_several_steps_ahead(unstable):
    traces = unstable.traces_ahead()
    assert list(traces.ahead) == [10, 100]
    for k, predicted in traces.ahead.items():
        assert np.all(np.isnan(predicted[: k - 1]))
        error = np.std(traces.measured[k - 1 :] - predicted[k - 1 :], axis=0)
        assert np.all(error >= 0.999 * np.std(traces.errors, axis=0))  # farther ahead is not better
    found = validated(unstable.estimate)
    page = validation_figure(found, [traces])
    titles = [a.get_title(loc="left") for a in page.axes]
    assert {"errors of the predictions: smaller is better", "growth of the errors with the horizon"} <= set(titles)
    assert "✗ autocorrelation: position residual is not white" in titles
    labels = {x.get_text() for place in page.subfigs for legend in place.legends for x in legend.get_texts()}
    assert {"predicted 10 steps ahead", "predicted 100 steps ahead", "as the model expects"} <= labels


def validated(estimate):
    sizes = {
        "one_step": 0.9,
        "simulation": None,
        "k_step": {"1": 0.9, "10": 0.8},
        "k_step_ratio": {"1": 1.0, "10": 1.1},
    }
    return Validation(
        estimate="a.json", record="b.csv", model=estimate.model, samples=3000,
        fit={"position": sizes, "current": sizes}, checks={"residuals_white": Check(passed=False, detail="as it is")},
    )  # fmt: skip


def test_a_figure_of_another_format_is_refused(tmp_path):
    with pytest.raises(AmbidError, match=r"a figure as \.jpg .*is written as \.png, \.svg or \.pdf"):
        save(Figure(), tmp_path / "a.jpg")
    assert not list(tmp_path.iterdir())
