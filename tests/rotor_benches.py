"""Rotors of the independent simulator in ``shared/checks``, which is beside the checkout and not part of it.

Tests that need it skip where it is absent. `model_and_truth` puts its numbers under the names of `RotorModel`.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from ambid.physics.linear_model import Parameter
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.presets import Turning
from ambid.physics.rotor_model import Bearing, RotorModel
from ambid.record import Record, read_record
from ambid.rig import Rig
from ambid.rig.rig import RecordSettings, RigChannel
from ambid.rig.rotor import RigModes
from tests.measured import RECORDS

DATUM = 0.2
"""Of the planes, from the centre of gravity, m."""


_UNITS = {"voltage": "V", "current": "A", "position": "m", "reference": "A"}


def _simulator() -> ModuleType | None:
    path = RECORDS.parent / "checks" / "rotor_truth.py"
    if not path.exists():
        return None
    spec = importlib.util.spec_from_file_location("rotor_truth", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["rotor_truth"] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


truth: Any = _simulator()
needs_simulator = pytest.mark.skipif(truth is None, reason="the independent simulator ../shared/checks is not here")


def rig_of(bench: Any) -> Rig:
    """Return the rig that simulates as a bench of the independent simulator does, with every number fixed.

    Its controller adds to the integral before it uses it, and its derivative forgets by 1 - c a sample.
    """
    model, theta = model_of(bench)
    modal, period = truth.modal_of(bench), 1.0 / bench.rate
    c = 1.0 - np.exp(-2.0 * np.pi * bench.kd_pole_hz * period)
    n, rigid = modal.mass.size - 2, replace(model, n_modes=0)
    numbers = {name: x for name, x in theta.items() if name.startswith(("mode", "gyro"))}
    numbers |= {f"mode{r}.unbalance.u": float(modal.unbalance[r + 1]) for r in range(1, n + 1)}
    of = {"phase": bench.phase_unbalance, "z": DATUM + float(modal.unbalance[1])}
    return Rig(
        name=bench.name, model="rotor", rotor=rigid, channels=tuple(_channels(rigid)),
        parameters=tuple(
            Parameter(name=p.name, unit=p.unit, role="fixed", value=theta[p.name]) for p in rigid.parameters
        ),
        modes=RigModes(count=n, frequency_hz=tuple((modal.omega[2:] / (2 * np.pi)).tolist()), numbers=numbers),
        unbalance=(Turning(name="u", value=bench.unbalance, **of),),
        runout=tuple(Turning(name=x, value=bench.runout, phase=1.1) for x in "AB"),
        loop=Loop(kp=bench.kc * (bench.kp + bench.ki * period), ki=bench.kc * bench.ki, kd=bench.kc * bench.kd,
                  kc=bench.kc, derivative_cutoff_hz=float(c / (2 * np.pi * period * (1.0 - c))), delay=bench.delay),
        limits=Limits(voltage=(-bench.volts_max, bench.volts_max)),
        noise=Noise.held(rate_hz=bench.rate, force=bench.force_noise, voltage=bench.voltage_noise,
                         position=bench.position_noise, current=bench.current_noise),
        record=RecordSettings(rate_hz=bench.rate),
    )  # fmt: skip


def free_rig(bench: Any) -> Rig:
    """Return the rig of a bench as an engineer knows it: the planes and the speed."""
    model, _ = model_of(bench)
    rigid, known = replace(model, n_modes=0), {"A.z", "A.z_sensor", "B.z", "B.z_sensor"}
    angle = [RigChannel(role="angle", column="angle")] if bench.rpm else []
    return Rig(
        name=bench.name, model="rotor", rotor=rigid, channels=(*_channels(rigid), *angle),
        parameters=tuple(
            Parameter(name=p.name, unit=p.unit, role="fixed", value=p.default) if p.name in known
            else Parameter(name=p.name, unit=p.unit, role="free")
            for p in rigid.parameters
        ),
    )  # fmt: skip


def record_of(bench: Any, seed: int) -> Record:
    """Return a record of a bench; with the angle where it turns."""
    found = truth.simulate(bench, seed)
    columns = {f"{axis}_{q}": found[q][:, j] for j, axis in enumerate(truth.AXES) for q in _UNITS}
    units = {f"{axis}_{q}": unit for axis in truth.AXES for q, unit in _UNITS.items()}
    if bench.rpm:
        columns["angle"], units["angle"] = found["angle"], "rad"
    return read_record(columns, rate_hz=bench.rate, units=units)


def stepped(bench: Any, changes: dict[int, Any], seed: int, fraction: float = 0.0) -> Record:
    """Return a record of a bench whose plant becomes that of another one at a sample of it, in the same loop.

    `fraction`: of a sample, by which voltages act later than the whole samples of the bench.
    """
    rng = np.random.default_rng(seed)
    reference = np.tile(truth.multisine(bench, rng), (bench.settle + bench.periods, 1))
    off, T = reference.shape[0] * bench.settle // (bench.settle + bench.periods), 1.0 / bench.rate
    c = 1.0 - np.exp(-2.0 * np.pi * bench.kd_pole_hz * T)
    held = rng.standard_normal((reference.shape[0], 8)) * np.repeat([bench.voltage_noise, bench.force_noise], 4)
    read = rng.standard_normal((reference.shape[0], 8)) * np.repeat([bench.position_noise, bench.current_noise], 4)
    early, late, C = _sampled(bench, fraction), _sampled(bench, 1.0 - fraction), truth.plant(bench)[2]
    x, slow, whole, before = np.zeros(C.shape[1]), np.zeros(4), np.zeros(4), np.zeros(4)
    waiting, rows = [np.zeros(4)] * bench.delay, np.empty((reference.shape[0], 16))
    for k, r in enumerate(reference):
        if k - off in changes:
            now = changes[k - off]
            early, late, C = _sampled(now, fraction), _sampled(now, 1.0 - fraction), truth.plant(now)[2]
        y = C @ x + read[k]
        rate = (y[:4] - slow) * (c / T)
        slow, whole = slow + c * (y[:4] - slow), whole + bench.ki * T * y[:4]
        v = bench.kc * (r - bench.kp * y[:4] - whole - bench.kd * rate - y[4:])
        rows[k] = np.concatenate([v, y[4:], y[:4], r])
        waiting.append(v)
        for (A, B), volts in ((early, before), (late, waiting[0])):
            x = A @ x + B @ np.concatenate([volts, held[k]])
        before = waiting.pop(0)
    names = [f"{axis}_{q}" for q in _UNITS for axis in truth.AXES]
    units = {name: _UNITS[name.split("_")[1]] for name in names}
    return read_record(dict(zip(names, rows[off:].T, strict=True)), rate_hz=bench.rate, units=units)


def _sampled(bench: Any, part: float) -> tuple[Any, Any]:
    """Return the plant of a bench over a part of a sample, all inputs held."""
    A, B, _ = truth.plant(bench)
    n, both = A.shape[0], np.zeros((A.shape[0] + B.shape[1],) * 2)
    both[:n] = np.column_stack([A, B]) * part / bench.rate
    both = expm(both)
    return both[:n, :n], both[:n, n:]


def _channels(model: RotorModel) -> Iterator[RigChannel]:
    for role in model.inputs:
        yield RigChannel(role=role, column=role, delay="auto")
    for role in (*model.outputs, *(f"{axis}_reference" for axis in model.axes)):
        yield RigChannel(role=role, column=role)


def model_and_truth(name: str) -> tuple[RotorModel, dict[str, float]]:
    """Return the model of a bench of the independent simulator, and its numbers."""
    return model_of(truth.BENCHES[name])


def model_of(bench: Any) -> tuple[RotorModel, dict[str, float]]:
    """Return the model of a bench, and its numbers."""
    modal, eddy = truth.modal_of(bench), bool(np.isfinite(bench.eddy_pole_hz))
    n = modal.mass.size - 2
    bearings = tuple(
        Bearing(name=x, axes=(f"{x.lower()}x", f"{x.lower()}y"), z=float(DATUM + modal.bearing[j, 1]),
                z_sensors=(float(DATUM + modal.sensor[j, 1]),))
        for j, x in enumerate("AB")
    )  # fmt: skip
    speed = bench.rpm * 2 * np.pi / 60
    model = RotorModel(bearings=bearings, speed=speed, polar=speed > 0, extras=("a",) * eddy, n_modes=n)
    theta = {p.name: p.default for p in model.parameters if p.default is not None}
    theta |= {"m": modal.mass[0], "Id": modal.mass[1], "Ip": modal.gyro[1, 1], "z_cg": DATUM}
    theta |= {"a": 2 * np.pi * bench.eddy_pole_hz} if eddy else {}
    for j, axis in enumerate(truth.AXES):
        theta |= {f"{axis}.{q}": getattr(bench, q)[j] for q in ("k_i", "k_x", "R", "L")}
    for r in range(1, n + 1):
        theta |= {f"mode{r}.omega": modal.omega[r + 1], f"mode{r}.zeta": modal.zeta[r + 1]}
        for j, x in enumerate("AB"):
            theta |= {f"mode{r}.{x}.z": modal.bearing[j, r + 1], f"mode{r}.{x}.z_sensor": modal.sensor[j, r + 1]}
        theta |= {f"gyro.{s}{r}": modal.gyro[s + 1, r + 1] for s in range(r + 1)}
    return model, {name: float(x) for name, x in theta.items()}
