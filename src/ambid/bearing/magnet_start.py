"""Where the search for a nonlinear bearing begins.

R, L, delay and an unknown mass from the linear grey box near one point; for one magnet that carries a weight i(x) at
rest, a line for the hyperbolic law, i = (x + s) sqrt(2 m g/k), and for the exponential, 2 ln i = ln(2 m g zeta/L_g) +
x/zeta; for a pair k_i = 2 k i0/s^2 and k_x = -2 k i0^2/s^3 (theory.md sec. 1, k = 2 k' cos(alpha)).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.bearing.linear import greybox
from ambid.bearing.magnet_likelihood import criterion
from ambid.bearing.magnet_problem import BODY, LEVELS, SIGNED, BearingProblem, BearingRecord, Number
from ambid.bearing.multistart import Signals
from ambid.bearing.rescue import EVALUATIONS as LINEAR_EVALUATIONS
from ambid.bearing.uncertainty import uncertainty
from ambid.errors import EstimationError
from ambid.estimation.likelihood import Fit
from ambid.estimation.predictor import noise_floor
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.linear_model import OneAxis, Parameter

_FIXED = frozenset({"c", "g", "a", "i_offset", "v_drop", "i_drop", "tau"})  # unless they are named
_ROUND = 0.02  # of the largest current: over which the drop of a stage changes its sign, where nothing is said
_TAU = 0.01  # of a record: time constant of a drifting force, at first
_LINEAR = 8192  # samples for the linear estimate
_SHORTEST = 500  # samples of one of its parts
_WINDOW_S = 0.1  # over which forces are taken to balance
_SIGNIFICANT = 4.0  # standard deviations from which the sign of k_i in the linear estimate speaks against the columns
_FORCE, _VOLTAGE = (1e-3, 1e-2, 1e-1), (0.03, 0.3)  # noise levels tried, over what the sensors would show as such


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearStart:
    """The linear estimate at one operating point."""

    values: Mapping[str, float]  # m, k_x, k_i, R, L, c; SI
    delay: float  # in samples


def linear_start(
    record: BearingRecord, known: Mapping[str, Parameter], delay: float | None, law: MagnetLaw
) -> LinearStart:
    """Run the linear grey box on (the first part of) a record of a free rotor; `known`: what is known of m, R and c;
    `delay`: in samples; None: searched.
    """
    model, wrong_signs, doubtful = OneAxis(), list[float](), list[LinearStart]()
    parameters = [
        known.get(p.name, Parameter(name=p.name, unit=p.unit, role="fixed", value=0.0))
        if p.name in ("m", "R", "c")
        else Parameter(name=p.name, unit=p.unit)
        for p in model.parameters
    ]
    parts = _stretches(record)
    for (first, last), evaluations in [*((part, 0) for part in parts), (parts[0], LINEAR_EVALUATIONS)]:
        if evaluations and wrong_signs:
            break  # what was found speaks against the signs, not against the start values
        part = Signals(u=record.u[first:last, None], y=record.y[first:last], rate_hz=record.rate_hz)
        try:
            fit = greybox(model, part, parameters, delay="auto" if delay is None else delay, noise="levels",
                          evaluations=evaluations)  # fmt: skip
        except ValueError:  # SciPy's, where a search steps to the edge of what has a predictor
            continue
        except EstimationError:
            if evaluations:
                raise
            continue
        if fit.status == "failed":
            continue
        values = fit.problem.parameters(fit.vector)
        if (values["k_i"] > 0) == law.pair:
            return LinearStart(values=values, delay=fit.problem.delay_samples(fit.vector))
        if _significant(fit):
            wrong_signs.append(values["k_i"])
        else:  # lost in the noise: no more than a size to begin with
            turned = {**values, "k_i": -values["k_i"], "k_x": -abs(values["k_x"])}
            doubtful.append(LinearStart(values=turned, delay=fit.problem.delay_samples(fit.vector)))
    if doubtful:  # where the sign is turned, every part says so
        return doubtful[0]
    if not wrong_signs:
        raise EstimationError(f"record {record.name}: no linear model to start from. Check columns and signs")
    sign = "positive: with a pair the force grows with the current" if law.pair else "negative: position is the gap"
    raise EstimationError(
        f"record {record.name}: the linear model finds k_i = {wrong_signs[0]:.3g} N/A; it must be {sign}, and "
        "grows away from a single magnet. Turn the sign of position or current in the rig, or choose the magnet"
    )


def _significant(fit: Fit) -> bool:
    """Whether a linear estimate knows the sign of k_i."""
    if fit.status != "converged":
        return False
    spread, values = uncertainty(fit), fit.problem.parameters(fit.vector)
    sd = spread.standard_deviations(robust=True)[spread.names.index("k_i")]
    return bool(abs(values["k_i"]) > _SIGNIFICANT * sd)


def _stretches(record: BearingRecord) -> list[tuple[int, int]]:
    """Where a linear model is looked for: the longest sound part; parts of that, where it moves too far for one."""
    broken = np.flatnonzero(~np.all(record.valid, axis=1))
    edges = np.concatenate([[-1], broken, [record.u.size]])
    longest = int(np.argmax(np.diff(edges)))
    first = int(edges[longest]) + 1
    last = int(min(edges[longest + 1], first + _LINEAR))
    stretches = [(first, last)]
    for share in (2, 4):
        size = (last - first) // share
        if size >= _SHORTEST:
            stretches += [(first + k * size, first + (k + 1) * size) for k in (0, share - 1)]
    return stretches


def balance(records: Sequence[BearingRecord], law: MagnetLaw, weight: float) -> tuple[float, float]:
    """Find `strength, length` of a single magnet that carries `weight` (m g in N, positive) from means over short
    windows of free-rotor records: k in N m^2/A^2 and s in m, or L_g in H and zeta in m.
    """
    x, i = [], []
    for record in records:
        width = max(4, round(_WINDOW_S * record.rate_hz))
        count = record.u.size // width
        both = record.y[: count * width].reshape(count, width, 2)
        sound = np.all(record.valid[: count * width].reshape(count, -1), axis=1)
        x += both[sound].mean(axis=1)[:, 0].tolist()
        i += both[sound].mean(axis=1)[:, 1].tolist()
    gap, current = np.array(x), np.array(i)
    use = current > 0.2 * np.median(current)
    gap, current = gap[use], current[use]
    value = 2.0 * np.log(current) if law.gap == "exponential" else current
    slope, constant = np.polyfit(gap, value, 1) if np.ptp(gap) > 0 else (0.0, 0.0)
    if not slope > 0:
        raise EstimationError(
            "the current that carries the weight does not grow with the distance over these records. Record at "
            "several positions, or check the sign of the position"
        )
    if law.gap == "exponential":
        return 2.0 * weight / slope * float(np.exp(-constant)), 1.0 / float(slope)
    return 2.0 * weight / float(slope) ** 2, float(constant / slope)


def start_numbers(
    law: MagnetLaw, rig: Mapping[str, Parameter], records: Sequence[BearingRecord], linear: LinearStart
) -> tuple[Number, ...]:
    """Put start values and roles together, in the order of the law's names and `BODY`; what `rig` does not name takes
    the law's default role.
    """
    lin, free = linear.values, [r for r in records if not r.held]
    position, current = np.concatenate([r.kept for r in free]).T
    mass = rig["m"].value if "m" in rig and rig["m"].value is not None else lin["m"]
    gravity = rig["g"].value if "g" in rig and rig["g"].value is not None else 0.0 if law.pair else 9.81
    guess = {
        **lin,
        "m": mass,
        "g": gravity,
        "a": 2.0 * np.pi * 200.0,
        "tau": _TAU * min(r.u.size / r.rate_hz for r in free),
        "sigma": 0.05 / np.max(current**2),
    }
    guess |= dict.fromkeys(("x_offset", "i_offset", "v_offset", "v_drop", "k_asym", "i0_asym"), 0.0)
    guess |= {"i_drop": _ROUND * float(np.max(np.abs(current))), "c": 1e-3 * np.sqrt(mass * abs(lin["k_x"]))}
    if law.pair:
        i0 = rig["i0"].value if "i0" in rig else None
        guess["i0"] = 1.5 * float(np.max(np.abs(current))) if i0 is None else i0
        wide = 1.1 * float(np.max(np.abs(position)))
        guess["s"] = max(guess["i0"] * lin["k_i"] / max(-lin["k_x"], 1e-12), wide) if lin["k_x"] < 0 else 2 * wide
        guess["k"] = lin["k_i"] * guess["s"] ** 2 / (2.0 * guess["i0"])
        own = 2.0 * guess["k"] / guess["s"]
    else:
        first, second = law.names[:2]
        guess[first], guess[second] = balance(free, law, mass * gravity)
        x = float(position.mean())
        own = guess[first] * np.exp(-x / guess[second]) if law.gap == "exponential" else guess[first] / (guess["s"] + x)
        guess["i0"] = 0.0
    leak = max(lin["L"] - own, 0.1 * lin["L"])
    typical = float(np.sqrt(np.mean(current**2)))
    guess |= {"L_leak": leak, "L_rise": 0.3 * leak, "i_knee": 0.5 * typical}
    magnitude = {
        "g": 9.81,
        "s": 0.1 * float(np.mean(np.abs(position))),
        "x_offset": float(np.std(position)),
        "i_offset": 0.1 * typical,
        "i0_asym": 0.1 * typical,
        "k_asym": 0.1,
        "v_drop": 0.1 * float(np.std(free[0].u)),
    }
    magnitude["v_offset"] = 0.1 * float(np.std(free[0].u))
    if "i_drop" not in rig and "v_drop" in rig and rig["v_drop"].role != "fixed":
        rig = {
            **rig,
            "i_drop": Parameter(name="i_drop", unit="A"),
        }  # a width that is wrong makes the drop wrong
    return tuple(
        _number(name, rig.get(name), guess[name], law, magnitude.get(name, 1.0)) for name in (*law.names, *BODY)
    )


def _number(name: str, parameter: Parameter | None, guess: float, law: MagnetLaw, magnitude: float) -> Number:
    """One number: as the user says, else free where the law has it."""
    signed = name in SIGNED or (name == "s" and not law.pair)
    has = {"sigma": law.saturation, "L_rise": law.rise, "i_knee": law.rise, "i0": law.pair}
    has |= dict.fromkeys(("k_asym", "i0_asym"), law.asymmetric)
    if not has.get(name, True):
        return Number(name=name, value=1.0 if name == "i_knee" else 0.0, estimated=False)
    if parameter is None:
        estimated = name not in _FIXED and not (name == "x_offset" and not law.pair)
        value = guess if estimated or name in ("g", "a", "i_drop", "tau") else 0.0
        return Number(name=name, value=value, estimated=estimated, signed=signed, magnitude=magnitude)
    value = guess if parameter.value is None else parameter.value
    if parameter.role != "fixed" and not signed and not value > 0.0:
        value = abs(guess) or 1.0
    sd = np.inf if parameter.sd is None else parameter.sd
    return Number(
        name=name, value=value, estimated=parameter.role != "fixed", prior_sd=sd, signed=signed, magnitude=magnitude
    )


def with_noise(problem: BearingProblem, values: Mapping[str, float]) -> BearingProblem:
    """Choose start levels of the noise: what the sensors' roughness says, and process noise by the criterion; m in kg,
    L in H.
    """
    centre = np.zeros((len(problem.records), len(LEVELS)))
    for r, record in enumerate(problem.records):
        first, end = max(record.parts, key=lambda part: part[1] - part[0])
        floor = np.log(noise_floor(record.y[first:end]))
        alone = replace(problem, records=(record,), noise_center=centre[r : r + 1])
        best = np.inf
        for f in _FORCE if not record.held else _FORCE[:1]:
            for v in _VOLTAGE:
                rate = record.rate_hz
                force, volt = values["m"] * rate**2 * f, values["L"] * rate * v
                own = floor + np.log([force, volt])
                trial = np.concatenate([floor, own, own - np.log(30.0)])
                alone = replace(alone, noise_center=trial[None, :])
                value = criterion(alone, alone.start())
                if value < best or best == np.inf:
                    best, centre[r] = min(value, best), trial
    return replace(problem, noise_center=centre)
