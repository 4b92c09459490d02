"""What changes while a bench runs: parameters, sensors, loads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from ambid.errors import ModelError, nearest
from ambid.physics.linear_model import LinearModel
from ambid.simulate.schedule import Schedule


@dataclass(frozen=True, slots=True, kw_only=True)
class Unbalance:
    """A rotor that is out of balance and turns: f = moment speed^2 cos(angle + phase).

    The angle is the exact integral of the speed from the record's beginning. As every disturbance of the simulator the
    force is held over a sample, at its value in the middle of it. The tangential part, moment times the angular
    acceleration, is left out: after a steady start from rest it is 1/(2 angle) of the whole.

    Attributes
    ----------
    moment : float
        Mass times eccentricity in kg m.
    phase : float
        In rad, of the heavy spot against the mark of the angle.
    speed : Schedule
        In rad/s.
    """

    moment: float
    speed: Schedule
    phase: float = 0.0


_NOTHING: Mapping[str, Schedule] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True)
class Variation:
    """What changes while a bench runs.

    Attributes
    ----------
    parameters : Mapping[str, Schedule]
        Parameters of the model, SI; the others stay as the plant has them.
    gains : Mapping[str, Schedule]
        Of the sensors by output: logged = gain times true value + noise, and the controller sees the logged one.
    force : Schedule or None
        Load in N beside the process noise.
    unbalance : Unbalance or None
        Of a turning rotor.
    """

    parameters: Mapping[str, Schedule] = field(default_factory=lambda: _NOTHING)
    gains: Mapping[str, Schedule] = field(default_factory=lambda: _NOTHING)
    force: Schedule | None = None
    unbalance: Unbalance | None = None


def check_variation(variation: Variation, of: LinearModel) -> None:
    """Refuse what a model does not have.

    `variation`: what is to change; `of`: the model that is simulated.
    """
    specs = {s.name: s for s in of.parameters}
    for name, schedule in variation.parameters.items():
        if name not in specs:
            raise ModelError(
                f"model {of.name!r} has no parameter {name!r} that could vary; it has {', '.join(specs)}."
                f"{nearest(name, list(specs))} Correct the variation"
            )
        if specs[name].positive and min(schedule.values) <= 0.0:
            raise ModelError(
                f"parameter {name!r} falls to {min(schedule.values):.6g} {specs[name].unit}; it must stay positive."
                " Change it less"
            )
    for name in variation.gains:
        if name not in of.outputs:
            raise ModelError(
                f"model {of.name!r} has no sensor of {name!r}; it has {', '.join(of.outputs)}."
                f"{nearest(name, list(of.outputs))} Correct the variation"
            )
    if (variation.force is not None or variation.unbalance is not None) and "force" not in of.disturbances:
        raise ModelError(f"model {of.name!r} has no rotor that a force could act on. Leave force and unbalance out")
