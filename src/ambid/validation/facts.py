"""What a record says of a bench by itself, without any fit: means, weight, belonging, sampling, the log.

Each fact is compared with the estimate in standard deviations of both; a contradiction is a check with its cause.

- Means: at rest on average V = R i, so that R = mean V / mean i where the current keeps its sign (theory.md sec. 1).
- Belonging: position and current of one run are related beyond chance. Slow signals always look alike, so that each is
  whitened by its own past first; n times the sum of squared cross-correlations at 2M + 1 lags is then chi-squared if
  they have nothing to do with each other (Haugh 1976).
- Sampling: a coil whose time constant L/R is shorter than a sample shows its resistance and no inductance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.uncertainty import Uncertainty, farthest
from ambid.estimation.calibration import explaining, lines_of
from ambid.estimation.estimate import Check
from ambid.estimation.likelihood import Fit, Freed, evaluate, workspace_near
from ambid.estimation.uncertainty import chi_squared_tail, natural_sizes
from ambid.record import Record
from ambid.rig import Rig
from ambid.signals.faults import Dropouts, Saturation, find_dropouts, find_outliers, find_saturation, resolution

_FAR = 2.0  # standard deviations between R and the means, whose offsets are allowed for generously
_FURTHER = 4.0  # and below zero, from which the means alone contradict a coil
_OFFSET = 0.005  # of a channel's largest value: its offset (sd), where the rig says nothing
_ONE_SIDED = 0.02  # part of a current's largest value that may lie beyond zero
_STAGE = 0.1  # of the mean voltage that a power stage may drop or add
_SHARP, _OFFSETS = 0.02, 0.5  # R known so well (sd over R) and so far from the means is not of the same mean current
_BLOCKS = 30  # stretches whose means show the scatter of a mean
_PAST, _LAGS = 20, 40  # samples that whiten a signal, and between which two are compared
_ENOUGH, _LONGEST = 4 * (_PAST + _LAGS), 40_000  # samples that are compared, at least and at most
_CHANCE = 1e-3  # probability above which a relation may be chance
_SHOWN = 3.0  # standard deviations of k_i above which current and position belong together, of L current and voltage
_STEPS = 0.1  # part of the samples in which a voltage stands that is made of steps
_STILL = 4  # samples in which no channel changes: the log stood still
GRAVITY = 9.81  # m/s^2
_FURTHEST = 1.0  # m, from zero that a position sensor can be
_TOP = 0.2  # part of the voltage's power in the top octave, from which it may change between samples
_SAYS, _ORDER = 0.25, 6  # part of the current's next change that a logged voltage says at least, from six samples
_NEAR_ENOUGH, _PARABOLA = 2.5, 2.0  # sd between weight and estimate, and rise of the criterion over that of a parabola
_LAW = 0.01  # part of a force that may not grow as the square of the current
_PER_COIL = 2.0  # samples in a coil's time constant below which its inductance is hardly seen
_ERRONEOUS = 5e-4  # part of the samples that may be outliers or drop-outs
_SATURATED = 0.005  # part of the samples at a limit that a check lets pass
_MISSING = {  # what a channel at its limits does to the parameters; measured on simulated benches, docs/checks.md
    "voltage": "R and L come out too small if the coil's voltage went on, too large if the log is a command that the "
    "amplifier did not follow; what it really limits does no harm",
    "current": "without its peaks R, L and k_i come out too large",
    "position": "without its peaks m comes out too large, and k_x wrong",
}
_COARSE = 0.4  # part of the innovations' variance that steps of a converter make up


def one_sided(current: Array) -> bool:
    """Return whether a current keeps its sign, but for what an offset may do."""
    low, high = sorted((float(current.min()), float(current.max())), key=abs)
    return low * high > 0 or abs(low) <= _ONE_SIDED * abs(high) != 0.0


def mean_resistance(record: Record, rig: Rig | None = None) -> tuple[float, float] | None:
    """Return mean voltage over mean current with its standard deviation, ohm; None where the current has both signs.

    The deviation holds the scatter of means of stretches, and offsets of both channels: of sd as the rig says, else
    0.5 % of each channel's largest value.
    """
    v, i = record["voltage"].values, record["current"].values
    if not one_sided(i) or abs(i.mean()) <= float(i.std()):
        return None
    ratio = float(v.mean() / i.mean())
    length = max(1, len(v) // _BLOCKS)
    rest = (v - ratio * i)[: len(v) // length * length].reshape(-1, length).mean(axis=1)
    scatter = float(rest.std(ddof=1)) / np.sqrt(rest.size) if rest.size > 1 else float(np.abs(v).max())
    volts, amperes = (offset_sd(record, role, rig) for role in ("voltage", "current"))
    return ratio, float(np.sqrt(scatter**2 + volts**2 + (ratio * amperes) ** 2) / abs(i.mean()))


def offset_sd(record: Record, role: str, rig: Rig | None) -> float:
    """Return how well the zero of a channel is known, SI: as the rig says, else to 0.5 % of its largest value."""
    said = None if rig is None else rig.channel(role).offset_sd
    return _OFFSET * float(np.abs(record[role].values).max()) if said is None else said


def facts(record: Record, rig: Rig | None = None, *, belongs: bool = False, coil: bool = False) -> dict[str, Check]:
    """Return what the record says by itself, channels named by role; a check that fails names a cause. `rig`: for the
    offsets of its channels; `belongs`, `coil`: whether all channels, or current and voltage, are known to.
    """
    roles = set(record.names)
    checks: dict[str, Check] = {}
    if {"voltage", "current"} <= roles:
        checks["ohm"] = means_check(record, rig)
    if {"position", "current"} <= roles:
        known_pair = Check(passed=True, detail="position and current are of one run: the force shows")
        checks["belonging"] = known_pair if belongs else belonging(record, coil=coil)
        checks["weight"] = _weight(record["current"].values)
    if "position" in roles:
        checks["position_size"] = _position_size(record["position"].values)
    checks["log_runs"] = _log_runs(record)
    return checks


def means_check(record: Record, rig: Rig | None) -> Check:
    """Check that mean voltage over mean current is none that a coil cannot have."""
    known = mean_resistance(record, rig)
    if known is None:
        return Check(passed=True, detail="voltage and current have no mean that shows R")
    (value, sd), text = known, _ohms(*known)
    negative = value < -_FURTHER * sd
    if negative:
        text += (
            ", and no coil's is negative: one of the two is reversed, or reads far from zero at rest, or is no voltage"
        )
    return Check(passed=not negative, detail=text, values={"value": value, "sd": sd}, cause="ohm" if negative else "")


def _ohms(value: float, sd: float) -> str:
    return f"mean voltage over mean current is {value:.4g} ± {sd:.2g} ohm, if neither has a larger offset"


def belonging(record: Record, *, coil: bool = False) -> Check:
    """Check that each of position, current and voltage is related to another of them beyond chance; of the latter two
    it may be known that one `coil` has both.
    """
    if record.n_samples < _ENOUGH:
        detail = f"whether position and current are of one run was not tested: less than {_ENOUGH} samples"
        return Check(passed=True, detail=detail)
    names = [name for name in ("position", "current", "voltage") if name in record.names]
    white = {name: _whitened(record[name].values[:_LONGEST]) for name in names}
    pairs = {pair: _chance(*(white[name] for name in pair)) for pair in combinations(names, 2)}
    pairs |= {("current", "voltage"): 0.0} if coil else {}
    chance = {name: min(p for pair, p in pairs.items() if name in pair) for name in names}
    alone = max(names, key=lambda name: chance[name])
    passed = chance[alone] <= _CHANCE
    others = " or ".join(name for name in names if name != alone)
    return Check(
        passed=passed, p=chance[alone], cause="" if passed else "belonging",
        detail="position and current are of one run: they are related beyond chance" if passed
        else f"nothing relates the {alone} to {others}, at any lag up to {_LAGS} samples: channels of "
        "different runs, or shifted against each other. Take all columns from one run",
    )  # fmt: skip


def _chance(x: Array, y: Array) -> float:
    """Probability that two whitened signals are related as much by chance."""
    size = float(np.sqrt((x @ x) * (y @ y)))
    if not size > 0.0:
        return 1.0
    both = np.fft.irfft(np.fft.rfft(x, 2 * x.size) * np.conj(np.fft.rfft(y, 2 * x.size))) / size
    r = np.concatenate([both[-_LAGS:], both[: _LAGS + 1]])
    return chi_squared_tail(r.size, x.size * float(r @ r))


def _whitened(x: Array) -> Array:
    """Return what a signal's own past does not say of it, in units of its spread, without glitches."""
    x = (x - x.mean()) / max(float(x.std()), 1e-300)
    rows = np.column_stack([x[_PAST - k : x.size - k] for k in range(_PAST + 1)])
    gram = rows.T @ rows
    past = np.linalg.lstsq(gram[1:, 1:], gram[1:, 0], rcond=1e-10)[0]
    rest = rows[:, 0] - rows[:, 1:] @ past
    reach = 12.0 * float(np.median(np.abs(rest)))
    return np.asarray(np.clip(rest, -reach, reach) if reach > 0.0 else rest)


def _weight(current: Array) -> Check:
    i0 = float(current.mean())
    if not one_sided(current):
        return Check(
            passed=True, detail="the current has both signs: it does not tell of one magnet that carries a weight"
        )
    return Check(
        passed=True, values={"k_i_over_m": -2.0 * GRAVITY / i0},
        detail=f"if one magnet carries the weight, k_i/m is -2 g/i0 = {-2.0 * GRAVITY / i0:.4g} N/(A kg)",
    )  # fmt: skip


def _position_size(x: Array) -> Check:
    far = float(np.abs(x).max())
    return Check(
        passed=far <= _FURTHEST, values={"largest": far}, cause="" if far <= _FURTHEST else "unit",
        detail=f"the position reaches {far:.3g} m" if far <= _FURTHEST
        else f"the position reaches {far:.3g} m, which no bearing has. Correct the unit of its column",
    )  # fmt: skip


def _log_runs(record: Record) -> Check:
    """Check that there are no stretches in which no channel changes: the log stood still, and time went on."""
    still = np.ones(record.n_samples - 1, dtype=bool)
    for channel in record.channels:
        if np.ptp(channel.values) > 0:
            still &= np.diff(channel.values) == 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.view(np.int8), [0]])))
    runs = [(a, b - a) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True) if b - a >= _STILL]
    moving = 1.0 - float(still.mean())
    if not runs or moving < 0.5 or _in_steps(record, still):  # slow signals of coarse steps stand still together
        return Check(passed=True, detail="no stretch in which the log stood still")
    first, longest = runs[0][0], max(length for _, length in runs) + 1
    at = record.start_s + first / record.rate_hz
    return Check(
        passed=False, cause="stuck", values={"stretches": float(len(runs)), "longest": float(longest)},
        detail=f"all channels stand still for up to {longest} samples, first at {at:.4g} s: the log stopped while the "
        "rotor went on. Cut the record there",
    )  # fmt: skip


def _in_steps(record: Record, still: NDArray[np.bool_]) -> bool:
    """Return whether the rotor is held and the voltage stands for samples on end also while the current moves."""
    return "position" not in record and float(np.mean(np.diff(record["voltage"].values)[~still] == 0.0)) > _STEPS


def agreements(
    record: Record,
    rig: Rig,
    theta: Mapping[str, float],
    sd: Mapping[str, float],
    alone: Mapping[str, float],
    freed: Freed | None = None,
) -> dict[str, Check]:
    """Compare the facts of a record with an estimate from it.

    `theta`, `sd`: parameters and their standard deviations, SI; `alone`: the latter under the model; `freed`: what
    `free_one` says of fixed ones. The weight has a check of its own, `ambid.validation.physical.gravity_balance`.
    """
    force, coil = (
        n in theta and abs(theta[n]) > _SHOWN * sd.get(n, np.inf) and rig.parameter(n).role == "free"
        for n in ("k_i", "L")
    )  # fmt: skip
    checks = {name: c for name, c in facts(record, rig, belongs=force, coil=coil).items() if name != "weight"}
    means = checks["ohm"].values if "ohm" in checks else {}
    if means:  # less what the flux took up from the first sample to the last
        i, rise = record["current"].values, 0.0
        for name, role in (("L", "current"), ("k_i", "position")):
            rise += theta[name] * float(np.subtract(*record[role].values[[-1, 0]])) if name in theta else 0.0
        value = means["value"] - rise * record.rate_hz / float(i.sum())
        gain, step = (freed or {}).get("R", (0.0, np.zeros(1)))
        shown = (theta["R"] + float(step[-1]), abs(float(step[-1])) / np.sqrt(gain)) if gain > 0.0 else None
        checks["ohm"] = ohm(record, theta["R"], alone.get("R", 0.0), value, means["sd"], shown=shown)
    return checks | ({"sampling": sampling(theta, sd, record.rate_hz)} if "L" in theta else {})


def between_samples(record: Record) -> bool:
    """Return whether the voltage may change between samples, where it is not logged.

    It has much power in the octave below half the rate, and says little of the next change of the current, beyond what
    the past of current and position says.
    """
    names = [name for name in ("voltage", "current", "position") if name in record]
    if "voltage" not in names:
        return False
    v, i, *x = (record[name].values[:_LONGEST] - record[name].values.mean() for name in names)
    power = np.abs(np.fft.rfft(v * np.hanning(v.size))) ** 2
    if power[power.size // 2 :].sum() < _TOP * power.sum():
        return False
    at = np.arange(_ORDER, i.size - 1)
    own = [s[at - k] for s in (i, *x) for k in range(4)]
    left = [_left(i[at + 1], np.column_stack(rows)) for rows in (own, [*own, *(v[at - k] for k in range(_ORDER))])]
    return left[1] > (1.0 - _SAYS) * left[0]


def _left(y: Array, rows: Array) -> float:
    rows = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    rest = y - rows @ np.linalg.lstsq(rows, y, rcond=1e-10)[0]
    return float(rest @ rest)


def ohm(
    record: Record, R: float, sd: float, mean: float, mean_sd: float, *, of: int = 1, offset: float = 0.0,
    shown: tuple[float, float] | None = None,
) -> Check:  # fmt: skip
    """Compare R with the means of a record, `mean` and its sd, ohm; one `of` several records: chance lets the farthest
    of all pass as often as a single one. `offset`: of the voltage, V, estimated beside R; where it explains the
    difference and is not larger than a stage's, both intervals have to hold that, `size`. Without `sd` R is the rig's,
    and the means contradict that, unless the record shows another (`shown`, with its sd) that is as far from them.
    """
    far = (R - mean) / float(np.hypot(sd, mean_sd))
    within = 2.0 * NormalDist().cdf(_FAR) - 1.0
    limit = NormalDist().inv_cdf(0.5 + 0.5 * within ** (1.0 / of))
    passed = abs(far) <= limit
    i0 = float(record["current"].values.mean())
    detail = f"{_ohms(mean, mean_sd)}; R is {R:.4g} ± {sd:.2g} ohm"
    seen, seen_sd = shown or (R, sd if sd > 0.0 else np.inf)
    if not passed and seen_sd < _SHARP * seen and abs(mean / seen - 1.0) > _OFFSETS and mean > -_FURTHER * mean_sd:
        passed, detail = True, f"{detail}: the means are those of offsets"
    apart = not passed
    left = far - offset / i0 / float(np.hypot(sd, mean_sd)) if i0 else far
    if apart and abs(left) <= limit and abs(mean / R - 1.0) < _STAGE:
        passed, detail = True, f"{detail}: the offset of the voltage explains it, and the intervals of both hold it"
    if not passed and sd == 0.0:
        detail += f", as the rig fixes it: {abs(far):.2g} sd apart. Measure R, and both channels at rest, or free R"
    elif not passed:
        detail += (
            f": {abs(far):.2g} sd apart. An offset of {(mean - R) * i0:+.2g} V or {i0 * (1.0 - mean / R):+.2g} A, or a "
            "coil that warms up, would explain it; else the model does not hold. Measure R, and both channels at rest"
        )
    return Check(
        passed=passed, detail=detail,
        values={"value": mean, "sd": mean_sd, "apart_sd": far, "current_offset": i0 * (1.0 - mean / R)},
        cause="" if passed else "ohm" if sd > 0.0 else "fixed_value", size=mean - R if apart else None,
        alternatives=() if passed or sd > 0.0 else ("ohm",),
    )  # fmt: skip


def sampling(theta: Mapping[str, float], sd: Mapping[str, float], rate_hz: float) -> Check:
    """Check that the coil is slower than the sampling, in samples of L/R at the upper end of L's interval."""
    R, L = theta["R"], theta["L"]
    if "L" not in sd:
        return Check(passed=True, detail="the inductance is given")
    seen = L / R * rate_hz if R > 0 else np.nan
    samples = (L + 2.0 * sd["L"]) / R * rate_hz if R > 0 else np.inf
    passed, low = samples >= _PER_COIL, max(samples, 0.1)
    size = f"is {seen:.2g}" if 2.0 * sd["L"] < L else f"is less than {low:.2g}"
    return Check(
        passed=passed, values={"samples": seen}, grave=samples < 1.0, cause="" if passed else "sampling",
        detail=f"the coil's time constant is {seen:.3g} samples long" if passed
        else f"sampled too slowly for the coil: L/R {size} samples, so that L is not seen. Sample at "
        f"{float(f'{rate_hz * 5.0 / low:.2g}'):.0f} Hz or more, or fix L",
    )  # fmt: skip


def informed(
    fit: Fit, rig: Rig, record: Record, facts: Mapping[str, Check], spread: Uncertainty, *, robust: bool
) -> tuple[Fit, Uncertainty, tuple[Array, Array] | None]:
    """Let facts tell of an estimate: what one contradicts is widened by how far apart they are, beside k_i all that
    would move with it, cov(θ, k_i)/var(k_i) times that; R and L by themselves where `sampling` may be the cause; the
    weight moves the estimate where the rig says that one magnet carries it and both agree, and then gain and h are
    given, (n,) each. `facts`: all checks.

    The weight says k_i - w m = 0 within a part s of k_i (of the law, the current's zero, as wrong as the means say, and
    what its check counts), h = (1, -w)/(w m) over k_i and m; with covariance P of the estimate, the gain is
    P h / (hᵀ P h + s²). The move has to be one in which the criterion is a parabola.
    """
    theta, names, n = fit.problem.parameters(fit.vector), spread.names, len(spread.names)
    weight, covariance, moves = facts.get("gravity_balance"), spread.covariance(robust=robust), list[Array]()
    if "R" in names and not facts["ohm"].passed:  # an offset explains it as well, and leaves the others
        moves.append((facts["ohm"].size or 0.0) * np.eye(n)[names.index("R")])
    if weight is not None and not weight.passed and "k_i" in names:
        j, far = names.index("k_i"), weight.values["expected"] - weight.values["k_i_over_m"]
        slope = np.array([(name == "k_i") / theta["k_i"] - (name == "m") / theta["m"] for name in names])
        scales = explaining(
            rig, fit.problem.model, theta, names, spread.information, [lines_of(fit)], slope,
            1.0 - weight.values["expected"] / weight.values["k_i_over_m"], own={"current": -1.0},
        )  # fmt: skip
        own = far * theta["m"] * covariance[j] / covariance[j, j]
        moves.append(farthest([own, *(-moved for _, moved in scales.values())]))
    named = facts.get("causes")
    if named is not None and not named.passed and "sampling" in (named.cause, *named.alternatives):
        moves += [theta[name] * np.eye(n)[names.index(name)] for name in ("R", "L") if name in names]
    spread = replace(spread, apart=np.array(moves).reshape(-1, n))
    single = rig.magnet is not None and rig.magnet.kind == "single"
    if weight is None or not (weight.passed and single) or "k_i" not in names:
        return fit, spread, None
    expected, covariance = weight.values["expected"], spread.covariance(robust=robust)
    slope = np.array([(name == "k_i") / (expected * theta["m"]) - (name == "m") / theta["m"] for name in names])
    seen = 0.0 if facts["ohm"].passed else facts["ohm"].values["current_offset"]
    zero = max(offset_sd(record, "current", rig), abs(seen)) / float(record["current"].values.mean())
    sd = float(np.linalg.norm([weight.values["expected_sd"] / expected, _LAW, zero]))
    off, total = 1.0 - weight.values["k_i_over_m"] / expected, float(slope @ covariance @ slope + sd**2)
    gain, vector = covariance @ slope / total, fit.vector.copy()
    step = gain * off / fit.problem.magnitude
    vector[:n] += step
    predicted = float(step @ np.linalg.pinv(spread.information / np.outer(*(fit.problem.magnitude,) * 2)) @ step)
    rise = evaluate(fit.problem, vector, workspace_near(fit, fit.problem))[0] - fit.criterion
    if abs(off) > _NEAR_ENOUGH * np.sqrt(total) or not rise < _PARABOLA * predicted + 1.0:
        return fit, spread, None
    moved = fit.problem.parameters(vector)
    scale = natural_sizes(names, moved, fit.problem.model.references(moved))
    return replace(fit, vector=vector), spread.weighed(gain, slope, sd, scale), (gain, slope)


def signal_checks(record: Record, outputs: tuple[str, ...]) -> dict[str, Check]:
    """Check ``within_limits`` and ``signals_sound`` of a record whose channels are named by role."""
    limits = {c.name: find_saturation(record, c.name) for c in record.channels}
    return {"within_limits": _within_limits(limits), "signals_sound": _signals_sound(record, outputs, limits)}


def _within_limits(saturations: Mapping[str, Saturation]) -> Check:
    bad = {name: s for name, s in saturations.items() if s.fraction > _SATURATED}
    detail = ". ".join(f"{s}{': ' + _MISSING[name] if name in _MISSING else ''}" for name, s in bad.items())
    return Check(
        passed=not bad,
        values={f"{name}_fraction": s.fraction for name, s in saturations.items()},
        detail=f"{detail}. Reduce the excitation, or cut those parts out" if bad else "no saturation",
    )


def _signals_sound(record: Record, outputs: tuple[str, ...], limits: Mapping[str, Saturation]) -> Check:
    """Outliers and drop-outs of the measured outputs; an input may rightly stand still or kick."""
    faults = [
        (role, fault)
        for role in outputs
        for fault in (find_outliers(record, role), find_dropouts(record, role, saturation=limits[role]))
    ]
    some = [f"{role}: {f}" for role, f in faults if f.count]
    most = max(faults, key=lambda fault: fault[1].count)[1]
    few = max(f.count for _, f in faults) <= _ERRONEOUS * record.n_samples
    return Check(
        passed=few,
        cause="" if few else "stuck" if isinstance(most, Dropouts) else "spikes",
        values={f"{role}_{type(f).__name__.lower()}": float(f.count) for role, f in faults},
        detail=f"{'; '.join(some)}. They were used unchanged; replace them (signals.replace_samples) or cut them out"
        if some
        else "no outliers or drop-outs in the measured outputs",
    )


def resolution_check(record: Record, variance: Mapping[str, float]) -> Check:
    """Check that the steps of the converters are small beside the innovations, of a `variance` by role."""
    text, worst = "", 0.0
    for role, own in variance.items():
        step = resolution(record, role).step
        part = step**2 / 12.0 / own
        if part > max(worst, _COARSE):
            worst = float(part)
            unit = record[role].unit
            text = (
                f"the steps of the {role}, {step:.3g} {unit}, make up {100.0 * min(part, 1.0):.2g} % of its innovations"
            )
    return Check(
        passed=not text, values={"part": worst}, cause="quantisation" if text else "",
        detail=f"{text}, and are no white noise. Use a finer range, or excite more" if text
        else "the steps of the converters are small beside the innovations",
    )  # fmt: skip
