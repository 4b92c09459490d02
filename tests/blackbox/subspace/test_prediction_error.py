"""State spaces by prediction error: exact derivatives, the maximum of the likelihood, and honest warnings."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.model import StateSpaceModel, pole_covariance, response_covariance
from ambid.blackbox.prediction import Sensitivities, one_step
from ambid.blackbox.state_space_search import balance, linear, sspem, tangent
from ambid.blackbox.subspace import pbsid
from ambid.errors import EstimationError
from tests.blackbox.subspace.systems import COLOURED, DT, SERIES, UNSTABLE, modal, record

OMEGA = np.array([1.0, 20.0, 50.0, 150.0, 280.0])


def some(seed: int = 0, n: int = 3, n_u: int = 2, n_y: int = 2) -> StateSpaceModel:
    rng = np.random.default_rng(seed)
    F = 0.8 * np.linalg.qr(rng.standard_normal((n, n)))[0]
    B, C, D, K = (rng.standard_normal(s) for s in ((n, n_u), (n_y, n), (n_y, n_u), (n, n_y)))
    return StateSpaceModel(A=F + K @ C, B=B, C=C, D=D, K=K, dt=DT)


def predictions(theta: np.ndarray, like: StateSpaceModel, x0: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Predictions of an innovations form, complex coefficients allowed."""
    parts, at = [], 0
    for name in "ABCDK":
        shape = getattr(like, name).shape
        parts.append(theta[at : at + shape[0] * shape[1]].reshape(shape))
        at += shape[0] * shape[1]
    A, B, C, D, K = parts
    x, out = x0.astype(theta.dtype), []
    for k in range(len(y)):
        out.append(C @ x + D @ u[k])
        x = A @ x + B @ u[k] + K @ (y[k] - out[-1])
    return np.array(out)


def test_sensitivities_equal_the_complex_step_across_blocks() -> None:
    m, rng = some(), np.random.default_rng(1)
    u, y, x0 = rng.standard_normal((40, 2)), rng.standard_normal((40, 2)), rng.standard_normal(3)
    x, states = x0, []
    for k in range(40):
        states.append(x)
        x = m.A @ x + m.B @ u[k] + m.K @ (y[k] - m.C @ x - m.D @ u[k])
    signals = np.hstack([states, u, y - np.array(states) @ m.C.T - u @ m.D.T])
    along = Sensitivities(m, np.eye(m.theta.size), initial=True)
    found = np.concatenate([along.block(signals[:15]), along.block(signals[15:])], axis=1)
    for j in range(m.theta.size + 3):
        theta, first = m.theta.astype(complex), x0.astype(complex)
        if j < m.theta.size:
            theta[j] += 1e-30j
        else:
            first[j - m.theta.size] += 1e-30j
        wanted = predictions(theta, m, first, u, y).imag.T / 1e-30
        np.testing.assert_allclose(found[:, :, j], wanted, rtol=1e-9, atol=1e-11 * np.abs(wanted).max())


def test_local_coordinates_hold_all_changes_of_the_model_and_none_of_its_states() -> None:
    m = some(3)
    for feedthrough in (True, False):
        P = tangent(m, feedthrough=feedthrough)
        np.testing.assert_allclose(P.T @ P, np.eye(P.shape[1]), atol=1e-12)
        assert P.shape[1] == 3 * (2 + 4) + (4 if feedthrough else 0)
    T = np.random.default_rng(0).standard_normal((3, 3))
    exchange = np.concatenate([x.ravel() for x in (T @ m.A - m.A @ T, T @ m.B, -m.C @ T, 0 * m.D, T @ m.K)])
    P = tangent(m, feedthrough=True)
    assert np.linalg.norm(P.T @ exchange) < 1e-12 * np.linalg.norm(exchange)
    assert np.linalg.matrix_rank(np.column_stack([P, exchange])) == P.shape[1] + 1


def test_predictions_are_linear_where_they_are_said_to_be() -> None:
    m, rng = some(4), np.random.default_rng(2)
    u, y = rng.standard_normal((60, 2)), rng.standard_normal((60, 2))
    for ways in (linear(m, feedthrough=False), linear(m, feedthrough=True)[:, [0, 1, 12, 13, 14, 15]]):
        step = ways @ rng.standard_normal(ways.shape[1])
        ends = [predictions(m.theta + s * step, m, np.zeros(3), u, y) for s in (-1, 0, 1)]
        np.testing.assert_allclose(ends[0] + ends[2], 2 * ends[1], atol=1e-9 * np.abs(ends[1]).max())


def test_balancing_changes_nothing_but_states() -> None:
    m, x0 = some(5), np.array([1.0, -2.0, 0.5])
    other, first = balance(m, x0, np.diag([2.0, 0.1]))
    rng = np.random.default_rng(1)
    u, y = rng.standard_normal((50, 2)), rng.standard_normal((50, 2))
    np.testing.assert_allclose(
        predictions(other.theta, m, first, u, y), predictions(m.theta, m, x0, u, y), rtol=1e-8, atol=1e-8
    )


@pytest.mark.parametrize(
    ("plant", "hold", "n"),
    [(COLOURED, None, 20_000), (UNSTABLE, 1.2, 20_000), (SERIES, None, 20_000), (modal(8, 4, 4, 0), None, 5000)],
    ids=["open loop", "unstable in a loop", "time series", "4 x 4 of order 8"],
)
def test_the_truth_is_recovered_within_its_spread(plant: StateSpaceModel, hold: float | None, n: int) -> None:
    data = record(plant, n, 3, hold=hold)
    found = sspem(data, {"n": plant.order})
    assert found.status == "converged"
    assert found.covariance is not None
    truth, poles = plant.poles(), found.model.poles()
    spread = pole_covariance(found.model, found.covariance)
    for p in truth:
        at = int(np.argmin(np.abs(poles - p)))
        assert abs(poles[at] - p) < 4 * np.sqrt(np.trace(spread[at])) < 0.2
    if plant.n_inputs:
        sd = np.sqrt(np.trace(response_covariance(found.model, found.covariance, OMEGA), axis1=-2, axis2=-1))
        error = np.abs(found.model.frequency_response(OMEGA) - plant.frequency_response(OMEGA))
        assert np.all(error < 5 * sd)
    np.testing.assert_allclose(found.noise_covariance, 0.25 * np.eye(plant.n_outputs), atol=0.02)
    # the rank of the covariance is that of the model, not of its matrices
    scale = np.sqrt(np.maximum(np.diag(found.covariance), 1e-300))
    values = np.linalg.eigvalsh(found.covariance / np.outer(scale, scale))
    assert np.sum(values > 1e-9 * values[-1]) == found.n_estimated
    assert found.n_estimated == plant.order * (plant.n_inputs + 2 * plant.n_outputs)


def log_det(model: StateSpaceModel, data, offsets) -> float:
    e = data.y - one_step(model, data.u, data.y, offsets)
    return data.n_samples * float(np.linalg.slogdet(e.T @ e / data.n_samples)[1])


def test_it_ends_where_no_direction_leads_further_down() -> None:
    data = record(modal(4, 2, 2, 1), 2000, 0)
    found, start = sspem(data, {"n": 4}), pbsid(data, {"n": 4})
    least = log_det(found.model, data, found.offsets)
    assert least < log_det(start.model, data, start.offsets)
    rng = np.random.default_rng(0)
    values, ways = np.linalg.eigh(found.covariance)
    factor = ways * np.sqrt(np.maximum(values, 0.0))
    for _ in range(20):
        step = 0.3 * factor @ rng.standard_normal(values.size)
        # part of a standard deviation along any direction costs something, and as much on either side
        up, down = (
            log_det(found.model.with_theta(found.model.theta + s * step), data, found.offsets) - least for s in (1, -1)
        )
        assert min(up, down) > 0
        assert up == pytest.approx(down, rel=0.6)


def test_a_feedthrough_is_found() -> None:
    direct = StateSpaceModel(A=COLOURED.A, B=COLOURED.B, C=COLOURED.C, D=[[0.7]], K=COLOURED.K, dt=DT)
    told = sspem(record(direct, 4000, 5), {"n": 3})
    assert told.model.D[0, 0] == pytest.approx(0.7, abs=5 * told.sd[list(told.model.names).index("D[0,0]")])


def test_units_change_nothing_but_units() -> None:
    one = sspem(record(COLOURED, 3000, 1), {"n": 3})
    other = sspem(record(COLOURED, 3000, 1, units=(1e6, 1e-9)), {"n": 3})
    np.testing.assert_allclose(other.model.poles(), one.model.poles(), rtol=1e-5)
    np.testing.assert_allclose(
        np.abs(pole_covariance(other.model, other.covariance)),
        np.abs(pole_covariance(one.model, one.covariance)), rtol=1e-3, atol=1e-12,
    )  # fmt: skip
    assert other.details["gain_nats"] == pytest.approx(one.details["gain_nats"], rel=1e-3)


def test_more_numbers_than_a_record_carries_are_refused() -> None:
    data = record(UNSTABLE, 4000, 0, hold=1.2)
    assert not sspem(data, {"n": 2}).warnings
    with pytest.raises(EstimationError, match="Lower"):
        sspem(data.part(0, 60), {"n": 8})


def test_more_states_than_the_plant_has_do_not_keep_it_from_the_plant() -> None:
    found = sspem(record(UNSTABLE, 4000, 0, hold=1.2), {"n": 4})
    assert found.status == "converged"
    assert abs(found.model.poles()[0]) == pytest.approx(1.05, abs=0.05)
