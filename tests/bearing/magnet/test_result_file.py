"""The estimate as JSON: what the contract names is there, numbers only, and it comes back bit by bit."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing.magnet_result import bearing_from_json, bearing_to_json, linearised
from ambid.errors import EstimationError
from ambid.physics.presets import preset
from tests.bearing.magnet.estimates import by_hand, seen


@pytest.fixture(scope="module")
def estimate():
    return by_hand({"ball.csv": seen(1), "other.csv": seen(2)})


def back(document):
    return bearing_from_json(document, "estimate nonlinear.json")


def test_it_comes_back_bit_by_bit(estimate):
    written = estimate.dumps()
    again = back(json.loads(written))
    assert again.dumps() == written
    assert again.values == estimate.values
    assert np.array_equal(again.covariance, estimate.covariance)
    x = np.linspace(8e-3, 12e-3, 5)
    assert np.array_equal(again.curves(x, 0.9).k_x.sd, estimate.curves(x, 0.9).k_x.sd)


def test_the_contract_is_kept(estimate):
    document = json.loads(estimate.dumps(), parse_constant=lambda x: pytest.fail(f"{x} is no JSON number"))
    assert document["schema"] == "ambid.estimate/1"
    assert document["model"] == "one-axis"
    assert set(document["record"]) >= {"samples", "rate_hz", "sha256"}
    assert [r["file"] for r in document["records"]] == ["ball.csv", "other.csv"]
    assert set(document["parameters"]["k"]) == {
        "value", "sd", "ci95", "unit", "role", "identifiable", "sd_calibrated", "ci95_calibrated"
    }  # fmt: skip
    assert document["delay"]["voltage"]["samples"] == 1
    assert set(document["fit"]) == {"position", "current"}
    assert document["fit"]["position"] == {"one_step": pytest.approx(0.999), "simulation": None,
                                           "innovation_sd": pytest.approx(2.9e-6)}  # fmt: skip
    for name in ("status", "checks", "validation", "warnings", "timing_s", "law", "curves"):
        assert name in document


def test_what_is_not_a_number_becomes_null(estimate):
    document = bearing_to_json(replace(estimate, criterion=math.nan))
    assert document["criterion"] is None


def test_the_linear_plant_is_that_of_the_bench():
    # at the preset's rest point, against its own analytic linearisation
    e, truth = by_hand({"ball.csv": seen(1)}), preset("levitated-ball")
    v, plant = truth.parameters, linearised(e)
    assert plant.states == ("position", "velocity", "current")
    expected = [[0, 1, 0], [-v["k_x"] / v["m"], 0, v["k_i"] / v["m"]], [0, -v["k_i"] / v["L"], -v["R"] / v["L"]]]
    assert np.allclose(plant.A, expected, rtol=1e-12, atol=0)
    assert plant.B[:, 0] == pytest.approx([0, 0, 1 / v["L"]])
    assert sorted(plant.poles.real) == pytest.approx(sorted(np.linalg.eigvals(np.array(expected, float)).real))


def test_an_eddy_pole_is_a_state_between_current_and_force():
    e = by_hand({"ball.csv": seen(1)})
    pole = replace(e.parameter("m"), name="a", unit="rad/s", value=500.0)
    slow = linearised(replace(e, eddy=True, parameters=(*e.parameters, pole)))
    quick = linearised(replace(e, eddy=True, parameters=(*e.parameters, replace(pole, value=1e7))))
    assert slow.states[-1] == "force"
    plain = linearised(e)
    assert np.allclose(slow.C @ slow.A @ slow.B, plain.C @ plain.A @ plain.B)
    # with a pole far out the slow poles are those without it
    near = quick.poles[np.argsort(np.abs(quick.poles))][:3]
    assert sorted(near.real) == pytest.approx(sorted(plain.poles.real), rel=1e-3)


def test_the_grid_of_the_curves_is_theirs(estimate):
    grid = bearing_to_json(estimate)["curves"]
    x, i = np.array(grid["position"]), np.array(grid["current"])
    k_x = np.array(grid["k_x"]["value"])
    assert k_x.shape == (x.size, i.size)
    assert k_x[2, 3] == estimate.curves(x[2], i[3]).k_x.value[0]
    assert grid["L"]["sd"][4][0] == estimate.curves(x[4], i[0]).L.sd[0]
    assert grid["inside"][0][0] is True


def without(name):
    def damage(document):
        del document[name]

    return damage


def put(value, *keys):
    def damage(document):
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return damage


@pytest.mark.parametrize(
    "damage",
    [
        without("hull"),
        without("noise"),
        put("cubic", "law", "gap"),
        put("kg", "parameters", "k", "unit"),
        put(None, "parameters", "k", "value"),
        put(-1.0, "parameters", "m", "value"),
        put([[1.0]], "covariance", "matrix"),
        put("almost", "status"),
        put(0.0, "noise", "ball.csv", "force"),
        put(1.5, "delay", "voltage", "by_rate", "2000 Hz", "fraction"),
        put(777.0, "records", 1, "rate_hz"),
        put(["x"], "usual", "position"),
        lambda d: d["parameters"].pop("L_leak"),
        lambda d: d["parameters"].update(gap=d["parameters"]["k"]),
        lambda d: d["fit_by_record"].pop("ball.csv"),
    ],
)
def test_a_damaged_file_is_refused_on_one_line(estimate, damage):
    document = json.loads(estimate.dumps())
    damage(document)
    with pytest.raises(EstimationError, match=r"estimate nonlinear\.json is not a complete estimate") as refused:
        back(document)
    assert "\n" not in str(refused.value)
