"""Simulation of a bench: plant, controller, delay, limits and noise, sampled as a data logger would.

y[k] is sampled at t_k before u[k] acts; u[k] is computed from y[k] (with noise and quantisation), logged, and acts from
t_k plus the delay on, held for a sample. Disturbances are held over a sample.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.linear_model import LinearModel
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.models import model
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint
from ambid.physics.presets import Preset
from ambid.record.record import Record
from ambid.simulate._logging import drawn_noise, logged, written
from ambid.simulate.plant import LinearPlant, Standing
from ambid.simulate.poles import closed_loop_poles
from ambid.simulate.rig_magnet import nonlinear_truth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Simulation:
    """A simulated record and what only the simulator knows.

    Attributes
    ----------
    record : Record
        Channels as logged: input, then the outputs (``voltage``, ``current``, ``position``).
    states : ndarray, shape (n_samples, n_states)
        True states at the sampling instants, in SI units.
    state_names : tuple of str
        Names of the columns of `states`.
    truth : Mapping[str, float]
        Parameters of the (linearised) model in SI units, ``delay`` in samples, and of a nonlinear plant the numbers of
        its law, as `nonlinear_truth` has them.
    first_contact : int or None
        First sample at which the rotor lies at, or has come back from, a stop.
    first_saturated : int or None
        First sample at which the command was limited.
    n_saturated : int
        Number of limited commands.
    n_over_current : int
        Number of samples with the true current outside its limits.
    largest_pole : float
        Largest modulus of the sampled (linearised) loop's poles; the loop is unstable above 1.
    """

    record: Record
    states: Array
    state_names: tuple[str, ...]
    truth: Mapping[str, float]
    first_contact: int | None
    first_saturated: int | None
    n_saturated: int
    n_over_current: int
    largest_pole: float

    @property
    def within_limits(self) -> bool:
        """True where there was no contact, no limited command and no current beyond its limits."""
        return self.first_contact is None and self.n_saturated == 0 and self.n_over_current == 0

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each thing that a user should know: an unstable loop, each limit that was met."""
        rate, found = self.record.rate_hz, []
        if self.largest_pole > 1.0 + 1e-9:
            found.append(f"the loop is unstable: its largest pole has the modulus {self.largest_pole:.6g}")
        if self.first_contact is not None:
            found.append(f"the rotor touched a stop at sample {self.first_contact} ({self.first_contact / rate:.6g} s)")
        if self.first_saturated is not None:
            found.append(
                f"the command was limited in {self.n_saturated} of {self.record.n_samples} samples, first at sample"
                f" {self.first_saturated}"
            )
        if self.n_over_current:
            found.append(f"the current was beyond its limits in {self.n_over_current} samples")
        return tuple(found)


def simulate(
    plant: LinearPlant | NonlinearPlant,
    excitation: ArrayLike,
    *,
    rate_hz: float,
    seed: int | np.random.Generator,
    loop: Loop | None = None,
    limits: Limits | None = None,
    noise: Noise | None = None,
    operating_point: OperatingPoint | None = None,
    setpoint: ArrayLike | None = None,
    start: ArrayLike | None = None,
    substeps: int = 1,
    current_offset: float = 0.0,
) -> Simulation:
    """Simulate a plant in open or closed loop.

    The linear plant is stepped with its exact zero-order-hold matrices, the nonlinear one by the classical Runge-Kutta
    method.

    Parameters
    ----------
    plant : LinearPlant or NonlinearPlant
        The plant; a linear one moves about the operating point.
    excitation : array_like, shape (n_samples,), in the unit of the input (V)
        Added at the controller's output, before its limits.
    rate_hz : float
        Sampling rate in Hz.
    seed : int or numpy.random.Generator
        Seed of the noise; equal seeds give equal records.
    loop : Loop, optional
        Controller and delay; open loop without delay if not given.
    limits : Limits, optional
        None by default.
    noise : Noise, optional
        None by default.
    operating_point : OperatingPoint, optional
        Where the controller holds the plant, and start; default zero (linear), the rest point at zero (nonlinear).
    setpoint : array_like, shape () or (n_samples,), in m, optional
        Wanted position; default the operating point's.
    start : array_like, shape (n_states,), optional
        Initial state; default at rest at the operating point. With an eddy pole its force comes last.
    substeps : int
        Runge-Kutta steps in each sample (nonlinear only).
    current_offset : float
        What the current sensor shows without current, in A; the controller knows what it shows at rest.

    Returns
    -------
    Simulation
        The record and what happened.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or value, or the simulation leaves the air gap or the finite numbers.
    """
    from ambid.simulate._kernels import run

    loop, limits, noise = loop or Loop(), limits or Limits(), noise or Noise()
    standing = Standing.of(plant, operating_point)
    u = _vector("excitation", excitation)
    r = _vector("setpoint", standing.point.position if setpoint is None else setpoint, u.size)
    x0 = standing.centre if start is None else _vector("start", start, standing.centre.size)
    if not (math.isfinite(rate_hz) and rate_hz > 0.0 and substeps >= 1):
        raise ModelError(f"rate_hz {rate_hz} and substeps {substeps} must be positive. Correct them")
    of, period, whole = standing.model, 1.0 / rate_hz, math.floor(loop.delay)
    sensor, disturbance = drawn_noise(of, noise, u.size, rate_hz, seed)
    if current_offset and "current" in of.outputs:
        sensor[:, of.outputs.index("current")] += current_offset
        u += loop.kc * current_offset
    measured, command, states, contact, first, count, lost = run(
        standing.linear,
        u,
        r,
        sensor,
        disturbance,
        x0,
        standing.centre,
        standing.centre_input,
        np.array([of.states.index(o) for o in of.outputs]),
        (_index(of.outputs, "position"), _index(of.outputs, "current")),
        *standing.matrices(period, loop.delay - whole),
        *standing.nonlinear(),
        np.array([loop.kp, loop.ki * period, loop.kd, loop.kc, loop.filter_s, period]),
        whole,
        loop.delay - whole,
        period,
        substeps,
        np.array([getattr(noise, f"{o}_resolution") for o in of.outputs]),
        (*getattr(limits, of.inputs[0]), getattr(noise, f"{of.inputs[0]}_resolution")),
        limits.position,
        standing.gap,
    )
    if lost >= 0:
        raise ModelError(
            f"the simulation leaves the air gap or the finite numbers at sample {lost} ({lost / rate_hz:.6g} s); an"
            " unstable plant needs a loop, and stops in the gap. Give limits.position, another loop, or more substeps"
        )
    linear = {**standing.parameters(), "delay": loop.delay}
    more = {} if isinstance(plant, LinearPlant) else nonlinear_truth(plant)
    truth = {**linear, **more, **({"i_offset": current_offset} if current_offset else {})}
    settings = {"rate_hz": rate_hz, "loop": written(loop), "noise": written(noise), "limits": written(limits)}
    return Simulation(
        record=logged(standing, command, measured, rate_hz, seed, settings),
        states=states[:, : len(of.states)],
        state_names=of.states,
        truth=MappingProxyType(truth),
        first_contact=None if contact < 0 else contact,
        first_saturated=None if first < 0 else first,
        n_saturated=count,
        n_over_current=_beyond(of, states, limits),
        largest_pole=float(np.abs(closed_loop_poles(linear, loop, rate_hz, of=of.name)[0])),
    )


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
        Seed of the noise.
    rate_hz : float, optional
        Sampling rate in Hz; default the preset's, for which its loop is designed.
    closed : bool, optional
        Closed or open loop; default the preset's usual way.
    nonlinear : bool
        Simulate the nonlinear plant instead of the linear one.
    noise : Noise, optional
        Default the preset's.
    setpoint : array_like, shape () or (n_samples,), in m, optional
        Wanted position; default the operating point's.
    substeps : int
        Runge-Kutta steps in each sample (nonlinear only).

    Returns
    -------
    Simulation
        The record and what happened.

    Raises
    ------
    ModelError
        If the preset has no nonlinear plant, or as `simulate`.
    """
    plant: LinearPlant | NonlinearPlant | None = preset.plant
    if not nonlinear:
        plant = LinearPlant(model=model(preset.model), parameters=preset.parameters)
    if plant is None:
        raise ModelError(
            f"preset {preset.name!r} has no nonlinear plant; it is linear only. Simulate it with nonlinear=False"
        )
    loop = preset.loop if (preset.usually_closed if closed is None else closed) else preset.loop.opened()
    return simulate(
        plant,
        excitation,
        rate_hz=preset.rate_hz if rate_hz is None else rate_hz,
        seed=seed,
        loop=loop,
        limits=preset.limits,
        noise=preset.noise if noise is None else noise,
        operating_point=preset.operating_point,
        setpoint=setpoint,
        substeps=substeps,
    )


def _vector(name: str, values: ArrayLike, n: int | None = None) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if n is not None and array.ndim == 0:
        array = np.full(n, float(array))
    if array.ndim != 1 or array.size == 0 or (n is not None and array.size != n):
        raise ModelError(
            f"{name} has shape {array.shape}; it must be one column of {n or 'n_samples'} values. Reshape it"
        )
    if not np.isfinite(array).all():
        raise ModelError(f"{name} is not finite at sample {int(np.argmin(np.isfinite(array)))}. Replace the value")
    return np.array(array)


def _index(names: tuple[str, ...], name: str) -> int:
    return names.index(name) if name in names else -1


def _beyond(of: LinearModel, states: Array, limits: Limits) -> int:
    if "current" not in of.states:
        return 0
    i = states[:, of.states.index("current")]
    return int(np.count_nonzero((i < limits.current[0]) | (i > limits.current[1])))
