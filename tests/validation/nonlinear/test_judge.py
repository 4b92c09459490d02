"""A nonlinear fit judged: what fit, rmse, criteria, free run and extrapolation are, on errors that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.estimation.uncertainty import criteria
from ambid.nonlinear.narmax import narmax
from ambid.validation.fits import beyond, judge, validation
from tests.validation.nonlinear.plants import Static, io, levitated, output_error, squared, static_fit


def static_record(n: int, seed: int, *, level: float = 0.0, noise: float = 0.2, size: float = 1.0):
    rng = np.random.default_rng(seed)
    u = size * rng.standard_normal(n)
    y = level + np.concatenate([[5.0], u[:-1]]) + noise * rng.standard_normal(n)
    return io(u, y)


def test_fit_and_rmse_leave_the_first_samples_out_and_take_each_record_s_own_mean() -> None:
    one, other = static_record(400, 1), static_record(300, 2, noise=0.5)
    away = io(other.u[:, 0], other.y[:, 0])
    found = judge(static_fit(Static(), one, away), [one, away])
    errors = [(x.y[1:] - x.u[:-1])[1:, 0] for x in (one, away)]
    spreads = [x.y[2:, 0] - x.y[2:, 0].mean() for x in (one, away)]
    expected = 1 - np.linalg.norm(np.concatenate(errors)) / np.linalg.norm(np.concatenate(spreads))
    assert found.fit["y"].one_step == pytest.approx(expected, rel=1e-12)
    assert found.fit["y"].simulation == pytest.approx(expected, rel=1e-12)
    assert found.fit["y"].innovation_sd == pytest.approx(0.2)
    second = validation(static_fit(Static(), one), away)["y"]
    assert second["one_step"]["rmse"] == pytest.approx(np.sqrt(np.mean(errors[1] ** 2)), rel=1e-12)


def test_a_level_that_differs_from_record_to_record_does_not_raise_the_fit() -> None:
    low, high = static_record(400, 3, noise=1.0), static_record(400, 4, noise=1.0)
    apart = io(high.u[:, 0] + 100.0, high.y[:, 0] + 100.0)
    together, far = (judge(static_fit(Static(), low, x), [low, x]).fit["y"].one_step for x in (high, apart))
    assert far == pytest.approx(together, rel=1e-9)


def test_criteria_are_those_of_a_linear_fit_with_the_same_errors() -> None:
    data = static_record(500, 5)
    found = judge(static_fit(Static(), data), [data])
    e = data.y - np.vstack([[0.0], data.u[:-1]])
    assert found.criteria == pytest.approx(criteria(e, data.y, 1))


def test_a_free_run_that_diverges_is_no_simulation_and_fails_its_check() -> None:
    data = static_record(300, 6)
    found = judge(static_fit(Static(diverges_at=120), data), [data])
    assert found.fit["y"].simulation is None
    check = found.checks["simulation_stable"]
    assert not check.passed
    assert "diverges after 1.2 s" in check.detail
    assert judge(static_fit(Static(), data), [data]).checks["simulation_stable"].passed
    big = judge(static_fit(Static(gain=40.0), data), [data]).checks["simulation_stable"]
    assert not big.passed
    assert big.values["reach"] > 10


def test_an_unstable_plant_in_a_loop_is_not_blamed_for_its_free_run() -> None:
    data = levitated(1500, 1)
    fit = judge(narmax([data], {}), [data])
    assert fit.fit["y"].one_step > 0.5
    assert fit.checks["feedback"].values["seen"] == 1.0
    assert fit.checks["feedback"].passed  # narmax has a noise model
    assert fit.checks["simulation_stable"].passed
    assert fit.fit["y"].simulation is None or fit.checks["simulation_stable"].values["reach"] < 10
    told_open = replace(data, open_loop=True)
    said = judge(narmax([told_open], {}), [told_open])
    assert any("open_loop was given" in x for x in said.warnings)


def test_what_a_model_misses_is_not_called_feedback() -> None:
    rng = np.random.default_rng(2)
    u = np.convolve(rng.standard_normal(1540), np.ones(40) / 6, "valid")[:1500]  # slow: it goes on as it did
    y = np.zeros(1500)
    for t in range(1, 1500):
        y[t] = 0.6 * y[t - 1] + u[t - 1] + u[t - 1] ** 2 + 0.05 * rng.standard_normal()
    found = judge(narmax([io(u, y)], {"degree": 1}), [io(u, y)])
    assert not found.checks["residuals_nonlinear"].passed
    assert not any("open_loop was given" in x for x in found.warnings)


def test_extrapolation_is_the_share_outside_the_training_data_and_is_warned_of() -> None:
    data = static_record(1000, 7)
    inside = judge(static_fit(Static(edge=10.0), data), [data], second=static_record(500, 8))
    assert inside.validation is not None
    assert inside.validation["y"]["extrapolated"] == 0.0
    assert not any("outside" in x for x in inside.warnings)
    other = static_record(500, 8)
    beyond = judge(static_fit(Static(edge=1.0), data), [data], second=other)
    assert beyond.validation is not None
    share = np.mean(np.abs(other.u[2:, 0]) > 1)
    assert beyond.validation["y"]["extrapolated"] == pytest.approx(share)
    assert any("extrapolates" in x for x in beyond.warnings)


def test_a_real_model_knows_when_a_second_record_leaves_its_data() -> None:
    data = squared(600, 1)
    fit = narmax([data], {})
    near, far = (judge(fit, [data], second=squared(400, 2, size=s)) for s in (1.0, 4.0))
    assert not any("extrapolates" in x for x in near.warnings)
    assert any("extrapolates" in x for x in far.warnings)


def test_a_fit_to_the_free_run_may_leave_coloured_errors_and_is_biased_by_feedback() -> None:
    settings = {"focus": "simulation", "ne": 0}
    data = output_error(1500, 1)
    fit = judge(narmax([data], settings), [data])
    assert fit.settings["focus"] == "simulation"
    assert (fit.checks["residuals_white"].p or 0) < 1e-3  # one-step errors of an output-error plant
    assert fit.checks["residuals_white"].passed
    assert fit.checks["residuals_uncorrelated"].passed
    assert fit.checks["residuals_nonlinear"].passed
    linear = judge(narmax([data], {**settings, "degree": 1}), [data])
    assert not linear.checks["residuals_nonlinear"].passed
    assert not any("biased" in x for x in fit.warnings)
    unsaid = output_error(1500, 1, open_loop=False)
    warned = judge(static_fit(Static(), unsaid), [unsaid])
    assert sum("biased" in x for x in warned.warnings) == 1


def test_a_failed_fit_stays_as_it_is_and_cannot_be_validated() -> None:
    data = static_record(300, 9)
    failed = replace(static_fit(Static(), data), model=None, status="failed", reason="it broke")
    assert judge(failed, [data]) is failed
    with pytest.raises(EstimationError, match="it broke"):
        validation(failed, data)


def test_records_that_do_not_belong_to_the_fit_are_refused() -> None:
    data = static_record(300, 10)
    fit = static_fit(Static(), data)
    with pytest.raises(EstimationError, match="50 Hz"):
        judge(fit, [replace(data, dt=0.02)])
    with pytest.raises(EstimationError, match="same channels"):
        judge(fit, [replace(data, inputs=("other",), units={"other": "V", "y": "m"})])
    with pytest.raises(EstimationError, match="the model needs more than"):
        judge(fit, [data.part(0, 2)])
    with pytest.raises(EstimationError, match="constant"):
        validation(fit, io(data.u[:, 0], np.ones(300)))


def test_a_stalled_search_is_said_once() -> None:
    data = static_record(300, 11)
    silent = judge(replace(static_fit(Static(), data), status="stalled"), [data])
    assert any("did not converge" in x for x in silent.warnings)
    told = replace(static_fit(Static(), data), status="stalled", warnings=("interrupted: the best model so far",))
    assert judge(told, [data]).warnings == told.warnings


def test_short_records_are_judged_without_residual_tests() -> None:
    data = static_record(40, 12)
    found = judge(static_fit(Static(), data), [data])
    assert set(found.checks) == {"finite_prediction", "simulation_stable"}
    assert found.criteria


def test_the_edge_of_the_training_data_is_not_outside_by_rounding() -> None:
    found = beyond(np.array([0.3, 1.0, 1.0 + 1e-15, 1.0 + 1e-6, np.nan]))
    assert found.tolist() == [False, False, False, True, True]
