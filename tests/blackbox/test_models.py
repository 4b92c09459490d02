"""Black-box models: conversions agree with each other, derivatives with differences along every coefficient."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.model import (
    Offsets,
    PolynomialModel,
    Polynomials,
    StateSpaceModel,
    TransferModel,
    root_derivative,
    roots_at,
)
from ambid.blackbox.prediction import one_step, simulation
from tests.blackbox.systems import noise_response

DT = 1e-3
OMEGA = np.array([3.0, 50.0, 400.0, 2500.0])

BJ = Polynomials(
    A=[1.0],
    B=([0, 0.5, 0.2], [0, 0, 1.0]),
    C=[1, 0.4],
    D=[1, -0.7, 0.1],
    F=([1, -1.5, 0.7], [1, -0.3]),
)
ARMAX = Polynomials(A=[1, -1.5, 0.7], B=([0, 1, 0.5], [0.3]), C=[1, 0.3, 0.2], D=[1.0], F=([1.0], [1.0]))
ARARMAX = Polynomials(A=[1, -0.8], B=([0, 1, 0.5], [0.3, 0.1]), C=[1, 0.3], D=[1, 0.5, 0.1], F=([1.0], [1.0]))
MIXED = Polynomials(A=[1, -0.8, 0.2], B=([0, 1], [0.3, 0.1]), C=[1, 0.3], D=[1, 0.5], F=([1.0], [1.0, 0.2]))


def _models() -> dict[str, object]:
    rng = np.random.default_rng(3)
    A = np.diag([0.9, 0.5, -0.3]) + 0.05 * rng.standard_normal((3, 3))
    ss = {"B": rng.standard_normal((3, 2)), "C": rng.standard_normal((2, 3)), "K": 0.1 * rng.standard_normal((3, 2))}
    return {
        "bj": PolynomialModel(outputs=(BJ,), dt=DT),
        "armax": PolynomialModel(outputs=(ARMAX,), dt=DT),
        "two outputs": PolynomialModel(outputs=(ARARMAX, BJ), dt=DT),
        "mixed": PolynomialModel(outputs=(MIXED,), dt=DT),
        "state space": StateSpaceModel(A=A, D=rng.standard_normal((2, 2)), dt=DT, **ss),
        "continuous": StateSpaceModel(A=A - np.eye(3), D=np.zeros((2, 2)), dt=None, **ss),
        "transfer": TransferModel(
            num=(([2.0, 1.0], [3.0]),), den=(([1.0, 0.4, 9.0], [1.0, 2.0]),), dt=None, delay=(0.0, 0.01)
        ),
        "discrete transfer": TransferModel(num=(([0.0, 1.0],),), den=(([1.0, -0.5],),), dt=DT, delay=(2e-3,)),
    }


def _moved(model: object, theta: np.ndarray) -> object:
    if isinstance(model, PolynomialModel | StateSpaceModel):
        return model.with_theta(theta)
    assert isinstance(model, TransferModel)
    num, den, first = [], [], 0
    for row_n, row_d in zip(model.num, model.den, strict=True):
        num.append([]), den.append([])
        for n, d in zip(row_n, row_d, strict=True):
            num[-1].append(theta[first : first + n.size])
            den[-1].append(theta[first + n.size : first + n.size + d.size])
            first += n.size + d.size
    return TransferModel(num=num, den=den, dt=model.dt, delay=model.delay)


@pytest.mark.parametrize("name", list(_models()))
@pytest.mark.parametrize("what", ["frequency_response", "poles", "zeros"])
def test_derivatives_agree_with_central_differences(name: str, what: str) -> None:
    model = _models()[name]
    of = (lambda m: m.frequency_response(OMEGA)) if what == "frequency_response" else (lambda m: getattr(m, what)())
    exact = {
        "frequency_response": lambda: model.frequency_response_derivative(OMEGA),
        "poles": model.pole_derivative,
        "zeros": model.zero_derivative,
    }[what]()
    assert len(model.names) == model.theta.size == exact.shape[-1]
    moving = model.theta != np.round(model.theta)  # leading ones and zeros stay
    moving |= np.array([isinstance(model, StateSpaceModel)] * moving.size)
    for k in np.nonzero(moving)[0]:
        h = np.zeros(model.theta.size)
        h[k] = 1e-6
        up, down = of(_moved(model, model.theta + h)), of(_moved(model, model.theta - h))
        base = of(model)
        if base.ndim == 1 and base.size:  # keep the order of roots
            up, down = (x[np.argmin(np.abs(x[None, :] - base[:, None]), axis=1)] for x in (up, down))
        np.testing.assert_allclose(
            exact[..., k], (up - down) / 2e-6, rtol=1e-5, atol=1e-5 * (1 + np.abs(base).max(initial=0.0))
        )


@pytest.mark.parametrize("name", [n for n, m in _models().items() if not any(getattr(m, "delay", [])) or m.dt])
def test_state_space_has_the_same_responses(name: str) -> None:
    model = _models()[name]
    ss = model.state_space()
    np.testing.assert_allclose(ss.frequency_response(OMEGA), model.frequency_response(OMEGA), rtol=1e-9, atol=1e-12)
    for o, p in enumerate(model.outputs if isinstance(model, PolynomialModel) else ()):
        C, A, D = (np.polynomial.polynomial.polyval(np.exp(-1j * OMEGA * DT), c) for c in (p.C, p.A, p.D))
        np.testing.assert_allclose(noise_response(ss, OMEGA)[:, o, o], C / (A * D), rtol=1e-9, atol=1e-12)


def test_armax_state_space_is_minimal() -> None:
    model = PolynomialModel(outputs=(ARMAX,), dt=DT)
    assert model.state_space().order == 2


def test_prediction_of_noise_free_data_is_exact() -> None:
    rng = np.random.default_rng(0)
    model = PolynomialModel(outputs=(BJ,), dt=DT).state_space()
    u = rng.standard_normal((400, 2))
    x, y = rng.standard_normal(model.order), np.empty((400, 1))
    for k in range(400):
        y[k] = model.C @ x + model.D @ u[k]
        x = model.A @ x + model.B @ u[k]
    offsets = Offsets(u=np.array([1.0, 2.0]), y=np.array([3.0]))
    moved = u + offsets.u
    for predicted in (one_step(model, moved, y + 3, offsets), simulation(model, moved, y + 3, offsets)):
        assert predicted is not None
        np.testing.assert_allclose(predicted, y + 3, atol=1e-6)


def test_unstable_models_are_not_simulated() -> None:
    model = StateSpaceModel(A=[[1.1]], B=[[1.0]], C=[[1.0]], D=[[0.0]], K=[[0.9]], dt=DT)
    u = np.ones((10, 1))
    assert simulation(model, u, u, Offsets(u=np.zeros(1), y=np.zeros(1))) is None


def test_roots_of_long_fir_models_have_finite_derivatives() -> None:
    """r^200 overflows for a root far outside the unit circle; its derivative does not. Euler's identities hold."""
    rng = np.random.default_rng(0)
    taps = 0.97 ** np.arange(200) * rng.standard_normal(200)
    taps[0] = 1e-6  # a first tap that is nearly zero: a root near 1e5
    model = PolynomialModel(outputs=(Polynomials(A=[1.0], B=(taps,), C=[1.0], D=[1.0], F=([1.0],)),), dt=DT)
    zeros, place = model.zeros(), slice(1, 201)
    slope = model.zero_derivative()[:, place]
    assert np.max(np.abs(zeros)) > 1e5
    assert np.all(np.isfinite(slope))
    size = np.max(np.abs(slope * taps), axis=1)
    assert np.max(np.abs(slope @ taps) / size) < 1e-9  # all coefficients times a number: the roots stay
    assert np.max(np.abs(slope @ (np.arange(200) * taps) - zeros) / np.abs(zeros)) < 1e-9  # p_k g^k: roots times g


def test_root_derivatives_inside_and_outside_the_unit_circle_agree_with_the_formula() -> None:
    c = np.array([1.0, -3.1, 2.9, -0.8, 0.2])
    roots = np.roots(c).astype(complex)
    assert np.min(np.abs(roots)) < 1 < np.max(np.abs(roots))
    expected = -(roots[:, None] ** np.arange(4, -1, -1)) / np.polyval(np.polyder(c), roots)[:, None]
    assert root_derivative(c, roots) == pytest.approx(expected, rel=1e-12)


def test_leading_zeros_of_a_polynomial_are_a_delay_and_have_no_roots() -> None:
    theta = np.array([9.0, 0.0, 0.0, 2.0, -1.0, 9.0])
    roots, slope = roots_at(theta, slice(1, 5))
    assert roots == pytest.approx([0.5])
    assert slope == pytest.approx(np.array([[0.0, 0.0, 0.0, -0.25, -0.5, 0.0]]))
    none, empty = roots_at(np.zeros(4), slice(0, 4))
    assert (none.shape, empty.shape) == ((0,), (0, 4))
