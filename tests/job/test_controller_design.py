"""What a design's job promises: the loop as the controller holds it, and none that is worse than the present one."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.acquisition.settings import held_by, law_trial
from ambid.control import tuning
from ambid.control.design import UNSTABLE, Examined, Figures, Goals, worst_of
from ambid.errors import EstimationError
from ambid.job import controller_design as room
from ambid.job.controller_design import _refuse_worse, design_controller
from ambid.physics.loop import Loop
from ambid.rig.draft import rig_of_preset
from tests.job.benches import prototype


def test_a_law_is_judged_as_the_words_that_the_controller_gets():
    rig = prototype()
    law = rig.loop.as_law(rig.daq.rate_hz)
    asked = Loop(law=law, delay=0.5)
    held = held_by(rig, asked)
    assert held.delay == 0.5
    f = np.geomspace(1.0, 0.45 * law.rate_hz, 50)
    off = np.abs(held.law.response(f) / law.response(f) - 1.0).max()
    assert 1e-7 < off < 0.01  # rounded, and to little
    words = law_trial(rig, replace(rig, loop=asked)).law.law(law.rate_hz)  # as they are sent, from counts to counts
    gain = [held.law.D / words.D, held.law.response(f) / words.response(f)]
    np.testing.assert_allclose(gain[1], np.broadcast_to(gain[0], gain[1].shape), rtol=1e-12)
    assert held_by(replace(rig, daq=None), asked) is asked


def test_a_loop_with_a_higher_peak_is_offered_only_when_asked_for(monkeypatch):
    rig = rig_of_preset(ambid.preset("rmit-axis"))
    known = ambid.identify(ambid.simulate("rmit-axis", duration=0.3, seed=1), rig)
    monkeypatch.setattr(room, "_JUDGES", 3)

    def given(change):
        monkeypatch.setattr(tuning, "tune_pid", lambda plants, rig, goals, tick, **_: change(rig.loop))

    given(lambda loop: replace(loop, kd=0.7 * loop.kd))
    with pytest.raises(
        EstimationError, match=r"none is offered. Give the goal peak alone, or limits={'peak': "
    ) as told:
        design_controller(known, rig, plants=3)
    least = float(str(told.value).rpartition("'peak': ")[2].removesuffix("}"))
    found = design_controller(known, rig, plants=3, limits={"peak": least})
    assert found.after.worst.peak > found.before.worst.peak
    given(lambda loop: replace(loop, kd=0.0))
    with pytest.raises(EstimationError, match=r"does not hold 3 of the 3 plants that judge, the present one loses 0"):
        design_controller(known, rig, plants=3)


def test_what_is_promised_counts_disturbances_as_they_were_identified(monkeypatch):
    """The noise of the sensors alone makes less of the command than a bench shows that is pushed as well."""
    rig = rig_of_preset(ambid.preset("rmit-axis"))
    rig = replace(rig, noise=replace(rig.noise, force=12.0 * rig.noise.force))
    known = ambid.identify(ambid.simulate(rig, duration=1.0, seed=1, amplitude=5.0), rig)
    monkeypatch.setattr(room, "_JUDGES", 2)
    monkeypatch.setattr(tuning, "tune_pid", lambda plants, rig, goals, tick, **_: rig.loop)
    found = design_controller(known, replace(rig, noise=None), plants=2)
    quiet = ambid.simulate(rig, duration=2.0, seed=2, amplitude=1e-9)
    for s in (found.before, found.after):
        assert s.rms["x"]["voltage"] == pytest.approx(quiet["voltage"].values.std(), rel=0.05)
        assert s.rms["x"]["position"] < quiet["position"].values.std()  # its sensor's noise is none of the rotor
    assert found.before.figures.noise < 0.95 * found.before.rms["x"]["voltage"]
    assert "voltage by all noise, rms" in found.summary()


def test_a_rotors_loop_with_a_higher_peak_is_refused_too(monkeypatch):
    rig = rig_of_preset(ambid.preset("rmit"))
    known = ambid.identify(ambid.simulate("rmit", duration=1.0, seed=1), rig)
    worse = replace(rig.loop, kd=0.7 * rig.loop.kd)
    monkeypatch.setattr(room, "_JUDGES", 2)
    monkeypatch.setattr(tuning, "tune_pid", lambda plants, rig, goals, tick, **_: worse)
    with pytest.raises(EstimationError, match=r"none is offered. Give the goal peak alone, or limits={'peak': "):
        design_controller(known, rig, plants=2)


def test_a_loop_that_holds_more_plants_and_is_better_on_the_others_is_not_refused():
    def seen(*peaks):
        rest = {"compliance": 1e-6, "noise": 0.1, "settling": 0.1}
        return [Examined(figures=Figures(peak=x, pole=5.0, **rest) if x else UNSTABLE) for x in peaks]

    before = seen(2.0, 3.0, None)
    goals = Goals.of(("peak",), {}, worst_of([x.figures for x in before]))
    _refuse_worse(goals, before, seen(1.9, 2.9, 5.0))
    for worse in (seen(1.9, 3.1, 2.0), seen(1.9, None, None)):
        with pytest.raises(EstimationError, match="none is offered"):
            _refuse_worse(goals, before, worse)
