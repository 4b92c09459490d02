"""A levitated ball at three gaps, simulated with its nonlinear magnet: poles of the frozen models against analysis."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.data import io_data
from ambid.nonlinear.lpv import lpv
from ambid.physics.loop import placed_loop
from ambid.physics.presets import preset
from ambid.simulation import simulate

GAPS = (0.008, 0.010, 0.012)


@pytest.fixture(scope="module")
def ball():
    """One record at each gap, held by a loop designed for it; noise of the preset."""
    of = preset("levitated-ball")
    out = []
    for seed, gap in enumerate(GAPS):
        poles = (-150, -40 + 30j, -40 - 30j, -2)
        loop = placed_loop(of.plant.linearise(gap), poles, derivative_cutoff_hz=400.0, delay=1.0)
        excitation = np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], 501), 8)[:4000]
        out.append(
            simulate(
                of.plant, excitation, rate_hz=of.rate_hz, seed=seed, loop=loop, limits=of.limits, noise=of.noise,
                operating_point=of.plant.equilibrium(gap), substeps=2,
            ).record
        )  # fmt: skip
    return of.plant, out


def linearised(plant, gap):
    """State matrix at rest at the gap (thesis eq. 4.8)."""
    p = plant.linearise(gap)
    return np.array([
        [0, 1, 0], [-p["k_x"] / p["m"], -p["c"] / p["m"], p["k_i"] / p["m"]], [0, -p["k_i"] / p["L"], -p["R"] / p["L"]]
    ])  # fmt: skip


def test_poles_from_voltage_are_those_of_the_linearised_plant(ball):
    plant, records = ball
    data = [io_data(x, ["voltage"], ["position"]) for x in records]
    fit = lpv(data, {"order": 3, "nk": 2, "degree": 2, "error_form": "arma", "form": "equation"})
    assert fit.status == "converged"
    for gap in GAPS:
        at = fit.model.at(gap, fit.covariance)
        unstable = float(np.max(np.linalg.eigvals(linearised(plant, gap)).real))
        assert at.poles[0].imag == 0
        assert abs(at.poles[0].real - unstable) < 3.5 * at.poles_sd[0].real
        assert at.poles[0].real == pytest.approx(unstable, rel=0.025)
        assert not at.stable
    poles = [row["poles_rad_s"][0][0] for row in fit.details["frozen"]]
    assert np.all(np.diff(poles) < 0)  # the farther the ball, the softer the negative spring


def test_poles_from_current_are_those_of_mass_and_negative_spring(ball):
    """All choices are the method's own. The current is measured with noise of its own, which no spread counts."""
    plant, records = ball
    fit = lpv([io_data(x, ["current"], ["position"]) for x in records], {"nk": 0, "nb": 3})
    assert fit.settings["schedule"] == "level"
    assert fit.settings["form"] == "equation"
    assert fit.model.schedule.low == pytest.approx(0.008, abs=2e-4)
    assert fit.model.schedule.high == pytest.approx(0.012, abs=2e-4)
    for gap in GAPS:
        at = fit.model.at(gap, fit.covariance)
        p = plant.linearise(gap)
        expected = np.sqrt(-p["k_x"] / p["m"])
        for pole, sd, sign in zip(at.poles, at.poles_sd, (1, -1), strict=True):
            assert 0.0 < sd.real < 0.5
            assert pole.real == pytest.approx(sign * expected, rel=0.025)
