"""The five gradients against fourth differences, the predictor against its definition, triangles against dense QR."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.blackbox.polynomial_predictor import Layout, predictor

NO = (0, 0)
STEP = 1e-3
LAYOUTS = {
    "fir": Layout(na=0, nb=(2, 3), nc=0, nd=0, nf=NO, nk=(1, 0)),
    "arx": Layout(na=2, nb=(2, 1), nc=0, nd=0, nf=NO, nk=(1, 3)),
    "armax": Layout(na=2, nb=(2, 1), nc=2, nd=0, nf=NO, nk=(1, 0)),
    "arma": Layout(na=3, nb=(), nc=2, nd=0, nf=(), nk=()),
    "ararx": Layout(na=2, nb=(2, 1), nc=0, nd=2, nf=NO, nk=(1, 2)),
    "ararmax": Layout(na=1, nb=(2, 2), nc=3, nd=1, nf=NO, nk=(0, 2)),
    "oe": Layout(na=0, nb=(2, 3), nc=0, nd=0, nf=(2, 1), nk=(1, 2)),
    "bj": Layout(na=0, nb=(2, 1), nc=1, nd=2, nf=(2, 4), nk=(0, 2)),
    "everything": Layout(na=2, nb=(1, 2), nc=4, nd=3, nf=(1, 2), nk=(1, 2), fixed=(1,)),
}


def case(layout: Layout, n: int = 160) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(8)
    p, theta = predictor(layout), layout.start()
    theta[layout.free] = 0.3 * rng.standard_normal(layout.free.size) / np.sqrt(layout.free.size)
    return rng.standard_normal(n), rng.standard_normal((layout.n_inputs, n)), theta, rng.standard_normal(p.n_nuisance)


AT_REST = Layout(na=1, nb=(2,), nc=2, nd=1, nf=(2,), nk=(1,), at_rest=True)


@pytest.mark.parametrize("layout", [*LAYOUTS.values(), AT_REST], ids=[*LAYOUTS, "at rest"])
def test_gradients_agree_with_fourth_differences(layout: Layout) -> None:
    p, (y, u, theta, nuisance) = predictor(layout), case(layout)
    rows = p.rows(y, u, theta, nuisance)
    vector = np.concatenate([nuisance, theta])
    moving = [*range(p.n_nuisance), *(p.n_nuisance + layout.free)]
    assert rows.shape == (len(moving) + 1, y.size - layout.first_row)

    def residual(place: int, move: float) -> np.ndarray:
        moved = vector.copy()
        moved[place] += move
        return p.rows(y, u, moved[p.n_nuisance :], moved[: p.n_nuisance])[-1].copy()

    for k, place in enumerate(moving):
        two, one = (residual(place, h) - residual(place, -h) for h in (2 * STEP, STEP))
        np.testing.assert_allclose(rows[k], (8 * one - two) / (12 * STEP), rtol=0, atol=1e-9 * np.max(np.abs(rows[k])))


@pytest.mark.parametrize("name", LAYOUTS)
def test_residual_is_thesis_equation_3_12(name: str) -> None:
    layout = LAYOUTS[name]
    p, (y, u, theta, nuisance) = predictor(layout), case(layout)
    nuisance[: p.n_initial] = 0.0
    x = layout.polynomials(theta)
    v = lfilter(x.A, [1], y) - nuisance[-1]
    for b, f, w in zip(x.B, x.F, u, strict=True):
        v -= lfilter(b, f, w)
    e = lfilter(x.D, x.C, v)[layout.first_row :]
    np.testing.assert_allclose(p.rows(y, u, theta, nuisance)[-1], e, atol=1e-12)


@pytest.mark.parametrize("name", ["arx", "oe", "everything"])
def test_triangle_of_many_blocks_is_that_of_all_rows(name: str) -> None:
    layout = LAYOUTS[name]
    p, (y, u, theta, nuisance) = predictor(layout), case(layout, 5000)
    rows = p.rows(y, u, theta, nuisance)
    R, dense = p.triangle(y, u, theta, nuisance), np.linalg.qr(rows.T, mode="r")
    np.testing.assert_allclose(np.abs(R), np.abs(dense), atol=1e-9 * np.max(np.abs(dense)))
    again = np.hstack([part.copy() for _, part in p.blocks(y, u, theta, nuisance)])
    np.testing.assert_allclose(again, rows, atol=1e-12)


@pytest.mark.parametrize("name", ["armax", "oe", "bj"])
def test_initial_states_hold_any_past(name: str) -> None:
    # The residual of the last part of a record is found again from that part alone.
    layout = LAYOUTS[name]
    p, (y, u, theta, nuisance) = predictor(layout), case(layout, 600)
    whole = p.rows(y, u, theta, nuisance)[-1][-200:]
    y, u = y[-200 - layout.first_row :], np.ascontiguousarray(u[:, -200 - layout.first_row :])
    nuisance = np.concatenate([np.zeros(p.n_initial), nuisance[p.n_initial :]])
    rows = p.rows(y, u, theta, nuisance)
    states = rows[: p.n_initial].T
    found = rows[-1] - whole
    left = found - states @ np.linalg.lstsq(states, found, rcond=None)[0]
    assert np.max(np.abs(found)) > 1e-3
    assert np.max(np.abs(left)) < 1e-10
