"""An estimate of the levitated ball made by hand: the truth as its numbers, so that nothing has to be searched."""

from functools import cache

import numpy as np

from ambid.bearing.magnet_problem import UNITS, BearingRecord
from ambid.bearing.magnet_result import NonlinearBearingEstimate
from ambid.estimation.estimate import Check, Delay, EstimatedParameter, OutputFit
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.presets import preset
from ambid.simulation import Simulation, simulate
from tests.bearing.magnet.bearings import as_seen, truth_of

LEVELS = {"position": 2e-6, "current": 1e-3, "force": 2e-3, "voltage": 0.02}  # of the preset, rms of one sample
BALL = ("k", "s", "sigma", "L_leak", "m", "R", "c", "g")
FREE = ("k", "s", "L_leak", "R")


@cache
def ball(seed: int, low: float = 8e-3, high: float = 12e-3, n: int = 4000, rate_scale: int = 1) -> Simulation:
    """A ball that is moved between two positions, with a two-level voltage on top."""
    bench, rng = preset("levitated-ball"), np.random.default_rng(seed)
    setpoint = np.repeat(rng.uniform(low, high, 8), n // 8)
    kick = np.repeat(rng.choice([-0.5, 0.5], n // 10), 10)
    return simulate(
        bench.plant, kick, rate_hz=bench.rate_hz * rate_scale, seed=seed, loop=bench.loop, limits=bench.limits,
        noise=bench.noise, operating_point=bench.operating_point, setpoint=setpoint,
    )  # fmt: skip


def seen(seed: int, name: str = "ball.csv", **settings: float) -> BearingRecord:
    return as_seen(ball(seed, **settings), name)


def by_hand(records: dict[str, BearingRecord], **off: float) -> NonlinearBearingEstimate:
    """The truth, times what is given by name; standard deviations of 1 %."""
    truth = truth_of(preset("levitated-ball"))
    values = {n: truth[n] * off.get(n, 1.0) for n in BALL if n != "sigma"}
    sds = {n: (0.01 * abs(values[n]) or 1e-5) if n in FREE else 0.0 for n in values}
    points = np.concatenate([r.y for r in records.values()])
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    sd = np.array([sds[n] for n in FREE])
    fits = {"position": OutputFit(one_step=0.999, simulation=None, innovation_sd=2.9e-6),
            "current": OutputFit(one_step=0.99, simulation=None, innovation_sd=1.1e-3)}  # fmt: skip
    between = {"position": (low[0], high[0]), "current": (low[1], high[1])}
    return NonlinearBearingEstimate(
        status="converged", law=MagnetLaw(), eddy=False, drift=False,
        records=tuple({"samples": r.u.size, "rate_hz": r.rate_hz, "sha256": None, "file": n, "held": r.held,
                       "history": ["read"]} for n, r in records.items()),
        parameters=tuple(
            EstimatedParameter(
                name=n, unit=UNITS[n], value=v, sd=sds[n], ci95=(v - 1.96 * sds[n], v + 1.96 * sds[n]),
                role="free" if n in FREE else "fixed", identifiable=True,
            )
            for n, v in values.items()
        ),
        covariance_names=FREE, covariance=np.diag(sd**2), covariance_method="information",
        delay={"2000 Hz": Delay(samples=1, fraction=0.0, sd=None, how="estimated")},
        noise=dict.fromkeys(records, LEVELS), fit=dict.fromkeys(records, fits), range=between, usual=between,
        operating_point={"position": 0.01, "current": 0.95}, hull=corners, coil_hull=corners, criterion=-1.25,
        bic=1.0 / 3.0, checks={"residuals_white": Check(passed=True, detail="white", p=0.5, values={"ball.csv": 0.5})},
        warnings=("one thing",), timing_s={"fit": 0.1}, rig={"name": "ball", "text": None, "folder": None},
    )  # fmt: skip
