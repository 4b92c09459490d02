"""Resonances of a rotor in its loop from a run-up or a coast-down: critical speeds, amplification factors, margins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.estimation.modes import EstimatedNumber
from ambid.estimation.result import NORMAL_95
from ambid.rotor.passage import Passage, whirl_of
from ambid.rotor.passage_fit import Course, ModalFit, fitted, reweighted, with_another

CRITICALLY_DAMPED = 2.5
"""Amplification factor below which a mode is no critical speed (API 684)."""
_STANDS_OUT = 0.01  # of the largest value, by which a peak rises above what is around it
_APART = 1e-9  # of the highest speed, up to which two are one
_BULGE = 1.05  # of a parabola over its highest point
_MODES = 8  # at most
_SMOOTH, _WORTH = 0.1, 3.0  # damping ratio above which a mode may gain less, for each of its numbers
_BLOCKS = 24  # that a passage needs, for two modes
_SEEN, _DAMPED = 0.25, 0.2  # relative spread of a damping ratio that is taken; ratio of a well damped mode
_RESOLVED = 5.0  # blocks in which a mode has to stand out
_GRID = 600  # speeds
_DRAWS = 100  # of the response, for intervals
_NEAR, _WIDTHS = 0.03, 1.5  # of the frequency, and damping ratios, within which a peak belongs to a pole
SCALING = (1.0, 6.0)
"""Least and largest factor by which a response to unbalance is scaled to a limit."""
_MISFIT = 2.0  # mean square of residuals over their variance from which the fit is doubtful


@dataclass(frozen=True, slots=True, kw_only=True)
class Peak:
    """A peak of a response over the speed, by its half-power points (API RP 684): AF = N_c/(N_2 - N_1)."""

    speed: float  # N_c, rad/s
    size: float  # in the unit of the response
    lower: float | None  # N_1, rad/s, where it is 1/√2 of the peak; None: it does not fall as far before another peak
    upper: float | None  # N_2

    @property
    def amplification(self) -> float | None:
        """AF; None where one of the half-power points is missing."""
        if self.lower is None or self.upper is None:
            return None
        return self.speed / (self.upper - self.lower)


def peaks(speed: Array, size: Array) -> tuple[Peak, ...]:
    """Return the peaks of a response (n,) over the speed in rad/s, in any order, by rising speed."""
    order = np.argsort(speed, kind="stable")
    x, y = speed[order], size[order]
    apart = np.diff(x, prepend=-np.inf) > _APART * np.abs(x).max(initial=0.0)  # a speed that is held counts once
    x, y = x[apart], y[apart]
    tops = np.flatnonzero((y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:])) + 1
    least = _STANDS_OUT * float(y.max(initial=0.0))
    return tuple(_peak_at(x, y, int(k)) for k in tops if _prominence(y, int(k)) >= least)


def _prominence(y: Array, k: int) -> float:
    """Return how far a curve falls on either side of a top before it rises above it."""
    higher = np.flatnonzero(y > y[k])
    a, b = int(np.searchsorted(higher, k)) - 1, int(np.searchsorted(higher, k))
    left = y[(higher[a] if a >= 0 else 0) : k + 1].min()
    right = y[k : (higher[b] if b < higher.size else y.size)].min()
    return float(y[k] - max(left, right))


def _peak_at(x: Array, y: Array, k: int) -> Peak:
    """Return the peak around a largest value: the top of a parabola, and where it falls to 1/√2 of that."""
    (left, right), (low, high) = x[[k - 1, k + 1]] - x[k], y[[k - 1, k + 1]] - y[k]
    bend = (low / left - high / right) / (left - right)
    slope = low / left - bend * left
    shift = float(np.clip(-0.5 * slope / bend, left, right)) if bend < 0.0 else 0.0
    top = float(y[k] + shift * (slope + bend * shift))
    if not y[k] <= top <= _BULGE * y[k]:
        shift, top = 0.0, float(y[k])
    ends = []
    for step in (-1, 1):
        m = k
        while 0 <= m + step < x.size and y[m] > top / np.sqrt(2.0) and y[m] <= top * (1.0 + _STANDS_OUT):
            m += step
        fell = y[m] <= top / np.sqrt(2.0)
        pair = sorted((m, m - step), key=lambda i: y[i])
        ends.append(float(np.interp(top / np.sqrt(2.0), y[pair], x[pair])) if fell else None)
    return Peak(speed=float(x[k] + shift), size=top, lower=ends[0], upper=ends[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Resonance:
    """A mode of the loop that a run-up or a coast-down passes.

    Speed and amplification are those of the response to unbalance at constant speed: what acceleration shifts and
    broadens is taken out. Intervals hold noise alone. Numbers of a well damped mode without half-power points are not
    identifiable: they lean on what is fitted beside it.
    """

    speed: EstimatedNumber  # critical speed, rad/s: where that response peaks; of a damped mode its natural frequency
    amplification: EstimatedNumber  # AF by the half-power points of that response, else 1/(2 damping ratio)
    half_power: bool  # whether it is by half-power points
    critically_damped: bool
    frequency: EstimatedNumber  # |pole|, rad/s
    damping: EstimatedNumber  # ratio
    forward: float | None  # part of the power of its motion that whirls forward; None: of one plane
    measured: Peak | None  # the peak of the tracked response itself, as the longest way passed it
    plane: str  # whose response shows it most


@dataclass(frozen=True, kw_only=True, eq=False)
class Resonances:
    """What passages show: resonances, and the synchronous response at constant speed that belongs to them."""

    resonances: tuple[Resonance, ...]  # by speed
    speed: Array  # (n,), rad/s, a grid over the range
    response: Complex  # (n, n_roles), to unbalance and what run-out does, of the longest way, m
    roles: tuple[str, ...]
    misfit: float  # mean square of the residuals over their variance
    warnings: tuple[str, ...] = ()


def resonances(passages: Sequence[Passage]) -> Resonances:
    """Return the resonances of passages of one machine, up or down, by as many modes as the data ask for."""
    passages = [way for p in passages for way in p.ways]
    courses, fewest = [Course.of(p) for p in passages], min((p.speed.size for p in passages), default=0)
    if fewest < _BLOCKS:
        raise EstimationError(
            f"a run-up has {fewest} blocks of whole turns; resonances need {_BLOCKS}. Run up more slowly, or further"
        )
    fit = fitted(courses, np.zeros(0, dtype=np.complex128))
    while fit.poles.size < min(_MODES, fewest // _BLOCKS * 2):
        more = with_another(fit)
        numbers = 3 + 4 * sum(c.amplitude.shape[1] for c in courses)
        narrow = [int(np.sum(-p.real < _SMOOTH * np.abs(p))) for p in (fit.poles, more.poles)]
        each = np.log(fit.size) if narrow[1] > narrow[0] else _WORTH  # noise looks like narrow ones more often
        if fit.cost - more.cost < numbers * each * max(more.misfit, 1.0):
            break
        fit = more
    misfit, fit = fit.misfit, reweighted(fit)
    courses = list(fit.courses)
    first = int(np.argmax([c.speed.size for c in courses]))
    low, high = min(c.speed.min() for c in courses), max(c.speed.max() for c in courses)
    speed = _grid(fit.poles, float(low), float(high))
    response = fit.response(speed, first)
    draws = fit.drawn(np.random.default_rng(0), speed, _DRAWS, first)
    passage, modal, unsure = passages[first], [], []
    for r in np.argsort(np.abs(fit.poles)):
        if low <= np.abs(fit.poles[r]) <= high:
            one = _resonance(fit, int(r), passage, first, speed, response, draws)
            if one.damping.sd < _SEEN * one.damping.value and fit.blocks(int(r)) > _RESOLVED:
                modal.append(one)
            elif one.damping.value < _SMOOTH:
                unsure.append(one)
    warnings = tuple(_warnings(fit.poles.size, misfit, passages, unsure))
    return Resonances(
        resonances=tuple(modal), speed=speed, response=response, roles=passage.roles, misfit=misfit, warnings=warnings
    )


def _grid(poles: Complex, low: float, high: float) -> Array:
    """Return speeds over the range, closer around the poles."""
    near = [abs(s) + side * width * abs(s.real) for s in poles for side in (-1, 1) for width in np.linspace(0, 6, 61)]
    every = np.concatenate([np.linspace(low, high, _GRID), [x for x in near if low < x < high]])
    return np.asarray(np.unique(every))


def _majors(passage: Passage, response: Complex) -> dict[str, Array]:
    """Return the orbit's half major axis of each plane by its response, of a single axis its amplitude."""
    none = np.zeros((response.shape[0], 2))
    of_planes = {
        name: whirl_of(response[:, [x, y]], none, reverse=passage.reverse).major for name, x, y in passage.planes
    }
    paired = {k for _, x, y in passage.planes for k in (x, y)}
    return of_planes | {role: np.abs(response[:, k]) for k, role in enumerate(passage.roles) if k not in paired}


def _resonance(
    fit: ModalFit, r: int, passage: Passage, course: int, speed: Array, response: Complex, draws: list[Complex]
) -> Resonance:
    """Return what is known of one pole."""
    s, residues = complex(fit.poles[r]), fit.weights[course][r]
    own = fit.covariance[3 * r : 3 * r + 2, 3 * r : 3 * r + 2]
    size = abs(s)
    along = np.array([s.real, s.imag]) / size  # |s| by real and imaginary part
    across = np.array([-1.0 / size + s.real**2 / size**3, s.real * s.imag / size**3])  # -Re s/|s|
    frequency = EstimatedNumber.of(size, float(np.sqrt(along @ own @ along)))
    damping = EstimatedNumber.of(-s.real / size, float(np.sqrt(across @ own @ across)))
    part = _majors(passage, residues[None, :])
    plane = max(part, key=lambda name: float(part[name][0]))
    wide = max(_NEAR, _WIDTHS * damping.value) * size

    def close(curve: Array, x: Array) -> list[Peak]:
        return sorted((p for p in peaks(x, curve) if abs(p.speed - size) < wide), key=lambda p: abs(p.speed - size))

    def near(curve: Array, x: Array) -> Peak | None:
        return next(iter(close(curve, x)), None)

    peak = near(_majors(passage, response)[plane], speed)
    others = [near(_majors(passage, y)[plane], speed) for y in draws]
    at, factor, by_points = frequency, _inverse(damping), False
    if peak is not None:
        at = EstimatedNumber.of(peak.speed, float(np.std([p.speed for p in others if p is not None])))
        factors = [p.amplification for p in others if p is not None and p.amplification is not None]
        if peak.amplification is not None and len(factors) > 0.9 * len(draws):
            factor, by_points = EstimatedNumber.of(peak.amplification, float(np.std(factors))), True
    if not by_points and damping.value > _DAMPED:
        at, factor, frequency, damping = (replace(v, identifiable=False) for v in (at, factor, frequency, damping))
    x, y = (np.array([residues[p[k]] for p in passage.planes]) for k in (1, 2))
    y = -y if passage.reverse else y
    forward, backward = float(np.sum(np.abs(x + 1j * y) ** 2)), float(np.sum(np.abs(x - 1j * y) ** 2))
    passed = close(_majors(passage, passage.amplitude)[plane], passage.speed)  # noise may split its top
    return Resonance(
        speed=at, amplification=factor, half_power=by_points, critically_damped=factor.value < CRITICALLY_DAMPED,
        frequency=frequency, damping=damping,
        forward=forward / (forward + backward) if passage.planes else None,
        measured=max(passed, key=lambda p: p.size, default=None), plane=plane,
    )  # fmt: skip


def _inverse(damping: EstimatedNumber) -> EstimatedNumber:
    """Return the amplification factor of a damping ratio."""
    return EstimatedNumber.of(0.5 / damping.value, 0.5 * damping.sd / damping.value**2)


def _warnings(modes: int, misfit: float, passages: Sequence[Passage], unsure: Sequence[Resonance]) -> list[str]:
    """Return what is doubtful of a fit."""
    warnings = [
        f"something narrow stands at {x.frequency.value / (2.0 * np.pi):.4g} Hz, whose damping the passage does not "
        "show: hum, or a mode that was passed too fast. It is left out; run through it more slowly"
        for x in unsure
    ]
    if misfit > _MISFIT:
        warnings.append(
            f"{modes} modes leave {misfit:.3g} times the noise of the synchronous response; the intervals "
            "are widened by that. Look at the run-up for what changes on the way"
        )
    if any(p.source == "speed" for p in passages):
        warnings.append(
            "the angle is the integral of the logged speed, whose error turns the phases; log the angle or pulses once "
            "a revolution"
        )
    return warnings


# --- margins ----------------------------------------------------------------------------------------------------------


def required_separation(amplification: float, *, above: bool) -> float:
    """Return how far a critical speed has to be from the operating speed that it is near, below the operating range or
    above it, over that speed; 0 of a critically damped mode.
    """
    if amplification < CRITICALLY_DAMPED:
        return 0.0
    base, most = (0.10, 0.26) if above else (0.0, 0.16)
    return min(base + 0.17 * (1.0 - 1.0 / (amplification - 1.5)), most)


@dataclass(frozen=True, slots=True, kw_only=True)
class Separation:
    """Where a resonance stands beside the operating speeds."""

    resonance: Resonance
    actual: float  # distance over the operating speed that is near; 0 within the range
    required: float
    required_most: float  # by the upper end of the interval of the amplification factor
    passed: bool  # the lower end of the actual one is at least that
    sd: float  # of the actual one


def separations(resonances: Sequence[Resonance], operating: tuple[float, float]) -> tuple[Separation, ...]:
    """Return the margin of each resonance to the lowest and highest operating speed, rad/s."""
    margins, (low, high) = [], operating
    for one in resonances:
        at, above = one.speed, one.speed.value > high
        near = high if above else low
        actual = 0.0 if low <= at.value <= high else abs(at.value - near) / near
        factor = one.amplification
        required, most = (required_separation(x, above=above) for x in (factor.value, factor.ci95[1]))
        sd = at.sd / near
        margins.append(
            Separation(
                resonance=one, actual=actual, required=required, required_most=most, sd=sd,
                passed=most == 0.0 or actual - NORMAL_95 * sd >= most,  # 0: critically damped for sure
            )
        )  # fmt: skip
    return tuple(margins)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scaled:
    """A measured response to unbalance, multiplied so that it reaches a limit in the operating range."""

    factor: float
    at: float  # speed in the operating range at which it reaches the limit, rad/s
    largest: float  # zero to peak over all speeds, scaled, m
    largest_at: float  # rad/s
    passed: bool


def scaled_to_limit(speed: Array, size: Array, operating: tuple[float, float], limit: float, room: float) -> Scaled:
    """Scale a response (n,), zero to peak in m, so that its largest in the operating range is `limit`, by a factor from
    1 to 6, and compare its largest at any speed with `room`.
    """
    inside = (speed >= operating[0]) & (speed <= operating[1])
    if not inside.any():
        rpm = 30.0 / np.pi
        raise EstimationError(
            f"the passage has no speed between {operating[0] * rpm:.5g} and {operating[1] * rpm:.5g} rpm; the response "
            "is scaled there. Run up to the operating speed"
        )
    k, top = int(np.argmax(np.where(inside, size, -np.inf))), int(np.argmax(size))
    factor = float(np.clip(limit / size[k], *SCALING))
    largest, at, largest_at = factor * float(size[top]), float(speed[k]), float(speed[top])
    return Scaled(factor=factor, at=at, largest=largest, largest_at=largest_at, passed=largest <= room)
