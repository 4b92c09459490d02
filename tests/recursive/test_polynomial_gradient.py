"""Residual and gradients of the compiled recursion against complex step, at fixed coefficients."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.blackbox.polynomial_predictor import Layout
from ambid.recursive.polynomial_kernels import run
from ambid.recursive.polynomial_state import new_state

N, SETTLED = 700, 600
LAYOUTS = {
    "fir": Layout(na=0, nb=(3,), nc=0, nd=0, nf=(0,), nk=(0,)),
    "arx": Layout(na=2, nb=(2,), nc=0, nd=0, nf=(0,), nk=(1,)),
    "armax": Layout(na=2, nb=(2,), nc=3, nd=0, nf=(0,), nk=(2,)),
    "arma": Layout(na=2, nb=(), nc=1, nd=0, nf=(), nk=()),
    "ararx": Layout(na=1, nb=(2,), nc=0, nd=2, nf=(0,), nk=(1,)),
    "ararmax": Layout(na=2, nb=(1,), nc=1, nd=2, nf=(0,), nk=(1,)),
    "oe": Layout(na=0, nb=(2,), nc=0, nd=0, nf=(3,), nk=(1,)),
    "bj": Layout(na=0, nb=(2,), nc=2, nd=1, nf=(2,), nk=(1,)),
    "all, two inputs": Layout(na=1, nb=(2, 1), nc=2, nd=1, nf=(0, 2), nk=(0, 3)),
    "bj, two inputs": Layout(na=0, nb=(2, 1), nc=1, nd=2, nf=(1, 3), nk=(1, 1)),
}
ROOTS = {"A": [0.8, -0.3], "C": [0.7, -0.5, 0.2], "D": [0.9, 0.4], "F": [0.8, 0.5, -0.4]}


def coefficients(layout: Layout) -> np.ndarray:
    theta = layout.start()
    for (letter, i), place in layout.places.items():
        n = place.stop - place.start - 1
        if letter == "B":
            theta[place.start + layout.nk[i] : place.stop] = 0.7 ** np.arange(layout.nb[i]) * (1 + i)
        else:
            theta[place] = np.poly(ROOTS[letter][:n])
    return theta


def residual(layout: Layout, theta: np.ndarray, constant: complex, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    p = {key: theta[place] for key, place in layout.places.items()}
    v = lfilter(p["A", None], [1.0], y.astype(complex)) - constant
    for i in range(layout.n_inputs):
        v = v - lfilter(p["B", i], p["F", i], u[:, i].astype(complex))
    return lfilter(p["D", None], p["C", None], v)


@pytest.mark.parametrize("name", LAYOUTS)
def test_gradient_is_that_of_the_residual(name: str) -> None:
    layout = LAYOUTS[name]
    theta, rng = coefficients(layout), np.random.default_rng(3)
    u, y = rng.standard_normal((N, layout.n_inputs)), rng.standard_normal(N)
    free = np.append(theta[layout.free], 0.3)
    state = new_state(
        layout,
        theta=free,
        P=np.eye(free.size),
        limit=np.full(free.size, np.inf),
        noise_variance=1.0,
        weight=1.0,
        centre=np.zeros(1 + layout.n_inputs),
        forgetting=1.0,
    )
    errors, psi, one = np.zeros(N), np.zeros((N, free.size)), np.zeros(1)
    for t in range(N):
        run(u[t : t + 1], y[t : t + 1], one, False, state.arrays())
        errors[t] = one[0]
        columns = state.plan[state.meta[8] :][: free.size]  # row of the buffer, lag, sign
        psi[t] = columns[:, 2] * state.signals[columns[:, 0], state.count[0] - 1 - columns[:, 1]]
    np.testing.assert_array_equal(state.at, free)
    np.testing.assert_allclose(errors[SETTLED:], residual(layout, theta, 0.3, u, y).real[SETTLED:], atol=1e-9)
    for j in range(free.size):
        bent, constant = theta.astype(complex), 0.3 + 0.0j
        if j < layout.free.size:
            bent[layout.free[j]] += 1e-30j
        else:
            constant += 1e-30j
        step = -residual(layout, bent, constant, u, y).imag / 1e-30
        np.testing.assert_allclose(psi[SETTLED:, j], step[SETTLED:], atol=1e-8 * np.max(np.abs(step)), err_msg=str(j))
