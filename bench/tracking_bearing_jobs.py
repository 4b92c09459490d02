"""Jobs on the record of a bearing under feedback: physical parameters and states."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np

from ambid.physics.linear_model import model
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.recursive.joint import JointEkf, JointStart, JointUkf
from ambid.tracking.evidence import Samples
from ambid.tracking.rpem import PhysicalRpem
from peers import Array, Bench
from tracking_benches import PHYSICAL, RATE, preset_bench, start_of
from tracking_job import Job, Same

NAME = "unstable-bearing"
N, N_JOINT = 200_000, 8_000
SPREAD = 0.02  # of the start of the joint filters, relative
WIDE = np.array([1e-3, 1.0, 1.0])  # m, m/s, A
OFFSET = np.array([10.0, 0.5])  # N, V


@cache
def _record() -> Samples:
    return preset_bench().samples("steady", 7, N / RATE)


def bearing_jobs() -> Iterator[Job]:
    """Jobs with physical parameters."""
    for memory in ("all", "auto"):
        yield _rpem(memory)
    yield _joint("joint EKF, 5 physical parameters, 3 states, 2 offsets", JointEkf, "filterpy, EKF", "ekf")
    yield _joint("joint UKF, 5 physical parameters, 3 states, 2 offsets", JointUkf, "filterpy, UKF", "ukf")


def _on_record(name: str, n: int, make: Callable[[], Any], **more: Any) -> Job:
    samples = _record()

    def feed() -> Callable[[int, int], object]:
        made = make()
        return lambda a, b: made.update(samples.u[a:b], samples.y[a:b])

    def single() -> Callable[[int], object]:
        made = make()
        return lambda k: made.update(samples.u[k], samples.y[k])

    return Job(name=name, n=n, feed=feed, single=single, **more)


def _rpem(memory: str) -> Job:
    def make() -> PhysicalRpem:
        return PhysicalRpem(start_of(NAME), memory="all" if memory == "all" else "auto")

    def compare(found: dict[str, Array]) -> Same:
        made = make()
        made.update(_record().u[:N_JOINT], _record().y[:N_JOINT])
        return _beside(made.estimate, np.sqrt(np.diag(made.covariance)), found)

    # the peer does the job that comes nearest: its start is what the RPEM starts from
    return _on_record(
        f"RPEM, 5 physical parameters, 3 states, memory {memory}", N, make, peer="filterpy, EKF", peer_n=N_JOINT,
        ask=lambda children, _: _ask(children, "ekf", _start_of_rpem()), compare=compare,
    )  # fmt: skip


def _joint(name: str, kind: type[JointEkf] | type[JointUkf], peer: str, structure: str) -> Job:
    start = _start()

    def compare(found: dict[str, Array]) -> Same:
        made = kind(start)
        made.update(_record().u[:N_JOINT], _record().y[:N_JOINT])
        return _beside(made.estimate[:5], np.sqrt(np.diag(made.covariance))[:5], found)

    return _on_record(
        name, N if kind is JointEkf else N // 4, lambda: kind(start), peer=peer, peer_n=N_JOINT,
        ask=lambda children, _: _ask(children, structure, _orders(start)), compare=compare,
    )  # fmt: skip


@cache
def _start() -> JointStart:
    bench, rng = preset(NAME), np.random.default_rng(3)
    values = dict(bench.parameters)
    draw = rng.standard_normal(5)
    values |= {k: values[k] * (1 + SPREAD * d) for k, d in zip(PHYSICAL, draw, strict=True)}
    return _joint_start(values, SPREAD)


def _joint_start(values: dict[str, float], spread: float) -> JointStart:
    bench = preset(NAME)
    noise: Noise = bench.noise
    force, voltage = noise.held_rms(RATE)
    return JointStart(
        model=model("one-axis"), rate_hz=RATE, values=values, free=PHYSICAL,
        covariance=np.diag([(spread * values[k]) ** 2 for k in PHYSICAL]),
        sensor_sd={"position": noise.position, "current": noise.current},
        disturbance_sd={"force": force, "voltage": voltage}, delay=bench.loop.delay,
        offset_sd={"force": float(OFFSET[0]), "voltage": float(OFFSET[1])},
    )  # fmt: skip


def _start_of_rpem() -> dict[str, Any]:
    numbers = start_of(NAME)
    found = {**preset(NAME).parameters, **dict(zip(numbers.names, numbers.start * numbers.magnitude, strict=True))}
    sd = np.sqrt(np.diag(numbers.covariance))[: len(PHYSICAL)]
    return _orders(_joint_start({k: found[k] for k in preset(NAME).parameters}, float(np.median(sd))))


def _orders(start: JointStart) -> dict[str, Any]:
    return {
        "dt": 1.0 / RATE,
        "values": [start.values[k] for k in PHYSICAL],
        "sensor": [start.sensor_sd[k] for k in ("position", "current")],
        "disturbance": [start.disturbance_sd[k] for k in ("force", "voltage")],
        "spread": float(np.sqrt(start.covariance[0, 0]) / start.values["m"]),
        "wide": WIDE.tolist(),
        "offset": OFFSET.tolist(),
    }


def _ask(children: Bench, structure: str, orders: dict[str, Any]) -> dict[str, Any]:
    """The peer gets the input as the plant does: a sample of delay is taken off."""
    u, delay = _record().u[:N_JOINT, 0], round(preset(NAME).loop.delay)
    late = np.concatenate([np.full(delay, u[0]), u[: u.size - delay]])
    return children.ask("filterpy", structure, orders, late, _record().y[:N_JOINT], limit_s=120.0)


def _beside(ours: Array, sd: Array, found: dict[str, Array]) -> Same:
    """Errors against the truth of both, and how far they are apart."""
    truth = np.array([preset(NAME).parameters[k] for k in PHYSICAL])
    mine, theirs = (np.sqrt(np.mean((x / truth - 1) ** 2)) for x in (ours, found["estimate"]))
    apart = float(np.max(np.abs(ours - found["estimate"]) / sd))
    return Same(
        text=f"rms error {mine:.2%}, peer {theirs:.2%}; at most {apart:.2g} sd apart",
        numbers={
            "rms_error": float(mine), "peer_rms_error": float(theirs), "apart_sd": apart,
            "sd": sd.tolist(), "peer_sd": found["sd"].tolist(),
        },
    )  # fmt: skip
