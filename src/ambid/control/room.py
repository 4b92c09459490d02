"""What noise, forces and unbalance ask of voltage, current and position in a closed loop, beside their limits.

A quantity that answers white noise of standard deviation s through G has the variance ∫ |G|² 2 s²/rate df. Its largest
answer to a step of force is that of the running sum over the impulse response, the inverse DFT of G. Unbalance U turns
with a force U W² at the speed W, run-out r adds to what sensors read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.closed import ClosedLoop
from ambid.physics.rotor_model import RotorModel
from ambid.rotor.balance import Machine

QUANTITIES: Mapping[str, str] = {"voltage": "V", "current": "A", "position": "m"}
_KEPT = 3.0  # standard deviations of the noise that a limit is left for
_LINES = 2048  # of the first window in which the answer to a step is looked for
_WINDOWS = 5  # each twice as long
_SETTLED = 0.01
_SPEEDS = 60
_SPEED_BAND = (1e-3, 0.05)  # of the rate: speeds that are looked at where none is known
_ABOVE = 1.2  # of a speed that is known
_MISSING = (None, None, None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """What one quantity of an axis is asked for, SI."""

    rms: float | None  # by all noise; None: it is not known
    sensors: float | None  # by the noise of the sensors alone
    process: float | None  # by the noise of force and voltage alone
    step: float  # its largest answer to a step of 1 N at the magnet
    room: float | None  # between where it stands and the nearer limit; None: there is no limit


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """What an axis bears before voltage, current or position comes to its limit; 3 rms of the noise are left for it."""

    quantities: Mapping[str, Demand]
    force_step: float | None  # largest step of force at the magnet, N; None: without a limit
    force_limit: str | None  # the quantity that comes to its limit
    unbalance: float | None  # largest unbalance in the plane of the magnet, kg m
    unbalance_limit: str | None
    unbalance_hz: float | None  # where


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vibration:
    """Motion of the rotor at its sensors by the unbalance and run-out that the rig gives, over the speed."""

    frequency_hz: Array  # (n,), of rotation
    amplitude: Mapping[str, Array]  # of each position output, m
    runout: bool
    clearance: float | None  # between where the rotor stands and the nearer stop, m


def room_by_axis(
    loop: ClosedLoop, noise: Mapping[str, float] | None, room: Mapping[str, float | None], machine: Machine | None
) -> dict[str, Room]:
    """Return what each axis bears.

    `noise`: standard deviation of the model's disturbances, held over a sample, and of its outputs' noise, by name;
    `room`: by role; `machine`: the rotor, where unbalance can be said of it.
    """
    found = {}
    answers, peaks = _answers(loop), _step_peaks(loop)
    for axis in loop.plant.axes:
        rows = quantity_rows(loop, axis)
        parts = {q: _noise(loop, answers[:, row], noise) for q, row in rows.items()}
        demands = {
            q: Demand(
                rms=parts[q][0], sensors=parts[q][1], process=parts[q][2], step=peaks[axis][q],
                room=room[role_of(loop, axis, q)],
            )
            for q, row in rows.items()
        }  # fmt: skip
        free = {q: max(d.room - _KEPT * (d.rms or 0.0), 0.0) for q, d in demands.items() if d.room is not None}
        steps = {q: x / demands[q].step for q, x in free.items()}
        force = min(steps, key=lambda q: steps[q]) if steps else None
        unbalance = _unbalance(loop, axis, free, machine) if free else _MISSING
        found[axis] = Room(
            quantities=demands, force_step=None if force is None else steps[force], force_limit=force,
            unbalance=unbalance[0], unbalance_limit=unbalance[1], unbalance_hz=unbalance[2],
        )  # fmt: skip
    return found


def quantity_rows(loop: ClosedLoop, axis: str) -> dict[str, int]:
    """Return where an axis' input, current and position at the magnet stand: inputs, then `ClosedLoop.motions`."""
    of, n_u = loop.plant.model, len(loop.plant.model.inputs)
    before = f"{axis}_" if isinstance(of, RotorModel) else ""
    rows = {}
    for kind in ("voltage", "current"):
        if f"{before}{kind}" in of.inputs:
            rows[kind] = of.inputs.index(f"{before}{kind}")
        elif f"{before}{kind}" in of.outputs:
            rows[kind] = n_u + of.outputs.index(f"{before}{kind}")
    return {**rows, "position": n_u + len(of.outputs) + loop.plant.axes.index(axis)}


def role_of(loop: ClosedLoop, axis: str, quantity: str) -> str:
    """Return the role of a quantity of an axis."""
    return f"{axis}_{quantity}" if isinstance(loop.plant.model, RotorModel) else quantity


def _answers(loop: ClosedLoop) -> Complex:
    """Return what inputs, outputs and magnets do by the causes of `ClosedLoop.answers`."""
    return np.concatenate([loop.answers, loop.motions], axis=1)


def _noise(
    loop: ClosedLoop, through: Complex, noise: Mapping[str, float] | None
) -> tuple[float | None, float | None, float | None]:
    """Return the rms of a quantity by all noise, by that of the sensors, and by that of the process."""
    if noise is None:
        return _MISSING
    of, f = loop.plant.model, loop.frequency_hz
    n_d, n_y = len(of.disturbances), len(of.outputs)
    names = {**dict(enumerate(of.disturbances)), **dict(enumerate(of.outputs, through.shape[1] - n_y))}
    power = {}
    for k, name in names.items():
        size = np.abs(through[:, k]) ** 2 * 2.0 * noise.get(name, 0.0) ** 2 / loop.plant.rate_hz
        power[k] = float(np.trapezoid(size, f))
    process = sum(x for k, x in power.items() if k < n_d)
    sensors = sum(x for k, x in power.items() if k >= n_d)
    return float(np.sqrt(process + sensors)), float(np.sqrt(sensors)), float(np.sqrt(process))


def _step_peaks(loop: ClosedLoop) -> dict[str, dict[str, float]]:
    """Return the largest answer of each quantity of each axis to a step of 1 N at its magnet."""
    axes = loop.plant.axes
    at = [(axis, q, row, j) for j, axis in enumerate(axes) for q, row in quantity_rows(loop, axis).items()]
    rows, causes = [row for _, _, row, _ in at], [j for *_, j in at]
    before = np.zeros(len(at))
    for k in range(_WINDOWS):
        f = np.linspace(0.0, 0.5, _LINES * 2**k + 1) * loop.plant.rate_hz
        f[0] = 1e-3 * f[1]  # at rest an integrator of the controller is infinite
        impulse = np.fft.irfft(_answers(loop.at(f))[:, rows, causes], axis=0)
        found = np.max(np.abs(np.cumsum(impulse, axis=0)), axis=0)
        if np.all(np.abs(found - before) <= _SETTLED * found):
            break
        before = found
    return {axis: {q: float(found[m]) for m, (a, q, *_) in enumerate(at) if a == axis} for axis in axes}


def _unbalance(
    loop: ClosedLoop, axis: str, free: Mapping[str, float], machine: Machine | None
) -> tuple[float | None, str | None, float | None]:
    """Return the largest unbalance in the plane of an axis' magnet, the quantity at its limit, and where in Hz."""
    of, f = loop.plant.model, speeds_of(loop)
    rows = quantity_rows(loop, axis)
    if isinstance(of, RotorModel):
        bearing, plane = of.placed[of.axes.index(axis)]
        if machine is None or plane == 2:
            return _MISSING
        n_u = len(of.inputs)
        answer = synchronous(loop, machine, f, machine.shape(f"{bearing.name}.z")[:, None], None)[:, :, 0]
        rows["position"] = n_u + loop.plant.sensors[of.axes.index(axis)][0]
    else:
        at = loop.at(f)
        answer = _answers(at)[:, :, len(of.disturbances)] * (2.0 * np.pi * f[:, None]) ** 2
    most = {q: x / np.abs(answer[:, rows[q]]) for q, x in free.items()}
    first = min(most, key=lambda q: float(np.min(most[q])))
    k = int(np.argmin(most[first]))
    return float(most[first][k]), first, float(f[k])


def speeds_of(loop: ClosedLoop) -> Array:
    """Return speeds of rotation in Hz: up to somewhat above that of the model, else where rotors may turn."""
    of = loop.plant.model
    speed = abs(of.speed) / (2.0 * np.pi) if isinstance(of, RotorModel) else 0.0
    if speed:
        return np.linspace(_ABOVE / _SPEEDS, _ABOVE, _SPEEDS) * speed
    return np.geomspace(*_SPEED_BAND, _SPEEDS) * loop.plant.rate_hz


def synchronous(
    loop: ClosedLoop, machine: Machine, frequency_hz: Array, unbalance: Array, runout: Complex | None
) -> Complex:
    """Return inputs, and motion at the outputs, of a rotor over its speed, (n, n_u + n_y, columns).

    `unbalance`: what it does to the coordinates of a plane of motion by column, kg m times shape; `runout`: (n_y,
    columns), m.
    """
    K, rate = loop.at(frequency_hz).K, loop.plant.rate_hz
    found = []
    for f, k in zip(frequency_hz, K, strict=True):
        omega = 2.0 * np.pi * float(f)
        pushed = machine.forced(omega, unbalance)
        H = machine.transfer(np.array([omega]), omega, rate)[0]
        read = 0.0 if runout is None else runout
        y = np.linalg.solve(np.eye(H.shape[0]) + H @ k, pushed + read)
        found.append(np.vstack([-k @ y, y - read]))
    return np.array(found)
