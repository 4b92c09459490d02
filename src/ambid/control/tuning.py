"""The PID of `ambid.physics.loop.Loop` tuned over many plants at once; of rotors also one a bearing.

The largest logarithm of each figure of `ambid.control.gain_sets.Loops` is minimised as an epigraph, limits' common
excess penalised exactly (Nocedal and Wright 2006, sec. 17.2 and 18.5): where it stays, no design meets them. Poles
stand for settling, corrected by what the force steps show.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.control.closed import Plant
from ambid.control.design import (
    FIGURES,
    SAME,
    UNSTABLE,
    Figures,
    Goals,
    examine,
    noise_of,
    worst_of,
)  # fmt: skip
from ambid.control.gain_sets import GainSets, Loops, Pid, form_of
from ambid.errors import EstimationError, ModelError
from ambid.estimation.progress import Tick
from ambid.physics.linear_model import OneAxis
from ambid.physics.loop import Loop, placed_loop
from ambid.physics.rotor_model import RotorModel
from ambid.rig import Rig
from ambid.settings.caller import setting

_SLOW = 0.02  # decay over that of the present loop, from which its logarithm goes on as a straight line
_RANGE = math.log(30.0)  # of each gain, up and down from the present one
_STEPS = 60  # of a search
_PENALTY = 10.0  # of the common excess over the limits
_MET = 2e-3  # excess in logarithms that counts as none
_SLACK = 0.01  # by which limits are kept from, in logarithms: other plants judge
_SMOOTH = 0.03  # by which smooth maxima are too large: the present loop must not pass the limits that follow from it
_ROUNDS = 5  # of corrections by the force steps
_WAYS = 10  # loops that are tried between the present one and the best
_AWAY = math.log(2.0)  # of the frequencies of a filter from those of its mode
_DAMPING = (0.02, 2.0)  # of zeros and poles of a filter
_PLACED = (0.6, 1.0, 1.6)  # over the plant's own rate, where poles are placed to start from


@dataclass(kw_only=True, eq=False)
class _Search:
    """One problem: what is minimised and limited, over plants; evaluated once for each point."""

    loops: Loops
    pid: GainSets
    reference: Mapping[str, float]
    decay: float  # 1/s, of the present loop, by which settling is judged

    def __post_init__(self) -> None:
        self._last: tuple[bytes, tuple[Array, Array]] | None = None

    def at(self, point: Array) -> tuple[Array, Array]:
        """Return ln(figure/reference), (n_plants, 4) in the order of `FIGURES`, and slopes by the logarithms."""
        key = point.tobytes()
        if self._last is None or self._last[0] != key:
            figures, slopes = self.loops.figures(point)
            decay, fall = self.loops.decays(point, integrates=bool(self.pid.signs[1]))
            share = np.maximum(decay / self.decay, _SLOW)
            slow = -np.log(share) + (share - decay / self.decay) / _SLOW
            values = np.column_stack([figures - np.log([self.reference[n] for n in list(FIGURES)[:3]]), slow])
            rates = np.concatenate([slopes, (-fall / self.decay / share[:, None])[:, None]], axis=1)
            self._last = key, (values, rates)
        return self._last[1]

    def solve(
        self,
        minimise: Sequence[str],
        limits: Mapping[str, float],
        start: Array,
        bounds: Array,
        tick: Callable[[], None],
    ) -> tuple[Array, float, float]:
        """Return the best point from a start, the goals' largest logarithm, and the excess over `limits`, largest
        ln(figure/reference); a pole that hardly decays is always beyond one.
        """
        from scipy.optimize import minimize

        names = list(FIGURES)
        goals, limited = [names.index(n) for n in minimise], [names.index(n) for n in limits]
        most = np.array([*limits.values(), -math.log(_SLOW)])
        limited.append(names.index("settling"))
        free = np.flatnonzero(self.pid.free)

        def point(x: Array) -> Array:
            full = start.copy()
            full[free] = x[:-2]
            return full

        def rest(x: Array) -> Array:
            values = self.at(point(x))[0]
            return np.concatenate([(x[-2] - values[:, goals]).ravel(), (most + x[-1] - values[:, limited]).ravel()])

        def slopes(x: Array) -> Array:
            rates = self.at(point(x))[1]
            parts = [-rates[:, g][:, :, free].reshape(-1, free.size) for g in (goals, limited)]
            ends = [np.tile(e, (p.shape[0], 1)) for e, p in zip(np.eye(2), parts, strict=True)]
            return np.vstack([np.hstack(pair) for pair in zip(parts, ends, strict=True)])

        values = self.at(start)[0]
        first = [float(values[:, goals].max()), max(float((values[:, limited] - most).max()), 0.0)]
        answer = minimize(
            lambda x: x[-2] + _PENALTY * x[-1], np.array([*start[free], *first]),
            jac=lambda _: np.array([*np.zeros(free.size), 1.0, _PENALTY]), method="SLSQP",
            bounds=[*bounds[free].tolist(), (None, None), (0.0, None)],
            constraints={"type": "ineq", "fun": rest, "jac": slopes}, callback=lambda _: tick(),
            options={"maxiter": _STEPS, "ftol": 1e-5},
        )  # fmt: skip
        solution = point(np.clip(answer.x, [*bounds[free, 0], -np.inf, 0.0], [*bounds[free, 1], np.inf, np.inf]))
        values = self.at(solution)[0]
        return solution, float(values[:, goals].max()), max(float((values[:, limited] - most).max()), 0.0)


def tune_pid(
    plants: Sequence[Plant], rig: Rig, goals: Goals, tick: Tick, *, form: str = "axes", filters: int = 0
) -> Loop:
    """Return the PID with current feedback that does best on the worst of some plants; gains the present loop has not
    stay absent. `form`: which of a rotor's axes share gains, of `ambid.control.gain_sets.FORMS`; `filters`: around so
    many of its lowest bending modes. EstimationError where no loop meets the limits.
    """
    assert rig.loop is not None
    if rig.loop.law is not None:
        raise EstimationError(
            "[loop] is a state-space law, whose structure is no PID. Give a PID in [loop] to start from"
        )
    return _tuned(_Problem.of(plants, rig, form, filters), goals, tick)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Problem:
    """What is tuned: plants, of which those are looked at that were the worst of all in any figure."""

    plants: Sequence[Plant]
    present: Loop
    noise: tuple[float, float]
    pid: GainSets
    around: tuple[float, ...]  # frequencies of filters, rad/s
    bounds: Array

    @classmethod
    def of(cls, plants: Sequence[Plant], rig: Rig, form: str, filters: int) -> _Problem:
        """Return the problem of a rig."""
        assert rig.loop is not None
        first = plants[0]
        if not isinstance(first.model, (OneAxis, RotorModel)):
            raise EstimationError(
                "a PID is tuned for one axis with its coil (model one-axis) or a rotor; the estimate is of another"
            )
        if isinstance(first.model, OneAxis) and (form != "axes" or filters):
            raise EstimationError("forms and filters of gains are of a rotor; the estimate is of one axis. Omit them")
        own = sorted(x for name, x in first.theta.items() if name.startswith("mode") and name.endswith(".omega"))
        if filters > len(own):
            raise EstimationError(
                f"{filters} filters are asked for, and the estimate has {len(own)} bending modes. Ask for no more than "
                "modes"
            )
        around = tuple(own[:filters])
        pid = GainSets.of(rig.loop, first.model, first.rate_hz, form_of(first.model, form), filters)
        one = pid.pid.at(rig.loop)
        gains = np.tile(bounds_of(rig, pid.pid, one), (len(pid.form.names), 1))
        near = [[[math.log(w) - _AWAY, math.log(w) + _AWAY]] * 2 + [list(np.log(_DAMPING))] * 2 for w in around]
        return cls(
            plants=plants, present=rig.loop, noise=noise_of(rig.noise, {})[:2], pid=pid, around=around,
            bounds=np.vstack([gains, *near]),
        )  # fmt: skip

    def starts(self) -> list[Array]:
        """Return where searches start: the present loop, and placed poles of one axis."""
        one = isinstance(self.plants[0].model, OneAxis)
        placed = _placed(self.plants[0], self.present, self.pid.pid, self.bounds) if one else []
        return [self.pid.at(self.present, self.around), *placed]

    def looked_at(self, figures: Sequence[Figures], before: Sequence[int]) -> list[int]:
        """Return the plants of before and those that are now the worst, by much, in any figure."""
        chosen = list(before) or [0]
        for name in FIGURES:
            sizes = np.array([getattr(f, name) for f in figures])
            k = int(np.argmax(sizes))
            if not before or sizes[k] > (1.0 + _SLACK) * sizes[chosen].max():
                chosen.append(k)
        return list(dict.fromkeys(chosen))

    def loops(self, which: Sequence[int], at: Array) -> Loops:
        """Return some plants in their loop."""
        return Loops(plants=[self.plants[k] for k in which], noise=self.noise, sets=self.pid, around=at)


def _tuned(problem: _Problem, goals: Goals, tick: Tick) -> Loop:
    """Return the best loop: on some plants, until it does as well on all."""
    starts, done = problem.starts(), 0

    def advance() -> None:
        nonlocal done
        done += 1
        tick("tune", 1.0 - 1.0 / (1.0 + done / (_STEPS * len(starts))))

    def figures_of(loop: Loop) -> list[Figures]:
        return [examine(p, loop, problem.noise).figures for p in problem.plants]

    unworsened, own = _worsened(goals), {n for n in goals.minimise if goals.limits[n] >= goals.reference[n]}
    limits = {
        n: math.log(x / goals.reference[n]) + (_SMOOTH if n in own else -_SLACK * (n not in unworsened))
        for n, x in goals.limits.items()
    }
    which = problem.looked_at(figures_of(problem.present), [])
    first = best = starts[0]
    for k in range(_ROUNDS):
        loops = problem.loops(which, starts[0])
        decays = loops.decays(first, integrates=bool(problem.pid.signs[1]))[0]
        search = _Search(
            loops=loops, pid=problem.pid, reference=goals.reference,
            decay=max(float(np.min(decays)), 1e-3 * loops.rate_hz / 1e3),
        )  # fmt: skip
        solutions = [search.solve(goals.minimise, limits, x, problem.bounds, advance) for x in starts]
        point, _, excess = min(solutions, key=lambda f: f[1] + _PENALTY * f[2])
        if excess > _MET and not k:  # or the search stood still: what is far inside a limit is a better start
            ways = _ways(search, limits, starts, problem.bounds, advance)
            inside = [
                search.solve(goals.minimise, limits, x, problem.bounds, advance) for gap, _, x in ways if gap <= 0.0
            ]
            point, _, excess = min(inside, key=lambda f: f[1] + _PENALTY * f[2], default=(point, 0.0, excess))
            if excess > _MET:
                raise EstimationError(_refusal(goals, ways))
        if excess > _MET:
            break
        best, loop = point, problem.pid.loop(point, problem.present)
        figures = figures_of(loop)
        over, more = (
            _worst(figures).settling / goals.limits.get("settling", math.inf),
            problem.looked_at(figures, which),
        )
        if over <= SAME and more == which:
            return loop
        if over > SAME and math.isfinite(over):
            limits["settling"] -= 1.5 * math.log(over) + _SLACK
        which, starts = more, [best, *starts[:1]]
    return _between(problem, (first, best), figures_of, goals)


def _worst(figures: Sequence[Figures]) -> Figures:
    """Return the worst of each figure over plants; without stability everywhere those of none."""
    return worst_of(figures) if all(f.stable for f in figures) else UNSTABLE


def _between(
    problem: _Problem,
    ends: tuple[Array, Array],
    figures_of: Callable[[Loop], Sequence[Figures]],
    goals: Goals,
) -> Loop:
    """Return the loop farthest towards the best that meets the limits on all plants: the slowest pole says little of
    force steps where it takes no part.
    """
    worst = UNSTABLE
    for share in np.linspace(1.0, 0.0, _WAYS + 1):
        loop = problem.pid.loop(ends[0] + share * (ends[1] - ends[0]), problem.present) if share else problem.present
        worst = _worst(figures_of(loop))
        if not goals.missed(worst):
            return loop
    listed = ", ".join(said(name, x) for name, x in goals.limits.items())
    least = worst.settling if math.isfinite(worst.settling) else 2.0 * goals.limits["settling"]
    raise EstimationError(
        f"no PID meets the limits ({listed}) on all plants: force steps take longer to settle. Give "
        f"{raised('settling', least)}, or raise another"
    )


def _worsened(goals: Goals) -> tuple[str, ...]:
    """Return the figures whose limit is what the present loop has: it meets them, and need not be left."""
    return tuple(n for n, x in goals.limits.items() if x == goals.reference[n])


def bounds_of(rig: Rig, pid: Pid, start: Array) -> Array:
    """Return between which logarithms the numbers are searched, (5, 2), as firmware holds them."""
    bounds = np.column_stack([start - _RANGE, start + _RANGE])
    bounds[4] = np.log([pid.period / 20.0, 100.0 * pid.period])
    if rig.daq is None:
        return bounds
    from ambid.acquisition.scales import LARGEST_GAIN
    from ambid.acquisition.settings import FEWEST_STEPS, controller_settings, exact_gains

    unit = replace(rig, loop=Loop(kp=1.0, ki=1.0 / pid.period, kd=pid.period, kc=1.0, delay=0.0))
    settings = controller_settings(rig)
    steps = exact_gains(unit, (settings.duty_bias, settings.current_rest, settings.setpoint))
    for k, name in enumerate(("kp", "ki", "kd", "kc")):
        representable = np.log(np.array([FEWEST_STEPS, LARGEST_GAIN]) / abs(steps[name]))
        bounds[k] = np.clip(bounds[k], *representable)
    return bounds


def _placed(plant: Plant, present: Loop, pid: Pid, bounds: Array) -> list[Array]:
    """Return further starts: poles placed at multiples of the plant's own rate, with the signs of the present loop."""
    theta, loops = plant.theta, []
    own = math.sqrt(max(abs(theta["k_x"]), theta["k_i"] ** 2 / theta["L"]) / theta["m"])
    for factor in _PLACED:
        w = factor * own
        try:
            loop = placed_loop(theta, (-5.0 * w, w * (-0.7 + 0.7j), w * (-0.7 - 0.7j), -w / 6.0),
                               derivative_cutoff_hz=present.derivative_cutoff_hz)  # fmt: skip
        except ModelError:
            continue
        if np.array_equal(Pid.of(loop, plant.rate_hz).signs, pid.signs):
            loops.append(np.clip(pid.at(loop), bounds[:, 0], bounds[:, 1]))
    return loops


_Way = tuple[float, str, Array]


def _ways(
    search: _Search, limits: Mapping[str, float], starts: Sequence[Array], bounds: Array, tick: Callable[[], None]
) -> list[_Way]:
    """Return how far each limit has to give way where the others are kept, in logarithms, its name, and where."""
    ways = []
    for name in limits:
        others = {n: x for n, x in limits.items() if n != name}
        point, least, excess = min(
            (search.solve((name,), others, x, bounds, tick) for x in starts), key=lambda f: f[1] + _PENALTY * f[2]
        )
        if excess <= _MET:
            ways.append((least - limits[name], name, point))
    return ways


def _refusal(goals: Goals, ways: Sequence[_Way]) -> str:
    """Say which limit to move, and how far: the one that has to give way least, the others kept."""
    listed = ", ".join(said(name, x) for name, x in goals.limits.items())
    if not ways:
        return f"no PID meets the limits ({listed}), nor where any one of them is left out. Raise several of them"
    gap, name, _ = min(ways, key=lambda w: w[0])
    least = goals.limits[name] * math.exp(gap)
    moved = raised(name, least)
    return (
        f"no PID meets the limits ({listed}) on all plants; with the others kept, {said(name, least)} is the "
        f"least. Give {moved}, or raise another"
    )


def said(name: str, x: float) -> str:
    """Write a limit for people."""
    number = 20.0 * math.log10(x) if name == "peak" else x
    return f"{name} {number:.4g} {'dB' if name == 'peak' else FIGURES[name]}"


def raised(name: str, x: float) -> str:
    """Write the setting of a limit that is a little more than it is."""
    shown = 1.01 * (20.0 * math.log10(x) if name == "peak" else x)
    return setting("limits", f"{name}={shown:.4g}{'dB' if name == 'peak' else FIGURES[name]}")
