"""Simulation of a rotor in its bearings: all axes in one loop, each with the rig's controller. Linear plants have exact
zero-order-hold matrices, nonlinear magnets classical Runge-Kutta; unbalance is exact: two states turn with the rotor.
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ambid.arrays import Array
from ambid.errors import ModelError, RigError
from ambid.physics.linear_model import StateSpace, discretise
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.nonlinear import OperatingPoint
from ambid.physics.presets import Turning
from ambid.physics.rotor_model import RotorModel
from ambid.physics.shaft import Shaft
from ambid.physics.whirl import drawn_numbers
from ambid.record.record import Channel, Record, Step
from ambid.rig.rig import Rig
from ambid.settings.caller import setting
from ambid.simulation.bench import Simulation, acting, largest_amplitude
from ambid.simulation.plant import (
    LinearPlant,
    closed_loop_poles,
    fed_back,
    law_on,
    matrices_of,
)
from ambid.simulation.rig_bench import FINE, as_columns, loop_of_rig
from ambid.simulation.variation import Integers, Schedule

if TYPE_CHECKING:
    from ambid.simulation.kernels import RotorLinear, RotorNonlinear


_CHUNK = 16384  # samples whose noise is drawn at once
_STRETCH = 200  # samples at one speed at most
_PHASE = 1e-4  # rad by which the angle may leave that of a changing speed inside a stretch
_CREEP = 1e-6  # rad/s
_NODE = 20.0  # rad/s between speeds with exact matrices


class Poles(NamedTuple):
    """Pole pairs of a rotor, as the compiled loop takes them."""

    numbers: Array  # (n_poles, 5): k, gap, bias, sigma, side
    axes: NDArray[np.int64]  # (n_poles,)
    leakage: Array  # (n_axes,), H


def poles_of(rig: Rig, rotor: RotorModel, theta: Mapping[str, float]) -> Poles:
    """Return the pole pairs that have the linear numbers of a rig at its centre, or raise `RigError` where there is no
    gap, or no magnet can have these.

    A pair with gap d and coil current j has W' = k h(j)/d, h = j^2/(1 + sqrt(1 + sigma j^2)) (thesis eq. 1.9 for sigma
    = 0; `physics.coenergy_law`). Two opposed pairs at gap s, bias i0, have k_i = 2 k h'(i0)/s^2, k_x = -4 k h(i0)/s^3,
    L = 2 k h''(i0)/s + leakage, from which k, i0 and leakage follow.
    """
    magnet, where = rig.magnet, f"rig {rig.name!r}"
    gap = None if magnet is None else magnet.known("s")
    if magnet is None or gap is None or not gap.value or gap.value <= 0.0:
        raise RigError(
            f"{where}: there is no gap; a nonlinear simulation needs it. Give s = {{ value = …, unit = \"mm\" }} in "
            "[magnet.parameters], or omit nonlinear"
        )  # fmt: skip
    if len(rotor.coils) != len(rotor.axes):
        raise RigError(f"{where}: an axis is driven by its current; nonlinear magnets need voltages. Omit nonlinear")
    sigma = magnet.known("sigma")
    saturation, s = 0.0 if sigma is None or sigma.value is None else sigma.value, gap.value
    pairs = [_strength(axis, theta, s, saturation, where) for axis in rotor.axes]
    rows = [[k, s, bias, saturation, side] for k, bias in pairs for side in (1.0, -1.0)]
    strength, at_rest = np.array(pairs).T
    own = strength / s * (1.0 + saturation * at_rest**2) ** -1.5  # inductance of each of two
    leakage = np.array([theta[f"{axis}.L"] for axis in rotor.axes]) - own - own
    poles = Poles(np.array(rows), np.repeat(np.arange(len(pairs)), 2), leakage)
    short = [rotor.axes[j] for j in range(leakage.size) if leakage[j] < -1e-9 * theta[f"{rotor.axes[j]}.L"]]
    if short:
        raise RigError(
            f"{where}: L of {', '.join(short)} is below k_i^2/abs(k_x), which the magnet's own energy needs. Correct "
            "L, k_i or k_x"
        )
    return poles


def _strength(axis: str, theta: Mapping[str, float], s: float, sigma: float, where: str) -> tuple[float, float]:
    """Return strength and bias of the pairs of an axis."""
    k_i, k_x = theta[f"{axis}.k_i"], theta[f"{axis}.k_x"]
    if not (k_i > 0.0 > k_x):
        raise RigError(
            f"{where}: {axis} has k_i {k_i:g} N/A and k_x {k_x:g} N/m; a magnet with bias has k_i > 0 > k_x. Correct it"
        )
    part = -s * k_x / (2.0 * k_i)  # h/h' = i0 r/(1 + r)
    bias = 2.0 * part
    for _ in range(100):
        r = math.sqrt(1.0 + sigma * bias**2)
        bias = part * (1.0 + r) / r
    return k_i * s**2 * math.sqrt(1.0 + sigma * bias**2) / (2.0 * bias), bias


_MOST_MODES = 12  # of a drawing that are looked at


@dataclass(slots=True, kw_only=True, eq=False)
class Running:
    """Where a loop stands between two runs of its simulation, each of which carries it on."""

    x: Array  # states of the plant, cos and sin of the angle
    z: Array  # states of the law
    memory: Array  # (n_axes, 3), of gains
    line: Array  # commands on their way, (whole delay + 2, n_axes)
    angle: float = 0.0  # of the rotor at the next sample, rad


@dataclass(slots=True, kw_only=True, eq=False)
class Motion:
    """What a stretch of a simulation gave, sample by sample."""

    measured: Array  # (n_samples, n_outputs)
    command: Array  # (n_samples, n_axes)
    truth: Array  # (n_samples, n_axes + n_currents): what each axis sees of the rotor, then currents
    angle: Array  # (n_samples,), rad
    counts: Integers  # first contact, first limited sample (-1: none), limited samples
    lost: int = -1  # first sample that is not finite, or in which a gap closes; -1: none
    speed: Array | None = None  # (n_samples,), rad/s, where it changes

    def part(self, samples: slice) -> Motion:
        """Return a view of some samples."""
        return replace(self, measured=self.measured[samples], command=self.command[samples], truth=self.truth[samples])


class _Fixed(NamedTuple):
    """What the compiled loop is given of a bench, each stretch the same."""

    size: Array  # of the noise of outputs, then disturbances
    before_line: tuple[Any, Any, Any, Any, Any, Any, Any]  # arguments of the kernel, in its order
    after_stops: tuple[Array, Array, Integers]

    def towards(self, other: _Fixed, share: float) -> _Fixed:
        """Return what lies between this speed and another."""
        equations, *rest = self.before_line
        between = tuple(
            a + share * (b - a) if isinstance(a, np.ndarray) and a.dtype == np.float64 and a.size else a
            for a, b in zip(equations, other.before_line[0], strict=True)
        )
        return self._replace(before_line=(between, *rest))


@dataclass(frozen=True, kw_only=True)
class RotorBench:
    """A rotor with numbers, and what stands around it."""

    rig: Rig
    plant: LinearPlant  # a `RotorModel` with its modes
    loop: Loop
    rate_hz: float
    shapes: Mapping[str, Array]  # what a force in the plane of each unbalance does: (n_coordinates / planes,)
    poles: Poles | None = None  # nonlinear magnets
    acceleration: float = 0.0  # of the rotation, rad/s²

    @classmethod
    def of(cls, rig: Rig, rate_hz: float | None, closed: bool | None, *, nonlinear: bool = False) -> RotorBench:
        """Return the bench of a rig with ``[bearings.X]``, as its records are taken unless `closed` says otherwise."""
        assert rig.rotor is not None
        numbers, rate = rig.modes.numbers, rig.rate_for(rate_hz)
        values = {p.name: p.value for p in rig.parameters if p.value is not None}
        n = sum(name.endswith(".omega") for name in numbers)
        if rig.shaft is not None:  # of a rig that gives its modes, the drawing gives the rigid motion alone
            n, drawn = _drawn(rig, rig.rotor, rig.shaft, values, rate, n)
            numbers = {**drawn, **numbers}
        model, values = rig.rotor.with_modes(n), {**numbers, **values}
        missing = [p.name for p in model.parameters if p.name not in values and p.default is None]
        if missing:
            raise RigError(
                f"rig {rig.name!r}: there is no value for {', '.join(missing)}; a simulation needs every parameter. "
                "Give value = ... (of modes: [modes] with frequency_hz, damping, shapes, gyroscopic)"
            )
        shapes = {
            u.name: np.array([1.0, u.z - values["z_cg"], *(values[f"mode{r}.unbalance.{u.name}"] for r in modes)])
            for modes in [range(1, n + 1)]
            for u in rig.unbalance
        }
        plant = LinearPlant(
            model=model, parameters={p.name: values[p.name] for p in model.parameters if p.name in values}
        )
        poles = poles_of(rig, model, plant.parameters) if nonlinear else None
        loop = loop_of_rig(rig, closed) or Loop()
        return cls(rig=rig, plant=plant, loop=loop, rate_hz=rate, shapes=shapes, poles=poles)

    @property
    def model(self) -> RotorModel:
        """The rotor with its modes, at its speed."""
        assert isinstance(self.plant.model, RotorModel)
        return self.plant.model

    @property
    def limits(self) -> Limits:
        """Of every axis."""
        return self.rig.limits or Limits()

    @property
    def noise(self) -> Noise:
        """Of every axis."""
        return self.rig.noise or Noise()

    @property
    def _currents(self) -> tuple[str, ...]:
        """States that are currents of coils."""
        rotor = self.model
        coils = dict.fromkeys(rotor.coils, "") | dict.fromkeys(rotor.amplified, "_amplifier")
        return tuple(f"{rotor.axes[j]}{kind}_current" for j, kind in sorted(coils.items()))

    @cached_property
    def largest_pole(self) -> float:
        """Largest modulus of the sampled loop's poles."""
        return float(np.abs(closed_loop_poles(self.plant.parameters, self.loop, self.rate_hz, of=self.model)[0]))

    def refuse_unstable(self) -> None:
        """Refuse a closed loop that is predicted unstable."""
        if self.loop.closed and self.largest_pole > 1.0 + 1e-9:
            raise ModelError(
                f"the loop is unstable on {self.rig.name!r} at {self.rate_hz:g} Hz with a delay of "
                f"{self.loop.delay:.2g} samples: largest pole {self.largest_pole:.5g}. Correct [loop] or the "
                f"parameters, or go on with {setting('force', True)}"
            )

    def simulate(
        self, excitation: ArrayLike, *, seed: int, columns: bool = True, settle: int = 0, load: Array | None = None,
        start: Array | Running | None = None,
    ) -> Simulation:  # fmt: skip
        """Simulate the bench, excited at the controllers' outputs, (n_samples, n_axes); `load` (n_samples, n_axes):
        force in N.

        `start` (n_states,): default at rest; or a loop that runs and goes on. Of `settle` samples only that limits were
        met is logged. The record holds voltage, current, position and reference of each axis and, of a rotor that
        turns, its angle.
        """
        rotor, u = self.model, np.ascontiguousarray(excitation, dtype=np.float64)
        if u.ndim != 2 or u.shape[1] != len(rotor.inputs) or u.shape[0] <= settle:
            raise ModelError(
                f"the excitation has shape {u.shape}; it must be (n_samples, {len(rotor.inputs)}), one column an axis, "
                f"with more samples than the {settle} that settle. Reshape it"
            )
        at = start if isinstance(start, Running) else self.begun(start)
        moved = self.advance(at, u, np.random.default_rng(seed), load=load)
        self._refuse_lost(moved, settle)
        return self._logged(moved, u, settle, seed, columns=columns)

    def run_up(self, speed: Schedule, n: int, *, seed: int, settle: int = 0) -> Simulation:
        """Simulate `n` samples at a speed in rad/s that runs along a schedule, after `settle` samples at its first.

        In stretches at their mean speed that begin at the exact angle; matrices are exact at nodes, linear between.
        """
        later = tuple(t + settle / self.rate_hz for t in speed.times_s)
        course, total = replace(speed, times_s=later), n + settle
        instants = np.arange(total, dtype=np.float64)
        w, angle = course.at(instants, self.rate_hz), course.integral(instants, self.rate_hz)
        moved = self._motion(total, angle)
        moved.speed = w
        at, rng, runout = self.begun(), np.random.default_rng(seed), self._runout(angle)
        still = np.zeros((_CHUNK, len(self.model.inputs)))
        for first, stop, fixed in self._stretches(w, course):
            if first % _CHUNK == 0:
                noise = rng.standard_normal((_CHUNK, fixed.size.size)) * fixed.size
            at.x[-2:] = math.cos(angle[first]), math.sin(angle[first])
            part, counts = slice(first, stop), np.array([-1, -1, 0], dtype=np.int64)
            lost = self._run(at, fixed, still[: stop - first], noise[first % _CHUNK :][: stop - first],
                             runout[part], moved.part(part), counts)  # fmt: skip
            for k in (0, 1):
                moved.counts[k] = first + counts[k] if moved.counts[k] < 0 <= counts[k] else moved.counts[k]
            moved.counts[2] += counts[2]
            if lost >= 0:
                moved.lost = first + lost
                break
        self._refuse_lost(moved, settle)
        return self._logged(moved, None, settle, seed)

    def _stretches(self, w: Array, course: Schedule) -> Iterator[tuple[int, int, _Fixed]]:
        """Yield stretches of samples in which the speed hardly changes, with what the loop is given in each."""
        knots = np.clip(course.knots(self.rate_hz).astype(int), 0, w.size)
        edges = np.unique([0, *knots.tolist(), *range(0, w.size, _CHUNK), w.size]).tolist()
        for begin, end in itertools.pairwise(edges):
            slope = (w[end - 1] - w[begin]) / max(end - 1 - begin, 1) * self.rate_hz
            size = max(1, min(_STRETCH, int(self.rate_hz * math.sqrt(8.0 * _PHASE / max(abs(slope), 1e-9)))))
            speeds = np.linspace(w[begin], w[end - 1], 2 + int(abs(w[end - 1] - w[begin]) / _NODE))
            turning = np.maximum(speeds, _CREEP)  # at rest the matrices have fewer entries
            nodes = [replace(self.at_speed(float(x)), acceleration=slope)._fixed for x in turning]
            for first in range(begin, end, size):
                stop = min(first + size, end)
                middle = float(np.mean(w[first:stop]))
                k = min(
                    int(np.searchsorted(np.abs(speeds - speeds[0]), abs(middle - speeds[0]), "right")), speeds.size - 1
                )
                share = (middle - speeds[k - 1]) / (speeds[k] - speeds[k - 1]) if speeds[k] != speeds[k - 1] else 0.0
                yield first, stop, nodes[k - 1].towards(nodes[k], share)

    def at_speed(self, speed: float) -> RotorBench:
        """Return the bench at another speed, rad/s; its rig has to give what the rotor needs to turn."""
        return replace(self, plant=replace(self.plant, model=self.model.at_speed(speed)))

    def _logged(self, moved: Motion, u: Array | None, settle: int, seed: int, *, columns: bool = True) -> Simulation:
        """Return what is logged of a motion, under an excitation if any, after the samples that settle."""
        rotor = self.model
        names = (
            *(f"{axis}_position" for axis in rotor.axes),
            *(name.replace("_amplifier", "") for name in self._currents),
        )
        low, high = self.limits.current
        truth = moved.truth[settle:]
        currents = truth[:, len(rotor.axes) :]
        origin = {"plant": f"{rotor.name}, {'nonlinear' if self.poles else 'linear'}", "seed": str(seed)}
        settings = {name: acting(getattr(self, name)) for name in ("loop", "noise", "limits")}
        record = Record(
            rate_hz=self.rate_hz,
            channels=self.channels(moved, u, settle),
            history=(Step(name="simulate", settings={**origin, "rate_hz": self.rate_hz, **settings}),),
            provenance=MappingProxyType({"simulator": "ambid.simulation", **origin}),
        )
        first = [None if k < 0 else max(0, int(k) - settle) for k in moved.counts[:2]]
        return Simulation(
            record=as_columns(record, self.rig) if columns else record,
            states=truth,
            state_names=names,
            truth=MappingProxyType(
                {
                    **self.plant.parameters,
                    **{f"unbalance.{u.name}": u.value for u in self.rig.unbalance},
                    "delay": self.loop.delay,
                }
            ),
            first_contact=first[0],
            first_saturated=first[1],
            n_saturated=int(moved.counts[2]),
            n_over_current=int(np.count_nonzero(((currents < low) | (currents > high)).any(axis=1))),
            largest_pole=self.largest_pole,
        )

    def channels(self, moved: Motion, u: Array | None, settle: int = 0) -> tuple[Channel, ...]:
        """Return what is logged of a motion under an excitation `u`, after the samples that settle, named by role."""
        rotor, roles = self.model, {c.role for c in self.rig.channels}
        values = dict(zip(rotor.inputs, moved.command[settle:].T, strict=True))
        values |= dict(zip(rotor.outputs, moved.measured[settle:].T, strict=True))
        references = {f"{axis}_reference": j for j, axis in enumerate(rotor.axes)}
        if u is None:  # nothing is excited: columns that the rig names stand at zero
            values |= {name: np.zeros(moved.angle.size - settle) for name in roles & set(references)}
        else:
            values |= {name: u[settle:, j] for name, j in references.items()}
        units = {
            **rotor.units,
            **dict.fromkeys(references, rotor.units[rotor.inputs[0]]),
        }
        order = sorted(values, key=lambda name: rotor.axes.index(name.split("_")[0]))  # an axis after the other
        channels = [Channel(name=name, unit=units[name], values=values[name]) for name in order]
        angle = moved.angle[settle:]
        if rotor.speed or "angle" in roles:  # of a rotor that turns; speed and tacho where the rig names them
            channels.append(Channel(name="angle", unit="rad", values=angle))
        if "speed" in roles or moved.speed is not None:
            speed = np.full(angle.size, rotor.speed) if moved.speed is None else moved.speed[settle:]
            channels.append(Channel(name="speed", unit="rad/s", values=speed))
        if "tacho" in roles:  # high in the first tenth of every revolution
            pulses = np.where(angle % (2.0 * np.pi) < 0.2 * np.pi, 5.0, 0.0)
            channels.append(Channel(name="tacho", unit="V", values=pulses))
        return tuple(channels)

    def largest(self, shape: Array, seed: int, fraction: float) -> float:
        """Return the amplitude of an excitation of peak one that uses a fraction of the limits, to three digits: the
        linear plant's, which is near the nonlinear one there, and fast.
        """
        linear = replace(self, poles=None)
        amplitude = largest_amplitude(
            lambda u: linear.simulate(u, seed=seed, columns=False), shape, limits=self.limits,
            operating_point=OperatingPoint(), fraction=fraction,
        )  # fmt: skip
        return float(f"{amplitude:.3g}")

    def advance(self, at: Running, u: Array, rng: np.random.Generator, *, load: Array | None = None) -> Motion:
        """Carry a loop over the samples of an excitation (n_samples, n_axes), in place; `load` as `simulate` has it."""
        rotor, n, fixed = self.model, u.shape[0], self._fixed
        disturbed = rng.standard_normal((n, fixed.size.size)) * fixed.size
        if load is not None:
            disturbed[:, len(rotor.outputs) : len(rotor.outputs) + len(rotor.axes)] += load
        turn = rotor.speed / self.rate_hz
        moved = self._motion(n, np.asarray(at.angle + np.arange(n, dtype=np.float64) * turn))
        at.angle += n * turn
        moved.lost = self._run(at, fixed, u, disturbed, self._runout(moved.angle), moved, moved.counts)
        return moved

    def _motion(self, n: int, angle: Array) -> Motion:
        """Return room for what `n` samples give."""
        return Motion(
            measured=np.empty((n, len(self.model.outputs))), command=np.empty((n, len(self.model.inputs))),
            truth=np.empty((n, len(self.model.axes) + len(self._currents))), angle=angle,
            counts=np.array([-1, -1, 0], dtype=np.int64),
        )  # fmt: skip

    def _run(
        self, at: Running, fixed: _Fixed, u: Array, disturbed: Array, runout: Array, moved: Motion, counts: Integers
    ) -> int:
        """Run the compiled loop over some samples; return the first that is lost, -1 for none."""
        from ambid.simulation.kernels import run_rotor

        return int(
            run_rotor(
                u, disturbed, runout, *fixed.before_line, at.line, self.limits.position, *fixed.after_stops, at.x,
                at.z, at.memory, counts, moved.measured, moved.command, moved.truth,
            )
        )  # fmt: skip

    def _refuse_lost(self, moved: Motion, settle: int) -> None:
        """Refuse a motion that ended before its time."""
        if moved.lost >= 0:
            place = f"sample {moved.lost - settle} ({(moved.lost - settle) / self.rate_hz:.6g} s)"
            raise ModelError(
                f"the simulation closes a gap or diverges at {place}; an unstable plant needs a loop that holds it. "
                "Give limits.position, or another loop"
            )

    @cached_property
    def _fixed(self) -> _Fixed:
        """What stays the same from one stretch to the next."""
        rotor, period = self.model, 1.0 / self.rate_hz
        c, fraction, kinds = self.loop, self.loop.delay % 1.0, [name.rsplit("_", 1)[-1] for name in rotor.inputs]
        if len(set(kinds)) > 1:
            raise ModelError(
                f"axes are driven by {', '.join(sorted(set(kinds)))}; one loop drives all alike. Correct it"
            )
        steps = [getattr(self.noise, f"{kind_of(name)}_resolution") for name in (*rotor.outputs, rotor.inputs[0])]
        magnets, _ = rotor.rows(self.plant.parameters)
        mass, _, _ = rotor.rotor_matrices(self.plant.parameters)
        pushes = magnets / mass / ((magnets**2 / mass).sum(axis=1))[:, None]
        continuous = self._continuous()
        equations: RotorLinear | RotorNonlinear
        if self.poles is None:
            d, *_ = discretise(continuous, period, fraction=fraction)
            a, b, late, e = (np.ascontiguousarray(x) for x in (d.A, d.B, d.B_late, d.E))
            equations = a, b, late, e
        else:
            equations = self._nonlinear(self.poles, fraction)
        force, voltage = self.noise.held_rms(self.rate_hz)
        sizes = {"force": force, "voltage": voltage, "position": self.noise.position, "current": self.noise.current}
        read, law = np.ascontiguousarray(continuous.C), law_on(c, rotor, self.rate_hz)
        return _Fixed(
            size=np.array([sizes[kind_of(name)] for name in (*rotor.outputs, *rotor.disturbances)]),
            before_line=(
                equations, read, fed_back(rotor), np.array([c.kp, c.ki * period, c.kd, c.kc, c.filter_s, period]),
                matrices_of(law), np.array(steps[:-1]), (*getattr(self.limits, kind_of(rotor.inputs[0])), steps[-1]),
            ),
            after_stops=(magnets, pushes, np.array([rotor.states.index(x) for x in self._currents], dtype=np.int64)),
        )  # fmt: skip

    def begun(self, start: Array | None = None) -> Running:
        """Return the loop at its beginning, with some states of the plant, by default at rest."""
        rotor, law, n = self.model, law_on(self.loop, self.model, self.rate_hz), len(self.model.inputs)
        x, memory = np.zeros(len(rotor.states) + 2), np.zeros((n, 3))
        x[: len(rotor.states)] = 0.0 if start is None else start
        x[-2], memory[:, 2] = 1.0, np.nan
        line = np.zeros((math.floor(self.loop.delay) + 2, n))
        return Running(x=x, z=np.zeros(0 if law is None else law.order), memory=memory, line=line)

    def _continuous(self, theta: Mapping[str, float] | None = None) -> StateSpace:
        """Return the plant; after its states cos and sin of the angle, from which unbalance pushes."""
        rotor, space = self.model, self.plant.model.matrices(theta or self.plant.parameters)
        n, speed = len(rotor.states), rotor.speed
        A, C = np.zeros((n + 2, n + 2)), np.zeros((space.C.shape[0], n + 2))
        A[:n, :n], C[:, :n] = space.A, space.C
        A[n, n + 1], A[n + 1, n] = -speed, speed
        A[:n, n:] = sum((self._unbalance(u) for u in self.rig.unbalance), np.zeros((n, 2)))
        B, E = (np.vstack([x, np.zeros((2, x.shape[1]))]) for x in (space.B, space.E))
        return StateSpace(A=A, B=B, E=E, C=C)

    def _nonlinear(self, poles: Poles, fraction: float) -> RotorNonlinear:
        """Return what the compiled loop steps the plant with: all that is linear, and the poles."""
        rotor, theta = self.model, self.plant.parameters
        free = self._continuous({**theta, **{f"{axis}.{q}": 0.0 for axis in rotor.axes for q in ("k_i", "k_x")}})
        flows = rotor.states.index(f"{rotor.axes[0]}_current")
        acts = rotor.states.index(f"{rotor.axes[0]}_effective_current") if "a" in rotor.extras else flows
        A = free.A.copy()
        A[flows : flows + len(rotor.axes)] = 0.0
        places = np.argwhere(A)
        largest = float(np.abs(np.linalg.eigvals(self._continuous().A)).max())
        steps = max(1, math.ceil(largest / (FINE * self.rate_hz)))
        values, push = A[places[:, 0], places[:, 1]], np.ascontiguousarray(free.E[:, : len(rotor.axes)])
        resistance = np.array([theta[f"{axis}.R"] for axis in rotor.axes])
        return (
            values, np.ascontiguousarray(places), push, poles.numbers, poles.axes, resistance, poles.leakage,
            (flows, acts), (fraction, 1.0 / self.rate_hz, steps),
        )  # fmt: skip

    def _unbalance(self, u: Turning) -> Array:
        """Return what cos and sin of the angle do to the states: U (W² - jW') exp(j(angle + phase)) in x + jy."""
        rotor, pushes = self.model, np.zeros((len(self.model.states), 2))
        mass, _, _ = rotor.rotor_matrices(self.plant.parameters)
        pull = u.value * complex(rotor.speed**2, -self.acceleration) * cmath.exp(1j * u.phase)
        n, turned = len(rotor.coordinates), np.array([[pull.real, -pull.imag], [pull.imag, pull.real]])
        for plane in (p for p in (0, 1) if p in rotor.planes):
            at = [k for k, q in enumerate(rotor.coordinates) if q.endswith("xy"[plane])]
            pushes[[n + k for k in at]] = np.outer(self.shapes[u.name] / mass[at], turned[plane])
        return pushes

    def _runout(self, angle: Array) -> Array:
        """Return what the sensors see beside the rotor's motion: (n_samples, n_outputs), or (0, n_outputs)."""
        rotor, runout = self.model, np.zeros((angle.size if self.rig.runout else 0, len(self.model.outputs)))
        for r in self.rig.runout:
            for k, (j, _) in enumerate(rotor.sensors):
                bearing, plane = rotor.placed[j]
                if bearing.name == r.name and plane < 2:
                    runout[:, k] += r.value * np.cos(angle + r.phase - 0.5 * np.pi * plane)
        return runout


def _drawn(
    rig: Rig, rotor: RotorModel, shaft: Shaft, values: Mapping[str, float], rate_hz: float, numbers: int
) -> tuple[int, Mapping[str, float]]:
    """Return how many bending modes a simulation keeps, ``modes.count`` or those below a quarter of the rate, and what
    follows from the drawing: no modes where the rig gives `numbers` of them.
    """
    missing = [place for place in rotor.places if place not in values]
    if missing:
        raise RigError(f"rig {rig.name!r}: there is no value for {', '.join(missing)}; a shape needs it. Give it")
    planes = {place: values[place] for place in rotor.places}
    if numbers:
        return numbers, drawn_numbers(rotor.with_modes(0), shaft, planes)
    n = rig.modes.count
    if n is None:
        omega = shaft.free_rotor(_MOST_MODES).omega[2:]
        n = int(np.count_nonzero(omega < 0.5 * np.pi * rate_hz))
    drawn = drawn_numbers(rotor.with_modes(n), shaft, planes)
    if rig.unbalance:
        at = [u.z for u in rig.unbalance]
        rows = shaft.free_rotor(n, planes=[*planes.values(), *at]).deflection(at)
        for u, row in zip(rig.unbalance, rows, strict=True):
            drawn |= {f"mode{r}.unbalance.{u.name}": float(row[r + 1]) for r in range(1, n + 1)}
    return n, drawn


def kind_of(name: str) -> str:
    """Return what a role of an axis is: ``ax_position2`` is a position; a command is a voltage."""
    kind = name.rsplit("_", 1)[-1].rstrip("0123456789")
    return "voltage" if kind == "command" else kind
