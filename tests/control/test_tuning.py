"""The PID tuned over many plants: exact slopes, no limit passed, a refusal that names the limit to move."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.control.design import GOALS, Goals, examine, noise_of, worst_of
from ambid.control.drawn import draw_plants
from ambid.control.gain_sets import GainSets, Loops, form_of
from ambid.control.tuning import _Search, tune_pid
from ambid.errors import EstimationError
from ambid.estimation.progress import silent
from tests.control.test_drawn import plant_of_preset


@pytest.fixture(scope="module")
def bench():
    plant, rig = plant_of_preset("unstable-bearing")
    plants = [d.plant for d in draw_plants(plant, rig, 6, seed=1).plants]
    noise = noise_of(rig.noise, {})[:2]
    before = worst_of([examine(p, rig.loop, noise).figures for p in plants])
    return plants, rig, noise, before


def loops_of(plants, noise, loop):
    sets = GainSets.of(loop, plants[0].model, plants[0].rate_hz, form_of(plants[0].model, "axes"))
    return Loops(plants=plants, noise=noise, sets=sets, around=sets.at(loop))


def test_all_plants_at_once_are_each_plant_alone(bench):
    plants, rig, noise, _ = bench
    loops = loops_of(plants, noise, rig.loop)
    for plant, (peak, compliance, noisy) in zip(plants, loops.figures(loops.around)[0], strict=True):
        alone = examine(plant, rig.loop, noise).figures
        assert np.exp(noisy) == pytest.approx(alone.noise, rel=1e-3)
        assert np.exp(peak) == pytest.approx(alone.peak, rel=0.02)  # the smooth maximum lies above
        assert np.exp(compliance) == pytest.approx(alone.compliance, rel=0.02)
        assert np.exp(peak) >= alone.peak * (1.0 - 1e-4)


@pytest.mark.parametrize("changes", [{}, {"ki": 0.0}])
def test_slopes_are_exact(bench, changes):
    plants, rig, noise, before = bench
    loop = replace(rig.loop, **changes)
    loops = loops_of(plants, noise, loop)
    pid = loops.sets
    search = _Search(
        loops=loops, pid=pid, decay=20.0,
        reference={name: getattr(before, name) for name in ("peak", "compliance", "noise", "settling")},
    )  # fmt: skip
    at, step = pid.at(loop), 1e-6
    slopes = search.at(at)[1]
    for j in np.flatnonzero(pid.free):
        unit = step * np.eye(5)[j]
        found = (search.at(at + unit)[0] - search.at(at - unit)[0]) / (2.0 * step)
        assert slopes[:, :, j] == pytest.approx(found, abs=2e-5 * np.abs(slopes).max())


def test_goals_become_better_and_nothing_else_worse(bench):
    plants, rig, noise, before = bench
    loop = tune_pid(plants, rig, Goals.of(GOALS, {}, before), silent)
    after = worst_of([examine(p, loop, noise).figures for p in plants])
    assert after.peak_db < before.peak_db - 2.5
    assert after.compliance < 0.75 * before.compliance
    assert after.noise < 1.001 * before.noise
    assert after.settling < 1.001 * before.settling
    assert loop.ki > 0.0


def test_a_plant_that_is_hardly_held_leaves_the_peak_a_goal(bench):
    plants, rig, noise, _ = bench
    weak = replace(rig, loop=replace(rig.loop, kd=0.4 * rig.loop.kd))
    before = worst_of([examine(p, weak.loop, noise).figures for p in plants])
    assert before.peak > 8.0
    goals = Goals.of(GOALS, {}, before)
    assert goals.reference["peak"] == 3.0
    assert goals.limits == {name: getattr(before, name) for name in ("peak", "compliance", "noise", "settling")}
    loop = tune_pid(plants, weak, goals, silent)
    assert worst_of([examine(p, loop, noise).figures for p in plants]).peak < 2.0


def test_a_limit_that_no_loop_meets_is_refused_with_the_one_to_move(bench):
    plants, rig, _, before = bench
    goals = Goals.of(GOALS, {"noise": 0.3 * before.noise, "peak": 1.3}, before)
    with pytest.raises(EstimationError, match="no PID meets the limits") as refused:
        tune_pid(plants[:2], rig, goals, silent)
    assert "with the others kept, peak" in str(refused.value)
    moved = float(str(refused.value).partition("limits={'peak': ")[2].partition("}")[0])
    goals = Goals.of(GOALS, {"noise": 0.3 * before.noise, "peak": 10.0 ** (moved / 20.0)}, before)
    assert tune_pid(plants[:2], rig, goals, silent).closed


def test_a_figure_that_is_not_known_is_refused():
    with pytest.raises(ambid.AmbidError, match=r"figure 'peek' of a design is unknown.*'peak'"):
        Goals.of(("peek",), {}, worst_of([]))
