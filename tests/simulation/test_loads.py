"""A force from outside moves the rotor by what the held loop's stiffness says, and a run may begin anywhere."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.physics.loop import Limits, Noise
from ambid.physics.presets import preset
from ambid.rig.draft import rig_of_preset
from ambid.simulation.bench import VaryingLoop
from ambid.simulation.rig_bench import Bench
from ambid.simulation.rotor_bench import RotorBench


def _stiffness(theta, loop, prefix=""):
    """Return that of the loop at rest: V = R i holds, so that i = -kp x/(R + kc)."""
    return theta[f"{prefix}k_x"] + theta[f"{prefix}k_i"] * loop.kp / (theta[f"{prefix}R"] + loop.kc)


@pytest.mark.parametrize("nonlinear", [False, True])
def test_a_steady_force_on_one_axis(nonlinear):
    bench = Bench.of(preset("unstable-bearing"), None, True, nonlinear=nonlinear)
    loop, force = replace(bench.loop, ki=0.0), 1e-3
    run = VaryingLoop(bench.plant, rate_hz=bench.rate_hz, seed=0, loop=loop, operating_point=bench.point)
    done = run.advance(np.zeros(6000), load=np.full(6000, force))
    assert done.states[-1, 0] == pytest.approx(force / _stiffness(bench.parameters, loop), rel=1e-6)


def test_a_steady_force_on_the_axes_of_a_rotor_from_a_start():
    bench = RotorBench.of(rig_of_preset(preset("rmit")), None, True)
    rig = replace(bench.rig, limits=Limits(), noise=Noise())
    bench = replace(bench, rig=rig, loop=replace(bench.loop, ki=0.0))
    start, force = np.zeros(len(bench.model.states)), np.array([1.0, 2.0, 1.0, 2.0])
    start[bench.model.states.index("x")] = 1e-5
    done = bench.simulate(np.zeros((6000, 4)), seed=0, load=np.tile(force, (6000, 1)), start=start, columns=False)
    assert done.states[0, :4] == pytest.approx([1e-5, 0.0, 1e-5, 0.0], abs=1e-18)
    assert done.states[-1, :4] == pytest.approx(force / _stiffness(bench.plant.parameters, bench.loop, "xL."), rel=1e-6)
