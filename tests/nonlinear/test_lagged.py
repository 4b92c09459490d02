"""The lagged model that families share: exact slopes of predictions and free runs, divergence, its file."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.nonlinear.fit import model_from_json, model_to_json
from ambid.nonlinear.lagged import Block, LaggedFunction, LaggedModel, Regressors, Rows, Terms, lags
from ambid.nonlinear.lagged_problem import problem_at
from ambid.nonlinear.narx import NarxFunction
from ambid.nonlinear.rbf import RbfFunction
from ambid.nonlinear.records import cloud_of
from tests.nonlinear.rbf.systems import network

METRIC = np.array([[1.0, -1.0, 0.0, 0.5], [0.3, 0.0, 2.0, 0.0]])
NARX = {
    "narx": NarxFunction(p=1, m=1, ny=2, nu=2, nk=1, neurons=3),
    "narx, 2 outputs": NarxFunction(p=2, m=1, ny=2, nu=2, nk=0, neurons=3),
    "narx, 2 inputs": NarxFunction(p=1, m=2, ny=2, nu=2, nk=3, neurons=3),
    "narx, time series": NarxFunction(p=2, m=0, ny=2, nu=0, nk=1, neurons=3),
}
RBF = {
    "rbf, 2 outputs": network(2, 1, ny=2, nu=2, nk=0),
    "rbf, 2 inputs": network(1, 2, ny=2, nu=2, nk=3, linear=False),
    "rbf, time series": network(2, 0, ny=3),
    "rbf, metric": network(1, 1, ny=2, nu=2, metric=METRIC),
}


class Noisy(LaggedFunction):
    """Two outputs, terms of degree three, innovations that bend or do not."""

    kind = "test"

    def __init__(self, *, bends: bool) -> None:
        x = lags(2, 1, ny=2, nu=1, nk=0, ne=1)  # y1(t-1) y1(t-2) y2(t-1) y2(t-2) u(t) e1(t-1) e2(t-1)
        num = [(0,), (0, 2, 4), (3, 3), (5,), (6, 6) if bends else (6, 4)]
        terms = [(0, t) for t in num] + [(1, t) for t in [(2,), (4,), (0, 6), (5,)]]
        table = np.array([[*t, *[-1] * (3 - len(t))] for _, t in terms], dtype=np.int64)
        place = np.array([o for o, _ in terms], dtype=np.int64)
        self._x, self._terms = x, Terms(n_outputs=2, terms=table, place=place)

    @property
    def regressors(self) -> Regressors:
        return self._x

    @property
    def blocks(self) -> tuple[Block, ...]:
        return (self._terms,)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"c{k}" for k in range(self.n_theta))

    def as_json(self) -> dict[str, object]:
        return {}

    @classmethod
    def from_json(cls, found: dict[str, object]) -> Noisy:
        raise NotImplementedError


NOISY = {
    "affine in e": Noisy(bends=False),
    "bent in e": Noisy(bends=True),
}
FUNCTIONS: dict[str, LaggedFunction] = {**NARX, **RBF, **NOISY}
every = pytest.mark.parametrize("f", FUNCTIONS.values(), ids=FUNCTIONS)
named = pytest.mark.parametrize("f", [*NARX.values(), *RBF.values()], ids=[*NARX, *RBF])


def numbers(f: LaggedFunction, seed: int = 0, size: float = 1.0) -> np.ndarray:
    return size * np.random.default_rng(seed).standard_normal(f.n_theta)


def signals(f: LaggedFunction, n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((n, f.n_outputs)), rng.standard_normal((n, f.n_inputs))


def gentle(f: LaggedFunction) -> np.ndarray:
    return numbers(f, size=0.15)


@named
def test_slopes_are_those_of_a_complex_step(f: LaggedFunction) -> None:
    theta, rows, none = numbers(f), f.rows(*signals(f, 20)), np.empty(0, dtype=np.int64)
    J, _ = f.derivatives(theta, rows, none)
    assert len(f.names) == len(set(f.names)) == f.n_theta
    for k in range(f.n_theta):
        moved = theta.astype(complex)
        moved[k] += 1e-30j
        np.testing.assert_allclose(J[:, :, k], f.values(moved, rows).imag / 1e-30, rtol=1e-11, atol=1e-13)


@every
@pytest.mark.parametrize("free", [False, True])
def test_slopes_through_own_outputs_and_innovations(f: LaggedFunction, free: bool) -> None:
    theta, (y, u) = gentle(f), signals(f, 50)

    def run(t: np.ndarray) -> np.ndarray:
        return f.free_run(t, y, u)[0][f.lag :] if free else f.predict(t, f.rows(y, u))[0]

    def rows() -> Rows:
        if not free:
            return f.predict(theta, f.rows(y, u))[1]
        return f.rows_of(f.free_run(theta, y, u)[1], y)

    J = f.slopes(theta, rows(), free=free)
    assert np.all(np.isfinite(J))
    for k in range(f.n_theta):
        d = np.zeros(theta.size)
        d[k] = 1e-4
        four = [run(theta + s * d) for s in (1, -1, 2, -2)]
        slope = (8 * (four[0] - four[1]) - (four[2] - four[3])) / 12e-4
        np.testing.assert_allclose(J[:, :, k], slope, atol=1e-8 * max(1.0, np.abs(J).max()))
    live = np.arange(f.n_theta) % 3 > 0
    some = f.slopes(theta, rows(), free=free, live=live)
    np.testing.assert_allclose(some, J[:, :, live], rtol=1e-12, atol=1e-14)
    head, tail = rows().part(slice(0, 17)), rows().part(slice(17, None))
    begun = f.slopes(theta, head, free=free)
    ended = f.slopes(theta, tail, free=free, before=begun)
    np.testing.assert_allclose(np.concatenate([begun, ended]), J, rtol=1e-12, atol=1e-14)


@named
def test_a_compiled_run_is_the_function_of_its_own_past(f: LaggedFunction) -> None:
    theta, (y, u) = gentle(f), signals(f, 60)
    z, _ = f.free_run(theta, y, u)
    np.testing.assert_array_equal(z[: f.lag], y[: f.lag])
    rows = f.rows(z, u)
    np.testing.assert_allclose(f.values(theta, rows), z[f.lag :], rtol=1e-12, atol=1e-12)


def test_a_linear_filter_of_the_innovations_is_the_recursion() -> None:
    f = Noisy(bends=False)
    assert f.affine
    assert not Noisy(bends=True).affine
    theta, (y, u) = gentle(f), signals(f, 80)
    mine, rows = f.predict(theta, f.rows(y, u))
    z = f.regressors.signals(y, u)
    np.testing.assert_allclose(f._run(theta, z, free=False)[f.lag :], mine, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(rows.z, z, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("free", [False, True])
def test_the_triangle_is_that_of_weighted_slopes_errors_and_prior(free: bool) -> None:
    f = Noisy(bends=False)
    theta, (y, u) = gentle(f), signals(f, 5000)
    precision = np.arange(f.n_theta) / 3.0
    at = problem_at(f, ((y, u), (y[:50], u[:50])), theta, precision, free=free)
    at = replace(at, weight=np.array([[0.5, 0.0], [-1.5, 2.0]]))
    R, whole = at.triangle(theta), []
    for ys, us in at.parts:
        if free:
            run, z = f.free_run(theta, ys, us)
            rows, left = f.rows_of(z, ys), (ys - run)[f.lag :]
        else:
            found, rows = f.predict(theta, f.rows(ys, us))
            left = ys[f.lag :] - found
        both = np.dstack([f.slopes(theta, rows, free=free), left])
        whole.append(np.einsum("op,tpk->tok", at.weight, both).reshape(-1, theta.size + 1))
    whole.append(np.hstack([np.diag(precision), -(precision * theta)[:, None]]))
    rows_ = np.concatenate(whole)
    np.testing.assert_allclose(R.T @ R, rows_.T @ rows_, rtol=1e-9, atol=1e-9)
    assert at.cost(theta) == pytest.approx(float(np.sum(rows_[:, -1] ** 2)))


def test_a_unit_has_its_textbook_value_and_no_slope_at_its_centre() -> None:
    f = network(1, 1, neurons=1, linear=False)
    theta = np.array([0.0, 1.0, 0.5, -0.5, np.log(2.0)])  # c, weight, centre, log width
    at = np.array([[0.5, -0.5], [2.5, 1.5]])  # r = 0 and r^2 = 8, two widths squared: q = 2
    rows = f.rows(np.append(at[:, :1], [[0.0]], axis=0), np.append(at[:, 1:], [[0.0]], axis=0))
    np.testing.assert_allclose(f.values(theta, rows)[:, 0], (1.0, np.exp(-1.0)), rtol=1e-14)
    assert not np.any(f.slopes(theta, rows, free=False)[0, 0, 2:])


def model(theta: np.ndarray, f: LaggedFunction) -> LaggedModel:
    x = np.random.default_rng(3).standard_normal((50, f.regressors.column.size))
    one = np.ones(1)
    return LaggedModel(
        dt=0.01, function=f, theta=theta, u_level=0.3 * one, u_scale=2 * one, y_level=-one, y_scale=0.5 * one,
        cloud=cloud_of(x),
    )  # fmt: skip


def test_a_run_that_diverges_is_nan_from_there_on() -> None:
    f = network(neurons=1)
    grows = np.concatenate([[1.5, 0.0, 0.1], np.zeros(f.n_theta - 3)])
    y, u = np.zeros((200, 1)), np.zeros((200, 1))
    run = model(grows, f).simulate(u, y)[:, 0]
    lost = int(np.argmax(np.isnan(run)))
    assert 20 < lost < 60
    assert np.all(np.isfinite(run[:lost]))
    assert np.all(np.isnan(run[lost:]))
    assert abs((run[lost - 1] + 1) / 0.5) < 1e6 < abs((run[lost - 1] + 1) / 0.5) * 1.6


def test_what_was_written_is_read_bit_by_bit_and_damage_is_refused() -> None:
    f = RBF["rbf, metric"]
    one = model(numbers(f), f)
    found = json.loads(json.dumps(model_to_json(one)))
    back = model_from_json(found)
    assert isinstance(back, LaggedModel)
    assert isinstance(back.function, RbfFunction)
    u, y = np.random.default_rng(4).standard_normal((2, 40, 1))
    np.testing.assert_array_equal(back.predict(u, y), one.predict(u, y))
    np.testing.assert_array_equal(back.function.metric, f.metric)
    for key, value in (("unit", "square"), ("theta", found["theta"][:-1]), ("metric", [[1.0, None, 0.0, 0.0]])):
        with pytest.raises(EstimationError, match="rbf"):
            model_from_json({**found, key: value})
    assert one.with_theta(one.theta + 1).theta[0] == one.theta[0] + 1
