"""An identified plant and a loop on the nonlinear simulator: magnets that linearise to the plant's own numbers.

The rig's [magnet] law is scaled, W'(x, i) -> a W'(x, b i) + c i²/2, to the plant's k_x, k_i and L at rest; without one
two opposed magnets (theory.md sec. 1) stand there. What lies beyond is assumed; `Workbench.assumed` says what.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ambid.arrays import Array
from ambid.control.closed import Plant
from ambid.control.drawn import GAP_OF_TRAVEL, UNKNOWN_SINGLE, nominal_of
from ambid.errors import ModelError, RigError
from ambid.physics.law_magnet import LawMagnet
from ambid.physics.linear_model import LinearModel, OneAxis, Parameter
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.magnet import CoEnergy
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint
from ambid.physics.rotor_model import RotorModel
from ambid.rig.rig import Rig, RigMagnet
from ambid.simulation.bench import VaryingLoop
from ambid.simulation.plant import LinearPlant, closed_loop_poles
from ambid.simulation.rig_bench import enough_steps, rest_of_rig
from ambid.simulation.rotor_bench import Poles, RotorBench, poles_of


class Answer(NamedTuple):
    """What a bench did, SI; positions are those from rest."""

    position: Array  # (n, n_axes)
    current: Array  # (n, n_coils)
    command: Array  # (n, n_inputs)
    limited: int  # samples with a limited command
    over: int  # samples with a current beyond its limits


@dataclass(frozen=True, kw_only=True)
class Workbench:
    """A plant in its loop that can be pushed, lifted and turned."""

    plant: Plant
    loop: Loop
    limits: Limits
    noise: Noise
    assumed: tuple[str, ...]  # of the magnets
    top_speed: float = 0.0  # the rig's own, rad/s; 0: none
    moment: float = 0.0  # the rig's own unbalance, kg m; 0: none

    @property
    def rest(self) -> OperatingPoint:
        """Where the loop holds the plant."""
        return OperatingPoint()

    @property
    def stops(self) -> tuple[float, float]:
        """Where the rotor touches, from rest, m."""
        low, high = self.limits.position
        return low - self.rest.position, high - self.rest.position

    @property
    def room(self) -> Array:
        """The force in N that each axis can hold for long by the limits, (n_axes,); without any 5 times the weight."""
        plant = self.plant
        prefixes = [f"{axis}." for axis in plant.axes] if isinstance(plant.model, RotorModel) else [""]
        return np.array([self._holds(prefix) for prefix in prefixes])

    def _holds(self, prefix: str) -> float:
        theta = self.plant.theta
        ways = [abs(end - self.rest.current) for end in self.limits.current]
        if f"{prefix}R" in theta:
            ways += [abs(end - self.rest.voltage) / theta[f"{prefix}R"] for end in self.limits.voltage]
        if not math.isfinite(min(ways)) or f"{prefix}k_i" not in theta:
            return 5.0 * 9.81 * theta["m"]
        return abs(theta[f"{prefix}k_i"]) * min(ways)

    def respond(
        self, n: int, *, load: Array | None = None, start: Array | None = None, speed: float | None = None,
        seed: int | None = None, linear: bool = False,
    ) -> Answer:  # fmt: skip
        """Simulate `n` samples, with noise where a seed is given: `load` (n, n_axes), N; `start` (n_axes,) from rest,
        m, without current and speed; `speed` of rotation, default the plant's own.
        """
        raise NotImplementedError


def workbench(plant: Plant, rig: Rig, loop: Loop, *, nonlinear: bool = True) -> Workbench:
    """Return the bench of a plant in a loop, its delay in place of the loop's, with the rig's limits, noise, point of
    rest and magnet. ModelError for a plant without a position.
    """
    plant = _without_fast_eddies(plant)
    loop = replace(loop, delay=float(plant.delays.max(initial=0.0)))
    if not plant.sensors:
        raise ModelError(f"model {plant.model.name!r} has no position, so that nothing levitates. Choose another model")
    return (_Rotor if isinstance(plant.model, RotorModel) else _OneAxis).of(plant, rig, loop, nonlinear)


def _without_fast_eddies(plant: Plant) -> Plant:
    """Return the plant with a delay in place of eddy currents that are gone within half a sample."""
    pole, plant_model = plant.theta.get("a", 0.0), plant.model
    if pole < _FAST * plant.rate_hz:
        return plant
    slow = (
        replace(plant_model, extras=tuple(x for x in plant_model.extras if x != "a"))
        if isinstance(plant_model, RotorModel)
        else OneAxis()
    )
    theta = {name: x for name, x in plant.theta.items() if name != "a"}
    return replace(plant, model=slow, theta=theta, delays=plant.delays + plant.rate_hz / pole)


def _gap(rig: Rig, farthest: float) -> tuple[float, str]:
    """Return the air gap at rest, and how it is known; infinite where nothing tells it."""
    known_gap = None if rig.magnet is None else rig.magnet.known("s")
    if known_gap is not None and known_gap.value and known_gap.value > 0.0:
        return known_gap.value, f"the rig's gap of {1e6 * known_gap.value:.4g} µm"
    gap = GAP_OF_TRAVEL * farthest
    return gap, f"a gap of {GAP_OF_TRAVEL:g} times the travel inside limits.position, {1e6 * gap:.4g} µm"


_FAST = 2.0  # eddy pole over the rate from which it is taken as a delay: small steps cost time
_INTEGRAL = 1e-6  # distance of an integrator's pole from 1
_LINEAR = "the magnet is simulated as linear, which says too little of large motions: "
_BEYOND = "; what lies beyond the neighbourhood of rest is assumed"


# --- one axis ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class AroundRest:
    """A magnet known by its numbers at one point of rest, as a `Magnet`."""

    coenergy: CoEnergy
    rest: tuple[float, float]  # position, m; current, A

    @property
    def range(self) -> tuple[float, float]:
        """Positions in m between which both gaps are open."""
        return -self.coenergy.s_b, self.coenergy.s_a

    def holding_current(self, x: float, load: float) -> float:
        """Return the current at rest; other places and loads are not asked for."""
        if x != self.rest[0] or load != 0.0:
            raise ModelError(f"this magnet rests at {self.rest[0]:g} m without a load. Ask for it there")
        return self.rest[1]


@dataclass(frozen=True, kw_only=True)
class _OneAxis(Workbench):
    """One axis at its point of rest."""

    body: NonlinearPlant | LinearPlant
    point: OperatingPoint

    @classmethod
    def of(cls, plant: Plant, rig: Rig, loop: Loop, nonlinear: bool) -> _OneAxis:
        """Return the bench, and what is assumed of its magnet."""
        limits, rest, theta = rig.limits or Limits(), dict(rig.operating_point), plant.theta
        rest.setdefault("voltage", theta.get("R", 0.0) * rest.get("current", 0.0))
        point = OperatingPoint(**{name: rest.get(name, 0.0) for name in OperatingPoint._fields})
        linear = LinearPlant(model=plant.model, parameters=theta)
        body, rests, note = (
            _around_rest(linear, rig, point, limits) if nonlinear
            else (linear, point, "the magnet is linear, as asked for")
        )  # fmt: skip
        return cls(
            plant=plant, loop=loop, limits=limits, noise=rig.noise or Noise(), body=body, point=rests, assumed=(note,)
        )  # fmt: skip

    @property
    def rest(self) -> OperatingPoint:
        """Where the loop holds the plant."""
        return self.point

    def respond(
        self, n: int, *, load: Array | None = None, start: Array | None = None, speed: float | None = None,  # noqa: ARG002
        seed: int | None = None, linear: bool = False,  # noqa: ARG002
    ) -> Answer:  # fmt: skip
        """Simulate; an axis knows no speed, and `linear` is what it is."""
        plant_model, first, steps = self.plant.model, None, 1
        if start is not None:
            x = self.point.position + float(start[0])
            first = [x, 0.0, 0.0][: len(plant_model.states)]
            if isinstance(self.body, LinearPlant):
                still = self.plant.theta
                force = (
                    -still["k_i"] * self.point.current - still["k_x"] * float(start[0])
                    if len(plant_model.states) > 3
                    else 0
                )
            else:
                force = self.body.magnet.coenergy.force(x, 0.0)
            if "a" in self.plant.theta:
                first.append(float(force))
        if isinstance(self.body, NonlinearPlant):
            steps = enough_steps(self.body, self.point, self.plant.rate_hz)
        run = VaryingLoop(
            self.body, rate_hz=self.plant.rate_hz, seed=seed or 0, loop=self.loop, limits=self.limits,
            noise=_quiet(self.noise) if seed is None else self.noise, operating_point=self.point, start=first,
            substeps=steps,
        )  # fmt: skip
        done = run.advance(np.zeros(n), load=None if load is None else load[:, 0])
        names = plant_model.states
        currents = done.states[:, [names.index("current")]] if "current" in names else done.command[:, None]
        position = done.states[:, [names.index("position")]] - self.point.position
        return Answer(position, currents, done.command[:, None], int(run.counts[3]), run.n_over_current)


def _quiet(noise: Noise) -> Noise:
    """Return the resolutions alone."""
    return replace(noise, position=0.0, current=0.0, force=0.0, voltage=0.0)


def _around_rest(
    linear: LinearPlant, rig: Rig, point: OperatingPoint, limits: Limits
) -> tuple[NonlinearPlant | LinearPlant, OperatingPoint, str]:
    """Return the nonlinear plant that linearises to a linear one, where it rests, and what is assumed."""
    theta = linear.parameters
    if not {"k_x", "k_i", "L", "R"} <= set(theta) or theta["k_x"] >= 0.0 or theta["k_i"] == 0.0:
        return linear, point, f"{_LINEAR}k_x is not negative, which no magnet's law explains"
    if rig.magnet is not None:
        try:
            body, rest = _scaled(theta, nominal_of(rig, theta, rig.operating_point), rig)
            return body, rest, f"the law of the magnet is the rig's [magnet], scaled to the plant's numbers{_BEYOND}"
        except (RigError, ModelError):  # some numbers are to be found by an identification, or are of another plant
            if rig.magnet.kind == "single":
                return linear, point, f"{_LINEAR}{UNKNOWN_SINGLE}"
    farthest = max(abs(end - point.position) for end in limits.position)
    gap, how = _gap(rig, farthest)
    if not math.isfinite(gap):
        return linear, point, f"{_LINEAR}neither a gap nor limits.position is given"
    energy = CoEnergy.opposed(
        k_i=theta["k_i"], k_x=theta["k_x"], L=theta["L"], gap=gap, x=point.position, i=point.current
    )
    body = NonlinearPlant(
        magnet=AroundRest(coenergy=energy, rest=(point.position, point.current)), m=theta["m"], R=theta["R"],
        c=theta.get("c", 0.0), eddy_pole=theta.get("a", math.inf),
    )  # fmt: skip
    rest = body.equilibrium(point.position)
    return body, rest, f"the law of the magnets is that of two opposed ones with {how}{_BEYOND}"


def _scaled(theta: Mapping[str, float], nominal: NonlinearPlant, rig: Rig) -> tuple[NonlinearPlant, OperatingPoint]:
    """Return the rig's plant with its co-energy scaled to numbers at rest, and the load with it."""
    own, rest, magnet = nominal.linearise(rest_of_rig(rig, nominal).position), rest_of_rig(rig, nominal), nominal.magnet
    assert isinstance(magnet, LawMagnet)
    a = theta["k_x"] / own["k_x"]
    b = theta["k_i"] / (a * own["k_i"])
    if not (a > 0.0 and b > 0.0):
        raise ModelError("the rig's [magnet] pulls the other way than the plant's. Correct one of them")
    square = a * b**2
    factors = {magnet.law.names[0]: square, "L_rise": square, "L_leak": square, "sigma": b**2}
    factors |= dict.fromkeys(("i0", "i0_asym", "i_knee"), 1.0 / b)
    values = {name: value * factors.get(name, 1.0) for name, value in {"L_leak": 0.0, **magnet.values}.items()}
    values["L_leak"] += theta["L"] - square * own["L"]
    body = replace(
        nominal, magnet=replace(magnet, values=values), m=theta["m"], c=theta.get("c", 0.0),
        R=theta["R"] - nominal.stage.slope(rest.current / b), gravity=a * nominal.m * nominal.gravity / theta["m"],
        eddy_pole=theta.get("a", math.inf),
    )  # fmt: skip
    return body, body.equilibrium(rest.position)


# --- a rotor ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _Rotor(Workbench):
    """A rotor on many axes."""

    rig: Rig  # without what turns with its own rotor
    poles: Poles | None

    @classmethod
    def of(cls, plant: Plant, rig: Rig, loop: Loop, nonlinear: bool) -> _Rotor:
        """Return the bench, and what is assumed of its magnets."""
        model, limits = plant.model, rig.limits or Limits()
        assert isinstance(model, RotorModel)
        poles, note = None, "the magnets are linear, as asked for"
        if nonlinear:
            gap, how = _gap(rig, max(map(abs, limits.position)))
            nominal = replace(
                rig.magnet or RigMagnet(kind="pair"),
                parameters=(Parameter(name="s", unit="m", role="fixed", value=gap),
                            *(p for p in (rig.magnet.parameters if rig.magnet else ()) if p.name != "s")),
            )  # fmt: skip
            try:
                if not math.isfinite(gap):
                    raise RigError("neither a gap nor limits.position is given")
                poles = poles_of(replace(rig, magnet=nominal), model, plant.theta)
                note = f"the law of the magnets is that of opposed pole pairs with {how}{_BEYOND}"
            except RigError as problem:
                note = f"{_LINEAR}{problem}"
        bare = replace(rig, unbalance=(), runout=(), limits=limits)
        return cls(
            plant=plant, loop=loop, limits=limits, noise=rig.noise or Noise(), rig=bare, poles=poles, assumed=(note,),
            top_speed=model.speed, moment=sum(abs(u.value) for u in rig.unbalance),
        )  # fmt: skip

    @property
    def model(self) -> RotorModel:
        """The rotor at its own speed."""
        assert isinstance(self.plant.model, RotorModel)
        return self.plant.model

    def at_speed(self, speed: float | None) -> RotorModel:
        """Return the model at another speed, as far as its numbers are known; without Ip it is that at rest."""
        turned = self.model if speed is None else self.model.at_speed(speed)
        names = set(self.plant.theta)
        return turned if all(p.name in names or p.default is not None for p in turned.parameters) else self.model

    def respond(
        self, n: int, *, load: Array | None = None, start: Array | None = None, speed: float | None = None,
        seed: int | None = None, linear: bool = False,
    ) -> Answer:  # fmt: skip
        """Simulate, with magnets that are linear where `linear`."""
        rotor, noise = self.at_speed(speed), _quiet(self.noise) if seed is None else self.noise
        bench = RotorBench(
            rig=replace(self.rig, noise=noise), plant=LinearPlant(model=rotor, parameters=self.plant.theta),
            loop=self.loop, rate_hz=self.plant.rate_hz, shapes={}, poles=None if linear else self.poles,
        )  # fmt: skip
        done = bench.simulate(
            np.zeros((n, len(rotor.inputs))), seed=seed or 0, columns=False, load=load,
            start=bench.begun(None if start is None else _placed(rotor, self.plant.theta, start)),
        )  # fmt: skip
        command = np.column_stack([done.record[name].values for name in rotor.inputs])
        n_axes = len(rotor.axes)
        return Answer(
            done.states[:, :n_axes], done.states[:, n_axes:], command, done.n_saturated, done.n_over_current
        )  # fmt: skip


def _placed(rotor: RotorModel, theta: Mapping[str, float], positions: Array) -> Array:
    """Return the states of a rigid rotor that lies still with these positions of its axes."""
    magnets, sensors = rotor.rows(theta)
    rigid = np.array([not q.startswith("mode") for q in rotor.coordinates])
    q = np.zeros(len(rotor.coordinates))
    q[rigid] = np.linalg.lstsq(magnets[:, rigid], positions, rcond=None)[0]
    x = np.zeros(len(rotor.states))
    x[: q.size] = q
    for name, value in zip(rotor.outputs, sensors @ q, strict=False):  # positions come first
        if name in rotor.states:
            x[rotor.states.index(name)] = value
    return x


def integrates(loop: Loop) -> bool:
    """Whether a steady force leaves no steady error."""
    if loop.law is None:
        return loop.ki != 0.0
    return bool(np.any(np.abs(np.linalg.eigvals(loop.law.A) - 1.0) < _INTEGRAL))


def slowest_pole(bench: Workbench) -> float:
    """Return the time constant of the loop's slowest pole in s; infinite of an unstable one."""
    plant_model: LinearModel = bench.plant.model
    poles = np.abs(closed_loop_poles(bench.plant.theta, bench.loop, bench.plant.rate_hz, of=plant_model))
    poles = poles[poles > 0.0]
    largest = float(poles.max(initial=0.0))
    return -1.0 / (bench.plant.rate_hz * math.log(largest)) if 0.0 < largest < 1.0 else math.inf
