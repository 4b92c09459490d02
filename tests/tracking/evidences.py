"""Evidence for the tests: Gaussian of known truth with its exact filter, and that of a simulated bearing."""

from __future__ import annotations

from functools import cache

import numpy as np

from ambid.estimation.likelihood import Workspace, innovations, residual_blocks, weight_of
from ambid.estimation.predictor import PredictorProblem, Scales
from ambid.physics.linear_model import LinearModel, model
from ambid.physics.loop import Noise
from ambid.physics.sensor_errors import SensorGains
from ambid.signals import multisine
from ambid.simulation import LinearPlant, simulate
from ambid.simulation.variation import Schedule, Variation
from ambid.tracking.evidence import Evidence
from tests.bearing.benches import SETTINGS

BLOCK, OUTPUTS = 100, 2
BLOCK_S = 0.005
PHYSICAL = ("m", "k_x", "k_i", "R", "L")
GAINS = ("gain_position", "gain_current")
OFFSETS = ("force", "voltage")
NAMES = (*PHYSICAL, *GAINS, *OFFSETS)


def triangle(p: int, seed: int, *, sd: float = 0.013, condition: float = 1.0) -> np.ndarray:
    """An upper triangle whose best seen direction has standard deviation `sd` in one block."""
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.normal(size=(p, p)))[0] for _ in range(2))
    return np.linalg.qr(u @ np.diag(np.logspace(0, -0.5 * np.log10(condition), p)) @ v.T / sd, mode="r")


def evidence(J: np.ndarray, truth: np.ndarray, k: int, rng: np.random.Generator, *, noise: float = 1.0) -> Evidence:
    """Block `k` of Gaussian evidence about `truth`, linearised at zero; `noise` is a standard deviation."""
    p = truth.size
    return Evidence(
        names=tuple(f"q{i}" for i in range(p)),
        at=np.zeros(p),
        J=J,
        r=noise * rng.normal(size=p) - J @ truth,
        rest=noise**2 * rng.chisquare(BLOCK * OUTPUTS - p),
        n_samples=BLOCK,
        n_outputs=OUTPUTS,
        first=k * BLOCK,
        last=(k + 1) * BLOCK,
    )


class Filter:
    """Exact filter over blocks of a random walk; `moving` numbers only, the others are held."""

    def __init__(self, q: np.ndarray, P: np.ndarray, *, walk: float = 0.0) -> None:
        self.q, self.P = np.array(q, dtype=float), np.array(P, dtype=float)
        self.walk = walk * (np.diag(self.P) > 0)

    def update(self, e: Evidence) -> None:
        JP = e.J @ self.P
        S = np.eye(self.q.size) + JP @ e.J.T
        gain = np.linalg.solve(S, JP)
        self.q = self.q - gain.T @ e.residual(self.q)
        self.P = self.P - JP.T @ gain
        self.P = 0.5 * (self.P + self.P.T) + np.diag(self.walk)


def changed_record(what: str, factor: float, at: int, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and outputs of the bearing of the off-line tests, whose `what` is multiplied by `factor` at a sample."""
    s = SETTINGS["bearing"]
    of, t = model(s.model), at / s.rate_hz
    gain = {o: Schedule.step(1.0, factor, t) for o in of.outputs if what == f"gain_{o}"}
    moved = {what: Schedule.step(s.truth[what], s.truth[what] * factor, t)} if what in s.truth else {}
    force = Schedule.step(0.0, factor, t) if what == "force" else None
    done = simulate(
        LinearPlant(model=of, parameters=s.truth),
        multisine(n, s.rate_hz, amplitude=s.rms, band=s.band, seed=seed, amplitude_is="rms"),
        variation=Variation(parameters=moved, gains=gain, force=force),
        rate_hz=s.rate_hz,
        seed=seed,
        loop=s.loop,
        noise=Noise.held(rate_hz=s.rate_hz, **s.noise),
    )
    r = done.record
    return np.stack([r[c] for c in of.inputs], axis=1), np.stack([r[c] for c in of.outputs], axis=1)


@cache
def _model() -> LinearModel:
    return SensorGains(model(SETTINGS["bearing"].model))


def bearing(what: str, factor: float, *, at: int, n: int, seed: int) -> list[Evidence]:
    """Evidence of blocks of that record about `NAMES`, linearised at the truth before the change, relative units."""
    s, of = SETTINGS["bearing"], _model()
    u, y = changed_record(what, factor, at, n, seed)
    sensor = np.array([s.noise[o] for o in of.outputs])
    truth = {**s.truth, **dict.fromkeys(GAINS, 1.0)}
    names = PHYSICAL + GAINS
    delay = int(s.loop.delay)
    state = np.array(
        [sensor[of.outputs.index(x)] if x in of.outputs else sensor[0] * s.rate_hz / 30 for x in of.states]
    )
    disturbance, u_rms = np.array([s.noise[d] for d in of.disturbances]), np.std(u, axis=0)
    problem = PredictorProblem(
        model=of, rate_hz=s.rate_hz, u=u, y=y, estimated=names, known={"c": truth["c"]},
        magnitude=np.array([abs(truth[k]) for k in names]),
        scales=Scales(state=3 * np.array(state), input=u_rms, output=1.5 * sensor, disturbance=0.7 * disturbance),
        noise_center=np.zeros(disturbance.size + sensor.size - 1), delay=delay, lag=s.loop.delay - delay,
        skip=BLOCK, prior_mean=np.zeros(len(names)), prior_sd=np.full(len(names), np.inf),
    )  # fmt: skip
    vector, sl = np.zeros(problem.size), problem.slices
    vector[sl["physical"]] = [truth[k] / m for k, m in zip(names, problem.magnitude, strict=True)]
    levels = np.log(np.r_[disturbance / problem.scales.disturbance, sensor / problem.scales.output])
    vector[sl["noise"]] = (levels - levels[disturbance.size])[np.arange(levels.size) != disturbance.size]
    work = Workspace(problem)
    e = innovations(problem, vector, work)
    quiet = e[10 * BLOCK : at - 2 * BLOCK]
    weight = weight_of(quiet.T @ quiet / len(quiet))
    rows = np.concatenate([b.copy() for b in residual_blocks(problem, vector, weight, work)])
    columns = [*range(*sl["physical"].indices(problem.size)), *range(*sl["offset"].indices(problem.size)), problem.size]
    rows, p = rows[:, :, columns], len(columns) - 1
    q = np.r_[np.sign([truth[k] for k in names]), np.zeros(p - len(names))]
    found = []
    for k in range(10, len(rows) // BLOCK):  # the first blocks depend on the initial state
        R = np.linalg.qr(rows[k * BLOCK : (k + 1) * BLOCK].reshape(-1, p + 1), mode="r")
        found.append(
            Evidence(
                names=NAMES, at=q, J=R[:p, :p].copy(), r=R[:p, p].copy(), rest=float(R[p, p] ** 2), n_samples=BLOCK,
                n_outputs=OUTPUTS, first=(k + 1) * BLOCK, last=(k + 2) * BLOCK,
            )
        )  # fmt: skip
    return found


def merge(parts):
    """The evidence of several blocks as one, at the linearisation point of the last: by dense QR."""
    end = parts[-1]
    p = end.r.size
    rows = np.vstack([np.column_stack([part.J, part.residual(end.at)]) for part in parts])
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    beyond = float(triangle[p, p] ** 2) if triangle.shape[0] > p else 0.0
    return Evidence(
        names=end.names,
        at=end.at,
        J=triangle[:p, :p],
        r=triangle[:p, p],
        rest=beyond + sum(part.rest for part in parts),
        n_samples=sum(part.n_samples for part in parts),
        n_outputs=end.n_outputs,
        first=parts[0].first,
        last=end.last,
    )
