"""State-space networks whose ordinary starts fail: global search finds the plant, and is not used elsewhere; delays."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.estimation.global_search import global_search
from ambid.nonlinear import nn as home
from ambid.nonlinear import state_start
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.nn import nn
from tests.nonlinear.test_state_network import bearing, linearised, sampled


def errors(fit: NonlinearFit) -> dict[str, float]:
    """Relative errors of the weights."""
    assert fit.model is not None
    found = dict(zip(fit.model.names, fit.model.theta, strict=True))
    return {k: abs(found[k] / v - 1.0) for k, v in linearised().items()}


@pytest.fixture(scope="module")
def noisy() -> IOData:
    """Small signals in thirty times the usual noise, on which no subspace model leads to a predictor that stays."""
    return bearing(4000, 1.0, 1, quiet=30.0)


def test_the_plant_is_found_where_every_ordinary_start_fails(noisy: IOData) -> None:
    before = nn([noisy], {"delay": 1, "descent": 0, "evaluations": 0})
    assert before.status == "failed"
    shares: list[float] = []

    def tick(stage: str, done: float | None = None, /) -> None:
        assert done is not None
        shares.append(done)

    fit = nn([noisy], {"delay": 1, "descent": 0, "evaluations": 500}, tick=tick)
    assert fit.status == "converged"
    assert max(errors(fit).values()) < 0.1
    assert fit.sd is not None
    np.testing.assert_allclose(np.sqrt(np.diag(fit.noise_covariance)), [3e-6, 6e-2], rtol=0.05)
    told = fit.details["global_search"]
    assert isinstance(told, dict)
    assert told["taken"]
    assert told["failed_starts"] == 3
    assert told["evaluations"] <= 500
    assert any("differential evolution" in w for w in fit.warnings)
    assert np.all(np.diff(shares) >= 0)
    assert 0.0 <= shares[0] < shares[-1] <= 1.0


def test_a_wrong_minimum_shows_in_its_errors_and_is_left() -> None:
    short = bearing(600, 1.0, 2, quiet=30.0)
    before = nn([short], {"delay": 1, "descent": 0, "evaluations": 0})
    assert before.status == "converged"  # so it says, with errors that are several times too large
    assert any("local minimum" in w for w in before.warnings)
    assert before.noise_covariance[1, 1] > 2.0 * 0.06**2
    fit = nn([short], {"delay": 1, "descent": 0, "evaluations": 500})
    np.testing.assert_allclose(np.sqrt(np.diag(fit.noise_covariance)), [3e-6, 6e-2], rtol=0.3)
    told = fit.details["global_search"]
    assert isinstance(told, dict)
    assert "linear regression" in told["why"]
    assert told["log_det_errors_after"] < told["log_det_errors_before"] - 1.0


@pytest.mark.parametrize("seed", [5, 6])
def test_a_wrong_minimum_of_nearly_the_right_errors_is_noticed(seed: int) -> None:
    """The errors are 7 % too large there. Rounding, and with it the machine, decides where a search ends."""
    record = bearing(4000, 1.0, seed, quiet=30.0)
    plain = nn([record], {"delay": 1, "descent": 0})
    if not any("local minimum" in w and "evaluations=2000" in w for w in plain.warnings):
        assert max(errors(plain).values()) < 0.6
        return
    assert max(errors(plain).values()) > 1.0
    fit = nn([record], {"delay": 1, "descent": 0, "evaluations": 500})
    assert max(errors(fit).values()) < 0.1
    assert not any("local minimum" in w for w in fit.warnings)


def test_a_wrong_minimum_is_noticed_in_a_short_record() -> None:
    """One state for a system of two: 70 samples are few for the regression, and enough to see it."""
    record, *_ = sampled(70, 3, noise=0.05)
    fit = nn([record], {"states": 1, "neurons": 0})
    assert any("local minimum" in w for w in fit.warnings)


def test_it_is_not_called_where_ordinary_starts_work(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a global search where none is needed")

    monkeypatch.setattr(home, "search_start", refuse)
    monkeypatch.setattr(state_start, "global_search", refuse)
    quiet = bearing(4000, 1.0, 1)
    fit = nn([quiet], {"delay": 1, "descent": 0})
    assert fit.status == "converged"
    assert max(errors(fit).values()) < 0.01
    assert "global_search" not in fit.details
    assert not any("local minimum" in w for w in fit.warnings)
    strong = nn([bearing(4000, 4.0, 1)], {"delay": 1, "descent": 0})  # nonlinear, but no linear model does better
    assert "global_search" not in strong.details


def test_an_interrupted_global_search_ends_without_a_model_or_with_the_best(noisy: IOData) -> None:
    def tick(stage: str, done: float | None = None, /) -> None:
        if stage == "global search":
            raise KeyboardInterrupt

    fit = nn([noisy], {"delay": 1, "descent": 0}, tick=tick)
    assert fit.status == "failed"
    assert fit.reason


def test_the_cost_over_shots_is_least_at_the_plant() -> None:
    from ambid.nonlinear.records import scaled_records
    from ambid.nonlinear.state_start import shot_cost

    data = scaled_records("nn", [bearing(2000, 1.0, 3, quiet=0.1)], lag=40)
    cost = shot_cost(data, 1 / 20_000.0, (0, 2))
    true = linearised()
    span = 4.5 * np.log(10.0)
    names = cost.layout.names
    at = {r: k for k, r in enumerate(cost.layout.entries)}
    theta = [true[names[at[e]]] / cost.layout.unit[at[e]] for e in cost.searched]
    z = np.arcsinh(np.array(theta) / cost.fastest * np.sinh(span)) / span
    np.testing.assert_allclose(cost.entries(z), theta, rtol=1e-9)
    near = global_search(cost, z - 0.05, z + 0.05, seed=0, evaluations=400)
    np.testing.assert_allclose(near.vector, z, atol=0.01)


@pytest.mark.parametrize(("delay", "noise"), [(0, 0.2), (3, 0.01), (12, 0.2)])
def test_the_delay_of_a_stable_plant_is_found(delay: int, noise: float) -> None:
    fit = nn([sampled(1500, 2, noise=noise, delay=delay)[0]], {"descent": 0})
    assert fit.settings["delay"] == delay
    assert fit.settings["states"] == 2


@pytest.mark.parametrize(("n", "amplitude", "quiet"), [(1500, 1.0, 1.0), (4000, 4.0, 1.0), (8000, 4.0, 30.0)])
def test_the_delay_of_an_unstable_plant_under_feedback_is_found(n: int, amplitude: float, quiet: float) -> None:
    fit = nn([bearing(n, amplitude, 1, quiet=quiet)], {"descent": 0, "delay": "auto"})
    assert fit.settings["delay"] == 1
