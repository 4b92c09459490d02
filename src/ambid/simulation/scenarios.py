"""Scenarios, to try on-line identification on: what changes on a linear bench, when, by how much. A position sensor of
gain g, z = g x, has the same equations with m/g^2, k_x/g^2, c/g^2, k_i/g: without the mass, none can tell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, TypedDict, Unpack

import numpy as np

from ambid.arrays import Array
from ambid.errors import ModelError, choices
from ambid.physics.presets import Preset
from ambid.record.record import Channel, Record, Step
from ambid.signals import multisine
from ambid.simulation.bench import TRUE, Simulation, VaryingLoop, join
from ambid.simulation.rig_bench import Bench, as_columns
from ambid.simulation.variation import Schedule, Unbalance, Variation

_PERIOD = 20_000  # samples in which the excitation repeats
_FLATTEN = 40  # iterations that lower the peaks of an excitation
_FRACTION = 0.4  # of the limits that an amplitude chosen here uses: a bench that changes needs room


def one_period(bench: Bench, seed: int) -> Array:
    """Return one period (n_samples,) of a multisine of peak one from 1/4000 to 1/20 of the rate, where rotor and coil
    both answer.
    """
    rate = bench.rate_hz
    band = (rate / 4000.0, rate / 20.0)
    return multisine(_PERIOD, rate, amplitude=1.0, band=band, seed=seed, crest_iterations=_FLATTEN)


def amplitude_for(bench: Bench, shape: Array, seed: int) -> float:
    """Return the amplitude that uses 0.4 of the limits, to three digits."""
    if not any(math.isfinite(e) for pair in (bench.limits.voltage, bench.limits.current) for e in pair):
        raise ModelError(
            f"bench {bench.name!r} limits neither voltage nor current, so no amplitude can be derived. Give one"
        )
    return bench.largest(np.tile(shape, 2), seed, _FRACTION)


DRIFT_S = 60.0
"""Time in s over which the drift is complete."""

TOP_SPEED = 15_000 * math.pi / 30
"""Speed in rad/s to which the spin-up goes."""

HEAVY_SPOT = 0.6
"""Phase of the unbalance in rad."""

GRADE = 2.5e-3
"""Eccentricity times speed in m/s of balance quality G 2.5 (ISO 21940-11)."""

_MAX_LOAD = 0.1  # of the force that the current's limit allows


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """What happens to a bench."""

    name: str
    summary: str
    duration_s: float  # length in s unless told otherwise
    begins: float = 0.5  # part of the duration after which it begins, unless told otherwise
    size: float | None = None  # how much, unless told otherwise; None where the bench says it
    size_is: str = ""  # what the size is, with its unit; empty where there is none
    # from the bench, the beginning in s, the size and the duration in s
    vary: Callable[[Bench, float, float, float], Variation] = lambda *_: Variation()
    own_size: Callable[[Bench], float] | None = None  # the size where `size` is None
    excited: bool = True  # whether the bench is excited persistently

    def size_for(self, bench: Bench, requested: float | None) -> float:
        """Return how much happens, in the unit of `size_is`: what was `requested`, else its own or the bench's."""
        if requested is not None and not self.size_is:
            raise ModelError(f"scenario {self.name!r} has no size. Omit the size")
        if requested is not None and not math.isfinite(requested):
            raise ModelError(
                f"the size of scenario {self.name!r} is {requested}; it must be finite. Give {self.size_is}"
            )
        size = self.size if requested is None else requested
        return size if size is not None else self.own_size(bench) if self.own_size else 0.0


def scenario_names() -> tuple[str, ...]:
    """Return the names of all scenarios, for the command line."""
    return tuple(SCENARIOS)


def scenario(name: str) -> Scenario:
    """Return the scenario called `name`."""
    if name not in SCENARIOS:
        raise ModelError(f"scenario {name!r} is unknown; known: {choices(name, SCENARIOS)} Give one of them")
    return SCENARIOS[name]


def _changing(
    name: str, course: Callable[[float, float, float], Schedule] = Schedule.step
) -> Callable[[Bench, float, float, float], Variation]:
    """Return a parameter's course from its value to (1 + size) times it, from a time on."""

    def vary(bench: Bench, at: float, size: float, _: float) -> Variation:
        value = _parameter(bench, name)
        return Variation(parameters={name: course(value, value * (1.0 + size), at)})

    return vary


def _spin_up(_: Bench, at: float, size: float, duration: float) -> Variation:
    # The last tenth of the time is spent at full speed.
    speed = Schedule.ramp(0.0, TOP_SPEED, at, at + 0.9 * (duration - at))
    return Variation(unbalance=Unbalance(moment=size, phase=HEAVY_SPOT, speed=speed))


def _load_of(bench: Bench) -> float:
    room = min(abs(end - bench.point.current) for end in bench.limits.current)
    if not math.isfinite(room):
        return 0.5 * 9.81 * _parameter(bench, "m")
    return _MAX_LOAD * abs(_parameter(bench, "k_i")) * room


def _parameter(bench: Bench, name: str) -> float:
    model, parameters = bench.linear.model, bench.linear.parameters
    if name not in parameters:
        raise ModelError(
            f"the scenario changes {name!r}, which model {model.name!r} of bench {bench.name!r} does not have; it has"
            f" {', '.join(parameters)}. Choose another scenario, or a rig with model 'one-axis'"
        )
    return parameters[name]


_PART = "relative change"

SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        s.name: s
        for s in (
            Scenario(name="steady", summary="nothing changes; excited throughout", duration_s=10.0),
            Scenario(
                name="drift",
                summary="the coil warms evenly: R +20 % over 60 s",
                duration_s=60.0, begins=0.0, size=0.2, size_is=f"{_PART} of R after 60 s",
                vary=_changing("R", lambda before, after, at: Schedule.ramp(before, after, at, at + DRIFT_S)),
            ),
            Scenario(
                name="change",
                summary="k_i drops by 15 %, in the force and in the back-EMF",
                duration_s=4.0, size=-0.15, size_is=f"{_PART} of k_i", vary=_changing("k_i"),
            ),
            Scenario(
                name="added-mass",
                summary="the rotor becomes 10 % heavier at once",
                duration_s=4.0, size=0.1, size_is=f"{_PART} of m", vary=_changing("m"),
            ),
            Scenario(
                name="sensor-gain",
                summary="the position sensor loses 20 % of its gain, unknown to the controller",
                duration_s=4.0, size=-0.2, size_is=f"{_PART} of the position sensor's gain",
                vary=lambda _, at, size, __: Variation(gains={"position": Schedule.step(1.0, 1.0 + size, at)}),
            ),
            Scenario(name="quiet", summary="nothing changes, no excitation", duration_s=60.0, excited=False),
            Scenario(
                name="spin-up",
                summary="the rotor spins up to 15 000 rpm with unbalance (G 2.5 there)",
                duration_s=20.0, begins=0.05, size_is="unbalance in kg m", vary=_spin_up,
                own_size=lambda bench: _parameter(bench, "m") * GRADE / TOP_SPEED,
            ),
            Scenario(
                name="offset",
                summary="a constant load of a tenth of what the current limit can hold",
                duration_s=4.0, size_is="force in N", own_size=_load_of,
                vary=lambda _, at, size, __: Variation(force=Schedule.step(0.0, size, at)),
            ),
        )
    }
)  # fmt: skip
"""All scenarios by name."""


if TYPE_CHECKING:  # the rig room reads files; a simulation needs its values only
    from ambid.rig.rig import Rig


_CHUNK = 16384  # samples that are simulated at once
_LARGEST = 10**8  # samples of one record: it has to fit into memory


class Course(TypedDict, total=False):
    """How a scenario runs; what is left out is the scenario's, or the bench's, own."""

    duration_s: float | None  # length in s
    rate_hz: float | None  # sampling rate in Hz
    seed: int  # of excitation and noise; 0 if left out
    # peak of the persistent excitation in the unit of the input; default what 0.4 of the limits allows before anything
    # changes
    amplitude: float | None
    at_s: float | None  # when it begins, in s
    size: float | None  # how much, as `Scenario.size_is` says
    closed: bool | None  # closed or open loop; default closed, unless a rig says ``open_loop``
    force: bool  # whether a loop that is predicted unstable is simulated too


def simulate_scenario(
    name: str | Scenario, bench: Preset | Rig, *, log_excitation: bool = False, **course: Unpack[Course]
) -> Simulation:
    """Simulate a scenario on the linear model of a bench.

    Parameters
    ----------
    name : str or Scenario
        One of `scenario_names`.
    bench : Preset or Rig
        With a loop that holds it, also after the change.
    log_excitation : bool
        Add a column ``excitation``.
    **course
        ``duration_s``, ``rate_hz``, ``seed``, ``amplitude``, ``at_s``, ``size`` and ``closed``, see `Course`.

    Returns
    -------
    Simulation
        Its record (a rig's has the rig's columns, uncalibrated) has a column ``true_<name>`` for all that varies,
        e.g. ``true_k_i``, ``true_gain_position``, ``true_force``, ``true_unbalance`` and ``true_unbalance_phase``, and
        ``speed`` and ``angle`` where the rotor turns; `Simulation.truth` are the parameters at the beginning.

    Raises
    ------
    ModelError
        If a number is out of range, there is no such scenario, or the bench does not survive it.
    RigError
        If a rig lacks what a simulation needs.
    """
    run = _Run(name, bench, **course)
    if run.n_samples > _LARGEST:
        raise ModelError(
            f"{run.duration_s:g} s at {run.bench.rate_hz:g} Hz is {run.n_samples:g} samples; one record takes"
            f" {_LARGEST:g}. Make it shorter"
        )
    stretches, excitations = [], []
    for first in range(0, run.n_samples, _CHUNK):
        u = run.excitation(first, min(_CHUNK, run.n_samples - first))
        stretches.append(run.running.advance(u))
        excitations.append(u)
    done = join(run.running, stretches, run.seed)
    record = done.record.with_step(Step(name="scenario", settings=MappingProxyType(run.settings())))
    if log_excitation:
        unit = run.bench.linear.model.units[run.bench.linear.model.inputs[0]]
        logged = Channel(name="excitation", unit=unit, values=np.concatenate(excitations))
        record = replace(record, channels=(*record.channels, logged))
    if run.bench.rig is not None:
        record = as_columns(record, run.bench.rig, np.full(record.n_samples, run.bench.point.position))
    return replace(done, record=record)


def truth_columns(record: Record) -> Mapping[str, Channel]:
    """Return the true values that a simulated record holds.

    Parameters
    ----------
    record : Record
        As simulated or read from a file, before a rig has selected its columns.

    Returns
    -------
    Mapping[str, Channel]
        The channels whose names begin with ``true_``, by what follows: ``k_i`` for ``true_k_i``. Empty for a record
        without truth.
    """
    columns = {c.name.removeprefix(TRUE): c for c in record.channels if c.name.startswith(TRUE)}
    return MappingProxyType(columns)


class _Run:
    """A scenario with all its numbers settled, ready to go."""

    def __init__(
        self,
        name: str | Scenario,
        bench: Preset | Rig,
        *,
        duration_s: float | None = None,
        rate_hz: float | None = None,
        seed: int = 0,
        amplitude: float | None = None,
        at_s: float | None = None,
        size: float | None = None,
        closed: bool | None = None,
        force: bool = False,
    ) -> None:
        self.scenario = scenario(name) if isinstance(name, str) else name
        always = closed is None and isinstance(bench, Preset)
        self.bench = b = Bench.of(bench, rate_hz, True if always else closed)
        self.seed, self.duration_s = seed, self.scenario.duration_s if duration_s is None else duration_s
        if not (math.isfinite(b.rate_hz) and b.rate_hz > 0.0):
            raise ModelError(f"rate_hz is {b.rate_hz}; it must be positive. Correct it")
        count = self.duration_s * b.rate_hz
        if not (math.isfinite(count) and count >= 1.0):
            raise ModelError(
                f"{self.duration_s:g} s at {b.rate_hz:g} Hz is {count:g} samples; it must be at least one. Correct one"
            )
        self.n_samples = round(count)
        if not force:
            b.refuse_unstable()
        if at_s is not None and not self.scenario.size_is:
            raise ModelError(f"scenario {self.scenario.name!r} has no beginning: nothing changes. Omit the time")
        self.at_s = self.scenario.begins * self.duration_s if at_s is None else at_s
        if not 0.0 <= self.at_s < self.duration_s:
            raise ModelError(
                f"scenario {self.scenario.name!r} begins at {self.at_s:g} s; the record runs from 0 to"
                f" {self.duration_s:g} s. Give a time in it"
            )
        if amplitude is not None and not (math.isfinite(amplitude) and amplitude >= 0.0):
            raise ModelError(f"amplitude is {amplitude}; it must be zero or positive. Correct it")
        if amplitude and not self.scenario.excited:
            raise ModelError(f"scenario {self.scenario.name!r} has no excitation. Omit the amplitude")
        self.size = self.scenario.size_for(b, size)
        self.amplitude, self._period = 0.0, np.zeros(1)
        if self.scenario.excited:
            shape = one_period(b, self.seed)
            self.amplitude = amplitude_for(b, shape, self.seed) if amplitude is None else amplitude
            self._period = self.amplitude * shape
        self.running = VaryingLoop(
            b.plant, self.scenario.vary(b, self.at_s, self.size, self.duration_s), rate_hz=b.rate_hz, seed=seed,
            loop=b.loop, limits=b.limits, noise=b.noise, operating_point=b.point,
        )  # fmt: skip

    def excitation(self, first: int, n: int) -> Array:
        """Return the excitation of n samples."""
        return np.asarray(self._period[(first + np.arange(n)) % self._period.size])

    def settings(self) -> dict[str, object]:
        """Return what the history says."""
        settings: dict[str, object] = {"name": self.scenario.name, "seed": self.seed, "amplitude": self.amplitude}
        if self.scenario.size_is:
            settings |= {"from_s": self.at_s, "size": self.size, "size_is": self.scenario.size_is}
        return settings
