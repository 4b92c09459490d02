"""Simulation of a bench: plant, controller, delay, limits and noise, sampled as a data logger would.

y[k] is sampled at t_k before u[k] acts; u[k] is computed from y[k] (with noise and quantisation), logged, and acts from
t_k plus the delay on, held for a sample. Disturbances are held over a sample.

Parameters of a linear plant may change on the way. While they drift, each stretch of a millisecond has the matrices of
its middle; jumps happen at their exact sample. States stay continuous where parameters change: a mass is added at the
rotor's speed, an inductance changes at equal current, and the term i dL/dt of a drifting inductance is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
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
from ambid.record.record import Channel, Record, Step
from ambid.simulate.plant import LinearPlant, Standing, closed_loop_poles, nonlinear_truth
from ambid.simulate.variation import Tables, Variation, check_variation


def drawn_noise(
    of: LinearModel, noise: Noise, n: int, rate_hz: float, seed: int | np.random.Generator
) -> tuple[Array, Array]:
    """Return sensor noise (n, n_outputs) and disturbances (n, n_disturbances), in SI units."""
    # All columns are drawn whatever their size, so that one level changed leaves the others' numbers as they were.
    rng, size = np.random.default_rng(seed), noise_sizes(of, noise, rate_hz)
    drawn = rng.standard_normal((n, size.size)) * size
    outputs = len(of.outputs)
    return np.ascontiguousarray(drawn[:, :outputs]), np.ascontiguousarray(drawn[:, outputs:])


def noise_sizes(of: LinearModel, noise: Noise, rate_hz: float) -> Array:
    """Return the rms of the noise of outputs, then disturbances (held over a sample), in SI units."""
    force, voltage = noise.held_rms(rate_hz)
    size = {"force": force, "voltage": voltage, "position": noise.position, "current": noise.current}
    return np.array([size[name] for name in (*of.outputs, *of.disturbances)])


def logged(
    standing: Standing,
    command: Array,
    measured: Array,
    rate_hz: float,
    seed: int | np.random.Generator,
    settings: Mapping[str, object],
) -> Record:
    """Return the record: input, current, position, as far as the model has them."""
    of = standing.model
    outputs = {name: measured[:, j] for j, name in enumerate(of.outputs)}
    columns = {of.inputs[0]: command}
    columns.update((name, outputs[name]) for name in ("current", "position") if name in outputs)
    how = "linear" if standing.linear else "nonlinear"
    named = "a generator" if isinstance(seed, np.random.Generator) else str(seed)
    return Record(
        rate_hz=rate_hz,
        channels=tuple(Channel(name=name, unit=of.units[name], values=values) for name, values in columns.items()),
        history=(Step(name="simulate", settings={"plant": f"{of.name}, {how}", "seed": named, **settings}),),
        provenance=MappingProxyType({"simulator": "ambid.simulate", "plant": f"{of.name}, {how}", "seed": named}),
    )


def written(values: Loop | Noise | Limits) -> dict[str, object]:
    """Return the settings that act, as JSON-able values: zeros and infinite limits are left out."""
    found: dict[str, object] = {}
    for name, value in asdict(values).items():
        if isinstance(value, tuple):
            ends = {end: v for end, v in zip(("low", "high"), value, strict=True) if math.isfinite(v)}
            if ends:
                found[name] = ends
        elif value and math.isfinite(value):
            found[name] = value
    return found


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
    from ambid.simulate.kernels import run

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


GRID_S = 1e-3
"""Longest stretch of equal parameters while they drift, in s."""

TRUE = "true_"
"""With what the names of the columns begin that hold the truth."""

_CHUNK = 16384


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stretch:
    """Consecutive samples of a running simulation.

    Attributes
    ----------
    first : int
        Number of its first sample.
    command : ndarray, shape (n_samples,), in the unit of the input
        As logged.
    measured : ndarray, shape (n_samples, n_outputs), SI
        Outputs as logged, in the order of the model.
    states : ndarray, shape (n_samples, n_states), SI
        True states.
    speed, angle : ndarray, shape (n_samples,), or None
        In rad/s and rad (not folded), at the sampling instants, where the rotor turns.
    truth : Mapping[str, ndarray of shape (n_samples,)]
        What varies, by name: parameters, ``gain_<output>``, ``force``, ``unbalance``, ``unbalance_phase``, SI.
    """

    first: int
    command: Array
    measured: Array
    states: Array
    speed: Array | None
    angle: Array | None
    truth: Mapping[str, Array]


class VaryingLoop:
    """A bench that runs on from call to call; how the samples are cut into calls changes no number.

    Parameters
    ----------
    plant : LinearPlant
        With its parameters where the variation does not say otherwise.
    variation : Variation
        What changes.
    rate_hz : float
        Sampling rate in Hz.
    seed : int or numpy.random.Generator
        Seed of the noise; with nothing varying the record is that of `ambid.simulate.simulate`, bit for bit.
    loop, limits, noise, operating_point
        As in `ambid.simulate.simulate`.
    setpoint : float, optional
        Wanted position in m; default the operating point's.
    start : array_like, shape (n_states,), optional
        Initial state; default at rest at the operating point.
    grid_s : float
        Longest stretch of equal parameters while they drift, in s.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or value, or something varies that the model does not have.
    """

    def __init__(
        self,
        plant: LinearPlant,
        variation: Variation,
        *,
        rate_hz: float,
        seed: int | np.random.Generator,
        loop: Loop | None = None,
        limits: Limits | None = None,
        noise: Noise | None = None,
        operating_point: OperatingPoint | None = None,
        setpoint: float | None = None,
        start: ArrayLike | None = None,
        grid_s: float = GRID_S,
    ) -> None:
        from ambid.simulate.kernels import run_varying

        if not (math.isfinite(rate_hz) and rate_hz > 0.0 and grid_s > 0.0):
            raise ModelError(f"rate_hz {rate_hz} and grid_s {grid_s} must be positive. Correct them")
        check_variation(variation, plant.model)
        self.loop, self.limits, self.noise = loop or Loop(), limits or Limits(), noise or Noise()
        self.standing, self.variation, self.rate_hz = Standing.of(plant, operating_point), variation, rate_hz
        self._run: Callable[..., int] = run_varying
        self._rng = np.random.default_rng(seed)
        of, period, whole = plant.model, 1.0 / rate_hz, math.floor(self.loop.delay)
        self.tables = Tables(
            of, plant.parameters, variation.parameters, variation.gains, rate_hz, self.loop.delay - whole,
            max(1, round(grid_s * rate_hz)),
        )  # fmt: skip
        at_rest = self.standing.centre if start is None else np.array(start, dtype=np.float64)
        if at_rest.shape != self.standing.centre.shape or not np.isfinite(at_rest).all():
            raise ModelError(f"start has shape {at_rest.shape}; it is {len(of.states)} finite states. Correct it")
        self._x, self._memory, self._counts = at_rest.copy(), np.zeros(3), np.array([0, -1, -1, 0])
        self._line = np.full(whole + 2, self.standing.centre_input)
        self._over = 0
        self._sizes = noise_sizes(of, self.noise, rate_hz)
        self._force_column = of.disturbances.index("force") if "force" in of.disturbances else -1
        self._input: str = of.inputs[0]
        goal = self.standing.point.position if setpoint is None else float(setpoint)
        self._settings = np.array([self.standing.centre_input, goal])
        self._outputs = np.array([of.states.index(o) for o in of.outputs])
        roles = [of.outputs.index(o) if o in of.outputs else -1 for o in ("position", "current")]
        self._roles = np.array(roles)
        c = self.loop
        self._gains = np.array([c.kp, c.ki * period, c.kd, c.kc, c.filter_s, period])
        self._resolution = np.array([getattr(self.noise, f"{o}_resolution") for o in of.outputs])
        self._ends = np.array(
            [
                *getattr(self.limits, self._input),
                *self.limits.position,
                getattr(self.noise, f"{self._input}_resolution"),
            ]
        )

    @property
    def units(self) -> Mapping[str, str]:
        """SI units of speed, angle, and of everything in `Stretch.truth`."""
        of = self.standing.model
        fixed = {"speed": "rad/s", "angle": "rad", "force": "N", "unbalance": "kg m", "unbalance_phase": "rad"}
        return {**{s.name: s.unit for s in of.parameters}, **{f"gain_{o}": "1" for o in of.outputs}, **fixed}

    @property
    def n_done(self) -> int:
        """Samples so far."""
        return int(self._counts[0])

    @property
    def first_contact(self) -> int | None:
        """First sample at which the rotor lay at a stop."""
        return None if self._counts[1] < 0 else int(self._counts[1])

    @property
    def first_saturated(self) -> int | None:
        """First sample at which the command was limited."""
        return None if self._counts[2] < 0 else int(self._counts[2])

    @property
    def n_saturated(self) -> int:
        """Number of limited commands."""
        return int(self._counts[3])

    @property
    def n_over_current(self) -> int:
        """Number of samples with the true current outside its limits."""
        return self._over

    def advance(self, excitation: Array) -> Stretch:
        """Run on for as many samples as there are of the excitation.

        Parameters
        ----------
        excitation : ndarray, shape (n_samples,), in the unit of the input
            Added at the controller's output.

        Returns
        -------
        Stretch
            New arrays.

        Raises
        ------
        ModelError
            If the states leave the finite numbers.
        """
        of, n, first = self.standing.model, excitation.size, self.n_done
        pieces = self.tables.pieces(first, first + n)
        noise = self._rng.standard_normal((n, self._sizes.size))  # in the order in which `simulate` draws
        force, speed, angle = self._loads(first, n)
        measured, command, states = np.empty((n, len(of.outputs))), np.empty(n), np.empty((n, len(of.states)))
        lost = self._run(
            np.ascontiguousarray(excitation, dtype=np.float64), noise, self._sizes, force, self._force_column,
            pieces.edges, pieces.A, pieces.B, pieces.B_late, pieces.E, pieces.gains, self._x, self._memory, self._line,
            self._counts, self.standing.centre, self._settings, self._outputs, self._roles, self._gains,
            self._resolution, self._ends, measured, command, states,
        )  # fmt: skip
        if lost >= 0:
            raise ModelError(
                f"the simulation leaves the finite numbers at sample {first + lost}"
                f" ({(first + lost) / self.rate_hz:.6g} s); an unstable plant needs a loop that holds it while it"
                " changes, and stops. Give limits.position, another loop, or a smaller change"
            )
        if "current" in of.states:
            i = states[:, of.states.index("current")]
            low, high = self.limits.current
            self._over += int(np.count_nonzero((i < low) | (i > high)))
        lengths = np.diff(pieces.edges)
        truth = {name: np.repeat(values, lengths) for name, values in pieces.theta.items()}
        truth.update(self._true_loads(first, n))
        return Stretch(
            first=first, command=command, measured=measured, states=states, speed=speed, angle=angle,
            truth=MappingProxyType(truth),
        )  # fmt: skip

    def _loads(self, first: int, n: int) -> tuple[Array, Array | None, Array | None]:
        """Return load and unbalance over each sample (empty for none), and speed and angle at the sampling instants."""
        v, rate = self.variation, self.rate_hz
        if v.force is None and v.unbalance is None:
            return np.empty(0), None, None
        instants = first + np.arange(n, dtype=np.float64)
        force = np.zeros(n) if v.force is None else v.force.at(instants + 0.5, rate)
        if v.unbalance is None:
            return force, None, None
        u = v.unbalance
        middle = u.speed.at(instants + 0.5, rate)
        force = force + u.moment * middle**2 * np.cos(u.speed.integral(instants + 0.5, rate) + u.phase)
        return force, u.speed.at(instants, rate), u.speed.integral(instants, rate)

    def _true_loads(self, first: int, n: int) -> dict[str, Array]:
        v, found = self.variation, {}
        if v.force is not None:
            found["force"] = v.force.at(first + 0.5 + np.arange(n, dtype=np.float64), self.rate_hz)
        if v.unbalance is not None:
            found["unbalance"] = np.full(n, v.unbalance.moment)
            found["unbalance_phase"] = np.full(n, v.unbalance.phase)
        return found


def simulate_varying(
    plant: LinearPlant,
    excitation: ArrayLike,
    *,
    variation: Variation,
    rate_hz: float,
    seed: int | np.random.Generator,
    loop: Loop | None = None,
    limits: Limits | None = None,
    noise: Noise | None = None,
    operating_point: OperatingPoint | None = None,
    setpoint: float | None = None,
    start: ArrayLike | None = None,
    grid_s: float = GRID_S,
) -> Simulation:
    """Simulate a linear plant whose parameters, sensors and loads change, in open or closed loop.

    Parameters
    ----------
    plant : LinearPlant
        With its parameters where the variation does not say otherwise.
    excitation : array_like, shape (n_samples,), in the unit of the input (V)
        Added at the controller's output, before its limits.
    variation : Variation
        What changes.
    rate_hz : float
        Sampling rate in Hz.
    seed : int or numpy.random.Generator
        Seed of the noise; with nothing varying the record is that of `ambid.simulate.simulate`, bit for bit.
    loop, limits, noise, operating_point
        As in `ambid.simulate.simulate`.
    setpoint : float, optional
        Wanted position in m; default the operating point's.
    start : array_like, shape (n_states,), optional
        Initial state; default at rest at the operating point.
    grid_s : float
        Longest stretch of equal parameters while they drift, in s.

    Returns
    -------
    Simulation
        Its record has a column ``true_<name>`` for all that varies, and ``speed`` and ``angle`` where the rotor turns;
        `Simulation.truth` are the parameters at the beginning.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or value, or the states leave the finite numbers.
    """
    u = np.asarray(excitation, dtype=np.float64)
    if u.ndim != 1 or u.size == 0 or not np.isfinite(u).all():
        raise ModelError(f"excitation has shape {u.shape}; it is one column of finite values. Correct it")
    running = VaryingLoop(
        plant, variation, rate_hz=rate_hz, seed=seed, loop=loop, limits=limits, noise=noise,
        operating_point=operating_point, setpoint=setpoint, start=start, grid_s=grid_s,
    )  # fmt: skip
    return gathered(running, [running.advance(u[k : k + _CHUNK]) for k in range(0, u.size, _CHUNK)], seed)


def gathered(running: VaryingLoop, stretches: Iterable[Stretch], seed: int | np.random.Generator) -> Simulation:
    """Return all stretches of a run as one simulation.

    `running`: the bench, after it has made the stretches; `stretches`: all of them, in order; `seed`: for the record's
    history. Returns as `simulate_varying`.
    """
    parts = list(stretches)
    standing, loop, rate_hz = running.standing, running.loop, running.rate_hz
    command, measured, states = (
        np.concatenate([getattr(p, n) for p in parts]) for n in ("command", "measured", "states")
    )
    settings = {
        "rate_hz": rate_hz,
        "loop": written(loop),
        "noise": written(running.noise),
        "limits": written(running.limits),
    }
    record = logged(standing, command, measured, rate_hz, seed, settings)
    units = running.units
    turning = [n for n in ("speed", "angle") if getattr(parts[0], n) is not None]
    more = [Channel(name=n, unit=units[n], values=np.concatenate([getattr(p, n) for p in parts])) for n in turning]
    for name in parts[0].truth:
        values = np.concatenate([p.truth[name] for p in parts])
        more.append(Channel(name=f"{TRUE}{name}", unit=units[name], values=values))
    begin = {name: s.at(np.zeros(1), rate_hz)[0] for name, s in running.variation.parameters.items()}
    return Simulation(
        record=replace(record, channels=(*record.channels, *more)),
        states=states,
        state_names=standing.model.states,
        truth=MappingProxyType({**standing.parameters(), **begin, "delay": loop.delay}),
        first_contact=running.first_contact,
        first_saturated=running.first_saturated,
        n_saturated=running.n_saturated,
        n_over_current=running.n_over_current,
        largest_pole=_largest_pole(running),
    )


def _largest_pole(running: VaryingLoop) -> float:
    """Return the largest modulus over the run, looked at wherever a change begins or ends."""
    corners = running.tables.corners
    corners = corners[corners <= running.n_done][:: max(1, corners.size // 50)].astype(np.float64)
    at = np.append(corners, float(running.n_done))
    v, rate, loop = running.variation, running.rate_hz, running.loop
    of = running.standing.model
    theta = {name: s.at(at, rate) for name, s in v.parameters.items()}
    gains = {name: s.at(at, rate) for name, s in v.gains.items()}
    largest = 0.0
    for k in range(at.size):
        here = {**running.standing.parameters(), **{name: float(x[k]) for name, x in theta.items()}}
        p, c = (float(gains[o][k]) if o in gains else 1.0 for o in ("position", "current"))
        seen = replace(loop, kp=p * loop.kp, ki=p * loop.ki, kd=p * loop.kd, kc=c * loop.kc)
        largest = max(largest, float(np.abs(closed_loop_poles(here, seen, rate, of=of.name)[0])))
    return largest
