"""Text and figure of a nonlinear fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ambid.job.presentation import text as fit_text
from ambid.nonlinear.fit import LearningCurve, NonlinearFit
from ambid.nonlinear.narmax import narmax
from ambid.report.document import part_lines
from ambid.report.fit import (
    curve_line,
    curve_lines,
    named_parts,
    schedule_parts,
    setting_text,
    term_parts,
)
from ambid.report.fit_figures import fit_overview, traces_of
from ambid.validation.fits import judge
from tests.validation.nonlinear.plants import Static, io, squared, static_fit


@dataclass(frozen=True)
class Renamed:
    """Numbers under other names, all that a table wants of a model."""

    names: tuple[str, ...]
    theta: NDArray[np.float64]


def lines_of(parts, fit):
    return [line for part in parts(fit) for line in part_lines(part, 80)]


@pytest.fixture(scope="module")
def fit() -> NonlinearFit:
    data = squared(500, 1)
    return judge(narmax([data], {"selection": "all", "pruning": "none", "ny": 3, "nu": 3, "ne": 0}), [data])


def test_the_first_twenty_terms_with_ratio_and_spread(fit: NonlinearFit) -> None:
    lines = lines_of(term_parts, fit)
    assert fit.model is not None
    assert fit.model.theta.size > 20
    assert len(lines) == 22
    assert lines[0].split() == ["term", "coefficient", "±", "sd", "ERR"]
    assert lines[-1] == f"… and {fit.model.theta.size - 20} more; save() has them all"
    k = fit.model.names.index("u(t-1)")
    row = next(x for x in lines if x.startswith("u(t-1) "))
    assert fit.sd is not None
    assert abs(float(row.split()[1]) - fit.model.theta[k]) < 0.5 * fit.sd[k]
    assert "±" not in "".join(lines_of(term_parts, replace(fit, covariance=None)))


def test_weights_beside_terms_are_counted_and_ratios_shown_where_there_are_any(fit: NonlinearFit) -> None:
    assert fit.model is not None
    names = [f"unit 1: {x}" if k > 3 else x for k, x in enumerate(fit.model.names)]
    hybrid = replace(
        fit,
        model=Renamed(names=tuple(names), theta=fit.model.theta),
        details={"terms": {"y": [{"term": x} for x in names[:4]]}},
    )
    lines = lines_of(term_parts, hybrid)
    assert lines[0].split() == ["term", "coefficient", "±", "sd"]
    assert [x.split()[0] for x in lines[1:5]] == names[:4]
    assert lines[5:] == [f"and a network of {len(names) - 4} weights; save() has them"]


def test_numbers_with_a_meaning_are_listed_and_weights_are_not(fit: NonlinearFit) -> None:
    few = replace(
        fit, model=Renamed(names=("a21", "b3"), theta=np.array([1939.0, 8.5])), covariance=np.diag([121.0, 0])
    )
    assert [x.split() for x in lines_of(named_parts, few)] == [
        ["parameter", "coefficient", "±", "sd"],
        ["a21", "1939", "±", "11"],
    ]
    assert lines_of(named_parts, replace(few, model=Renamed(names=("a21", "unit 1: u"), theta=np.ones(2)))) == []
    assert lines_of(named_parts, replace(fit, details={})) == []


def test_a_schedule_is_shown_at_its_ends_and_in_the_middle(fit: NonlinearFit) -> None:
    table = [
        {
            "p": p,
            "poles_rad_s": [[-3.0, 4.0, 0.1, 0.2], [-3.0, -4.0, 0.1, 0.2], [-20.0, 0.0, 1.0, 0.0]],
            "dc_gain": {"u": [g, s]},
        }
        for p, g, s in ((1.0, 2.0, 0.1), (1.5, 2.5, 0.1), (2.0, 3.0, None))
    ]
    schedule = {"signal": "level", "low": 1.0, "high": 2.0, "time_constant_s": 0.5, "unit": "m"}
    lines = lines_of(schedule_parts, replace(fit, details={"schedule": schedule, "frozen": table}))
    assert lines[0] == "schedule: the output, low-passed (0.5 s), 1 to 2 m in training"
    assert [x.split()[0] for x in lines[2:]] == ["1", "1.5", "2"]
    assert "-3.00 ± 0.10 ± j 4.00 ± 0.20, -20.0 ± 1.0" in lines[2]
    assert lines[2].endswith("2.00 ± 0.10")
    assert lines[4].endswith(" 3")


def test_of_many_trainings_the_first_and_the_last_are_shown() -> None:
    curves = [LearningCurve(method=f"m{k}", seconds=np.array([0.1]), training=np.array([1.0])) for k in range(9)]
    lines = curve_lines(curves)
    assert [x.split(":")[0] for x in (*lines[:3], *lines[4:])] == ["m0", "m1", "m2", "m6", "m7", "m8"]
    assert lines[3].startswith("… 3 more trainings")
    assert curve_lines(curves[:6]) == [curve_line(c) for c in curves[:6]]


def test_the_table_fits_a_terminal_and_holds_every_part(fit: NonlinearFit) -> None:
    curve = LearningCurve(
        method="descent", seconds=np.array([0.0, 0.5]), training=np.array([1.0, 0.25]), held_out=np.array([1.1, 0.3])
    )
    text = fit_text(replace(fit, curves=(curve,), warnings=("mind the gap " * 12,), settings={"nu": (2, 3)}))
    assert max(map(len, text.splitlines())) <= 80
    for part in ("settings: nu = 2/3; seed 0", "criteria: aic", "residuals_nonlinear", "warning: mind", "descent: 2"):
        assert part in text
    assert curve_line(curve).endswith("error 1 -> 0.25 of the output, held out 1.1 -> 0.3")
    assert setting_text(0.5) == "0.5"


def test_a_failed_fit_shows_its_reason(fit: NonlinearFit) -> None:
    failed = replace(fit, model=None, covariance=None, status="failed", reason="no finite weights " * 9, fit={})
    text = fit_text(replace(failed, checks={}, criteria={}))
    assert "no model: no finite weights" in text
    assert max(map(len, text.splitlines())) <= 80


def test_the_figure_shows_what_the_fit_says(fit: NonlinearFit) -> None:
    data = squared(400, 2)
    page = fit_overview(fit, [data])
    titles = [a.get_title(loc="left") for a in page.axes]
    assert "e of y, u²" in titles
    assert "predictions with their bands" in texts_of(page)
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
    page = fit_overview(fit, records[:8], records[8])
    page.canvas.draw()
    texts = texts_of(page)
    assert any("8 records" in x and "the first 6 are drawn, 2 more are not" in x for x in texts)
    assert {f"{k}.csv" for k in range(6)} <= set(texts)
    assert "6.csv" not in texts
    assert "second record, not fitted: 8.csv" in texts


def test_a_free_run_that_diverges_is_left_out_of_the_figure() -> None:
    rng = np.random.default_rng(3)
    data = io(rng.standard_normal(200), rng.standard_normal(200))
    fit = static_fit(Static(diverges_at=50), data)
    assert traces_of(fit, data).simulated is None
    fit_overview(fit, [data]).canvas.draw()
