"""Simulation of a rig: its parameters, loop, limits and noise, logged in the columns that its records have."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import RigError
from ambid.physics.loop import Loop
from ambid.physics.models import model
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint
from ambid.record.record import Channel, Record, Step
from ambid.simulate.bench import Simulation, simulate
from ambid.simulate.plant import LinearPlant
from ambid.simulate.rig_magnet import current_offset, enough_steps, plant_of_rig, rest_of_rig
from ambid.units import parse_unit

TURNING = {"speed": "rad/s", "angle": "rad"}
"""Columns of a turning rotor, with their units."""

if TYPE_CHECKING:  # the rig room reads files; a simulation needs its values only
    from ambid.rig.rig import Rig, RigChannel


def simulate_rig(
    rig: Rig,
    excitation: ArrayLike,
    *,
    rate_hz: float,
    seed: int | np.random.Generator,
    closed: bool | None = None,
    setpoint: ArrayLike | None = None,
    nonlinear: bool = False,
    substeps: int | None = None,
    columns: bool = True,
) -> Simulation:
    """Simulate the linear model of a rig about its operating point, or the nonlinear plant of its ``[magnet]``.

    Linear: a value that the operating point does not give is zero; a voltage that it does not give is R times the
    current. Nonlinear: it gives the position alone, current and voltage are those that hold the rotor there.

    Parameters
    ----------
    rig : Rig
        Every parameter needs a value, whatever its role; a nonlinear plant the numbers that `plant_of_rig` names.
    excitation : array_like, shape (n_samples,), in the unit of the model's input
        Added at the controller's output.
    rate_hz : float
        Sampling rate in Hz.
    seed : int or numpy.random.Generator
        Seed of the noise.
    closed : bool, optional
        Closed or open loop; default closed where the rig has a loop and does not say ``open_loop``.
    setpoint : array_like, shape () or (n_samples,), in m, optional
        Wanted position; default the operating point's.
    nonlinear : bool
        Simulate the nonlinear plant instead of the linear one.
    substeps : int, optional
        Runge-Kutta steps in each sample (nonlinear only); default what the plant's rates ask for.
    columns : bool
        Log in the rig's columns, uncalibrated, so that the rig reads the record back; else by role, in SI.

    Returns
    -------
    Simulation
        The record and what happened.

    Raises
    ------
    RigError
        If a parameter has no value, a closed loop is asked for and the rig has none, or a calibration cannot be undone.
    ModelError
        As `ambid.simulate.simulate`.
    """
    plant, loop, point = parts_of_rig(rig, closed, nonlinear=nonlinear)
    if isinstance(plant, NonlinearPlant) and substeps is None:
        substeps = enough_steps(plant, point, rate_hz)
    done = simulate(
        plant,
        excitation,
        rate_hz=rate_hz,
        seed=seed,
        loop=loop,
        limits=rig.limits,
        noise=rig.noise,
        operating_point=point,
        setpoint=setpoint,
        substeps=substeps or 1,
        current_offset=current_offset(rig) if nonlinear else 0.0,
    )
    if not columns:
        return done
    wanted = np.broadcast_to(
        np.asarray(point.position if setpoint is None else setpoint, dtype=np.float64), done.record.n_samples
    )
    return replace(done, record=as_columns(done.record, rig, wanted))


@overload
def parts_of_rig(
    rig: Rig, closed: bool | None, *, nonlinear: Literal[False] = False
) -> tuple[LinearPlant, Loop | None, OperatingPoint]: ...
@overload
def parts_of_rig(
    rig: Rig, closed: bool | None, *, nonlinear: bool
) -> tuple[LinearPlant | NonlinearPlant, Loop | None, OperatingPoint]: ...
def parts_of_rig(
    rig: Rig, closed: bool | None, *, nonlinear: bool = False
) -> tuple[LinearPlant | NonlinearPlant, Loop | None, OperatingPoint]:
    """Return what a rig gives a simulation.

    `rig`: every parameter needs a value, whatever its role; `nonlinear`: the nonlinear plant and its rest point, as
    `simulate_rig`. Returns `plant`: with the rig's parameters; `loop`: the controller, or its delay alone; `point`: a
    value that the rig does not give is zero; a voltage that it does not give is R times the current.
    """
    loop = rig.loop
    if closed and (loop is None or not loop.closed):
        raise RigError(f"rig {rig.name!r} has no [loop] with a gain; a closed loop needs one. Add it, or simulate open")
    if loop is not None and (rig.open_loop if closed is None else not closed):
        loop = loop.opened()
    if nonlinear:
        body = plant_of_rig(rig)
        return body, loop, rest_of_rig(rig, body)
    values = {p.name: p.value for p in rig.parameters}
    parameters = {name: value for name, value in values.items() if value is not None}
    missing = [name for name in values if name not in parameters]
    if missing:
        raise RigError(
            f"rig {rig.name!r}: there is no value for {', '.join(missing)}; a simulation needs every parameter. Give"
            " value = ..."
        )
    plant = LinearPlant(model=model(rig.model), parameters=parameters)
    rest = dict(rig.operating_point)
    rest.setdefault("voltage", parameters.get("R", 0.0) * rest.get("current", 0.0))
    point = OperatingPoint(**{name: rest.get(name, 0.0) for name in OperatingPoint._fields})
    return plant, loop, point


def as_columns(record: Record, rig: Rig, setpoint: Array) -> Record:
    """Name the roles by the rig's columns and undo their calibrations.

    `setpoint`: (n_samples,), in m, the role ``reference``. Returns the rig's columns, then what has no role.
    """
    roles = {c.name: c for c in record.channels}
    roles["reference"] = Channel(name="reference", unit="m", values=setpoint)
    for name, unit in TURNING.items():
        roles.setdefault(name, Channel(name=name, unit=unit, values=np.zeros(record.n_samples)))
    of = model(rig.model)
    taken = {c.role for c in rig.channels} | set(of.inputs) | set(of.outputs)
    others = [c for c in record.channels if c.name not in taken]
    channels = tuple(_raw(roles[c.role], c) for c in rig.channels)
    columns = MappingProxyType({c.role: c.column for c in rig.channels})
    return record.with_step(Step(name="uncalibrate", settings=columns), channels=(*channels, *others))


def _raw(channel: Channel, c: RigChannel) -> Channel:
    calibration, values = c.calibration, channel.values
    written = parse_unit(c.unit) if c.unit is not None else None
    if written is not None and written.scale != 1.0:
        # The rig reads the column as that unit whatever its header says, and records are written in SI.
        raise RigError(
            f"channels.{c.role}.unit is {c.unit!r}; a simulated record is written in SI, here [{written.si}]."
            f" Simulate with a rig without channels.{c.role}.unit"
        )
    if calibration is None:
        unit = channel.unit
    elif calibration.raw is None or calibration.out is None:
        values = (values - calibration.offset) / calibration.gain
        unit = calibration.unit_in or (written.si if written else "1")
    else:
        unit = calibration.unit_in
        slopes = np.diff(calibration.out)
        if not (np.all(slopes >= 0.0) or np.all(slopes <= 0.0)):
            raise RigError(
                f"channels.{c.role}.table rises and falls; a simulated {c.role} cannot be put back through it."
                " Simulate with a rig without that table"
            )
        rising = slice(None) if slopes.sum() > 0.0 else slice(None, None, -1)
        out, raw = calibration.out[rising], calibration.raw[rising]
        if values.min() < out[0] or values.max() > out[-1]:
            raise RigError(
                f"the simulated {c.role} runs from {values.min():.4g} to {values.max():.4g} {channel.unit}; the table"
                f" of channels.{c.role} gives {out[0]:.4g} to {out[-1]:.4g}. Set loop.limits.{c.role}, or extend"
                " the table"
            )
        values = np.interp(values, out, raw)
    return Channel(name=c.column, unit=unit, values=values)
