"""LQG laws are searched among those that the controller can hold."""

import ambid.control.knobs as room
from ambid.acquisition.settings import held_by
from ambid.control.design import Goals, examine, noise_of, worst_of
from ambid.control.drawn import draw_plants
from ambid.estimation.progress import silent
from tests.control.test_lqg import of_preset
from tests.job.benches import prototype


def test_the_quietest_law_fits_in_the_words_of_the_controller(monkeypatch):
    plant, rig = of_preset("prototype")[1], prototype()
    plants = [d.plant for d in draw_plants(plant, rig, 6, seed=1).plants]
    noise = noise_of(rig.noise, {})[:2]
    goals = Goals.of(["noise"], {}, worst_of([examine(p, rig.loop, noise).figures for p in plants]))
    refused = 0

    def count(rig, loop):
        nonlocal refused
        refused += 1
        held = held_by(rig, loop)
        refused -= 1
        return held

    monkeypatch.setattr(room, "held_by", count)
    monkeypatch.setattr(room, "_FINEST", 1.5)
    law = room.design_lqg(plants, rig, goals, silent)
    assert refused  # modes that nearly cancel: such laws are tried here, and passed over
    held = examine(plant, held_by(rig, law), noise).figures
    assert held.stable
    assert held.noise < goals.reference["noise"]
