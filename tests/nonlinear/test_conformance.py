"""One suite over all nonlinear structures: what every one of them promises."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.fit import (
    MODEL_KINDS,
    NONLINEAR_STRUCTURES,
    NonlinearFit,
    NonlinearModel,
    NonlinearStructure,
    model_from_json,
    model_to_json,
    nonlinear_fit_from_json,
    nonlinear_fit_text,
    nonlinear_structure,
)
from tests.nonlinear.systems import SETTINGS, runaway, smooth

ALL = list(NONLINEAR_STRUCTURES.values())
every = pytest.mark.parametrize("s", ALL, ids=[s.name for s in ALL])


def fitted(s: NonlinearStructure, *records: IOData, **options: object) -> NonlinearFit:
    return s.estimator(records, dict(SETTINGS.get(s.name, {})), **options)


@cache
def _usual(name: str) -> tuple[NonlinearFit, tuple[tuple[str, float | None], ...]]:
    heard: list[tuple[str, float | None]] = []

    def listen(stage: str, done: float | None = None) -> None:
        heard.append((stage, done))

    return fitted(nonlinear_structure(name), smooth(), tick=listen), tuple(heard)


def usual(s: NonlinearStructure) -> NonlinearFit:
    """The fit to the usual record, made once."""
    return _usual(s.name)[0]


def model_of(s: NonlinearStructure) -> NonlinearModel:
    model = usual(s).model
    assert model is not None
    return model


def one_step(fit: NonlinearFit, data: IOData) -> float:
    """Part of the output's deviation that is not predicted."""
    assert fit.model is not None
    found, lag = fit.model.predict(data.u, data.y), fit.model.lag
    return float(np.std((data.y - found)[lag:]) / np.std(data.y[lag:]))


@every
def test_input_is_unchanged_and_results_repeat_for_a_seed(s: NonlinearStructure) -> None:
    data = smooth()
    u, y = data.u.copy(), data.y.copy()
    again = fitted(s, data, seed=0)
    np.testing.assert_array_equal(data.u, u)
    np.testing.assert_array_equal(data.y, y)
    first = usual(s)
    assert first.seed == again.seed == 0
    assert again.model is not None
    np.testing.assert_array_equal(model_of(s).theta, again.model.theta)
    np.testing.assert_array_equal(first.noise_covariance, again.noise_covariance)
    if first.covariance is not None:
        np.testing.assert_array_equal(first.covariance, again.covariance)
    assert again.warnings == first.warnings


@every
def test_result_is_whole(s: NonlinearStructure) -> None:
    data, found, model = smooth(), usual(s), model_of(s)
    assert found.structure == s.name
    assert found.status in ("converged", "stalled")
    assert not found.reason
    assert set(SETTINGS.get(s.name, {})) <= set(s.settings)
    assert set(s.settings) <= set(found.settings)
    assert (found.inputs, found.outputs, dict(found.units)) == (data.inputs, data.outputs, dict(data.units))
    assert found.dt == model.dt == data.dt
    assert (model.n_inputs, model.n_outputs) == (data.n_inputs, data.n_outputs)
    assert len(model.names) == len(set(model.names)) == model.theta.size >= found.n_estimated >= 1
    assert model.theta.dtype == np.float64
    assert np.all(np.isfinite(model.theta))
    assert [dict(r)["sha256"] for r in found.records] == ["0" * 64]
    assert found.noise_covariance.shape == (1, 1)
    assert found.noise_covariance[0, 0] > 0
    assert found.timing_s
    for c in found.curves:
        assert c.seconds.shape == c.training.shape
        assert np.all(np.diff(c.seconds) >= 0)


@every
def test_it_learns(s: NonlinearStructure) -> None:
    assert one_step(usual(s), smooth()) < 0.25
    assert one_step(usual(s), smooth(seed=3)) < 0.3


@every
def test_covariance_is_symmetric_and_positive_semidefinite_or_missed(s: NonlinearStructure) -> None:
    found = usual(s)
    if found.covariance is None:
        assert any("standard deviation" in w or "covariance" in w for w in found.warnings)
        assert not found.covariance_from
        return
    P, n = found.covariance, model_of(s).theta.size
    assert P.shape == (n, n)
    assert found.covariance_from in ("information", "laplace", "sandwich")
    np.testing.assert_allclose(P, P.T, rtol=1e-9, atol=1e-12 * np.abs(P).max())
    sd = found.sd
    assert sd is not None
    live = sd > 0
    assert np.count_nonzero(live) == found.n_estimated
    assert np.linalg.eigvalsh(P[np.ix_(live, live)] / np.outer(sd[live], sd[live])).min() > -1e-8
    assert not np.any(P[~live])


@every
def test_units_of_the_channels_only_scale_the_result(s: NonlinearStructure) -> None:
    data, cu, cy = smooth(), 2.0**10, 2.0**-20
    other = fitted(s, smooth(scale_u=cu, scale_y=cy))
    assert other.model is not None
    scale = np.abs(data.y).max()
    for one, same in (
        (model_of(s).predict(data.u, data.y), other.model.predict(data.u * cu, data.y * cy) / cy),
        (model_of(s).simulate(data.u, data.y), other.model.simulate(data.u * cu, data.y * cy) / cy),
    ):
        np.testing.assert_allclose(same, one, rtol=1e-4, atol=1e-4 * scale)
    np.testing.assert_allclose(other.noise_covariance / cy**2, usual(s).noise_covariance, rtol=1e-3)
    assert other.warnings == usual(s).warnings


@every
def test_saved_and_loaded_results_are_equal(s: NonlinearStructure) -> None:
    found = usual(s)
    text = nonlinear_fit_text(found)
    document = json.loads(text)
    back = nonlinear_fit_from_json(document, "here")
    assert back.model is not None
    np.testing.assert_array_equal(back.model.theta, model_of(s).theta)
    assert back.model.names == model_of(s).names
    assert type(back.model) is type(model_of(s))
    data = smooth(seed=4)
    for one, same in (
        (model_of(s).predict(data.u, data.y), back.model.predict(data.u, data.y)),
        (model_of(s).simulate(data.u, data.y), back.model.simulate(data.u, data.y)),
        (model_of(s).novelty(data.u, data.y), back.model.novelty(data.u, data.y)),
    ):
        np.testing.assert_array_equal(same, one)
    if found.covariance is not None:
        np.testing.assert_array_equal(back.covariance, found.covariance)
    assert nonlinear_fit_text(back) == text
    assert document["schema"] == "ambid.fit/1"
    assert document.keys() >= {
        "structure", "orders", "settings", "model", "sd", "noise_variance", "fit", "criteria", "rate_hz", "checks",
        "validation", "warnings", "curves", "seed",
    }  # fmt: skip
    assert document["rate_hz"] == 100.0


@every
def test_a_damaged_file_is_refused(s: NonlinearStructure) -> None:
    document = json.loads(nonlinear_fit_text(usual(s)))
    for cut in ("model", "structure", "noise_covariance", "settings", "dt_s"):
        with pytest.raises(EstimationError, match="here"):
            nonlinear_fit_from_json({k: v for k, v in document.items() if k != cut}, "here")
    model = model_to_json(model_of(s))
    for cut in set(model) - {"kind"}:
        with pytest.raises(EstimationError):
            model_from_json({k: v for k, v in model.items() if k != cut})


@every
def test_predictions_look_back_no_farther_than_the_lag(s: NonlinearStructure) -> None:
    data, model = smooth(), model_of(s)
    lag = model.lag
    found = model.predict(data.u, data.y)
    assert found.shape == data.y.shape
    assert np.all(np.isnan(found[:lag]))
    assert np.all(np.isfinite(found[lag:]))
    at, later = 100, data.y.copy()
    later[at:] += 1.0
    u_later = data.u.copy()
    u_later[at + 1 :] += 1.0
    changed = model.predict(u_later, later)
    np.testing.assert_array_equal(changed[: at + 1], found[: at + 1])  # one step ahead: the present output is not seen
    assert np.any(changed[at + 1 : at + 1 + max(lag, 1)] != found[at + 1 : at + 1 + max(lag, 1)])


@every
def test_free_runs_look_at_the_first_samples_alone(s: NonlinearStructure) -> None:
    data, model = smooth(), model_of(s)
    lag = model.lag
    whole = model.simulate(data.u, data.y)
    assert whole.shape == data.y.shape
    np.testing.assert_array_equal(whole[:lag], data.y[:lag])
    np.testing.assert_array_equal(model.simulate(data.u, data.y[: max(lag, 1)]), whole)
    assert np.all(np.isfinite(whole))
    assert np.std(whole - data.y) < 0.8 * np.std(data.y)


@every
def test_jacobian_is_the_derivative_of_the_predictions(s: NonlinearStructure) -> None:
    if not hasattr(model_of(s), "with_theta"):
        pytest.skip("the model cannot be given other parameters")
    data, model = smooth(120), model_of(s)
    J = model.jacobian(data.u, data.y)
    assert J.shape == (120, 1, model.theta.size)
    assert not np.any(J[: model.lag])
    size = np.abs(J).max(axis=(0, 1))
    places = np.random.default_rng(0).permutation(model.theta.size)[:12]
    for k in places:
        h = 1e-5 * max(abs(model.theta[k]), 0.01 * np.abs(data.y).max() / max(size[k], 1e-12))
        d = []
        for sign in (1, -1, 2, -2):
            theta = model.theta.copy()
            theta[k] += sign * h
            d.append(model.with_theta(theta).predict(data.u, data.y)[model.lag :])
        slope = (8 * (d[0] - d[1]) - (d[2] - d[3])) / (12 * h)
        np.testing.assert_allclose(J[model.lag :, :, k], slope, rtol=1e-5, atol=1e-6 * max(size[k], 1e-300))


@every
def test_novelty_tells_inside_from_outside(s: NonlinearStructure) -> None:
    data, model = smooth(), model_of(s)
    inside = model.novelty(data.u, data.y)
    assert inside.shape == (data.n_samples,)
    assert np.all(np.isnan(inside[: model.lag]))
    assert np.all(inside[model.lag :] >= 0)
    assert np.max(inside[model.lag :]) <= 1.0 + 1e-6
    outside = model.novelty(data.u * 10, data.y * 10)[model.lag :]
    assert np.median(outside) > 1.0


@every
def test_several_records_at_once(s: NonlinearStructure) -> None:
    found = fitted(s, smooth(300, seed=1), smooth(400, seed=2))
    assert len(found.records) == 2
    assert one_step(found, smooth(seed=3)) < 0.3
    with pytest.raises(EstimationError, match=r"rate|Hz"):
        fitted(s, smooth(300), replace(smooth(300), dt=0.02))
    with pytest.raises(EstimationError, match=r"channel|column"):
        fitted(s, smooth(300), replace(smooth(300), inputs=("other",)))


@every
def test_several_inputs(s: NonlinearStructure) -> None:
    data = smooth(n_inputs=2)
    found = fitted(s, data)
    assert found.model is not None
    assert found.model.n_inputs == 2
    assert one_step(found, data) < 0.3


@every
def test_unknown_settings_are_refused_by_name(s: NonlinearStructure) -> None:
    with pytest.raises(EstimationError, match="nonsense"):
        s.estimator([smooth()], {"nonsense": 1})


@every
def test_a_channel_that_stands_still_is_refused_or_failed(s: NonlinearStructure) -> None:
    data = smooth()
    still = replace(data, y=np.full_like(data.y, 3.0))
    try:
        found = fitted(s, still)
    except EstimationError:
        return
    assert found.status == "failed"
    assert found.reason


@every
def test_numbers_that_run_away_end_in_failed_or_in_a_finite_model(s: NonlinearStructure) -> None:
    try:
        found = fitted(s, runaway())
    except EstimationError:
        return
    if found.status == "failed":
        assert found.model is None
        assert found.reason
        assert "\n" not in found.reason
        back = nonlinear_fit_from_json(json.loads(nonlinear_fit_text(found)), "here")
        assert (back.status, back.reason, back.model) == ("failed", found.reason, None)
    else:
        assert found.model is not None
        assert np.all(np.isfinite(found.model.theta))


@every
def test_interruption_gives_the_best_so_far(s: NonlinearStructure) -> None:
    stages, dones = zip(*_usual(s.name)[1], strict=True)
    shares = [x for x in dones if x is not None]
    assert all(isinstance(x, str) and x for x in stages)
    assert shares  # from which the time left is told
    assert all(0.0 <= x <= 1.0 for x in shares)
    assert all(b >= a for a, b in pairwise(shares))  # what is over stays so
    for stop in sorted({0, len(stages) // 2}):
        calls = 0

        def tick(_: str, done: float | None = None, /, stop: int = stop) -> None:
            del done
            nonlocal calls
            calls += 1
            if calls > stop:
                raise KeyboardInterrupt

        found = fitted(s, smooth(), tick=tick)
        assert calls == stop + 1  # it ends at once
        assert found.status == "stalled"
        assert found.model is not None
        assert one_step(found, smooth()) < 2.0
        assert any("interrupt" in w for w in found.warnings)


def test_kinds_and_names_are_known() -> None:
    for home in MODEL_KINDS.values():
        assert home.startswith("ambid.nonlinear.")
    with pytest.raises(EstimationError, match="narmax"):
        nonlinear_structure("narmx")
    with pytest.raises(EstimationError, match="narmax"):
        model_from_json({"kind": "narmx"})
    with pytest.raises(EstimationError, match="kind"):
        model_from_json({})
    with pytest.raises(EstimationError, match="schema"):
        nonlinear_fit_from_json({"schema": "other"}, "here")
