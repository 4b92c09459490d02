"""Figures of black-box fits: what is estimated is drawn with its uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from scipy.signal import lfilter

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import structure
from ambid.report.fit_figures import comparison_figure, fit_overview, traces_of
from ambid.validation.comparison import compare
from ambid.validation.fits import judge

POLES, ZEROS = 0.9 * np.exp(0.4j), 0.8 * np.exp(1.2j)


@pytest.fixture(scope="module")
def data() -> IOData:
    rng = np.random.default_rng(0)
    u = rng.standard_normal((2000, 1))
    b, f = (np.poly([r, r.conj()]).real for r in (ZEROS, POLES))
    y = lfilter(np.append(0.0, b), f, u, axis=0) + 0.5 * rng.standard_normal(u.shape)
    return IOData(
        u=u, y=y, dt=0.01, inputs=("u",), outputs=("y",), units={"u": "V", "y": "m"}, open_loop=True,
        record={"samples": 2000},
    )  # fmt: skip


def test_poles_and_zeros_are_drawn_with_their_regions(data: IOData) -> None:
    fit = judge(structure("oe").estimator(data, {"nb": 3, "nf": 2, "nk": 1}), data)
    (axes,) = (a for a in fit_overview(fit, [data]).findobj(Axes) if "zeros" in a.get_title(loc="left"))
    regions = [p for p in axes.patches if isinstance(p, Ellipse)]
    centres = np.array([complex(*p.get_center()) for p in regions])
    truth = np.array([POLES, POLES.conj(), ZEROS, ZEROS.conj()])
    assert len(regions) == 4
    assert np.max(np.min(np.abs(truth[:, None] - centres), axis=1)) < 0.02
    assert all(0 < p.width < 0.1 for p in regions)


def test_time_is_that_of_the_record_after_a_cut(data: IOData) -> None:
    part = replace(data, start_s=3.0).part(500, 1500)
    fit = structure("oe").estimator(part, {"nb": 1, "nf": 1, "nk": 1})
    t = traces_of(fit, part).time_s
    assert part.start_s == t[0] == 3.0 + 500 * data.dt
    assert t[-1] == pytest.approx(3.0 + 1499 * data.dt)


def test_structures_are_drawn_by_what_they_leave_of_unseen_data(data: IOData) -> None:
    found = compare(data, [("oe", {"nb": 3, "nf": 2, "nk": 1}), ("arx", {"na": 1, "nb": 1, "nk": 1})])
    page = comparison_figure(found, found.used)
    errors, tests = page.axes[:2]
    (one, free) = (np.asarray(x.get_xdata()) for x in errors.lines)
    np.testing.assert_allclose(one, [100 * (1 - (x.one_step or 0)) for x in found.entries])
    np.testing.assert_allclose(free, [100 * (1 - (x.simulation or 0)) for x in found.entries])
    assert [t.get_text().split(",")[0] for t in errors.get_yticklabels()] == [x.structure for x in found.entries]
    assert tests.get_xscale() == "log"
    (whole,) = (a for a in page.axes if a.get_title(loc="left") == "y, the whole record")
    low, high = whole.dataLim.intervalx
    assert low == found.used.start_s > 13.9  # the held-out part, at its own time
    assert high == pytest.approx(19.99)
