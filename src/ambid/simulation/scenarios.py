"""Scenarios, to try on-line identification on: what changes on a linear bench, when, by how much. A position sensor of
gain g, z = g x, has the same equations with m/g^2, k_x/g^2, c/g^2, k_i/g: without the mass, none can tell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

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

    def start_for(self, duration_s: float, requested: float | None) -> float:
        """Return when it begins, in s: as `requested`, else by its own part of the duration."""
        if requested is not None and not self.size_is:
            raise ModelError(f"scenario {self.name!r} has no beginning: nothing changes. Omit the time")
        at = self.begins * duration_s if requested is None else requested
        if not 0.0 <= at < duration_s:
            raise ModelError(
                f"scenario {self.name!r} begins at {at:g} s; the record runs from 0 to {duration_s:g} s. Give a time in"
                " it"
            )
        return at


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


def simulate_scenario(
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
    log_excitation: bool = False,
) -> Simulation:
    """Simulate a scenario on the linear model of a bench.

    Parameters
    ----------
    name : str or Scenario
        One of `scenario_names`.
    bench : Preset or Rig
        With a loop that holds it, also after the change.
    duration_s : float, optional
        Length in s; default the scenario's.
    rate_hz : float, optional
        Sampling rate in Hz; default the bench's.
    seed : int
        Of excitation and noise.
    amplitude : float, optional
        Peak of the persistent excitation in the unit of the input; default what 0.4 of the limits allows before
        anything changes.
    at_s : float, optional
        When it begins, in s.
    size : float, optional
        How much, as `Scenario.size_is` says.
    closed : bool, optional
        Default closed, unless a rig says ``open_loop``.
    force : bool
        Simulate a loop that is predicted unstable too.
    log_excitation : bool
        Add a column ``excitation``.

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
    what = scenario(name) if isinstance(name, str) else name
    always = closed is None and isinstance(bench, Preset)
    b = Bench.of(bench, rate_hz, True if always else closed)
    duration = what.duration_s if duration_s is None else duration_s
    n = _samples(duration, b.rate_hz)
    if not force:
        b.refuse_unstable()
    at, much = what.start_for(duration, at_s), what.size_for(b, size)
    u, peak = _excitation(what, b, n, amplitude, seed)
    running = VaryingLoop(
        b.plant, what.vary(b, at, much, duration), rate_hz=b.rate_hz, seed=seed, loop=b.loop, limits=b.limits,
        noise=b.noise, operating_point=b.point,
    )  # fmt: skip
    done = join(running, [running.advance(u[k : k + _CHUNK]) for k in range(0, n, _CHUNK)], seed)
    settings: dict[str, object] = {"name": what.name, "seed": seed, "amplitude": peak}
    settings |= {"from_s": at, "size": much, "size_is": what.size_is} if what.size_is else {}
    record = done.record.with_step(Step(name="scenario", settings=MappingProxyType(settings)))
    if log_excitation:
        logged = Channel(name="excitation", unit=b.linear.model.units[b.linear.model.inputs[0]], values=u)
        record = replace(record, channels=(*record.channels, logged))
    if b.rig is not None:
        record = as_columns(record, b.rig, np.full(record.n_samples, b.point.position))
    return replace(done, record=record)


def _samples(duration_s: float, rate_hz: float) -> int:
    if not (math.isfinite(rate_hz) and rate_hz > 0.0):
        raise ModelError(f"rate_hz is {rate_hz}; it must be positive. Correct it")
    count = duration_s * rate_hz
    if not 1.0 <= count <= _LARGEST:
        raise ModelError(
            f"{duration_s:g} s at {rate_hz:g} Hz is {count:g} samples; it must be 1 to {_LARGEST:g}. Correct one"
        )
    return round(count)


def _excitation(what: Scenario, bench: Bench, n: int, amplitude: float | None, seed: int) -> tuple[Array, float]:
    """Return the excitation of n samples, and its peak."""
    if amplitude is not None and not (math.isfinite(amplitude) and amplitude >= 0.0):
        raise ModelError(f"amplitude is {amplitude}; it must be zero or positive. Correct it")
    if not what.excited:
        if amplitude:
            raise ModelError(f"scenario {what.name!r} has no excitation. Omit the amplitude")
        return np.zeros(n), 0.0
    shape = one_period(bench, seed)
    peak = amplitude_for(bench, shape, seed) if amplitude is None else amplitude
    return np.resize(peak * shape, n), peak


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
