"""One suite over all black-box estimators: what every one of them promises."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import STRUCTURES, BlackBoxFit, Structure, fit_from_json, fit_text
from ambid.blackbox.model import response_covariance
from ambid.blackbox.prediction import innovations_form
from ambid.errors import EstimationError
from ambid.validation.fits import judge
from tests.blackbox import systems

OMEGA = 2 * np.pi * np.geomspace(0.5, 40, 12)
ALL = list(STRUCTURES.values())
WITH_INPUT = [s for s in ALL if s.inputs]


def names(some: list[Structure]) -> list[str]:
    return [s.name for s in some]


def data_for(s: Structure, **options: object) -> IOData:
    """Records of a plant that the structure can hold; the first output is `place` where it has no more."""
    return systems.three_blocks(**options) if s.name == "blocks" else systems.open_loop(inputs=s.inputs, **options)


def fitted(s: Structure, data: IOData) -> BlackBoxFit:
    return s.estimator(data, systems.orders_for(s.name, s.orders))


_FITS: dict[str, BlackBoxFit] = {}


def usual(s: Structure) -> BlackBoxFit:
    """The fit to the usual record, made once."""
    if s.name not in _FITS:
        _FITS[s.name] = fitted(s, data_for(s))
    return _FITS[s.name]


_JUDGED: dict[str, BlackBoxFit] = {}


def judged(s: Structure) -> BlackBoxFit:
    """The fit to the usual record judged on it and on a second one, made once."""
    if s.name not in _JUDGED:
        _JUDGED[s.name] = judge(usual(s), data_for(s), second=data_for(s, seed=7))
    return _JUDGED[s.name]


@pytest.mark.parametrize("s", ALL, ids=names(ALL))
def test_input_is_unchanged_and_results_repeat(s: Structure) -> None:
    data = data_for(s)
    u, y, r = data.u.copy(), data.y.copy(), data.reference.copy()
    first, second = usual(s), fitted(s, data)
    for before, after in ((u, data.u), (y, data.y), (r, data.reference)):
        np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(first.model.theta, second.model.theta)
    if first.covariance is not None:
        np.testing.assert_array_equal(first.covariance, second.covariance)


@pytest.mark.parametrize("s", ALL, ids=names(ALL))
def test_result_is_whole(s: Structure) -> None:
    data, found = data_for(s), usual(s)
    assert found.structure == s.name
    assert set(found.orders) <= set(s.orders)
    assert (found.inputs, found.outputs, dict(found.units)) == (data.inputs, data.outputs, dict(data.units))
    assert found.dt == data.dt
    assert (found.model.n_inputs, found.model.n_outputs) == (data.n_inputs, data.n_outputs)
    assert found.noise_covariance.shape == (data.n_outputs,) * 2
    assert np.all(np.diag(found.noise_covariance) > 0)
    assert found.n_estimated >= 1
    json.dumps(dict(found.details), default=lambda x: np.asarray(x).tolist())


@pytest.mark.parametrize("s", ALL, ids=names(ALL))
def test_covariance_is_symmetric_and_positive_semidefinite(s: Structure) -> None:
    found = usual(s)
    if found.covariance is None:
        assert any("standard deviation" in w or "covariance" in w for w in found.warnings)
        return
    P, n = found.covariance, found.model.theta.size
    assert P.shape == (n, n)
    np.testing.assert_allclose(P, P.T, rtol=1e-9, atol=1e-12 * np.abs(P).max())
    scale = np.sqrt(np.maximum(np.diag(P), 0.0))
    live = scale > 0
    assert np.count_nonzero(live) >= 1
    correlation = P[np.ix_(live, live)] / np.outer(scale[live], scale[live])
    assert np.linalg.eigvalsh(correlation).min() > -1e-8
    assert not np.any(P[~live])


def assert_response_is(found: BlackBoxFit, truth: np.ndarray) -> None:
    """Within five standard deviations, which are of a sensible size themselves."""
    held = innovations_form(found)  # continuous models as the sampled plant shows itself
    error, size = np.abs(held.frequency_response(OMEGA)[:, 0, 0] - truth), np.abs(truth)
    assert np.all(error < 0.2 * size.max())
    if found.covariance is not None:
        spread = response_covariance(found.model, found.covariance, OMEGA)[:, 0, 0]
        sd = np.sqrt(np.trace(spread, axis1=1, axis2=2))
        assert np.all(error < 5 * sd + 0.01 * size)
        assert np.all(sd < 0.3 * size.max())


@pytest.mark.parametrize("s", WITH_INPUT, ids=names(WITH_INPUT))
def test_frequency_response_is_the_truth_within_its_spread(s: Structure) -> None:
    assert_response_is(usual(s), systems.truth_of_blocks(OMEGA) if s.name == "blocks" else systems.truth(OMEGA))


@pytest.mark.parametrize("s", ALL, ids=names(ALL))
def test_units_of_the_channels_only_scale_the_result(s: Structure) -> None:
    data = data_for(s)
    cu, cy = 1e3, 1e-6
    scaled = IOData(
        u=data.u * cu,
        y=data.y * cy,
        dt=data.dt,
        inputs=data.inputs,
        outputs=data.outputs,
        units=data.units,
        open_loop=data.open_loop,
        reference=data.reference * cu,
        references=data.references,
        record=data.record,
    )
    one, other = usual(s), fitted(s, scaled)
    np.testing.assert_allclose(other.noise_covariance, one.noise_covariance * cy**2, rtol=1e-4)
    if s.inputs:
        G, H = one.model.frequency_response(OMEGA), other.model.frequency_response(OMEGA)
        np.testing.assert_allclose(H, G * cy / cu, rtol=1e-4, atol=1e-4 * np.abs(G).max() * cy / cu)
    assert other.warnings == one.warnings


@pytest.mark.parametrize("s", ALL, ids=names(ALL))
def test_saved_and_loaded_results_are_equal(s: Structure) -> None:
    found = judged(s)
    text = fit_text(found)
    back = fit_from_json(json.loads(text), "here")
    np.testing.assert_array_equal(back.model.theta, found.model.theta)
    assert back.model.names == found.model.names
    if found.covariance is not None:
        np.testing.assert_array_equal(back.covariance, found.covariance)
    assert fit_text(back) == text
    document = json.loads(text)
    assert document["schema"] == "ambid.fit/1"
    assert document.keys() >= {"structure", "orders", "sd", "noise_variance", "fit", "criteria", "rate_hz", "checks"}
    flat = ("one_step", "simulation") if len(found.outputs) == 1 else ()
    assert document["validation"].keys() >= {*found.outputs, *flat}


@pytest.mark.parametrize("s", ALL, ids=names(ALL))
def test_a_second_record_of_the_same_plant_is_fitted_as_well(s: Structure) -> None:
    found = judged(s)
    assert found.validation is not None
    for output in found.outputs:
        here, there = found.fit[output].one_step, found.validation[output]["one_step"]["fit"]
        assert here == pytest.approx(there, abs=0.05)
    assert found.criteria.keys() >= {"aic", "aicc", "bic", "mdl", "fpe"}


@pytest.mark.parametrize("s", ALL, ids=names(ALL))
def test_too_short_records_are_refused(s: Structure) -> None:
    with pytest.raises(EstimationError) as error:
        fitted(s, data_for(s).part(0, 9))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("s", WITH_INPUT, ids=names(WITH_INPUT))
def test_an_input_that_stands_still_is_refused(s: Structure) -> None:
    data = data_for(s)
    still = replace(data, u=np.full_like(data.u, 3.0), reference=np.full_like(data.u, 1.0))
    with pytest.raises(EstimationError):
        fitted(s, still)


@pytest.mark.parametrize("s", WITH_INPUT, ids=names(WITH_INPUT))
def test_feedback_is_warned_of_where_it_disturbs(s: Structure) -> None:
    def warned(fit: BlackBoxFit) -> bool:
        return any("biased" in w and "open loop" in w for w in fit.warnings)

    assert warned(fitted(s, data_for(s, told=False))) == (s.feedback == "biased")
    assert data_for(s).open_loop
    assert not warned(usual(s))


def _consistent(s: Structure) -> bool:
    return s.feedback != "biased" and s.name not in ("bj", "blocks")  # for a stable plant, and for one of three blocks


CONSISTENT = [s for s in WITH_INPUT if _consistent(s)]


@pytest.mark.parametrize("s", CONSISTENT, ids=names(CONSISTENT))
def test_an_unstable_plant_under_feedback_is_found(s: Structure) -> None:
    own = {"nk": 1, "nb": 2} if s.kind == "transfer function" else {"nk": 2, "nb": 1, "n": 3}  # a delay is a state
    orders = {**systems.orders_for(s.name, s.orders), **{k: v for k, v in own.items() if k in s.orders}}
    found = s.estimator(systems.closed_loop(), orders)
    assert_response_is(found, systems.unstable_truth(OMEGA))
    poles = np.sort(np.abs(innovations_form(found).poles()))[::-1]
    assert poles[0] == pytest.approx(1.2, rel=0.01)


def test_data_that_break_a_rule_are_refused() -> None:
    data = systems.open_loop()
    y = data.y.copy()
    y[17, 0] = np.nan
    for damage in (
        {"y": y},
        {"u": data.u[:-1]},
        {"u": data.u[:, 0]},
        {"u": np.hstack([data.u, data.u])},
        {"dt": 0.0},
        {"inputs": ("place",)},
        {"y": data.y[:0], "u": data.u[:0], "reference": data.reference[:0]},
    ):
        with pytest.raises(EstimationError):
            replace(data, **damage)
