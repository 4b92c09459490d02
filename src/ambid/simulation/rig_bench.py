"""Simulation of a rig: its linear model, or the nonlinear plant of its ``[magnet]``, whose numbers are those that
`ambid.identify_nonlinear` finds, under the same names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import ModelError, RigError
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.law_magnet import LawMagnet
from ambid.physics.linear_model import model
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.nonlinear import IDEAL, NonlinearPlant, OperatingPoint, PowerStage
from ambid.physics.presets import Preset, RotorBody
from ambid.record.record import Channel, Record, Step
from ambid.settings.caller import setting
from ambid.simulation.bench import Simulation, largest_amplitude, simulate
from ambid.simulation.margins import loop_margins
from ambid.simulation.plant import LinearPlant, Standing
from ambid.units import parse_unit

if TYPE_CHECKING:
    from ambid.rig.rig import Rig, RigChannel, RigMagnet


FINE = 0.25  # largest rate of the plant at rest times a Runge-Kutta step


def law_of_rig(rig: Rig) -> tuple[MagnetLaw, dict[str, float]]:
    """Return the law that a rig's ``[magnet]`` names, and all numbers of ``[magnet.parameters]`` with a value, whatever
    their role, with m, R and c; SI.
    """
    magnet = rig.magnet
    if magnet is None:
        raise RigError(
            f"rig {rig.name!r} has no [magnet]; a nonlinear simulation needs one. Add it with kind and parameters, "
            "or omit nonlinear"
        )
    kind = "single" if magnet.kind == "auto" and magnet.gap == "exponential" else magnet.kind
    if kind == "auto":
        raise RigError(
            f"rig {rig.name!r}: magnet.kind is 'auto', which a simulation cannot resolve without a record. Give "
            "kind = 'single' or 'pair'"
        )
    law = MagnetLaw(
        gap=magnet.gap or "hyperbolic", pair=kind == "pair", saturation=_has(magnet, magnet.saturation, ("sigma",)),
        rise=_has(magnet, magnet.rise, ("L_rise", "i_knee")),
        asymmetric=_has(magnet, magnet.asymmetric, ("k_asym", "i0_asym")),
    )  # fmt: skip
    parameters = [*(rig.parameter(n) for n in ("m", "R", "c")), *magnet.parameters]
    values = {p.name: p.value for p in parameters if p.value is not None}
    needed = [
        "m",
        "R",
        "c",
        *law.names[:2],
        "L_leak",
        *(["i0"] if law.pair else []),
        *(p.name for p in magnet.parameters),
    ]
    needed += [n for n, on in (("sigma", law.saturation), ("L_rise", law.rise), ("i_knee", law.rise)) if on]
    needed += ["a"] if magnet.eddy else []
    missing = list(dict.fromkeys(n for n in needed if n not in values))
    if missing:
        where = " and ".join(
            f"{table} for {', '.join(names)}"
            for table, names in (
                ("[parameters]", [n for n in missing if n in ("m", "R", "c")]),
                ("[magnet.parameters]", [n for n in missing if n not in ("m", "R", "c")]),
            )
            if names
        )
        raise RigError(
            f"rig {rig.name!r}: there is no value for {', '.join(missing)}; a nonlinear simulation of a {law} needs it."
            f" Give value = ... in {where}"
        )
    return law, values


def _has(magnet: RigMagnet, setting: bool | None, names: tuple[str, ...]) -> bool:
    """Whether the law has a part that the rig may leave to the records: as it says, else where it names a number."""
    return any(magnet.known(n) is not None for n in names) if setting is None else setting


def plant_of_rig(rig: Rig) -> NonlinearPlant:
    """Return the nonlinear plant of a rig, in the coordinates of its position sensor.

    A number that the rig does not name takes what identification takes for it: gravity is 9.81 m/s^2 for one magnet and
    0 for a pair, offsets, drops and differences of a pair are zero. Only the leakage has to be named, if only as zero.
    ``k_x``, ``k_i`` and ``L`` of ``[parameters]`` are not looked at; ``drift`` and ``off_below`` are not simulated.

    Parameters
    ----------
    rig : Rig
        Model ``one-axis``, with ``[magnet]``.

    Returns
    -------
    NonlinearPlant
        Its magnet is a `LawMagnet`.

    Raises
    ------
    RigError
        As `law_of_rig`.
    ModelError
        If a number cannot be that of a plant.
    """
    law, values = law_of_rig(rig)
    return plant_of_law(law, values, eddy=rig.magnet is not None and rig.magnet.eddy)


def plant_of_law(law: MagnetLaw, values: Mapping[str, float], *, eddy: bool) -> NonlinearPlant:
    """Return the plant of a law with its numbers, m, R and c by name, as `plant_of_rig`."""
    stage = PowerStage(
        v_drop=values.get("v_drop", 0.0),
        i_drop=values.get("i_drop", IDEAL.i_drop),
        offset=values.get("v_offset", 0.0),
    )
    return NonlinearPlant(
        magnet=LawMagnet(law=law, values=values, x_offset=values.get("x_offset", 0.0)),
        m=values["m"],
        R=values["R"],
        c=values["c"],
        gravity=values.get("g", 0.0 if law.pair else 9.81),
        eddy_pole=values["a"] if eddy else math.inf,
        stage=stage,
    )


def current_offset(rig: Rig) -> float:
    """Return in A what the rig's current sensor shows without current."""
    offset = None if rig.magnet is None else rig.magnet.known("i_offset")
    return 0.0 if offset is None or offset.value is None else offset.value


def rest_of_rig(rig: Rig, plant: NonlinearPlant) -> OperatingPoint:
    """Return where the loop holds the plant: the declared position, 0 without one, and the law's current and voltage
    there.
    """
    return plant.equilibrium(rig.operating_point.get("position", 0.0))


def enough_steps(plant: NonlinearPlant, point: OperatingPoint, rate_hz: float) -> int:
    """Return how many Runge-Kutta steps, at least 1, a sample needs by the fastest rate of the plant at rest."""
    p = plant.linearise(point.position)
    resistance = p["R"] + abs(plant.stage.slope(0.0))  # the drop is steepest where the current passes zero
    rates = [resistance / p["L"], abs(p["k_i"]) / math.sqrt(p["L"] * p["m"]), math.sqrt(abs(p["k_x"]) / p["m"])]
    rates += [p["c"] / p["m"], plant.eddy_pole if math.isfinite(plant.eddy_pole) else 0.0]
    return max(1, math.ceil(max(rates) / (FINE * rate_hz)))


TURNING = {"speed": "rad/s", "angle": "rad"}
"""Columns of a turning rotor, with their units."""


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
    force: bool = False,
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
        Of the noise.
    closed : bool, optional
        Default closed where the rig has a loop and does not say ``open_loop``.
    setpoint : array_like, shape () or (n_samples,), in m, optional
        Wanted position; default the operating point's.
    nonlinear : bool
        Simulate the nonlinear plant.
    substeps : int, optional
        Runge-Kutta steps in each sample (nonlinear only); default what the plant's rates ask for.
    columns : bool
        Log in the rig's columns, uncalibrated, so that the rig reads the record back; else by role, in SI.
    force : bool
        Simulate a loop that is predicted unstable too.

    Returns
    -------
    Simulation

    Raises
    ------
    RigError
        If a parameter has no value, a closed loop is asked for and the rig has none, or a calibration cannot be undone.
    ModelError
        As `ambid.simulation.simulate`, and for a loop that is predicted unstable.
    """
    bench = Bench.of(rig, rate_hz, closed, nonlinear=nonlinear)
    if not force:
        bench.refuse_unstable()
    return bench.simulate(excitation, seed=seed, setpoint=setpoint, substeps=substeps, columns=columns)


def simulate_preset(
    preset: Preset,
    excitation: ArrayLike,
    *,
    seed: int | np.random.Generator,
    rate_hz: float | None = None,
    closed: bool | None = None,
    nonlinear: bool = False,
    noise: Noise | None = None,
    setpoint: ArrayLike | None = None,
    substeps: int = 1,
) -> Simulation:
    """Simulate a named bench with its own loop, limits and noise.

    Parameters
    ----------
    preset : Preset
        See `ambid.physics.presets.preset`.
    excitation : array_like, shape (n_samples,), in V
        Added at the controller's output.
    seed : int or numpy.random.Generator
        Of the noise.
    rate_hz : float, optional
        Sampling rate in Hz; default the preset's, for which its loop is designed.
    closed : bool, optional
        Default the preset's usual way.
    nonlinear : bool
        Simulate the nonlinear plant.
    noise : Noise, optional
        Default the preset's.
    setpoint : array_like, shape () or (n_samples,), in m, optional
        Wanted position; default the operating point's.
    substeps : int
        Runge-Kutta steps in each sample (nonlinear only).

    Returns
    -------
    Simulation

    Raises
    ------
    ModelError
        If the preset has no nonlinear plant, or as `simulate`.
    """
    bench = Bench.of(preset, rate_hz, preset.usually_closed if closed is None else closed, nonlinear=nonlinear)
    bench = bench if noise is None else replace(bench, noise=noise)
    return bench.simulate(excitation, seed=seed, setpoint=setpoint, substeps=substeps)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """Plant, loop and what stands around them; `rig` is where the columns of a record are named, if there is one."""

    name: str
    plant: LinearPlant | NonlinearPlant
    loop: Loop
    limits: Limits
    noise: Noise
    point: OperatingPoint
    rate_hz: float
    rig: Rig | None = None

    @classmethod
    def of(cls, source: Preset | Rig, rate_hz: float | None, closed: bool | None, *, nonlinear: bool = False) -> Bench:
        """Return the bench of a preset, closed unless `closed` is False, or of a rig as its records are taken."""
        body = source.rotor
        if body is not None:
            axes = (body.model if isinstance(body, RotorBody) else body).axes
            raise ModelError(
                f"{source.name!r} has a rotor on {len(axes)} axes; this needs one axis. Give another bench"
            )
        if isinstance(source, Preset):
            plant: LinearPlant | NonlinearPlant | None = source.plant
            if not nonlinear:
                plant = LinearPlant(model=model(source.model), parameters=source.parameters)
            if plant is None:
                raise ModelError(
                    f"preset {source.name!r} has no nonlinear plant; it is linear only. Simulate it with"
                    " nonlinear=False"
                )
            loop = source.loop.opened() if closed is False else source.loop
            return cls(
                name=source.name, plant=plant, loop=loop, limits=source.limits, noise=source.noise,
                point=source.operating_point, rate_hz=source.rate_hz if rate_hz is None else rate_hz,
            )  # fmt: skip
        plant, controller, point = parts_of_rig(source, closed, nonlinear=nonlinear)
        return cls(
            name=source.name, plant=plant, loop=controller or Loop(), limits=source.limits or Limits(),
            noise=source.noise or Noise(), point=point, rate_hz=source.rate_for(rate_hz), rig=source,
        )  # fmt: skip

    @property
    def linear(self) -> LinearPlant:
        """The plant of a linear bench."""
        assert isinstance(self.plant, LinearPlant)
        return self.plant

    @property
    def parameters(self) -> Mapping[str, float]:
        """Those of the linear plant, or of what the nonlinear one linearises to at rest; SI."""
        return Standing.of(self.plant, self.point).parameters()

    def refuse_unstable(self) -> None:
        """Refuse a closed loop that is predicted unstable."""
        if self.loop.closed:
            model_name = Standing.of(self.plant, self.point).model.name
            margins = loop_margins(self.parameters, self.loop, self.rate_hz, of=model_name)
            where = f"{self.name!r} at {self.rate_hz:g} Hz with a delay of {self.loop.delay:.2g} samples"
            margins.refuse(where, remedy="Correct [loop] or the parameters")

    def simulate(
        self,
        excitation: ArrayLike,
        *,
        seed: int | np.random.Generator,
        setpoint: ArrayLike | None = None,
        substeps: int | None = None,
        columns: bool = True,
    ) -> Simulation:
        """Simulate the bench, a rig's in its own columns unless told otherwise."""
        offset = 0.0
        if self.rig is not None and isinstance(self.plant, NonlinearPlant):
            substeps = enough_steps(self.plant, self.point, self.rate_hz) if substeps is None else substeps
            offset = current_offset(self.rig)
        done = simulate(
            self.plant, excitation, rate_hz=self.rate_hz, seed=seed, loop=self.loop, limits=self.limits,
            noise=self.noise, operating_point=self.point, setpoint=setpoint, substeps=substeps or 1,
            current_offset=offset,
        )  # fmt: skip
        if self.rig is None or not columns:
            return done
        wanted = np.asarray(self.point.position if setpoint is None else setpoint, dtype=np.float64)
        record = as_columns(done.record, self.rig, np.broadcast_to(wanted, done.record.n_samples))
        return replace(done, record=record)

    def largest(self, shape: Array, seed: int, fraction: float) -> float:
        """Return the amplitude of an excitation of peak one that uses a fraction of the limits, to three digits."""
        amplitude = largest_amplitude(
            lambda u: self.simulate(u, seed=seed, columns=False), shape, limits=self.limits,
            operating_point=self.point, fraction=fraction,
        )  # fmt: skip
        return float(f"{amplitude:.3g}")


def parts_of_rig(
    rig: Rig, closed: bool | None, *, nonlinear: bool = False
) -> tuple[LinearPlant | NonlinearPlant, Loop | None, OperatingPoint]:
    """Return plant, controller (or its delay alone) and operating point that a rig gives a simulation; every parameter
    needs a value. A value that the rig does not give is zero, a voltage R times the current; a nonlinear plant has its
    rest point.
    """
    loop = loop_of_rig(rig, closed)
    if nonlinear:
        body = plant_of_rig(rig)
        return body, loop, rest_of_rig(rig, body)
    values = {p.name: p.value for p in rig.parameters}
    parameters = {name: value for name, value in values.items() if value is not None}
    missing = [name for name in values if name not in parameters]
    if missing:
        raise RigError(
            f"rig {rig.name!r}: there is no value for {', '.join(missing)}; a linear simulation needs every parameter. "
            + (
                f"Simulate its [magnet] ({setting('nonlinear', True)}), or give value = ..."
                if rig.magnet
                else "Give value = ..."
            )
        )
    plant = LinearPlant(model=model(rig.model), parameters=parameters)
    rest = dict(rig.operating_point)
    rest.setdefault("voltage", parameters.get("R", 0.0) * rest.get("current", 0.0))
    point = OperatingPoint(**{name: rest.get(name, 0.0) for name in OperatingPoint._fields})
    return plant, loop, point


def loop_of_rig(rig: Rig, closed: bool | None) -> Loop | None:
    """Return the controller of a rig, or its delay alone where the loop is open."""
    loop = rig.loop
    if closed and (loop is None or not loop.closed):
        raise RigError(f"rig {rig.name!r} has no [loop] with a gain; a closed loop needs one. Add it, or simulate open")
    return loop.opened() if loop is not None and (rig.open_loop if closed is None else not closed) else loop


def as_columns(record: Record, rig: Rig, setpoint: Array | None = None) -> Record:
    """Name the roles by the rig's columns and undo their calibrations, those first, then what has no role. `setpoint`
    (n_samples,), in m: the role ``reference`` of one axis.
    """
    extra = () if setpoint is None else (Channel(name="reference", unit="m", values=setpoint),)
    columns = MappingProxyType({c.role: c.column for c in rig.channels})
    channels = column_channels(record.channels, rig, record.n_samples, extra)
    return record.with_step(Step(name="uncalibrate", settings=columns), channels=channels)


def column_channels(
    channels: Sequence[Channel], rig: Rig, n_samples: int, extra: Sequence[Channel] = ()
) -> tuple[Channel, ...]:
    """Return channels named by role as the rig's columns, then those without a role but the `extra` ones."""
    roles = {c.name: c for c in (*channels, *extra)}
    for name, unit in TURNING.items():
        if name not in roles:
            roles[name] = Channel(name=name, unit=unit, values=np.zeros(n_samples))
    plant = rig.plant
    occupied = {c.role for c in rig.channels} | set(plant.inputs) | set(plant.outputs)
    others = [c for c in channels if c.name not in occupied]
    return (*(_raw(roles[c.role], c) for c in rig.channels), *others)


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
                f"channels.{c.role}.table is not monotonic; a simulated {c.role} cannot be inverted through it. "
                "Simulate with a rig without that table"
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
