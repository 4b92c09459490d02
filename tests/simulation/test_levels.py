"""The largest amplitude a bench allows."""

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.physics.linear_model import model
from ambid.physics.loop import Limits
from ambid.physics.presets import preset
from ambid.simulation import LinearPlant, Simulation, largest_amplitude, simulate, simulate_preset

PLANT = LinearPlant(model=model("one-axis"), parameters=preset("thesis").parameters)
SHAPE = np.sin(2 * np.pi * 30.0 * np.arange(2000) / 10_000.0)


def respond(u: np.ndarray) -> Simulation:
    return simulate(PLANT, u, rate_hz=10_000.0, seed=0)


@pytest.mark.parametrize("quantity", ["voltage", "current", "position"])
def test_linear_plant_scales_to_its_nearest_limit(quantity: str) -> None:
    peak = np.abs(respond(SHAPE).record[quantity]).max()
    limits = Limits(**{quantity: (-1e-3, 2e-3)})
    found = largest_amplitude(respond, SHAPE, limits=limits, fraction=0.5, accuracy=1e-4)
    # the lower limit is the nearer one wherever the response is about as large on both sides
    low, high = respond(SHAPE).record[quantity].min(), respond(SHAPE).record[quantity].max()
    assert found == pytest.approx(min(0.5e-3 / -low, 1e-3 / high), rel=1e-4)
    assert found * peak <= 1e-3


def test_nonlinear_bench_stays_inside_and_just_so() -> None:
    p = preset("levitated-ball")
    shape = np.sin(2 * np.pi * 20.0 * np.arange(2000) / p.rate_hz)

    def ball(u: np.ndarray) -> Simulation:
        return simulate_preset(p, u, seed=3, nonlinear=True)

    found = largest_amplitude(ball, shape, limits=p.limits, operating_point=p.operating_point, fraction=0.6)
    point, inside, outside = p.operating_point, ball(found * shape), ball(1.02 * found * shape)

    def part(done: Simulation) -> float:
        """Largest used part of the way to any limit."""
        used = 0.0
        for name, values in (
            ("voltage", done.record["voltage"]), ("current", done.states[:, 2]), ("position", done.states[:, 0])
        ):  # fmt: skip
            (low, high), rest = getattr(p.limits, name), getattr(point, name)
            used = max(used, (values.max() - rest) / (high - rest), (values.min() - rest) / (low - rest))
        return used

    assert inside.within_limits
    assert part(inside) <= 0.6
    assert part(outside) > 0.6


def test_what_has_no_answer_is_refused() -> None:
    with pytest.raises(ModelError, match="no limit is finite"):
        largest_amplitude(respond, SHAPE, limits=Limits())
    with pytest.raises(ModelError, match="zero throughout"):
        largest_amplitude(respond, np.zeros(10), limits=Limits(voltage=(-1.0, 1.0)))
    with pytest.raises(ModelError, match="fraction"):
        largest_amplitude(respond, SHAPE, limits=Limits(voltage=(-1.0, 1.0)), fraction=1.5)
    p = preset("unstable-bearing")
    tight = Limits(position=(-1e-8, 1e-8))
    with pytest.raises(ModelError, match="without any excitation"):
        largest_amplitude(lambda u: simulate_preset(p, u, seed=0), SHAPE, limits=tight)
