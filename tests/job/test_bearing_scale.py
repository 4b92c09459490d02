"""What no record of a nonlinear bearing can show: it is said."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.job.identification import identify_nonlinear
from ambid.physics.linear_model import Parameter
from ambid.physics.presets import preset
from ambid.rig import RigMagnet, default_rig
from ambid.simulation import simulate


def test_a_wrong_gain_of_the_position_is_not_seen_while_the_mass_is_free_and_that_is_said():
    bench = preset("unstable-bearing")
    rng, n = np.random.default_rng(5), 3000
    kick = np.repeat(rng.choice([-12.0, 12.0], n // 3), 3)
    setpoint = 1.2e-4 * np.sin(2 * np.pi * 4 * np.arange(n) / bench.rate_hz)
    record = simulate(
        bench.plant, kick, rate_hz=bench.rate_hz, seed=5, loop=bench.loop, noise=bench.noise, setpoint=setpoint
    ).record
    wide = replace(
        record,
        channels=tuple(replace(c, values=1.05 * c.values) if c.name == "position" else c for c in record.channels),
    )
    bias = Parameter(name="i0", unit="A", role="fixed", value=1.0)
    found = identify_nonlinear([wide], replace(default_rig(), magnet=RigMagnet(kind="pair", parameters=(bias,))))
    m = found.parameter("m")
    assert found.checks["residuals_white"].passed
    assert found.checks["residuals_uncorrelated"].passed
    assert m.value == pytest.approx(bench.plant.m / 1.05**2, rel=0.02)
    assert any("gain error of the position sensor cannot be detected" in w for w in found.warnings)
