"""What a rig simulates is found again by the nonlinear identification, which is told what is fixed alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import ambid
from ambid.errors import RigError
from ambid.job.identification import identify_nonlinear
from ambid.physics.presets import preset
from ambid.rig import preset_text, rig_from_text
from ambid.simulation import simulate_rig
from tests.job.benches import PROTOTYPE_FILE

HEAD = """schema = "ambid.rig/1"
model = "one-axis"
[channels.voltage]
[channels.current]
[channels.position]
"""
BALL = """[parameters]
m = { value = 60, unit = "g", role = "fixed" }
R = { value = 4.2, unit = "ohm" }
[magnet]
kind = "single"
rise = false
eddy = true
[magnet.parameters]
L_g = { value = 60, unit = "mH" }
zeta = { value = 5.5, unit = "mm" }
L_leak = { value = 104, unit = "mH" }
a = { value = 500, unit = "rad/s" }
i_offset = { value = 10, unit = "mA", role = "fixed" }
v_offset = { value = 0.2, unit = "V" }
[operating_point]
position = { value = 10, unit = "mm" }
"""
PAIR = """[parameters]
m = { value = 4, unit = "kg", role = "fixed" }
R = { value = 1.6, unit = "ohm" }
[magnet]
kind = "pair"
asymmetric = true
rise = false
[magnet.parameters]
k = { value = 5.2, unit = "N mm^2/A^2" }
s = { value = 0.432, unit = "mm" }
L_leak = { value = 2, unit = "mH" }
i0 = { value = 1, unit = "A", role = "fixed" }
g = { value = 0.5, unit = "m/s^2", role = "fixed" }
k_asym = { value = 0.05, unit = "1" }
i0_asym = { value = 0.04, unit = "A" }
v_drop = { value = 0.8, unit = "V" }
i_drop = { value = 0.2, unit = "A" }
x_offset = { value = 20, unit = "um" }
"""


def rig(text, loop_of):
    """A rig with the loop, limits and noise of a preset."""
    loop = preset_text(preset(loop_of)).partition("[loop]")
    return rig_from_text(f"{HEAD}{text}{loop[1]}{loop[2]}", "bench.toml")


def blind(bench):
    """The same rig without the values that are to be found."""
    parameters, numbers = (
        tuple(p if p.role == "fixed" else replace(p, value=None) for p in known)
        for known in (bench.parameters, bench.magnet.parameters)
    )
    return replace(bench, parameters=parameters, magnet=replace(bench.magnet, parameters=numbers))


def records(bench, places, n, volts, hold, swing=0.0):
    """Records at several places; around each the set point may swing."""
    rate, done = bench.record.rate_hz, []
    for seed, place in enumerate(places):
        rng = np.random.default_rng(seed)
        kicks = np.repeat(rng.choice([-volts, volts], n // hold + 1), hold)[:n]
        setpoint = place + swing * np.sin(2 * np.pi * (2.0 * np.arange(n) / rate + rng.random()))
        there = replace(bench, operating_point={"position": place})
        done.append(simulate_rig(there, kicks, rate_hz=rate, seed=seed, nonlinear=True, setpoint=setpoint))
    return done


def found_again(estimate, truth, names):
    for name in names:
        p = estimate.parameter(name)
        assert abs(p.value - truth[name]) < max(0.01 * abs(truth[name]), 2.6 * p.sd), name  # 99 %
        assert p.sd < 0.2 * abs(truth[name]), name
    # all numbers together: the squared distance is chi2 distributed
    estimated = estimate.covariance_names
    off = np.array([estimate.values[name] - truth.get(name, 0.0) for name in estimated])
    scale = np.sqrt(np.diag(estimate.covariance))
    off, covariance = off / scale, estimate.covariance / np.outer(scale, scale)
    assert off @ np.linalg.solve(covariance, off) < chi2.ppf(0.999, len(estimated))


@pytest.mark.parametrize(
    ("text", "bench", "how", "names"),
    [
        (
            BALL, "levitated-ball", {"places": (8e-3, 10e-3, 12e-3), "n": 1500, "volts": 0.8, "hold": 10},
            ("L_g", "zeta", "L_leak", "R", "a", "v_offset"),
        ),
        (
            PAIR, "unstable-bearing", {"places": (-4e-5, 8e-5), "n": 4000, "volts": 5.0, "hold": 20, "swing": 4e-5},
            ("k", "s", "L_leak", "R", "k_asym", "i0_asym", "v_drop", "i_drop", "x_offset"),
        ),
    ],
)  # fmt: skip
def test_what_is_simulated_is_found_again(text, bench, how, names) -> None:
    known = rig(text, bench)
    done = records(known, **how)
    assert not any(d.n_saturated or d.first_contact for d in done)
    estimate = identify_nonlinear([d.record for d in done], blind(known))
    assert estimate.status == "converged"
    assert estimate.law.gap == ("exponential" if text is BALL else "hyperbolic")
    found_again(estimate, done[0].truth, names)
    assert all(check.passed for check in estimate.checks.values())


def test_a_controllers_rig_is_simulated_at_its_rate_and_names_its_magnet():
    with pytest.raises(RigError, match=r"no value for k_x, k_i, L; .* Simulate its \[magnet\] \(nonlinear=True"):
        ambid.simulate(PROTOTYPE_FILE, duration=0.1)
    assert ambid.simulate(PROTOTYPE_FILE, duration=0.1, nonlinear=True).rate_hz == 2000.0
