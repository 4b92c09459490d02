"""Margins of a loop: where gains make it unstable, what its sensitivity is, what is said of one that is unstable."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.physics.loop import Loop
from ambid.physics.presets import preset
from ambid.rig.draft import rig_of_preset
from ambid.simulation import closed_loop_poles, simulate_rig
from ambid.simulation.margins import OpenLoop, loop_margins

BENCH = preset("prototype")


def margins(loop=BENCH.loop, *, parameters=BENCH.parameters, rate_hz=BENCH.rate_hz, of="one-axis"):
    return loop_margins(parameters, loop, rate_hz, of=of)


def scaled(factor):
    gains = {name: factor * getattr(BENCH.loop, name) for name in ("kp", "ki", "kd", "kc")}
    return replace(BENCH.loop, **gains)


def largest(loop):
    return np.abs(closed_loop_poles(BENCH.parameters, loop, BENCH.rate_hz)[0])


def test_at_the_ends_of_the_gain_margin_a_pole_is_on_the_circle():
    low, high = margins().gain
    for end, inside in ((low, 1.02), (high, 0.98)):
        assert largest(scaled(end)) == pytest.approx(1.0, abs=2e-4)
        assert largest(scaled(inside * end)) < 1.0 < largest(scaled(end / inside))


def test_the_open_loop_of_a_coil_is_known_in_closed_form():
    """u = -kc i, i[k+1] = a i[k] + b u[k]: L(z) = kc b/(z - a), its phase margin and sensitivity with it."""
    R, ell, kc, rate_hz = 2.0, 0.01, 12.0, 1000.0
    found = margins(Loop(kc=kc), parameters={"R": R, "L": ell}, rate_hz=rate_hz, of="coil")
    a = math.exp(-R / ell / rate_hz)
    z = np.exp(2j * np.pi * found.frequency_hz / rate_hz)
    wanted = kc * (1.0 - a) / R / (z - a)
    np.testing.assert_allclose(found.open_loop, wanted, rtol=1e-9)
    assert found.peak[0] == pytest.approx(np.max(1.0 / np.abs(1.0 + wanted)))
    assert found.gain[1] == pytest.approx((1.0 + a) * R / (1.0 - a) / kc, rel=1e-3)
    crossing = wanted[np.argmin(np.abs(np.abs(wanted) - 1.0))]
    assert found.phase_deg == pytest.approx(180.0 - abs(math.degrees(np.angle(crossing))), abs=1.0)


@pytest.mark.parametrize(
    ("loop", "words"),
    [
        (replace(BENCH.loop, kp=-BENCH.loop.kp, ki=-BENCH.loop.ki, kd=-BENCH.loop.kd), "other sign of kp, ki and kd"),
        (replace(BENCH.loop, kd=0.1 * BENCH.loop.kd), r"it is stable for 6\.\d to 14 times its gains"),
        (replace(BENCH.loop, kd=0.0), "no factor of 0.05 to 20 on its gains"),
    ],
    ids=["reversed", "weak", "undamped"],
)
def test_an_unstable_loop_is_refused_with_what_would_make_it_stable(loop, words):
    found = margins(loop)
    assert not found.stable
    with pytest.raises(ModelError, match=rf"largest pole {found.largest_pole:.5g}; .*{words}.*force=True"):
        found.refuse("this plant", remedy="Design [loop]")
    assert found.words().startswith("unstable")


def test_a_stable_loop_is_not_refused_and_told_in_one_line():
    found = margins()
    found.refuse("this plant", remedy="none")
    assert "stable for 0.28 to 14 times the gains" in found.words()
    assert "peak of the sensitivity at the controller's output" in found.words()
    assert "zone" not in found.words()  # of ISO 14839-3, which opens the loop at the position


def test_a_rig_whose_loop_is_unstable_is_simulated_only_by_force():
    rig = rig_of_preset(replace(BENCH, loop=replace(BENCH.loop, kd=0.1 * BENCH.loop.kd)))
    with pytest.raises(ModelError, match="unstable"):
        simulate_rig(rig, np.zeros(50), rate_hz=2000.0, seed=1)
    assert simulate_rig(rig, np.zeros(50), rate_hz=2000.0, seed=1, force=True).largest_pole > 1.0
    assert simulate_rig(rig, np.zeros(50), rate_hz=2000.0, seed=1, closed=False).record.n_samples == 50


def test_an_integrator_that_is_seen_from_above_its_corner_has_no_margin_at_rest():
    f = np.geomspace(1e-2, 1e3, 4000)
    s = 2j * np.pi * f
    flat, behind = 5e3 / ((s + 6.0) * (s + 400.0)), 1.0 + 0.02 / s
    assert OpenLoop(frequency_hz=f, open_loop=-flat).gain_between[0] == pytest.approx(6.0 * 400.0 / 5e3, rel=1e-3)
    assert OpenLoop(frequency_hz=f, open_loop=flat * behind / s).gain_between[0] is None
    slow = 1e4 * (s + 1.0) / (s * (s + 0.007) * (s + 400.0))  # near -180 degrees above its corner, -90 below
    assert OpenLoop(frequency_hz=f, open_loop=slow).gain_between[0] is None
