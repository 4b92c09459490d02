"""Simulation of a bench, sampled as a data logger would: y[k] at t_k before u[k] acts; u[k], from y[k] (with noise and
quantisation), acts from t_k plus the delay on, held for a sample, as disturbances are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.law import StateLaw
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint
from ambid.record.record import Channel, Record, Step
from ambid.simulation.plant import LinearPlant, Standing, closed_loop_poles, law_on, matrices_of, nonlinear_truth
from ambid.simulation.variation import Pieces, Tables, Variation, check_variation

GRID_S = 1e-3
"""Longest stretch of equal parameters while they drift, in s."""

TRUE = "true_"
"""With what the names of the columns begin that hold the truth."""


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
    notes : tuple of str
        What else a user should know.
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
    notes: tuple[str, ...] = ()

    @property
    def within_limits(self) -> bool:
        """True where there was no contact, no limited command and no current beyond its limits."""
        return self.first_contact is None and self.n_saturated == 0 and self.n_over_current == 0

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each thing that a user should know: an unstable loop, each limit that was met."""
        rate, warnings = self.record.rate_hz, []
        if self.largest_pole > 1.0 + 1e-9:
            warnings.append(f"the loop is unstable: its largest pole has magnitude {self.largest_pole:.6g}")
        if self.first_contact is not None:
            warnings.append(
                f"the rotor touched a stop at sample {self.first_contact} ({self.first_contact / rate:.6g} s)"
            )
        if self.first_saturated is not None:
            warnings.append(
                f"the command was limited in {self.n_saturated} of {self.record.n_samples} samples, first at sample"
                f" {self.first_saturated}"
            )
        if self.n_over_current:
            warnings.append(f"the current was beyond its limits in {self.n_over_current} samples")
        return (*warnings, *self.notes)


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
    variation: Variation | None = None,
) -> Simulation:
    """Simulate a plant in open or closed loop.

    The linear plant is stepped with its exact zero-order-hold matrices, the nonlinear one by the classical Runge-Kutta
    method. While parameters drift, each stretch of a millisecond has the matrices of its middle; jumps happen at their
    exact sample. States stay continuous: a mass is added at the rotor's speed, an inductance changes at equal current,
    and the term i dL/dt of a drifting inductance is left out.

    Parameters
    ----------
    plant : LinearPlant or NonlinearPlant
        A linear one moves about the operating point.
    excitation : array_like, shape (n_samples,), in the unit of the input (V)
        Added at the controller's output, before its limits.
    rate_hz : float
        Sampling rate in Hz.
    seed : int or numpy.random.Generator
        Of the noise; equal seeds give equal records.
    loop : Loop, optional
        Controller and delay; open loop without delay if not given.
    limits : Limits, optional
    noise : Noise, optional
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
    variation : Variation, optional
        What changes on the way (linear only); the record then has a column ``true_<name>`` for all that varies, and
        ``speed`` and ``angle`` where the rotor turns.

    Returns
    -------
    Simulation

    Raises
    ------
    ModelError
        If an argument has a wrong shape or value, something varies that the model does not have, or the simulation
        leaves the air gap or the finite numbers.
    """
    u = _vector("excitation", excitation)
    running = VaryingLoop(
        plant, variation, rate_hz=rate_hz, seed=seed, loop=loop, limits=limits, noise=noise,
        operating_point=operating_point, start=start, substeps=substeps, current_offset=current_offset,
    )  # fmt: skip
    return join(running, [running.advance(u, setpoint)], seed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stretch:
    """Consecutive samples of a running simulation, SI."""

    first: int  # number of its first sample
    command: Array  # (n_samples,), as logged
    measured: Array  # (n_samples, n_outputs), as logged, in the order of the model
    states: Array  # (n_samples, n_states), true
    speed: Array | None  # (n_samples,), rad/s, at the sampling instants, where the rotor turns
    angle: Array | None  # (n_samples,), rad, not folded
    # (n_samples,) of what varies: parameters, ``gain_<output>``, ``force``, ``unbalance``, ``unbalance_phase``
    truth: Mapping[str, Array]


class VaryingLoop:
    """A bench that runs on from call to call; how the samples are cut into calls changes no number. Arguments as
    `simulate`; while parameters drift, stretches of `grid_s` s have equal ones.
    """

    def __init__(
        self,
        plant: LinearPlant | NonlinearPlant,
        variation: Variation | None = None,
        *,
        rate_hz: float,
        seed: int | np.random.Generator,
        loop: Loop | None = None,
        limits: Limits | None = None,
        noise: Noise | None = None,
        operating_point: OperatingPoint | None = None,
        start: ArrayLike | None = None,
        substeps: int = 1,
        current_offset: float = 0.0,
        grid_s: float = GRID_S,
    ) -> None:
        from ambid.simulation.kernels import run

        if not (math.isfinite(rate_hz) and rate_hz > 0.0 and substeps >= 1 and grid_s > 0.0):
            raise ModelError(f"rate_hz {rate_hz} and substeps {substeps} must be positive. Correct them")
        self.loop, self.limits, self.noise = loop or Loop(), limits or Limits(), noise or Noise()
        self.standing, self.rate_hz = Standing.of(plant, operating_point), rate_hz
        self.variation, self._told = variation or Variation(), variation is not None
        model, period, whole = self.standing.model, 1.0 / rate_hz, math.floor(self.loop.delay)
        fraction = self.loop.delay - whole
        self.tables: Tables | None = None
        if isinstance(plant, LinearPlant):
            check_variation(self.variation, model)
            v, grid = self.variation, max(1, round(grid_s * rate_hz))
            self.tables = Tables(model, plant.parameters, v.parameters, v.gains, rate_hz, fraction, grid)
        else:
            if self._told:
                raise ModelError("a nonlinear plant does not vary. Give a LinearPlant, or omit the variation")
            self._equations = self.standing.equations(period, fraction, substeps)
        self._run: Callable[..., int] = run
        self._rng, self.current_offset = np.random.default_rng(seed), current_offset
        self._x = self.standing.centre.copy() if start is None else _vector("start", start, self.standing.centre.size)
        law = law_on(self.loop, model, rate_hz)
        self._memory, self.counts = np.zeros(3 + (law.order if law else 0)), np.array([0, -1, -1, 0])
        self._line = np.full(whole + 2, self.standing.centre_input)
        self.n_over_current = 0
        force, voltage = self.noise.held_rms(rate_hz)
        sizes = {"force": force, "voltage": voltage, "position": self.noise.position, "current": self.noise.current}
        self._sizes = np.array([sizes[name] for name in (*model.outputs, *model.disturbances)])
        self._roles = tuple(model.outputs.index(o) if o in model.outputs else -1 for o in ("position", "current"))
        c, resolution = (
            self.loop,
            [getattr(self.noise, f"{name}_resolution") for name in (*model.outputs, model.inputs[0])],
        )
        self._law = (
            np.array([model.states.index(o) for o in model.outputs]),
            self._roles,
            np.array([c.kp, c.ki * period, c.kd, c.kc, c.filter_s, period]),
            matrices_of(law),
            current_offset,
            np.array(resolution[:-1]),
            (*getattr(self.limits, model.inputs[0]), resolution[-1]),
            self.limits.position,
            self.standing.gap,
        )

    @property
    def units(self) -> Mapping[str, str]:
        """SI units of speed, angle, and of everything in `Stretch.truth`."""
        model = self.standing.model
        fixed = {"speed": "rad/s", "angle": "rad", "force": "N", "unbalance": "kg m", "unbalance_phase": "rad"}
        return {**{s.name: s.unit for s in model.parameters}, **{f"gain_{o}": "1" for o in model.outputs}, **fixed}

    @property
    def n_done(self) -> int:
        """Samples so far."""
        return int(self.counts[0])

    def advance(self, excitation: Array, setpoint: ArrayLike | None = None, load: Array | None = None) -> Stretch:
        """Run on for the samples of the excitation, new arrays each time; `load` (n_samples,): further force over each
        in N.
        """
        model, n, first, standing = self.standing.model, excitation.size, self.n_done, self.standing
        wanted = _vector("setpoint", standing.point.position if setpoint is None else setpoint, n)
        if self.tables is None:
            pieces = Pieces(np.array([0, n]), np.ones((1, len(model.outputs))), self._equations, {})
        else:
            pieces = self.tables.pieces(first, first + n)
        # All columns are drawn whatever their size, so that one level changed leaves the others' numbers as they were.
        noise = self._rng.standard_normal((n, self._sizes.size)) * self._sizes
        u = np.array(excitation, dtype=np.float64)
        if self.current_offset and "current" in model.outputs:
            noise[:, self._roles[1]] += self.current_offset
        force, speed, angle, loads = self._loads(first, n)
        if load is not None:
            force = force + load if force.size else np.ascontiguousarray(load, dtype=np.float64)
        column = model.disturbances.index("force") if "force" in model.disturbances else -1
        measured, command, states = np.empty((n, len(model.outputs))), np.empty(n), np.empty((n, self._x.size))
        lost = self._run(
            u, wanted, noise, force, column, pieces.edges, pieces.equations, pieces.gains, self._x, self._memory,
            self._line, self.counts, standing.centre, standing.centre_input, *self._law, measured, command, states,
        )  # fmt: skip
        if lost >= 0:
            at = f"at sample {first + lost} ({(first + lost) / self.rate_hz:.6g} s); an unstable plant needs a loop"
            if self._told:
                raise ModelError(
                    f"the simulation diverges {at} that holds it while it changes, and stops. Give limits.position, "
                    "another loop, or a smaller change"
                )
            raise ModelError(
                f"the simulation leaves the air gap or diverges {at}, and stops in the gap. Give limits.position, "
                "another loop, or more substeps"
            )
        if "current" in model.states:
            i, (low, high) = states[:, model.states.index("current")], self.limits.current
            self.n_over_current += int(np.count_nonzero((i < low) | (i > high)))
        truth = {name: np.repeat(values, np.diff(pieces.edges)) for name, values in pieces.theta.items()}
        truth.update(loads)
        return Stretch(
            first=first, command=command, measured=measured, states=states[:, : len(model.states)], speed=speed,
            angle=angle, truth=MappingProxyType(truth),
        )  # fmt: skip

    def _loads(self, first: int, n: int) -> tuple[Array, Array | None, Array | None, dict[str, Array]]:
        """Return the force over each sample (empty for none), speed and angle at its instant, and the true loads."""
        v, rate = self.variation, self.rate_hz
        instants = first + np.arange(n, dtype=np.float64)
        truth = {} if v.force is None else {"force": v.force.at(instants + 0.5, rate)}
        force = truth.get("force", np.empty(0))
        if v.unbalance is None:
            return force, None, None, truth
        u = v.unbalance
        middle = u.speed.at(instants + 0.5, rate)
        turning = u.moment * middle**2 * np.cos(u.speed.integral(instants + 0.5, rate) + u.phase)
        truth |= {"unbalance": np.full(n, u.moment), "unbalance_phase": np.full(n, u.phase)}
        force = turning if v.force is None else force + turning
        return force, u.speed.at(instants, rate), u.speed.integral(instants, rate), truth


def join(running: VaryingLoop, stretches: Sequence[Stretch], seed: int | np.random.Generator) -> Simulation:
    """Return all stretches of a run, in order, as one simulation; `seed` is for the record's history."""
    standing, loop, rate_hz = running.standing, running.loop, running.rate_hz
    model, plant = standing.model, standing.plant
    seed_text = "a generator" if isinstance(seed, np.random.Generator) else str(seed)
    origin = {
        "plant": f"{model.name}, {'linear' if isinstance(plant, LinearPlant) else 'nonlinear'}",
        "seed": seed_text,
    }
    settings = {name: acting(getattr(running, name)) for name in ("loop", "noise", "limits")}
    begin = {name: float(s.at(np.zeros(1), rate_hz)[0]) for name, s in running.variation.parameters.items()}
    truth = {**standing.parameters(), **begin, "delay": loop.delay}
    truth |= {} if isinstance(plant, LinearPlant) else nonlinear_truth(plant)
    truth |= {"i_offset": running.current_offset} if running.current_offset else {}
    contact, saturated = (None if k < 0 else int(k) for k in running.counts[1:3])
    return Simulation(
        record=Record(
            rate_hz=rate_hz,
            channels=_channels(running, stretches),
            history=(Step(name="simulate", settings={**origin, "rate_hz": rate_hz, **settings}),),
            provenance=MappingProxyType({"simulator": "ambid.simulation", **origin}),
        ),
        states=np.concatenate([s.states for s in stretches]),
        state_names=model.states,
        truth=MappingProxyType(truth),
        first_contact=contact,
        first_saturated=saturated,
        n_saturated=int(running.counts[3]),
        n_over_current=running.n_over_current,
        largest_pole=_largest_pole(running),
    )


def _channels(running: VaryingLoop, stretches: Sequence[Stretch]) -> tuple[Channel, ...]:
    """Return input, current and position as far as the model has them, speed and angle, and what varies."""
    model, units = running.standing.model, running.units
    measured = np.concatenate([s.measured for s in stretches])
    columns = {model.inputs[0]: np.concatenate([s.command for s in stretches])}
    columns |= {
        name: measured[:, model.outputs.index(name)] for name in ("current", "position") if name in model.outputs
    }
    for name in ("speed", "angle"):
        parts = [x for x in (getattr(s, name) for s in stretches) if x is not None]
        columns |= {name: np.concatenate(parts)} if parts else {}
    channels = [Channel(name=name, unit={**model.units, **units}[name], values=x) for name, x in columns.items()]
    for name in stretches[0].truth:
        values = np.concatenate([s.truth[name] for s in stretches])
        channels.append(Channel(name=f"{TRUE}{name}", unit=units[name], values=values))
    return tuple(channels)


def acting(values: Loop | Noise | Limits) -> dict[str, object]:
    """Return the settings that act, as JSON-able values: zeros and infinite limits are left out."""
    settings: dict[str, object] = {}
    for name in values.__slots__:
        value = getattr(values, name)
        if name == "laws":  # the first of them is the law
            continue
        if isinstance(value, StateLaw):
            settings[name] = f"state space of order {value.order}"
        elif isinstance(value, tuple):
            ends = {end: v for end, v in zip(("low", "high"), value, strict=True) if math.isfinite(v)}
            if ends:
                settings[name] = ends
        elif value and math.isfinite(value):
            settings[name] = value
    return settings


def _largest_pole(running: VaryingLoop) -> float:
    """Return the largest modulus over the run, looked at wherever a change begins or ends."""
    v, rate, loop = running.variation, running.rate_hz, running.loop
    model, at = running.standing.model, np.zeros(1)
    if running.tables is not None and (v.parameters or v.gains):
        corners = running.tables.corners
        corners = corners[corners <= running.n_done][:: max(1, corners.size // 50)].astype(np.float64)
        at = np.append(corners, float(running.n_done))
    theta = {name: s.at(at, rate) for name, s in v.parameters.items()}
    gains = {name: s.at(at, rate) for name, s in v.gains.items()}
    largest = 0.0
    for k in range(at.size):
        here = {**running.standing.parameters(), **{name: float(x[k]) for name, x in theta.items()}}
        p, c = (float(gains[o][k]) if o in gains else 1.0 for o in ("position", "current"))
        poles = closed_loop_poles(here, loop.scaled(p, c), rate, of=model.name)
        largest = max(largest, float(np.abs(poles[0])))
    return largest


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


def noise_at_snr(clean: Simulation, snr_db: float) -> Noise:
    """Return the sensor noise that stands `snr_db` below each output of a simulation without noise.

    SNR = variance of the signal / variance of the noise (theory.md sec. 2.1).

    Parameters
    ----------
    clean : Simulation
        A simulation whose outputs are free of noise.
    snr_db : float
        Signal-to-noise ratio in dB.

    Returns
    -------
    Noise
        White noise of the position in m rms and of the current in A rms.
    """
    spread = {name: float(clean.states[:, j].std()) for j, name in enumerate(clean.state_names) if name != "velocity"}
    return Noise(**{name: s * 10.0 ** (-snr_db / 20.0) for name, s in spread.items()})


def largest_amplitude(
    respond: Callable[[Array], Simulation],
    shape: ArrayLike,
    *,
    limits: Limits,
    operating_point: OperatingPoint | None = None,
    fraction: float = 0.8,
    accuracy: float = 0.01,
) -> float:
    """Return the largest factor on an excitation that keeps a simulated bench within a part of its limits.

    Grows the factor until a limit is met, then bisects. Allowed is the part `fraction` of the way from the operating
    point to each end of `limits`, for the command and for the true current and position at the sampling instants;
    besides, no command may be limited and no stop touched.

    Parameters
    ----------
    respond : callable
        Takes an excitation, shape (n_samples,), returns its `Simulation`, with the same seed each time.
    shape : array_like, shape (n_samples,), in V
        Excitation of amplitude one.
    limits : Limits
        At least one end has to be finite.
    operating_point : OperatingPoint, optional
        Rest point in m, A, V; default zero.
    fraction : float
        0 < fraction <= 1.
    accuracy : float
        Relative accuracy of the result; the result itself is within the limits.

    Returns
    -------
    float, in the unit of the excitation

    Raises
    ------
    ModelError
        If nothing is limited, the excitation is zero, or the bench exceeds its limits without any excitation.
    """
    unit = np.asarray(shape, dtype=np.float64)
    ends = (limits.voltage, limits.current, limits.position)
    if not any(math.isfinite(end) for pair in ends for end in pair):
        raise ModelError("no limit is finite; the largest amplitude needs at least one. Give limits.voltage or another")
    if not unit.any():
        raise ModelError("the excitation is zero throughout; it must move the bench. Give another signal")
    if not 0.0 < fraction <= 1.0:
        raise ModelError(f"fraction is {fraction}; it must be above 0 and at most 1. Give for example 0.8")
    point = operating_point or OperatingPoint()

    def allowed(factor: float) -> bool:
        done = respond(factor * unit)
        signals = {name: done.states[:, j] for j, name in enumerate(done.state_names)}
        signals |= {name: done.record[name].values for name in done.record.names if name not in signals}
        for name, values in signals.items() if done.within_limits else ():
            kind = name.rsplit("_", 1)[-1]  # of an axis of a rotor: ``ax_position``
            if kind not in OperatingPoint._fields:
                continue
            (low, high), rest = getattr(limits, kind), getattr(point, kind)
            if values.min() < rest + fraction * (low - rest) or values.max() > rest + fraction * (high - rest):
                return False
        return done.within_limits

    if not allowed(0.0):
        raise ModelError(
            f"the bench exceeds {fraction:g} of its limits without any excitation. Reduce the noise, or correct "
            "the loop or the limits"
        )
    # Any start works; with a limited voltage this one is near the answer in open loop.
    room = [abs(end - point.voltage) for end in limits.voltage if math.isfinite(end)]
    low, high = 0.0, (min(room) if room and min(room) > 0.0 else 1.0) / float(np.abs(unit).max())
    while allowed(high):
        low, high = high, 4.0 * high
        if not math.isfinite(high):
            raise ModelError(
                "no amplitude reaches a limit: the excitation moves nothing that is limited. Limit the voltage"
            )
    while high - low > accuracy * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if allowed(middle) else (low, middle)
    return low
