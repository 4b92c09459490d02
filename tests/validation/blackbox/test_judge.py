"""Fit, criteria and second record of a black-box fit, against direct sums."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.estimation.uncertainty import criteria, skipped
from ambid.validation.fits import judge
from tests.validation.blackbox.fits import arx, io, polynomial, run

TRUTH = polynomial(A=(1, -1.5, 0.7), B=((0, 1.0, 0.5),))


def record(seed, n=600, model=TRUTH, sd=0.3):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n, model.n_inputs))
    return io(u + 2.0, run(model, u, sd * rng.standard_normal((n, 1))) + 5.0)


def test_fit_is_one_minus_the_relative_error():
    data = record(0)
    found = judge(arx(data, 2, 2), data)
    y, spread = data.y[:, 0], np.linalg.norm(data.y - data.y.mean())
    a, b = found.model.outputs[0].A, found.model.outputs[0].B[0]
    v, w = y - found.offsets.y, data.u[:, 0] - found.offsets.u
    e = (v[2:] + a[1] * v[1:-1] + a[2] * v[:-2]) - (b[1] * w[1:-1] + b[2] * w[:-2])
    assert found.fit["y0"].one_step == pytest.approx(1 - np.linalg.norm(e) / spread, abs=2e-3)
    assert 0.5 < found.fit["y0"].simulation < found.fit["y0"].one_step < 1


def test_an_unstable_model_has_no_simulation():
    truth = polynomial(A=(1, -1.02), B=((0, 1.0),))
    data = record(1, n=300, model=truth)
    assert judge(arx(data, 1, 1), data).fit["y0"].simulation is None


@pytest.mark.parametrize("n_y", [1, 2])
def test_criteria_are_those_of_the_gaussian_likelihood(n_y):
    rng = np.random.default_rng(2)
    e, d = rng.standard_normal((500, n_y)) @ np.diag([0.1, 3.0][:n_y]), 6
    found = criteria(e, np.ones((500, n_y)), d)
    used = e[skipped(500) :]
    N = len(used)
    S = used.T @ used / N
    deviance = N * (np.linalg.slogdet(S)[1] + n_y * np.log(2 * np.pi)) + np.trace(used @ np.linalg.inv(S) @ used.T)
    k = d + n_y * (n_y + 1) / 2
    assert found["aic"] == pytest.approx(deviance + 2 * k)
    assert found["bic"] == pytest.approx(deviance + k * np.log(N))
    if n_y == 1:
        assert found["aicc"] == pytest.approx(found["aic"] + 2 * k * (k + 1) / (N - k - 1))
        assert found["fpe"] == pytest.approx(S[0, 0] * (1 + d / N) / (1 - d / N))
        assert found["mdl"] == pytest.approx(S[0, 0] * (1 + d * np.log(N) / N))


def test_bic_prefers_the_true_orders():
    data = record(3)
    scores = {(na, nb): judge(arx(data, na, nb), data).criteria["bic"] for na in (1, 2, 3) for nb in (1, 2, 3)}
    assert min(scores, key=scores.get) == (2, 2)


def test_a_second_record_is_judged_by_output():
    data, second = record(4), record(5)
    found = judge(arx(data, 2, 2), data, second=second).validation["y0"]
    assert found["one_step"]["rmse"] == pytest.approx(0.3, rel=0.1)
    assert set(found["simulation"]) == {"fit", "rmse"}


def test_another_operating_point_is_no_error():
    data, second = record(6), record(7)
    moved = io(second.u, second.y + 100.0)
    fit = arx(data, 2, 2)
    plain, shifted = (judge(fit, data, second=x).validation["y0"]["simulation"]["rmse"] for x in (second, moved))
    assert shifted == pytest.approx(plain, rel=0.05)


def test_a_second_record_of_another_rate_is_refused():
    from dataclasses import replace

    data = record(8)
    with pytest.raises(EstimationError, match="Hz"):
        judge(arx(data, 2, 2), data, second=replace(data, dt=0.02))
