"""Monte Carlo over a rig: what is told of estimates that are honest, and of those that are not."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.errors import AmbidError
from ambid.fleet import monte_carlo
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset
from ambid.validation.coverage import Coverage, Trial, wilson
from tests.fleet.jobs import known_mass

TRUTH = {"k_i": 80.0, "R": 4.0}


def coverage(n=400, said=1.0, bias=0.0, failed=0, seed=1):
    rng = np.random.default_rng(seed)
    trials = [
        Trial(
            seed=k, verdict="unusable" if k % 50 == 0 else "usable",
            values={"k_i": (80.0 + 0.5 * (rng.standard_normal() + bias) if k % 50 else 1e6, 0.5 * said),
                    "R": (4.0 + 0.1 * rng.standard_normal(), 0.1) if k % 9 else (None, None)},
        )
        for k in range(n)
    ]  # fmt: skip
    trials += [Trial(seed=n + k, reason="it fell", values={}) for k in range(failed)]
    units = {"k_i": "N/A", "R": "ohm"}
    return Coverage(
        rig="bench", job="identify", settings="{}", truth=TRUTH, units=units, trials=tuple(trials),
        asked=n + failed, seconds=1.0,
    )  # fmt: skip


def test_honest_intervals_pass_and_what_may_not_be_used_does_not_count():
    found = coverage()
    k_i, r = found.rows
    assert found.verdict.word == "usable"
    assert (k_i.runs, k_i.unknown, r.unknown > 30) == (392, 0, True)
    assert k_i.ratio[0] < 1.0 < k_i.ratio[1]
    assert k_i.coverage == wilson(k_i.inside, 392)
    assert k_i.coverage[0] < 0.95 < k_i.coverage[1]
    assert abs(k_i.bias) < 4 * k_i.bias_sd < 0.15


@pytest.mark.parametrize(
    ("wrong", "check"),
    [
        ({"said": 0.7}, "coverage"),
        ({"bias": 0.6}, "bias"),
        ({"failed": 3}, "failures"),
        ({"n": 10}, "runs"),
    ],
)
def test_what_is_not_honest_is_told(wrong, check):
    assert [r.check for r in coverage(**wrong).reasons if r.check == check] == [check]


def test_false_alarms_are_as_rare_as_promised():
    told = sum(not coverage(n=100, seed=seed).passed for seed in range(100))
    assert told <= 5  # of 100 tables at 1 %


def test_it_is_told_drawn_and_comes_back_from_its_file(tmp_path):
    found = coverage(failed=2)
    assert "2 x it fell" in found.summary()
    found.save(tmp_path / "c.json")
    again = ambid.load(tmp_path / "c.json")
    assert again.rows == found.rows
    assert len(found.to_dataframe()) == 402
    assert len(found.plot().axes) == 2


def test_records_are_simulated_and_identified_without_the_truth():
    found = monte_carlo("thesis", runs=3, seed=5, simulated={"duration": 0.05}, workers=1)
    assert [t.seed for t in found.trials] == [5, 6, 7]
    assert {r.name for r in found.rows} == {"k_x", "k_i", "R", "L"}  # m is fixed there
    assert max(r.largest_z for r in found.rows) < 5.0
    assert not found.trials[0].reason


def test_the_truth_of_a_drawn_rotor_is_that_of_its_drawing():
    few = {"duration": 0.1, "periods": 1, "excitation": "zippered"}
    found = monte_carlo("central-mass", runs=2, job=known_mass, simulated=few, workers=1)
    assert found.truth == {"m": pytest.approx(4.224, abs=0.01), "ax.k_i": pytest.approx(31.227, abs=0.001)}
    assert [t.values["m"] for t in found.trials] == [(4.0, None)] * 2  # the job does not see it


def test_what_cannot_be_simulated_or_compared_is_refused():
    rig = rig_of_preset(preset("thesis"))
    blind = replace(rig, parameters=tuple(replace(p, value=None) if p.name == "R" else p for p in rig.parameters))
    with pytest.raises(AmbidError, match="has no value of R"):
        monte_carlo(blind, runs=1)
    with pytest.raises(AmbidError, match="Did you mean 'thesis'"):
        monte_carlo("thesi", runs=1)
    with pytest.raises(AmbidError, match="gives no number that is a parameter of the rig"):
        monte_carlo("thesis", runs=1, job="info", simulated={"duration": 0.05}, workers=1)
