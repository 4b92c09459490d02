"""Run-up and coast-down of a rotor: its synchronous motion over the speed, whirl and orbits, waterfall."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.physics.rotor_model import RotorModel, position_role
from ambid.record import Record
from ambid.rotor.synchronous import Source, logged_angle
from ambid.signals.orders import Orders, Waterfall, track_orders, waterfall

_TURNS = 64  # that a run-up has; noise of a speed channel at rest makes none
_RANGE = 0.2  # of the speed over its mean, from which a record is a run-up or a coast-down


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Turning:
    """How a rotor turned in a record, its speed free to change."""

    angle: Array  # (n_samples,), rad, not wrapped
    source: Source  # "angle" and "tacho" count from a mark on the rotor, so that phases of several records compare

    def speed(self, rate_hz: float) -> Array:
        """Return the speed at every sample, rad/s, with its sign."""
        return np.asarray(np.gradient(self.angle) * rate_hz)


def turning_of(record: Record) -> Turning:
    """Return how the rotor turned: by its angle, pulses once a revolution, or the integral of its speed."""
    if (logged := logged_angle(record)) is not None:
        return Turning(angle=logged[0], source=logged[1])
    raise EstimationError(
        "the record has neither angle, tacho nor speed; orders over the speed need one of them. Log it, and name its "
        "column in [channels]"
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Whirl:
    """The synchronous motion of one plane of sensors, x + jy = forward exp(j angle) + backward exp(-j angle)."""

    forward: Complex  # (n,), m; forward turns as the shaft does
    backward: Complex
    sd: Array  # (n,), of real and imaginary part of each

    @property
    def major(self) -> Array:
        """Half the major axis of the orbit, (n,), m."""
        return np.asarray(np.abs(self.forward) + np.abs(self.backward))


@dataclass(frozen=True, kw_only=True, eq=False)
class Passage:
    """The positions of a rotor while its speed changes; phases count from angle zero, leads are positive."""

    roles: tuple[str, ...]  # positions, as the model has them
    model: RotorModel
    orders: Orders
    source: Source
    reverse: bool  # whether the rotor turns from y to x

    @property
    def speed(self) -> Array:
        """Of each block in the order of time, rad/s, (n,)."""
        return self.orders.speed

    @property
    def ways(self) -> tuple[Passage, ...]:
        """The run-ups and coast-downs in it, in their order."""
        return tuple(replace(self, orders=part) for part in self.orders.ways())

    @property
    def amplitude(self) -> Complex:
        """Synchronous amplitudes, (n, n_roles), m: x(t) = Re a exp(j angle)."""
        return self.orders.of(1)[0]

    @property
    def sd(self) -> Array:
        """Standard deviation of real and of imaginary part, (n, n_roles)."""
        return self.orders.of(1)[1]

    @property
    def planes(self) -> tuple[tuple[str, int, int], ...]:
        """Name of each plane of sensors with two axes, such as "A" or "A 2", and the places of x and y in `roles`."""
        pairs = [(name, roles) for name, roles in sensor_planes(self.model, self.roles) if len(roles) == 2]
        return tuple((name, self.roles.index(x), self.roles.index(y)) for name, (x, y) in pairs)

    def whirl(self, plane: str) -> Whirl:
        """Return the whirl of a plane of `planes` over the speed."""
        x, y = next((x, y) for name, x, y in self.planes if name == plane)
        return whirl_of(self.amplitude[:, [x, y]], self.sd[:, [x, y]], reverse=self.reverse)


def whirl_of(amplitude: Complex, sd: Array, *, reverse: bool = False) -> Whirl:
    """Return the whirl by the amplitudes of x and y, (n, 2); `reverse`: the rotor turns from y to x."""
    x, y = amplitude[:, 0], -amplitude[:, 1] if reverse else amplitude[:, 1]
    backward = np.conj(0.5 * (x - 1j * y)).astype(np.complex128)
    return Whirl(forward=0.5 * (x + 1j * y), backward=backward, sd=0.5 * np.sqrt((sd**2).sum(axis=1)))


def sensor_planes(model: RotorModel, known: Container[str]) -> list[tuple[str, tuple[str, ...]]]:
    """Return each plane of sensors, "A", of a second one "A 2", with those of its positions that are known: x and y, or
    one.
    """
    planes = []
    for b in model.bearings:
        for k in range(len(b.z_sensors)):
            roles = tuple(role for role in (position_role(axis, k) for axis in b.axes) if role in known)
            planes.append((b.name if k == 0 else f"{b.name} {k + 1}", roles))
    return [(name, roles) for name, roles in planes if roles]


def positions_of(record: Record, model: RotorModel) -> tuple[str, ...]:
    """Return the positions of a model that a record has."""
    return tuple(r for r in model.outputs if "_position" in r and r in record)


def track_passage(record: Record, model: RotorModel, *, turns: int = 8, orders: Sequence[int] = (1, 2, 3)) -> Passage:
    """Return the synchronous motion of a record, seen through its rig, at a speed that may change as it likes; `turns`:
    of a block, over which amplitudes are means.
    """
    roles, turning = positions_of(record, model), turning_of(record)
    y = np.column_stack([record[role].values for role in roles])
    tracked = track_orders(y, turning.angle, record.rate_hz, turns=turns, orders=orders)
    return Passage(
        roles=roles, model=model, orders=tracked, source=turning.source,
        reverse=bool(turning.angle[-1] < turning.angle[0]),
    )  # fmt: skip


def changes_speed(record: Record) -> bool:
    """Whether a record with an angle or a speed is a run-up or a coast-down."""
    if not {"angle", "tacho", "speed"} & set(record.names):
        return False
    speed = np.abs(turning_of(record).speed(record.rate_hz))
    parts = np.array([x.mean() for x in np.array_split(speed, 20)])
    turns = parts.mean() * record.n_samples / record.rate_hz / (2.0 * np.pi)
    return bool(turns > _TURNS and np.ptp(parts) > _RANGE * parts.mean())


def record_waterfall(
    record: Record, model: RotorModel, *, spectra: int = 120, highest_hz: float | None = None
) -> Waterfall:
    """Return the waterfall of the positions of a record, in the order of `positions_of`."""
    y = np.column_stack([record[role].values for role in positions_of(record, model)])
    speed = turning_of(record).speed(record.rate_hz)
    return waterfall(y, speed, record.rate_hz, spectra=spectra, highest_hz=highest_hz)


# --- displacement from the centre -------------------------------------------------------------------------------------


def displacements(record: Record, model: RotorModel) -> dict[str, float]:
    """Return the largest displacement from zero of each of `sensor_planes`, √(x² + y²) in m, as ISO 14839-2 counts it:
    zero to peak, with the offset at rest.
    """
    return {
        plane: float(np.linalg.norm([record[role].values for role in roles], axis=0).max())
        for plane, roles in sensor_planes(model, record)
    }
