"""An estimate as JSON: what contracts.md fixes, numbers only, and the way back."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.estimation.estimate import estimate_from_json, estimate_text, estimate_to_json
from ambid.job import identify
from ambid.physics.presets import preset
from ambid.signals import multisine
from ambid.simulation import simulate_preset


@pytest.fixture(scope="module")
def estimate():
    p = preset("unstable-bearing")
    u = multisine(2000, p.rate_hz, amplitude=5.0, band=(10.0, 2000.0), seed=1, amplitude_is="rms")
    return identify(simulate_preset(p, u, seed=1).record)


def refuse(constant):
    raise AssertionError(f"{constant} is no JSON number")


def test_the_fields_that_others_rely_on(estimate):
    d = json.loads(estimate.dumps(), parse_constant=refuse)
    assert d["schema"] == "ambid.estimate/1"
    assert d["status"] == "converged"
    assert d["record"]["samples"] == 2000
    assert d["record"]["rate_hz"] == 20_000.0
    assert "sha256" in d["record"]
    assert d["model"] == "one-axis"
    assert list(d["parameters"]) == ["m", "k_x", "k_i", "R", "L", "c"]
    for p in d["parameters"].values():
        assert set(p) >= {"value", "sd", "ci95", "unit", "role", "identifiable"}
    m = d["parameters"]["m"]
    assert (m["unit"], m["role"]) == ("kg", "free")
    np.testing.assert_allclose(m["ci95"], [m["value"] - 1.96 * m["sd"], m["value"] + 1.96 * m["sd"]], rtol=1e-4)
    assert d["parameters"]["c"]["role"] == "fixed"
    assert d["parameters"]["c"]["sd"] == 0
    assert set(d["delay"]["voltage"]) >= {"samples", "how"}
    assert d["continuous"]["states"] == ["position", "velocity", "current"]
    assert np.array(d["continuous"]["A"]).shape == (3, 3)
    assert np.array(d["continuous"]["poles"]).shape == (3, 2)
    assert d["fit"]["position"]["simulation"] is None
    for check in ("residuals_white", "residuals_uncorrelated", "identifiable"):
        assert isinstance(d["checks"][check]["passed"], bool)
    assert 0 <= d["checks"]["residuals_white"]["p"] <= 1
    assert d["validation"] is None
    assert isinstance(d["warnings"], list)
    assert set(d["timing_s"]) >= {"read", "fit", "checks"}


def test_matrices_are_those_of_the_parameters(estimate):
    d = estimate_to_json(estimate)
    v = {k: p["value"] for k, p in d["parameters"].items()}
    a = np.array(d["continuous"]["A"])
    np.testing.assert_allclose(a[1], [-v["k_x"] / v["m"], -v["c"] / v["m"], v["k_i"] / v["m"]], atol=1e-12)
    np.testing.assert_allclose(a[2], [0, -v["k_i"] / v["L"], -v["R"] / v["L"]], rtol=1e-12)
    poles = [complex(*p) for p in d["continuous"]["poles"]]
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(np.linalg.eigvals(a)), rtol=1e-9)
    covariance = np.array(d["covariance"]["matrix"])
    assert d["covariance"]["names"] == ["m", "k_x", "k_i", "R", "L"]
    np.testing.assert_allclose(
        np.sqrt(np.diag(covariance)), [d["parameters"][k]["sd"] for k in d["covariance"]["names"]], rtol=1e-9
    )
    assert np.linalg.eigvalsh(covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))).min() > 0


def test_it_comes_back_as_it_went(estimate):
    again = estimate_from_json(json.loads(estimate_text(estimate)), "estimate.json")
    assert estimate_to_json(again) == estimate_to_json(estimate)
    assert again.values == estimate.values
    assert again.passed == estimate.passed


def test_numbers_that_are_not_finite_become_null(estimate):
    broken = replace(estimate, timing_s={"read": float("nan"), "fit": float("inf")})
    text = broken.dumps()
    assert "NaN" not in text
    assert "Infinity" not in text
    assert json.loads(text)["timing_s"] == {"read": None, "fit": None}


def test_parameters_are_found_by_name(estimate):
    assert estimate.parameter("k_i").unit == "N/A"
    with pytest.raises(EstimationError, match="no parameter 'Q'"):
        estimate.parameter("Q")


@pytest.mark.parametrize("document", [{}, {"schema": "ambid.fit/1"}, [], "text", 3, None])
def test_other_documents_are_refused(document):
    with pytest.raises(EstimationError, match=r"e\.json has schema"):
        estimate_from_json(document, "e.json")


@pytest.mark.parametrize(
    "path", ["status", "parameters", "continuous", "noise", "covariance", "delay", "fit", "checks"]
)
def test_a_part_that_is_missing_or_no_longer_what_it_was_is_refused(estimate, path):
    d = estimate_to_json(estimate)
    for damaged in ({k: v for k, v in d.items() if k != path}, {**d, path: 7} if path != "status" else {}):
        with pytest.raises(EstimationError, match=r"e\.json"):
            estimate_from_json(damaged, "e.json")
