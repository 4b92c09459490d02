"""What is found where a machine is accepted: items of the standards, each with what was measured, its limit and its
outcome; ``ambid.acceptance/1``. And the dynamic stiffness of magnetic bearings, by their controller and coils.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.control.closed import ClosedLoop
from ambid.control.limits import LIMITS
from ambid.control.margins import Margins
from ambid.control.zones import LONG_TERM, Grade
from ambid.estimation.estimate import Check, Judged
from ambid.estimation.result import NORMAL_95
from ambid.physics.rotor_model import RotorModel
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.whirl_points import WhirlPoint

Outcome = Literal["passed", "doubt", "failed", "reported", "missing"]
"""Doubt: the 95 % interval holds the limit; reported: there is no limit; missing: these records cannot tell."""
Part = Literal["sensitivity", "vibration", "bearings", "critical", "unbalance", "collocation", "capacity", "touch_down"]
PARTS: Mapping[Part, str] = MappingProxyType(
    {
        "sensitivity": "Sensitivity of every axis (ISO 14839-3)",
        "vibration": "Vibration within the clearance (ISO 14839-2)",
        "bearings": "Bearings: force by displacement, closed-loop stiffness and damping",
        "critical": "Critical speeds: amplification factors and separation margins",
        "unbalance": "Unbalance, and its response at the limit",
        "collocation": "Sensors and magnets along the bending modes",
        "capacity": "Static load and capacity",
        "touch_down": "Touch-down clearance",
    }
)
_LINES = 1500  # frequencies up to 1.2 times the highest speed
_DERIVED = 1e-4  # relative step of a parameter, by which the spread of a stiffness is found


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """One line of the report."""

    part: Part
    what: str
    outcome: Outcome
    value: float | None = None  # SI
    sd: float = 0.0  # 0: it is not known
    unit: str = ""
    limit: float | None = None  # in `unit`
    limits: str = ""  # which of `LIMITS` that is
    words: str = ""  # zone, place; of a missing item the record that would show it

    @property
    def confirmed(self) -> bool:
        """Whether a stored text has the figure of its limit."""
        return not self.limits or bool(LIMITS[self.limits].looked_up)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stiffness:
    """Dynamic stiffness of the bearings: force on the rotor by its displacement, as a function of frequency."""

    frequency_hz: Array  # (n,)
    real: Mapping[str, Array]  # by axis, N/m: stiffness
    imaginary: Mapping[str, Array]  # N/m: damping times angular frequency


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """A run-up or coast-down: what turns with the rotor over its speed."""

    record: str
    speed: Array  # (n,), rad/s, in the order of time
    amplitude: Mapping[str, Complex]  # by position, (n,), m: x(t) = Re a exp(j angle)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WhirlLines:
    """Where the loop as identified resonates over the speed of rotation."""

    speed: Array  # (n,), rad/s
    forward: tuple[Array, ...]  # by speed: frequencies of the peaks of its response to a force that turns, rad/s
    backward: tuple[Array, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Acceptance(Judged):
    """A machine by the standards that it is accepted by, as its records show it.

    Attributes
    ----------
    status : {"converged", "stalled", "failed"}
        Of the estimate of the machine.
    model : str
    record : Mapping[str, object]
        The first record.
    records : tuple of Mapping
        Of each its ``kind`` ("rest", "speed", "run-up", "stops"), ``speed`` in rad/s, file, SHA-256, samples, rate.
    items : tuple of Item
    checks : Mapping[str, Check]
        One a part with limits, ``complete``, ``estimate``.
    margins : Mapping[str, Margins]
        Of the loop of each steady record.
    estimate : RotorEstimate
        The machine.
    stiffness : Stiffness or None
        Of the bearings; None where no controller is known.
    runs : tuple of Run
    points : tuple of WhirlPoint
        Modes that noise shows in records at rest and at speed.
    whirl : WhirlLines or None
        None where no controller is known.
    clearance : float or None
        Radial clearance in the touch-down bearings, m.
    speeds : tuple of float
        Minimum and maximum continuous speed, rad/s.
    calibration : Mapping[str, str]
        What the rig says of each channel's calibration.
    warnings : tuple of str
    timing_s : Mapping[str, float]
    rig : Mapping[str, object]
    """

    status: Literal["converged", "stalled", "failed"]
    model: str
    record: Mapping[str, object]
    records: tuple[Mapping[str, object], ...]
    items: tuple[Item, ...]
    checks: Mapping[str, Check]
    margins: Mapping[str, Margins]
    estimate: RotorEstimate
    stiffness: Stiffness | None
    runs: tuple[Run, ...]
    points: tuple[WhirlPoint, ...]
    whirl: WhirlLines | None
    clearance: float | None
    speeds: tuple[float, float]
    calibration: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    rig: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    def of(self, part: Part) -> list[Item]:
        """Return the items of a part.

        Parameters
        ----------
        part : str
            One of `PARTS`.

        Returns
        -------
        list of Item
        """
        return [item for item in self.items if item.part == part]


def outcome_of(value: float, sd: float, limit: float) -> Outcome:
    """Judge a number that is to lie below its limit; one of which it is not known how well it is known is in doubt."""
    if not np.isfinite(sd):
        return "doubt"
    if value + NORMAL_95 * sd < limit:
        return "passed"
    return "doubt" if value - NORMAL_95 * sd < limit else "failed"


def outcome_of_zone(grade: Grade) -> Outcome:
    """Judge a number by its zone: A or B is for operation without limit of time."""
    return "passed" if grade.worst in LONG_TERM else "doubt" if grade.letters[0] in LONG_TERM else "failed"


def dynamic_stiffness(loop: ClosedLoop) -> Complex:
    """Return -f/x of each axis of a rotor, (n, n_axes) in N/m: its magnet's force by a displacement of the shaft that
    its magnet and sensors see alike, through controller, hold, delay, coil (with the voltage that motion induces), eddy
    pole and the magnet's own k_x.
    """
    plant, model = loop.plant, loop.plant.model
    assert isinstance(model, RotorModel)
    s, theta, n = 2j * np.pi * loop.frequency_hz, plant.theta, len(model.axes)
    of = {q: np.array([theta.get(f"{axis}.{q}", 0.0) for axis in model.axes]) for q in ("k_i", "k_x", "R", "L")}
    turn = s / plant.rate_hz
    acting = np.exp(-turn[:, None] * plant.delays)  # an input that is held over a sample, and late
    acting = np.where(np.array(model.held), acting * ((1.0 - np.exp(-turn)) / turn)[:, None], acting)
    through, induced = np.ones((s.size, n), dtype=complex), np.zeros((s.size, n), dtype=complex)
    for j, axis in enumerate(model.axes):
        if model.drive(j) == "voltage":
            through[:, j] = 1.0 / (of["R"][j] + s * of["L"][j])
            induced[:, j] = through[:, j] * s * of["k_i"][j]
        elif model.drive(j) == "command":
            pole = theta[f"{axis}.amplifier_pole"]
            through[:, j] = theta[f"{axis}.amplifier_gain"] * pole / (s + pole)
    read = np.zeros((s.size, len(model.outputs), n), dtype=complex)
    for k, (j, _) in enumerate(model.sensors):
        axis = model.axes[j]
        read[:, k, j] = theta.get(f"{axis}.gain", 1.0)
        if f"{axis}.sensor_pole" in model.extras:
            read[:, k, j] *= theta[f"{axis}.sensor_pole"] / (s + theta[f"{axis}.sensor_pole"])
    back = np.zeros((len(model.outputs), n))
    for k, j in enumerate(model.coils):
        back[len(model.sensors) + k, j] = 1.0
    forward = (through * acting)[:, :, None] * loop.K
    coil = np.einsum("kj,ji->kji", induced, np.eye(n))
    current = np.linalg.solve(np.eye(n) + forward @ back, forward @ read + coil)
    late = theta["a"] / (s + theta["a"]) if "a" in model.extras else np.ones(s.size)
    return np.asarray(late[:, None] * of["k_i"] * np.diagonal(current, axis1=1, axis2=2) + of["k_x"])


def whirl_lines(loop: ClosedLoop, speeds: Array) -> WhirlLines:
    """Return where the compliance of the loop peaks at each speed in rad/s, to forces in the radial bearings that turn
    with the shaft or against it.
    """
    model, n_y, n_d = loop.plant.model, len(loop.plant.model.outputs), loop.plant.space.E.shape[1]
    assert isinstance(model, RotorModel)
    top = 1.2 * float(speeds[-1]) / (2.0 * np.pi)
    f = np.linspace(top / _LINES, top, _LINES)
    turn = np.array([(1.0, -1j, 0.0)[plane] for _, plane in model.placed])
    radial = np.flatnonzero(turn)
    lines: tuple[list[Array], list[Array]] = ([], [])
    for speed in speeds:
        plant = replace(loop.plant, model=model.at_speed(float(speed)))
        moved = ClosedLoop(plant=plant, controller=loop.controller, frequency_hz=f).motions
        G = moved[:, n_y + radial][:, :, n_d + radial]
        for way, peaks in zip((turn[radial], turn[radial].conj()), lines, strict=True):
            circular = np.conj(way)[None, :, None] * G * way
            size = np.linalg.norm(_by_bearing(circular, model, radial), ord=2, axis=(1, 2))
            k = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])) + 1
            bend = 0.5 * (size[k - 1] - size[k + 1]) / (size[k - 1] - 2.0 * size[k] + size[k + 1])
            peaks.append(2.0 * np.pi * (f[k] + bend * (f[1] - f[0])))
    return WhirlLines(speed=speeds, forward=tuple(lines[0]), backward=tuple(lines[1]))


def _by_bearing(G: Complex, model: RotorModel, radial: Any) -> Complex:
    """Return the response of bearings, (n, n_bearings, n_bearings), to a turning force in each: means over the axes."""
    names = [model.placed[j][0].name for j in radial]
    own = np.array([[1.0 * (name == b) for name in names] for b in dict.fromkeys(names)])
    return np.asarray(own @ G @ own.T / 2.0)


def stiffness_sd(loop: ClosedLoop) -> Complex:
    """Return the standard deviations of the real and, as imaginary part, of the imaginary part of the dynamic
    stiffness, by the covariance of the plant; the controller counts as known.
    """
    plant = loop.plant
    if plant.covariance is None:
        return np.zeros((loop.frequency_hz.size, len(plant.axes)), dtype=complex)
    middle, slopes = dynamic_stiffness(loop), []
    for name in plant.names:
        theta, delays, step = dict(plant.theta), plant.delays.copy(), _DERIVED
        if name.endswith(".delay"):
            delays[plant.model.inputs.index(name.removesuffix(".delay"))] += step
        else:
            step *= abs(theta[name]) or 1.0
            theta[name] += step
        moved = replace(loop, plant=replace(plant, theta=theta, delays=delays))
        slopes.append((dynamic_stiffness(moved) - middle) / step)
    J = np.array(slopes)
    variance = [np.einsum("pkj,pq,qkj->kj", x, plant.covariance, x) for x in (J.real, J.imag)]
    real, imaginary = (np.sqrt(np.maximum(v, 0.0)) for v in variance)
    return np.asarray(real + 1j * imaginary)
