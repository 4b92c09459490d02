"""A nonlinear bearing on a record: its predictor run again, and judged where nothing is fitted any more."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ambid.arrays import Array
from ambid.bearing.columns import check_lag
from ambid.bearing.magnet_likelihood import BearingFit, BearingUncertainty, run, search, sweep, uncertainty
from ambid.bearing.magnet_problem import BODY, LEVELS, SIGNED, BearingProblem, BearingRecord, Number, weight_carried
from ambid.bearing.magnet_result import NonlinearBearingEstimate
from ambid.bearing.multistart import Signals
from ambid.errors import EstimationError, counted
from ambid.estimation.estimate import Check
from ambid.estimation.linear import triangle_of
from ambid.record import Record
from ambid.rig import Rig
from ambid.validation.facts import facts, ohm, resolution_check, sampling, signal_checks
from ambid.validation.physical import Agreement
from ambid.validation.residuals import (
    P_LEAST,
    ResidualTest,
    fit_of,
    joint_triangle,
    score_of,
    uncorrelated_check,
    white_check,
)
from ambid.validation.second_record import conclude, consistency_check

_ROLES = ("position", "current")
_STAGE = ("v_offset", "v_drop", "i_offset")  # numbers that move the means of voltage and current
_NEUTRAL = {"i_knee": 1.0, "a": 1.0, "i_drop": 1.0, "tau": 1e9}  # of a number that does not act; 0 for the others
_LAGS = (1, 2, 3, 5, 8, 13)
_INPUT_LAGS = (1, 2, 3, 4, 6, 9, 14, 21)
_STRIDES, _REFIT, _LEAST = (2, 4), 30, 500  # of samples, iterations of a refit, and samples of half a record
_OUTSIDE = 0.1  # share of the samples beyond what the records covered that a check lets pass
_CONTRADICTS = 5.0  # standard deviations, of the largest of many moves
_WEIGHT = 0.1  # relative error of the force at rest that a check lets pass


class Whiteness(NamedTuple):
    """What the innovations of one record say."""

    own: ResidualTest  # against past innovations, and against past voltages
    inputs: ResidualTest

    @property
    def p(self) -> float:
        """Return the probability of at least this much if the model is right, by both tests together."""
        return min(1.0, 2.0 * min(self.own.p, self.inputs.p))


def whiteness(fit: BearingFit, r: int, name: str = "") -> Whiteness:
    """Test the innovations of one record against their own past and past voltages: an eddy pole between current and
    force leaves them white, as noise levels grow over it, but not independent of these.
    """
    residuals = run(fit.problem, fit.vector, r) if fit.at is None else fit.at.innovations[r]
    assert residuals is not None
    outputs = (1,) if fit.problem.records[r].held else (0, 1)
    n, first = residuals.e.shape[0], fit.problem.skip
    white = np.nan_to_num(residuals.e[:, outputs] / np.sqrt(residuals.s[:, outputs]))
    begin, u = first + max(*_LAGS, *_INPUT_LAGS), fit.problem.records[r].u[:, None]
    past = [(white, k) for k in _LAGS] + [(u, k) for k in _INPUT_LAGS]
    mean = np.concatenate([x[begin - k : n - k].mean(axis=0) for x, k in past])
    triangles: list[list[Array]] = [[] for _ in outputs]
    for part in sweep(fit.problem, fit.vector, r, residuals, slopes=True):
        assert part is not None
        at = max(begin, part.first)
        slopes = part.rows[at - part.first :, [2 * c for c in outputs], :-1]
        end = at + len(slopes)
        regressors = np.hstack([x[at - k : end - k] for x, k in past]) - mean
        for o, blocks in enumerate(triangles):
            blocks.append(triangle_of([np.column_stack([slopes[:, o], regressors, white[at:end, o]])]))
    whole, p = np.stack([triangle_of([np.vstack(blocks)]) for blocks in triangles], axis=1), slopes.shape[2]
    tests, own = list[ResidualTest](), p + len(outputs) * len(_LAGS)
    for columns, lags in ((whole[..., p:own], _LAGS), (whole[..., own:-1], _INPUT_LAGS)):
        p_value, statistic, degrees = score_of(joint_triangle(whole[..., :p], whole[..., -1], columns), p)
        size = np.linalg.norm(columns, axis=0) * np.linalg.norm(whole[..., -1], axis=0)[:, None]
        found = np.max(np.abs(np.einsum("nok,no->ok", columns, whole[..., -1])) / np.maximum(size, 1e-300), axis=0)
        at = int(np.argmax(found))
        tests.append(ResidualTest(
            p=p_value, statistic=statistic, degrees=degrees, largest=float(found[at]),
            largest_lag=lags[at * len(lags) // found.size], channel=name,
        ))  # fmt: skip
    return Whiteness(*tests)


def innovation_sd(fit: BearingFit, r: int) -> Mapping[str, float]:
    """Return root mean square innovations of what a record measures, by role, SI."""
    residuals = run(fit.problem, fit.vector, r) if fit.at is None else fit.at.innovations[r]
    assert residuals is not None
    rms = np.sqrt(np.nanmean(residuals.e[fit.problem.skip :, int(fit.problem.records[r].held) :] ** 2, axis=0))
    return dict(zip(_ROLES[int(fit.problem.records[r].held) :], rms.tolist(), strict=True))


def white(fit: BearingFit) -> bool:
    """Whether the innovations of every record pass `whiteness`."""
    return all(whiteness(fit, r).p >= P_LEAST for r in range(len(fit.problem.records)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingReplay:
    """A record run through an estimate, SI units."""

    fit: BearingFit  # the estimate's problem on this record alone, with every number at its estimate
    noise_of: str  # the record of the estimate whose noise levels were taken
    first: int  # sample at which row 0 of the arrays stands
    # (n_used, 2), position and current: measured, predicted from all samples before, their difference, and the
    # standard deviation that the predictor expects of it; NaN for what is not predicted: the position of a held rotor,
    # and samples that were left out
    measured: Array
    predicted: Array
    innovations: Array
    sd: Array


def replay(estimate: NonlinearBearingEstimate, record: BearingRecord, *, noise_of: str | None = None) -> BearingReplay:
    """Run a record of the same bench, at a rate of the estimate's own records, through its predictor."""
    delay = estimate.delay_samples(record.rate_hz)
    kind = [
        name
        for name, r in zip(estimate.noise, estimate.records, strict=True)
        if bool(r["held"]) == record.held and abs(float(str(r["rate_hz"])) / record.rate_hz - 1.0) < 1e-6
    ]
    if delay is None or not kind:
        of_kind = [r for r in estimate.records if bool(r["held"]) == record.held]
        rates = ", ".join(dict.fromkeys(f"{float(str(r['rate_hz'])):g} Hz" for r in of_kind))
        raise EstimationError(
            f"{record.name} is sampled at {record.rate_hz:g} Hz, the estimate's predictor at {rates}; the rates must "
            "agree. Resample the record, or identify with it"
        )
    if noise_of is None and "zeros" in estimate.extended and not record.held:
        record = _less_its_zero(_fit(estimate, record, estimate.noise[kind[0]], delay).problem)
    best, found = np.inf, None
    for name in kind if noise_of is None else [noise_of]:
        fit = _fit(estimate, record, estimate.noise[name], delay)
        if fit.criterion < best:
            best, found = fit.criterion, (name, fit)
    if found is None:
        raise EstimationError(
            f"the estimate gives no stable predictor for {record.name}. Check that both come from the same bench"
        )
    name, fit = found
    return _replayed(fit, name)


def _fit(
    estimate: NonlinearBearingEstimate, record: BearingRecord, levels: Mapping[str, float], delay: float
) -> BearingFit:
    """The estimate's problem on one record, and its criterion there (infinite without a predictor)."""
    from ambid.bearing.magnet_likelihood import criterion

    values, law = estimate.values, estimate.law
    numbers = tuple(
        Number(
            name=n,
            value=values.get(n, _NEUTRAL.get(n, 0.0)),
            estimated=n in estimate.covariance_names,
            signed=n in SIGNED or (n == "s" and not law.pair),
        )
        for n in (*law.names, *BODY)
    )
    centre = np.log([[levels.get(name, min(levels.values())) for name in LEVELS]])
    known = estimate.delay[f"{record.rate_hz:g} Hz"]
    problem = BearingProblem(
        law=law,
        records=(record,),
        numbers=numbers,
        delays={record.rate_hz: delay},
        free_delay=frozenset({record.rate_hz} if known.sd is not None else ()),
        eddy=estimate.eddy,
        drift=estimate.drift,
        noise_center=centre,
        skip=int(delay) + 8,
    )
    if record.u.size < problem.skip + 60:
        raise EstimationError(
            f"{record.name} has {counted(record.u.size, 'sample')}, too few to test an estimate. Give a longer one"
        )
    vector = problem.start()
    value = criterion(problem, vector)
    return BearingFit(problem=problem, vector=vector, at=None, criterion=value, status="stalled", evaluations=1)


def _less_its_zero(problem: BearingProblem) -> BearingRecord:
    """Return the one record of a problem less the zero of its position, which no other record tells."""
    record = problem.records[0]
    fixed = tuple(replace(n, estimated=False) for n in problem.numbers)
    alone = replace(problem, records=(replace(record, zero=0.0),), numbers=fixed, free_delay=frozenset())
    zero = float(search(alone, alone.start()).vector[-1] * alone.zero_scale)
    return replace(record, y=record.y - [zero, 0.0])


def _replayed(fit: BearingFit, name: str) -> BearingReplay:
    record, first = fit.problem.records[0], fit.problem.skip
    residuals = run(fit.problem, fit.vector, 0)
    assert residuals is not None  # its criterion is finite
    e, s = residuals.e[first:], residuals.s[first:]
    return BearingReplay(
        fit=fit,
        noise_of=name,
        first=first,
        measured=record.y[first:],
        predicted=record.y[first:] - e,
        innovations=e,
        sd=np.sqrt(s),
    )


def validation(estimate: NonlinearBearingEstimate, record: BearingRecord) -> dict[str, object]:
    """Judge an estimate on a further record of a moving rotor; only the first state is fitted. ``fit`` by output:
    one_step, simulation (None: one magnet falls or clings), innovation_rms in SI and ratio to that at identification;
    ``checks``: residuals_white, residuals_uncorrelated, innovations_consistent, inside_range (positions and currents
    that the estimate has seen) and, for one magnet, carries_its_weight; ``passed``; ``samples``; ``outside``, share of
    the record.
    """
    replayed = replay(estimate, record)
    record = replayed.fit.problem.records[0]  # less a zero of its own
    sound = np.all(np.isfinite(replayed.innovations), axis=1)
    errors, measured = replayed.innovations[sound], replayed.measured[sound]
    rms = np.sqrt(np.mean(errors**2, axis=0))
    before = [estimate.fit[replayed.noise_of][role].innovation_sd for role in _ROLES]
    one_step, ratio = fit_of(errors, measured), rms / np.array(before)
    outside = 1.0 - float(np.mean(estimate.covers(record.kept)))
    checks = {
        **whiteness_checks([whiteness(replayed.fit, 0)]),
        "innovations_consistent": consistency_check(
            dict(zip(_ROLES, ratio.tolist(), strict=True)), f"on {replayed.noise_of} at identification"
        ),
        "inside_range": _inside(estimate, record, outside),
        **_carries(estimate, record),
    }
    return {
        "fit": {
            role: {
                "one_step": float(one_step[j]),
                "simulation": None,
                "innovation_rms": float(rms[j]),
                "ratio": float(ratio[j]),
            }
            for j, role in enumerate(_ROLES)
        },
        **conclude(checks, int(record.u.size)),
        "outside": outside,
        "noise_of": replayed.noise_of,
    }


def agreement(fit: BearingFit, spread: BearingUncertainty, *, alone: bool) -> Agreement:
    """Refit the numbers to other uses of the records: each moving one `alone`, where there are several, or else to
    halves of a single one and to every second and fourth sample. Refits that do not converge are left out.
    """
    plain, values = np.diag(spread.information), fit.problem.values(fit.vector)
    shifts, sds, used = list[list[float]](), list[Array](), list[int]()
    for k, problem in enumerate(_each(fit) if alone else _parts(fit)):
        again = search(problem, problem.start(), iterations=_REFIT)
        if again.status == "converged":
            own, found = np.diag(uncertainty(again).information), problem.values(again.vector)
            shifts.append([found[name] - values[name] for name in spread.names])
            sds.append(np.sqrt(np.maximum(own - plain, 0.25 * own)))  # as of physical.agreement
            used.append(k)
    n = len(spread.names)
    shift, sd = np.array(shifts).reshape(-1, n), np.array(sds).reshape(-1, n)
    return Agreement(names=spread.names, shift=shift, sd=sd, strides=tuple(used))


def record_facts(
    fit: BearingFit, spread: BearingUncertainty, benches: Sequence[Record], names: Sequence[str], rig: Rig, *,
    robust: bool = False,
) -> tuple[dict[str, Check], Array]:  # fmt: skip
    """Compare what each record says by itself with the estimate, and return the worst of each check, and how far R and
    the offset of the voltage move where the means contradict them, (n_contradicting, n), SI. `benches`: channels by
    role; `names`: of the records; `robust`: whether other checks failed. Of a record that was cut its longest part
    speaks, with the voltage that counts.

    A rig that gives an offset or a drop of the stage explains the means by it, and a stage that is off has none.
    """
    values, law = fit.problem.values(fit.vector), fit.problem.law
    covariance = spread.covariance(robust=True)
    sd = dict(zip(spread.names, np.sqrt(np.diag(covariance)), strict=True))
    explained = rig.magnet is not None and any(rig.magnet.known(n) is not None for n in _STAGE)
    found: dict[str, list[tuple[str, Check]]] = {}
    moves = list[list[float]]()
    for r, (record, bench, name) in enumerate(zip(fit.problem.records, benches, names, strict=True)):
        outputs = ("current",) if record.held else _ROLES
        roles = ("voltage", *outputs)
        first, end = max(record.parts, key=lambda part: part[1] - part[0])
        values_of = {role: record.u if role == "voltage" else bench[role].values for role in roles}
        own = tuple(replace(bench[role], values=x[first:end]) for role, x in values_of.items())
        bench = replace(bench, channels=own, start_s=bench.start_s + first / bench.rate_hz)
        # a stage that is off is no limit, and one that the rig says is taken as it is
        known = outputs if np.any(record.loose > 0.0) or rig.limits is not None else roles
        checks = {**facts(bench, rig), **signal_checks(bench[[*known]], outputs)}
        if "voltage" in known and not checks["within_limits"].passed:
            more = (
                f"{checks['within_limits'].detail}; or give loop.limits.voltage in the rig where the log is what acted"
            )
            checks["within_limits"] = replace(checks["within_limits"], detail=more)
        if robust:
            checks["resolution"] = resolution_check(bench, {k: x**2 for k, x in innovation_sd(fit, r).items()})
        if record.held:  # a coil at rest stands still
            del checks["log_runs"]
        means = checks.pop("ohm").values
        if means and not explained and not np.any(record.loose > 0.0):
            R, sd_R = values["R"], sd.get("R", 0.0)
            checks["ohm"] = ohm(
                bench,
                R,
                sd_R,
                means["value"],
                means["sd"],
                of=len(names),
                offset=values["v_offset"] if "v_offset" in sd else 0.0,
            )
            shift = checks["ohm"].size or 0.0
            by = {"R": shift, "v_offset": shift * float(bench["current"].values.mean())}
            moves += [[by.get(n, 0.0) for n in spread.names]] * (shift != 0.0)
        if not record.held:
            at = record.kept.mean(axis=0, keepdims=True) - [values["x_offset"], values["i_offset"]]
            table, slopes = law.table(at[:, 0], at[:, 1], values)
            by_number = dict(zip(law.names, slopes[0, 3], strict=True))
            g = np.array([by_number.get(n, 0.0) for n in spread.names])
            coil = {"R": values["R"], "L": float(table[0, 3])}
            y = np.column_stack([bench[role].values for role in _ROLES])
            if not fit.problem.eddy:  # else the force lags
                checks["in_time"] = check_lag(Signals(u=bench["voltage"].values[:, None], y=y, rate_hz=record.rate_hz))
            checks["sampling"] = sampling(coil, {"L": float(np.sqrt(g @ covariance @ g))}, record.rate_hz)
        checks.pop("weight", None)
        for check, result in checks.items():
            found.setdefault(check, []).append((name, result))
    worst = {k: min(x, key=lambda c: (c[1].passed, -abs(c[1].values.get("apart_sd", 0.0)))) for k, x in found.items()}
    several = len(names) > 1
    told = {k: replace(c, detail=f"{name}: {c.detail}" if several else c.detail) for k, (name, c) in worst.items()}
    return told, np.array(moves).reshape(-1, len(spread.names))


def agreement_check(alone: Agreement) -> Check:
    """Check that records alone give what they give together, but for what drifts from day to day."""
    nuisances = ("tau", "v_offset") if "tau" in alone.names else ()
    ratio = np.abs(alone.shift / alone.sd) * ~np.isin(alone.names, nuisances)
    record, number = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    largest = float(ratio[record, number])
    text = f"{alone.names[number]} moves by {largest:.2g} sd with record {alone.strides[record] + 1} alone"
    passed = largest < _CONTRADICTS
    return Check(
        passed=passed, values={"largest": largest},
        detail=f"each record alone gives what they give together ({text} at most)" if passed
        else f"the records contradict each other: {text}. The law does not hold for all of them, or the bench changed",
    )  # fmt: skip


def _begun(fit: BearingFit) -> BearingProblem:
    """Return the problem of a fit, beginning where it ended."""
    problem, values, centre = fit.problem, fit.problem.values(fit.vector), fit.problem.noise_center.copy()
    for r, place in enumerate(problem.noise_slices):
        centre[r, list(problem.levels(r))] = fit.vector[place]
    return replace(
        problem, noise_center=centre,
        delays={rate: problem.delay_at(fit.vector, rate) for rate in problem.delays},
        numbers=tuple(replace(n, value=values[n.name]) if np.isinf(n.prior_sd) else n for n in problem.numbers),
    )  # fmt: skip


def _each(fit: BearingFit) -> Iterator[BearingProblem]:
    """Yield each moving record alone, with those of a held rotor, where there are several."""
    problem = _begun(fit)
    moving = [r for r, x in enumerate(problem.records) if not x.held]
    for r in moving if len(moving) > 1 else ():
        kept = [k for k, x in enumerate(problem.records) if x.held or k == r]
        rates = {problem.records[k].rate_hz for k in kept}
        yield replace(
            problem, records=tuple(replace(problem.records[k], zero=None) for k in kept),
            noise_center=problem.noise_center[kept],
            delays={rate: x for rate, x in problem.delays.items() if rate in rates},
            free_delay=problem.free_delay & rates,
        )  # fmt: skip


def _parts(fit: BearingFit) -> Iterator[BearingProblem]:
    """Yield halves of a single moving record, and all records with some of their samples."""
    problem = _begun(fit)
    moving = [x for x in problem.records if not x.held]
    half = moving[0].u.size // 2
    for part in (slice(0, half), slice(half, None)) if len(moving) == 1 and half > _LEAST else ():
        yield replace(problem, records=tuple(x if x.held else x.part(part) for x in problem.records))
    for stride in _STRIDES:
        thin = [(np.arange(x.u.size) % stride == 0)[:, None] for x in problem.records]
        pairs = zip(problem.records, thin, strict=True)
        yield replace(problem, records=tuple(replace(x, valid=x.valid & on) for x, on in pairs))


def whiteness_checks(tests: Sequence[Whiteness]) -> dict[str, Check]:
    """Check residuals against their own past and past voltages; each passes where every record does."""
    own, inputs = (min(column, key=lambda t: t.p) for column in zip(*tests, strict=True))
    return {"residuals_white": white_check(own), "residuals_uncorrelated": uncorrelated_check(inputs)}


def _inside(estimate: NonlinearBearingEstimate, record: BearingRecord, outside: float) -> Check:
    low, high = record.kept.min(axis=0), record.kept.max(axis=0)
    visited = estimate.range
    detail = f"{100 * outside:.2g} % of the record lies outside the positions and currents used for identification"
    if outside > _OUTSIDE:
        detail += (
            f" (here {1e3 * low[0]:.4g} to {1e3 * high[0]:.4g} mm, {low[1]:.3g} to {high[1]:.3g} A; there "
            f"{1e3 * visited['position'][0]:.4g} to {1e3 * visited['position'][1]:.4g} mm, "
            f"{visited['current'][0]:.3g} to {visited['current'][1]:.3g} A): the force law extrapolates"
        )
    return Check(passed=outside <= _OUTSIDE, detail=detail, values={"outside": outside})


def _carries(estimate: NonlinearBearingEstimate, record: BearingRecord) -> dict[str, Check]:
    """For one magnet: is the mean force on this record the weight?"""
    weight = estimate.values["m"] * estimate.values["g"]
    if estimate.law.pair or weight == 0.0:
        return {}
    carried = weight_carried(estimate.law, estimate.values, record)
    if carried is None:
        return {}
    off = carried - 1.0
    detail = f"the magnet's mean force is {abs(off):.1%} {'above' if off > 0 else 'below'} the weight on this record"
    return {"carries_its_weight": Check(passed=abs(off) < _WEIGHT, detail=detail, values={"relative": off})}
