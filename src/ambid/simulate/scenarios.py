"""Scenarios: named courses of a bench whose truth is known, to try on-line identification on.

Each says what changes, from when, and by how much; the bench is any preset or rig of a linear model with a loop, and
chooses the excitation that suits it.

A position sensor of gain g hides behind the parameters: z = g x obeys the same equations with m/g^2, k_x/g^2, c/g^2 and
k_i/g. Who does not know the mass cannot tell the two apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.errors import ModelError, nearest
from ambid.signals import multisine
from ambid.simulate.rig_bench import Bench
from ambid.simulate.variation import Schedule, Unbalance, Variation

if TYPE_CHECKING:
    pass


_PERIOD = 20_000  # samples in which the excitation repeats
_FLATTEN = 40  # iterations that lower the peaks of an excitation
_FRACTION = 0.4  # of the limits that an amplitude chosen here uses: a bench that changes needs room


def input_room(bench: Bench) -> float:
    """From the operating point to the nearer limit of the input; infinite where it has none."""
    name = bench.linear.model.inputs[0]
    rest = float(getattr(bench.point, name))
    low, high = getattr(bench.limits, name)
    return float(min(abs(low - rest), abs(high - rest)))


def one_period(bench: Bench, seed: int, *, fast: bool = False) -> Array:
    """Return one period of a multisine of peak one from 1/4000 to 1/20 of the rate, shape (n_samples,).

    There the rotor and the coil both answer: 5 Hz to 1 kHz at 20 kHz. A `fast` one, from 1/40 to 1/5 of the rate, the
    rotor hardly follows.
    """
    rate = bench.rate_hz
    band = (rate / 40.0, rate / 5.0) if fast else (rate / 4000.0, rate / 20.0)
    return multisine(_PERIOD, rate, amplitude=1.0, band=band, seed=seed, crest_iterations=_FLATTEN)


def amplitude_for(bench: Bench, shape: Array, seed: int) -> float:
    """Return the amplitude that uses 0.4 of the limits, to three digits."""
    if not any(math.isfinite(e) for pair in (bench.limits.voltage, bench.limits.current) for e in pair):
        raise ModelError(
            f"bench {bench.name!r} limits neither voltage nor current; no amplitude can be chosen. Give one"
        )
    return bench.largest(np.tile(shape, 2), seed, _FRACTION)


DRIFT_S = 60.0
"""Time in s over which the drift is complete."""

WARM_UP_S = 20.0
"""Time constant of the warm-up in s."""

TOP_SPEED = 15_000 * math.pi / 30
"""Speed in rad/s to which the spin-up goes."""

HEAVY_SPOT = 0.6
"""Phase of the unbalance in rad."""

_GRADE = 2.5e-3  # m/s: eccentricity times speed of balance quality G 2.5 (ISO 21940-11)
_MAX_LOAD = 0.1  # of the force that the current's limit allows


def _nothing(_: Bench, __: float, ___: float, ____: float) -> Variation:
    return Variation()


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """What happens to a bench.

    Attributes
    ----------
    name, summary : str
        Name for the command line, and one line that describes it.
    duration_s : float
        Length in s unless told otherwise.
    begins : float
        Part of the duration after which it begins, unless told otherwise.
    size : float or None
        How much, unless told otherwise; None where the bench says it.
    size_is : str
        What the size is, with its unit; empty where there is none.
    vary : Callable
        Takes the bench, the beginning in s, the size and the duration in s; gives the `Variation`.
    own_size : Callable or None
        Takes the bench, gives the size where `size` is None.
    excited : bool
        Whether the bench is excited persistently.
    driven : bool
        Whether a second, larger excitation is added from the beginning on: its peak is `size` times the voltage's room.
    dropped : bool
        Whether samples are lost; `size` is their share.
    """

    name: str
    summary: str
    duration_s: float
    begins: float = 0.5
    size: float | None = None
    size_is: str = ""
    vary: Callable[[Bench, float, float, float], Variation] = _nothing
    own_size: Callable[[Bench], float] | None = None
    excited: bool = True
    driven: bool = False
    dropped: bool = False

    def size_for(self, bench: Bench, given: float | None) -> float:
        """Return how much happens.

        Parameters
        ----------
        bench : Bench
            The bench, for the scenarios whose size it says.
        given : float or None
            What the user says.

        Returns
        -------
        float
            In the unit of `size_is`; 0 where the scenario has none.

        Raises
        ------
        ModelError
            If a size is given that is not finite, or the scenario has none.
        """
        if given is not None and not self.size_is:
            raise ModelError(f"scenario {self.name!r} has no size. Leave the size out")
        if given is not None and not math.isfinite(given):
            raise ModelError(f"the size of scenario {self.name!r} is {given}; it must be finite. Give {self.size_is}")
        found = self.size if given is None else given
        if found is None:
            found = self.own_size(bench) if self.own_size else 0.0
        if self.dropped and not 0.0 < found <= 0.5:
            raise ModelError(f"the size of scenario {self.name!r} is {found}; it is a share above 0 and at most 0.5")
        return found


def scenario_names() -> tuple[str, ...]:
    """Return the names of all scenarios.

    Returns
    -------
    tuple of str
        Names for the command line.
    """
    return tuple(SCENARIOS)


def scenario(name: str) -> Scenario:
    """Return the scenario called `name`.

    Parameters
    ----------
    name : str
        One of `scenario_names`.

    Returns
    -------
    Scenario
        The scenario.

    Raises
    ------
    ModelError
        If there is none of that name; the message names the nearest.
    """
    if name not in SCENARIOS:
        known = list(SCENARIOS)
        raise ModelError(
            f"there is no scenario {name!r}; there are {', '.join(known)}.{nearest(name, known)} Give one of them"
        )
    return SCENARIOS[name]


def _ramp(bench: Bench, at: float, size: float, _: float) -> Variation:
    r = _parameter(bench, "R")
    return Variation(parameters={"R": Schedule.ramp(r, r * (1.0 + size), at, at + DRIFT_S)})


def _warm_up(bench: Bench, at: float, size: float, _: float) -> Variation:
    r = _parameter(bench, "R")
    return Variation(parameters={"R": Schedule.warm_up(r, r * (1.0 + size), at, WARM_UP_S)})


def _jump(name: str) -> Callable[[Bench, float, float, float], Variation]:
    def vary(bench: Bench, at: float, size: float, _: float) -> Variation:
        value = _parameter(bench, name)
        return Variation(parameters={name: Schedule.step(value, value * (1.0 + size), at)})

    return vary


def _sensor(_: Bench, at: float, size: float, __: float) -> Variation:
    return Variation(gains={"position": Schedule.step(1.0, 1.0 + size, at)})


def _spin_up(_: Bench, at: float, size: float, duration: float) -> Variation:
    # The last tenth of the time is spent at full speed.
    speed = Schedule.ramp(0.0, TOP_SPEED, at, at + 0.9 * (duration - at))
    return Variation(unbalance=Unbalance(moment=size, phase=HEAVY_SPOT, speed=speed))


def _load(_: Bench, at: float, size: float, __: float) -> Variation:
    return Variation(force=Schedule.step(0.0, size, at))


def _unbalance_of(bench: Bench) -> float:
    return _parameter(bench, "m") * _GRADE / TOP_SPEED


def _load_of(bench: Bench) -> float:
    room = min(abs(end - bench.point.current) for end in bench.limits.current)
    return (
        _MAX_LOAD * abs(_parameter(bench, "k_i")) * room if math.isfinite(room) else 0.5 * 9.81 * _parameter(bench, "m")
    )


def _parameter(bench: Bench, name: str) -> float:
    of, known = bench.linear.model, bench.linear.parameters
    if name not in known:
        raise ModelError(
            f"the scenario changes {name!r}, which model {of.name!r} of bench {bench.name!r} does not have; it has"
            f" {', '.join(known)}. Choose another scenario, or a rig with model 'one-axis'"
        )
    return known[name]


_PART = "relative change"

SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        s.name: s
        for s in (
            Scenario(name="steady", summary="nothing changes; excited throughout", duration_s=10.0),
            Scenario(
                name="drift",
                summary="the coil warms evenly: R +20 % over 60 s",
                duration_s=60.0, begins=0.0, size=0.2, size_is=f"{_PART} of R after 60 s", vary=_ramp,
            ),
            Scenario(
                name="warm-up",
                summary="the coil warms exponentially: R +20 %, time constant 20 s",
                duration_s=60.0, begins=0.0, size=0.2, size_is=f"{_PART} of R in the end", vary=_warm_up,
            ),
            Scenario(
                name="change",
                summary="k_i jumps by -15 %, in the force and in the motional voltage",
                duration_s=4.0, size=-0.15, size_is=f"{_PART} of k_i", vary=_jump("k_i"),
            ),
            Scenario(
                name="added-mass",
                summary="the rotor becomes 10 % heavier at once",
                duration_s=4.0, size=0.1, size_is=f"{_PART} of m", vary=_jump("m"),
            ),
            Scenario(
                name="sensor-gain",
                summary="the position sensor loses 20 % of its gain, and the controller does not know",
                duration_s=4.0, size=-0.2, size_is=f"{_PART} of the position sensor's gain", vary=_sensor,
            ),
            Scenario(name="quiet", summary="nothing changes and nothing excites", duration_s=60.0, excited=False),
            Scenario(
                name="spin-up",
                summary="the rotor spins up to 15 000 rpm, out of balance (G 2.5 there)",
                duration_s=20.0, begins=0.05, size_is="unbalance in kg m", vary=_spin_up, own_size=_unbalance_of,
            ),
            Scenario(
                name="saturation",
                summary="a fast excitation is added that meets the limits of the voltage",
                duration_s=4.0, size=1.5, size_is="its peak over the room of the voltage", driven=True,
            ),
            Scenario(
                name="dropped",
                summary="samples are lost: empty cells, empty rows, missing rows",
                duration_s=4.0, begins=0.1, size=0.01, size_is="share of the samples that is lost", dropped=True,
            ),
            Scenario(
                name="offset",
                summary="a constant load comes on: a tenth of what the current's limit can hold",
                duration_s=4.0, size_is="force in N", vary=_load, own_size=_load_of,
            ),
        )
    }
)  # fmt: skip
"""All scenarios by name."""
