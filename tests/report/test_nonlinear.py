"""Text and figure of a nonlinear fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.identify.narmax.estimate import narmax
from ambid.identify.nonlinear.fit import LearningCurve, NonlinearFit
from ambid.report.nonlinear_figure import nonlinear_overview, traces_of
from ambid.report.nonlinear_panels import bars_of, columns_of
from ambid.report.nonlinear_text import curve_line, nonlinear_text, setting_text, term_lines
from ambid.validate.nonlinear import judged
from tests.validate.nonlinear.plants import Static, io, squared, static_fit


@pytest.fixture(scope="module")
def fit() -> NonlinearFit:
    data = squared(500, 1)
    return judged(narmax([data], {"selection": "all", "pruning": "none", "ny": 3, "nu": 3, "ne": 0}), [data])


def test_the_first_twenty_terms_with_ratio_and_spread(fit: NonlinearFit) -> None:
    lines = term_lines(fit)
    assert fit.model is not None
    assert fit.model.theta.size > 20
    assert len(lines) == 22
    assert lines[0].split() == ["term", "coefficient", "±", "sd", "ERR"]
    assert lines[-1] == f"… and {fit.model.theta.size - 20} more; --json has them all"
    k = fit.model.names.index("u(t-1)")
    row = next(x for x in lines if x.startswith("u(t-1) "))
    assert fit.sd is not None
    assert abs(float(row.split()[1]) - fit.model.theta[k]) < 0.5 * fit.sd[k]
    assert "±" not in "".join(term_lines(replace(fit, covariance=None)))


def test_the_table_fits_a_terminal_and_holds_every_part(fit: NonlinearFit) -> None:
    curve = LearningCurve(
        method="descent", seconds=np.array([0.0, 0.5]), training=np.array([1.0, 0.25]), held_out=np.array([1.1, 0.3])
    )
    text = nonlinear_text(replace(fit, curves=(curve,), warnings=("mind the gap " * 12,), settings={"nu": (2, 3)}))
    assert max(map(len, text.splitlines())) <= 80
    for part in ("settings: nu = 2/3; seed 0", "criteria: aic", "residuals_nonlinear", "warning: mind", "descent: 2"):
        assert part in text
    assert curve_line(curve).endswith("error 1 -> 0.25 of the output, held out 1.1 -> 0.3")
    assert setting_text(0.5) == "0.5"


def test_a_failed_fit_shows_its_reason(fit: NonlinearFit) -> None:
    failed = replace(fit, model=None, covariance=None, status="failed", reason="no finite weights " * 9, fit={})
    text = nonlinear_text(replace(failed, checks={}, criteria={}))
    assert "no model: no finite weights" in text
    assert max(map(len, text.splitlines())) <= 80


def test_the_figure_shows_what_the_fit_says(fit: NonlinearFit) -> None:
    data = squared(400, 2)
    curve = LearningCurve(method="x", seconds=np.array([0.0, 0.1]), training=np.array([1.0, 0.5]))
    page = nonlinear_overview(replace(fit, curves=(curve,)), [data])
    titles = [a.get_title() for a in page.axes]
    assert "e of y, u²" in titles
    assert "learning curves (dashed: held out)" in titles
    assert any("coefficients with 95 % intervals" in x for x in texts_of(page))
    traces = traces_of(fit, data)
    assert fit.model is not None
    np.testing.assert_array_equal(traces.measured, data.y[fit.model.lag :])
    np.testing.assert_allclose(traces.predicted, fit.model.predict(data.u, data.y)[fit.model.lag :])
    assert traces.simulated is not None
    np.testing.assert_allclose(traces.simulated, fit.model.simulate(data.u, data.y)[fit.model.lag :])


def texts_of(figure) -> list[str]:
    """Every text of a figure and the figures in it."""
    from matplotlib.text import Text

    return [x.get_text() for x in figure.findobj(Text)]


def test_six_of_many_records_are_drawn_and_the_second_one_too(fit: NonlinearFit) -> None:
    records = [squared(120, k) for k in range(9)]
    records = [replace(x, record={**x.record, "file": f"{k}.csv"}) for k, x in enumerate(records)]
    page = nonlinear_overview(fit, records[:8], records[8])
    page.canvas.draw()
    texts = texts_of(page)
    assert any("8 records" in x and "the first 6 are drawn, 2 more are not" in x for x in texts)
    assert {f"{k}.csv" for k in range(6)} <= set(texts)
    assert "6.csv" not in texts
    assert "second record, not fitted: 8.csv" in texts
    assert [columns_of(n) for n in (1, 2, 3, 4, 5, 7)] == [1, 2, 3, 2, 3, 3]


def test_the_most_significant_coefficients_have_bars_of_their_95_percent_intervals(fit: NonlinearFit) -> None:
    bars = bars_of(fit)
    assert bars is not None
    assert fit.model is not None
    assert fit.sd is not None
    ratio = np.abs(fit.model.theta) / fit.sd
    assert len(bars.names) == 25
    assert bars.n_more == fit.model.theta.size - 25
    assert set(bars.names) == {fit.model.names[k] for k in np.argsort(-ratio)[:25]}
    k = fit.model.names.index(bars.names[0])
    assert (bars.theta[0], bars.half_width[0]) == (fit.model.theta[k], pytest.approx(1.96 * fit.sd[k], rel=1e-3))
    assert bars_of(replace(fit, covariance=None)) is None


def test_of_weights_without_names_the_predictions_with_their_bands_are_drawn(fit: NonlinearFit) -> None:
    plain = replace(fit, details={})
    assert bars_of(plain) is None
    data = squared(400, 2)
    page = nonlinear_overview(plain, [data])
    page.canvas.draw()
    texts = texts_of(page)
    assert "predictions with their bands" in texts
    assert not any("coefficients" in x for x in texts)
    axes = next(a for a in page.axes if a.get_title() == "measured - predicted")
    low, high = (float(f(axes.collections[0].get_datalim(axes.transData).intervaly)) for f in (np.min, np.max))
    scale = 1e-3 if "mm" in axes.get_ylabel() else 1.0
    sd = np.sqrt(fit.noise_covariance[0, 0])
    assert high * scale > 1.96 * sd * 0.999
    assert high * scale < 1.96 * sd * 3.0
    assert low == pytest.approx(-high)


def test_a_free_run_that_diverges_is_left_out_of_the_figure() -> None:
    rng = np.random.default_rng(3)
    data = io(rng.standard_normal(200), rng.standard_normal(200))
    fit = static_fit(Static(diverges_at=50), data)
    assert traces_of(fit, data).simulated is None
    nonlinear_overview(fit, [data]).canvas.draw()
