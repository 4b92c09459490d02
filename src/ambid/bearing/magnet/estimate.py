"""Strategy of the nonlinear grey box: laws compared by likelihood, extensions where they pay, delay as the data show.

Prediction error with an extended Kalman predictor: consistent under feedback and for an unstable plant as far as the
linearisation of the *noise* holds (the mean follows the full equations), because each prediction uses the past alone
and the predictor, unlike the plant, is stable. Its gain follows the operating point through the Riccati recursion from
four levels per record; a constant gain would be wrong by the change of k_x over the gap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ambid.bearing.magnet.likelihood import BearingFit, criterion, linearise, promise, search
from ambid.bearing.magnet.problem import LEVELS, BearingProblem, BearingRecord, Number
from ambid.bearing.magnet.rescue import EVALUATIONS, rescued
from ambid.bearing.magnet.start import LinearStart, linear_start, start_numbers, with_noise
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, portions
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.parameters import Parameter

_NEAR_WHOLE = 0.1  # distance of a delay from a whole number at which the whole number is tried
_SHORT = 12  # iterations with which a whole delay is tried
_TRIED = 15  # iterations with which laws are compared
_LONG = 30  # iterations with which a richer law is
_HINT = 1e-3  # of the leakage: how much it rises where only its promise is asked
_KNEES = (0.4, 1.0, 3.0)  # times the knee at which a search begins
_LIKELY = 0.5  # share of its price that a rising leakage must promise to be searched
_STRETCH = 4000  # samples of each record on which laws are compared


def estimate_bearing(
    records: Sequence[BearingRecord],
    known: Mapping[str, Parameter],
    *,
    laws: Sequence[MagnetLaw],
    delay: float | None = None,
    extend: bool = True,
    eddy: bool = False,
    drift: bool = False,
    tick: Tick | None = None,
    evaluations: int = EVALUATIONS,
    seed: int = 0,
) -> BearingFit:
    """Estimate one nonlinear bearing from several records at once.

    `records`: at least one of a rotor that is free to move; `known`: what is known of the numbers, by name; `laws`: the
    likelihood chooses; `delay`: of the voltage in samples of the first record; None: found; `eddy`: force behind a pole
    a/(s + a); `drift`: a force that walks slowly: what the law leaves over; `tick`: called after each evaluation;
    KeyboardInterrupt ends in the best so far; `seed`: of the global search. Returns a `RescuedFit` where there was a
    global search.
    """
    free = [r for r in records if not r.held]
    if not free:
        raise EstimationError("every record holds the rotor; masses and forces want one in which it moves")
    laws = [_widened(law, known) for law in laws]
    short = [_short(r) for r in records]
    few, many = (float(sum(r.u.size for r in x)) for x in (short, records))
    rich = extend and any(not law.rise or (law.pair and not law.asymmetric) for law in laws)
    again = _remembered(tick)
    ticks = portions(again, [*[few] * len(laws), 2.0 * few * rich, many, many * (delay is None)])
    with one_thread():
        linear = linear_start(free[0], known, delay, laws[0])
        fits = [
            _first(short, known, law, linear, delay, eddy=eddy, drift=drift, tick=t)
            for law, t in zip(laws, ticks, strict=False)
        ]
        fit = min(fits, key=lambda f: f.criterion)
        if extend and fit.status != "failed":
            for name in ("asymmetric", "rise") if fit.problem.law.pair else ("rise",):
                law = replace(fit.problem.law, rise=fit.problem.law.rise or name == "rise",
                              asymmetric=fit.problem.law.asymmetric or name == "asymmetric")  # fmt: skip
                if law != fit.problem.law:
                    fit = _extended(fit, law, known, short, linear, ticks[-3])
        whole = replace(fit.problem, records=tuple(records))
        fit = search(whole, fit.vector, tick=ticks[-2])
        fit = rescued(
            fit if delay is not None or fit.status == "failed" else _with_fraction(fit, ticks[-1]), records,
            lambda f: f if delay is not None or f.status == "failed" else _with_fraction(f, again),
            search_delay=delay is None, seed=seed, evaluations=evaluations, tick=again,
        )  # fmt: skip
    if fit.status == "failed":
        raise EstimationError("no start value makes a predictor for these records. Check columns, signs and values")
    return fit


def _widened(law: MagnetLaw, known: Mapping[str, Parameter]) -> MagnetLaw:
    """The law with what the user says of a difference between the magnets of a pair."""
    said = [known[n] for n in ("k_asym", "i0_asym") if n in known]
    return replace(law, asymmetric=law.pair and (law.asymmetric or any(p.role != "fixed" or p.value for p in said)))


def _remembered(tick: Tick | None) -> Tick:
    """An interruption ends every search that comes after it, too."""
    interrupted = False

    def again(stage: str, done: float | None = None, /) -> None:
        nonlocal interrupted
        if interrupted:
            raise KeyboardInterrupt
        try:
            if tick is not None:
                tick(stage, done)
        except KeyboardInterrupt:
            interrupted = True
            raise

    return again


def _short(record: BearingRecord) -> BearingRecord:
    """The first part of a record: enough to choose a law and to come near."""
    return record if record.held else record.first(_STRETCH)


def _first(
    records: Sequence[BearingRecord], known: Mapping[str, Parameter], law: MagnetLaw, linear: LinearStart,
    delay: float | None, *, eddy: bool, drift: bool, tick: Tick | None,
) -> BearingFit:  # fmt: skip
    """Start values of one law, and a search from there."""
    rate = next(r.rate_hz for r in records if not r.held)
    total = linear.delay if delay is None else delay
    whole = float(round(total)) if delay is None and abs(total - round(total)) < _NEAR_WHOLE else total
    delays = {r: (whole if r == rate else whole / rate * r) for r in dict.fromkeys(x.rate_hz for x in records)}
    problem = BearingProblem(
        law=law,
        records=tuple(records),
        numbers=_with_eddy(start_numbers(law, known, records, linear), known, on=eddy),
        delays=delays,
        free_delay=frozenset(r for r in delays if delay is None and (r != rate or whole != round(whole))),
        eddy=eddy,
        drift=drift,
        noise_center=np.zeros((len(records), len(LEVELS))),
        skip=int(max(delays.values())) + 8,
    )
    problem = with_noise(problem, linear.values)
    return search(problem, problem.start(), iterations=_TRIED, tick=tick)


def _with_eddy(numbers: tuple[Number, ...], known: Mapping[str, Parameter], *, on: bool) -> tuple[Number, ...]:
    free = on and ("a" not in known or known["a"].role != "fixed")
    return tuple(replace(n, estimated=free) if n.name == "a" else n for n in numbers)


def _extended(
    fit: BearingFit, law: MagnetLaw, known: Mapping[str, Parameter], records: Sequence[BearingRecord],
    linear: LinearStart, tick: Tick | None,
) -> BearingFit:  # fmt: skip
    """The fit with a richer law where it pays (BIC)."""
    if fit.status == "stalled":  # else the richer law would be paid for going on
        fit = search(fit.problem, fit.vector, iterations=_LONG, tick=tick)
    values, old = fit.problem.values(fit.vector), {n.name: n for n in fit.problem.numbers}
    fresh = {n.name: n for n in start_numbers(law, known, records, linear)}
    new = [n for n in law.names if fresh[n].estimated and not old[n].estimated]
    if not new:
        return fit
    if "L_rise" in new:
        values |= {"L_leak": 0.7 * values["L_leak"], "L_rise": 0.4 * values["L_leak"]}
    numbers = tuple(
        fresh[n.name] if n.name in new
        else n if not n.estimated or np.isfinite(n.prior_sd) else replace(n, value=values[n.name])
        for n in fit.problem.numbers
    )  # fmt: skip
    if "L_rise" in new:
        numbers = tuple(replace(n, value=values["L_rise"]) if n.name == "L_rise" else n for n in numbers)
    problem, price = replace(fit.problem, law=law, numbers=numbers), len(new) * float(np.log(fit.problem.n_used))
    if "L_rise" in new and fit.status == "converged" and not _rises(fit, problem, _LIKELY * price):
        return fit
    found = search(problem, _carried(fit, problem), iterations=_LONG, tick=tick)
    return found if fit.criterion - found.criterion > price else fit


def _rises(fit: BearingFit, problem: BearingProblem, least: float) -> bool:
    """Whether a hint of a rising leakage promises enough, at any of a few knees (score test: a search takes longer)."""
    names, start = [n.name for n in problem.estimated], _carried(fit, problem)
    if not {"L_leak", "L_rise"} <= set(names):
        return True
    leak = fit.problem.values(fit.vector)["L_leak"]
    start[names.index("L_leak")], start[names.index("L_rise")] = np.log(leak), np.log(_HINT * leak)
    for share in _KNEES if "i_knee" in names else (1.0,):
        beside = start.copy()
        if "i_knee" in names:
            beside[names.index("i_knee")] += np.log(share)
        at = linearise(problem, beside)
        if at is None or promise(at) > least:
            return True
    return False


def _carried(fit: BearingFit, problem: BearingProblem) -> np.ndarray:
    """Write a fit's numbers in the vector of another problem; what is new stands at its start."""
    vector, old = problem.start(), fit.problem
    place = {n.name: fit.vector[j] for j, n in enumerate(old.estimated)}
    for j, n in enumerate(problem.estimated):
        vector[j] = place.get(n.name, vector[j])
        if n.name == "L_leak" and "L_rise" in {x.name for x in problem.estimated} - set(place):
            vector[j] = np.log(n.value)
    for j, rate in enumerate(problem.rates):
        vector[len(problem.estimated) + j] = old.delay_at(fit.vector, rate)
    for r, slot in enumerate(problem.noise_slices):
        levels, had = problem.levels(r), old.levels(r)
        for j, level in enumerate(levels):
            if level in had:
                vector[slot.start + j] = fit.vector[old.noise_slices[r].start + had.index(level)]
            elif level == LEVELS.index("drift"):  # a hundredth of the force of one sample, at first
                vector[slot.start + j] = fit.vector[old.noise_slices[r].start + had.index(2)] - np.log(100.0)
    return vector


def _with_fraction(fit: BearingFit, tick: Tick | None) -> BearingFit:
    """Free a delay that was whole where the score test says so; put one back that came out whole."""
    price = float(np.log(fit.problem.n_used))
    for rate, delay in fit.problem.delays.items():
        if rate not in fit.problem.free_delay:
            free = replace(fit.problem, free_delay=fit.problem.free_delay | {rate})
            start = _carried(fit, free)
            place, gain, from_here = len(free.estimated) + free.rates.index(rate), 0.0, start
            for shift in (0.0, -1e-9) if delay >= 1.0 else (0.0,):  # the slope differs on the two sides
                beside = start.copy()
                beside[place] += shift
                at = linearise(free, beside)
                if at is not None and promise(at) > gain:
                    gain, from_here = promise(at), beside
            if gain > price:
                found = search(free, from_here, tick=tick)
                fit = found if fit.criterion - found.criterion > price else fit
        if rate in fit.problem.free_delay:
            total = fit.problem.delay_at(fit.vector, rate)
            if abs(total - round(total)) < _NEAR_WHOLE:
                fit = _whole(fit, rate, float(round(total)), price, tick)
    return fit


def _whole(
    fit: BearingFit, rate: float, total: float, price: float, tick: Tick | None
) -> BearingFit:  # fmt: skip
    exact = replace(
        fit.problem, delays={**fit.problem.delays, rate: total}, free_delay=fit.problem.free_delay - {rate}
    )  # fmt: skip
    vector = _carried(fit, exact)
    if criterion(exact, vector) - fit.criterion > 100.0 * price:
        return fit
    back = search(exact, vector, iterations=_SHORT, tick=tick)
    return back if back.status == "converged" and back.criterion - fit.criterion < price else fit
