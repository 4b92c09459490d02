"""Strategy of the nonlinear grey box: laws compared by likelihood, extensions where they pay, delay as the data show.

Prediction error with an extended Kalman predictor: consistent under feedback and for an unstable plant as far as the
*noise*'s linearisation holds (the mean follows the full equations). Its gain follows the operating point through the
Riccati recursion from four levels per record; a constant one would be wrong by the change of k_x over the gap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ambid.bearing.magnet_likelihood import BearingFit, criterion, linearise, promise, search
from ambid.bearing.magnet_likelihood import uncertainty as magnet_uncertainty
from ambid.bearing.magnet_problem import BODY, LEVELS, BearingProblem, BearingRecord, Number
from ambid.bearing.magnet_rescue import EVALUATIONS, rescue
from ambid.bearing.magnet_start import LinearStart, linear_start, start_numbers, with_noise
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.estimation.progress import Tick, portions
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.linear_model import Parameter

_NEAR_WHOLE = 0.1  # distance of a delay from a whole number at which the whole number is tried
_FASTEST = 2.0  # samples that a drifting force lasts at least
_SHORT = 12  # iterations with which a whole delay is tried
_TRIED = 15  # iterations with which laws are compared
_LONG = 30  # iterations with which a richer law is
_HINT = 1e-3  # of the leakage: how much it rises where only its promise is asked
_SATURATES = 0.2  # of the start value of sigma, likewise
_AT = 0.02  # of a bound at which a number stands, in its logarithm
_PLAIN = 3.0  # standard deviations from which saturation is known
_KNEES = (0.4, 1.0, 3.0)  # times the knee at which a search begins
_LIKELY = 0.5  # share of its price that a part of the law must promise to be searched
PARTS = {"asymmetric": ("k_asym", "i0_asym"), "rise": ("L_rise", "i_knee"), "saturation": ("sigma",)}
"""Parts that a law may have, with their numbers."""
_STRETCH = 4000  # samples of each record on which laws are compared
_FAR, _CLOSE = 1e-3, 1e-9  # damping with which the search over all samples begins
_LONGER = 64000  # samples of each record on which the search goes on, where there are many more


def estimate_bearing(
    records: Sequence[BearingRecord],
    parameters: Mapping[str, Parameter],
    *,
    laws: Sequence[MagnetLaw],
    delay: float | None = None,
    extend: Sequence[str] = (*PARTS, "drift", "zeros"),
    white: Callable[[BearingFit], bool] | None = None,
    eddy: bool = False,
    drift: bool = False,
    tick: Tick | None = None,
    evaluations: int = EVALUATIONS,
    seed: int = 0,
) -> BearingFit:
    """Estimate one nonlinear bearing from several `records`, at least one of a free rotor. `laws`: the likelihood
    chooses; `extend`: parts that they may take on (BIC), saturation, drift and zeros of each record's own only with
    residuals that are `white`, or they would take up any misfit; `delay`: of the voltage in samples of the first
    record, None: found; `eddy`: force behind a pole a/(s + a); `drift`: a force that is forgotten in tau and a voltage
    that walks, both driven by noise, for sure, not only where they pay; `seed`: of the global search, told by the fit's
    `global_search`; a KeyboardInterrupt of `tick`, called after each iteration, ends in the best so far.
    """
    free = [r for r in records if not r.held]
    if not free:
        raise EstimationError("the rotor is held in every record; mass and force need one in which it moves")
    laws = [_widened(law, parameters) for law in laws]
    short = [_short(r) for r in records]
    few, many = (float(sum(r.u.size for r in x)) for x in (short, records))
    shown_soon = [n for n in ("asymmetric", "rise") if n in extend and (laws[0].pair or n != "asymmetric")]
    again = _remembered(tick)
    longer = tuple(r.first(_LONGER) for r in records)
    every = short, longer, records
    some = float(sum(r.u.size for r in longer)) * (max(r.u.size for r in records) > 2 * _LONGER)
    ticks = portions(again, [*[few] * len(laws), 2.0 * few * bool(shown_soon), some, many, many * (delay is None)])
    with one_thread():
        linear = linear_start(free[0], parameters, delay, laws[0])
        fits = [
            _first(short, parameters, law, linear, delay, eddy=eddy, drift=drift, tick=t)
            for law, t in zip(laws, ticks, strict=False)
        ]

        def finished(fits: Sequence[BearingFit], ticks: Sequence[Tick | None]) -> BearingFit:
            fit = min(fits, key=_bic)
            short, longer, records = (_with_zeros_of(fit, x) for x in every)
            for part in shown_soon:
                fit = _extended(fit, part, parameters, short, linear, ticks[-4])
            whole, near = replace(fit.problem, records=records), _FAR
            if some:  # a step or two over all samples will do from there
                fit = search(replace(whole, records=longer), fit.vector, tick=ticks[-3])
                near = _CLOSE if fit.status == "converged" else _FAR
            fit = search(whole, fit.vector, damping=near, tick=ticks[-2])
            if "saturation" in extend:
                richer = _extended(fit, "saturation", parameters, short, linear, again)
                same = richer.problem.law == fit.problem.law
                sure = not same and richer.status != "failed" and _saturates(richer)
                fit = richer if same or (sure and (white is None or white(richer))) else fit
            fit = rescue(
                fit if delay is not None or fit.status == "failed" else with_fraction(fit, ticks[-1]), records,
                lambda f: f if delay is not None or f.status == "failed" else with_fraction(f, again),
                search_delay=delay is None, seed=seed, evaluations=evaluations, tick=again,
            )  # fmt: skip
            if white is not None and "drift" in extend:
                fit = _with_drift(fit, laws, parameters, short, linear, white, again)
            return fit

        fit = None
        if white is not None and "zeros" in extend:
            own = [_own_zeros(f, again) for f in fits]
            if _hopeful(min(own, key=_bic), fits, white, again):
                fit = finished(own, [again] * len(ticks))
        if fit is None or fit.status == "failed" or white is None or not white(fit):
            fit = finished(fits, ticks)
        fit = _folded(fit)
    if fit.status == "failed":
        raise EstimationError("no start value makes a predictor for these records. Check columns, signs and values")
    return fit


def _widened(law: MagnetLaw, parameters: Mapping[str, Parameter]) -> MagnetLaw:
    """The law with the parts of which the user says a number."""
    own = {
        part: any(n in parameters and (parameters[n].role != "fixed" or parameters[n].value) for n in names)
        for part, names in PARTS.items()
    }
    return replace(
        law, asymmetric=law.pair and (law.asymmetric or own["asymmetric"]), rise=law.rise or own["rise"],
        saturation=law.saturation or own["saturation"],
    )  # fmt: skip


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
    records: Sequence[BearingRecord], parameters: Mapping[str, Parameter], law: MagnetLaw, linear: LinearStart,
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
        numbers=_acting(start_numbers(law, parameters, records, linear), parameters, eddy=eddy, drift=drift),
        delays=delays,
        free_delay=frozenset(r for r in delays if delay is None and (r != rate or whole != round(whole))),
        eddy=eddy,
        drift=drift,
        noise_center=np.zeros((len(records), len(LEVELS))),
        skip=int(max(delays.values())) + 8,
    )
    tau = next(n.value for n in problem.numbers if n.name == "tau")
    if drift and tau * max(delays) < _FASTEST:
        raise EstimationError(
            f"magnet.parameters.tau is {tau:.3g} s; a force that is forgotten within {_FASTEST:g} samples is noise. "
            "Give more, or omit it"
        )
    problem = with_noise(problem, linear.values)
    return search(problem, problem.start(), iterations=_TRIED, tick=tick)


def _acting(
    numbers: tuple[Number, ...], parameters: Mapping[str, Parameter], *, eddy: bool, drift: bool
) -> tuple[Number, ...]:
    fixed = {name for name, p in parameters.items() if p.role == "fixed"}
    free = {"a": eddy and "a" not in fixed, "tau": drift and "tau" not in fixed}
    return tuple(replace(n, estimated=free.get(n.name, n.estimated)) for n in numbers)


def _extended(
    fit: BearingFit, part: str, parameters: Mapping[str, Parameter], records: Sequence[BearingRecord],
    linear: LinearStart, tick: Tick | None,
) -> BearingFit:  # fmt: skip
    """The fit with one part more of its law where it pays (BIC)."""
    if getattr(fit.problem.law, part) or fit.status == "failed":
        return fit
    if fit.status == "stalled":  # else the richer law would be paid for going on
        fit = search(fit.problem, fit.vector, iterations=_LONG, tick=tick)
    more: dict[str, Any] = {part: True}
    law, values = replace(fit.problem.law, **more), dict(fit.problem.values(fit.vector))
    fresh = {n.name: n for n in start_numbers(law, parameters, records, linear)}
    new = [n for n in PARTS[part] if fresh[n].estimated]
    if not new:  # a rig gives zero for all of it
        return fit
    if "L_rise" in new:
        values |= {"L_leak": 0.7 * values["L_leak"], "L_rise": 0.4 * values["L_leak"]}
        fresh["L_rise"] = replace(fresh["L_rise"], value=values["L_rise"])
    numbers = tuple(
        fresh[n.name] if n.name in new
        else n if not n.estimated or np.isfinite(n.prior_sd) else replace(n, value=values[n.name])
        for n in fit.problem.numbers
    )  # fmt: skip
    problem, price = replace(fit.problem, law=law, numbers=numbers), len(new) * float(np.log(fit.problem.n_used))
    if part != "asymmetric" and fit.status == "converged" and not _promises(fit, problem, _LIKELY * price):
        return fit
    richer = search(problem, _carried(fit, problem), iterations=_LONG, tick=tick)
    return richer if fit.criterion - richer.criterion > price else fit


def _with_drift(
    fit: BearingFit, laws: Sequence[MagnetLaw], parameters: Mapping[str, Parameter], short: Sequence[BearingRecord],
    linear: LinearStart, white: Callable[[BearingFit], bool], tick: Tick | None,
) -> BearingFit:  # fmt: skip
    """Return a fit with a drift where one is taken in, unless a magnet with the other gap law explains the records
    better by the price of a number: the drift stood for a wrong law then. That law is taken where it is one of `laws`;
    where it is not, the fit says by how much it is `beaten`.
    """
    more, law = _drifting(fit, short, white, tick), fit.problem.law
    if law.pair:  # its gap has one law
        return more
    other = replace(law, gap="hyperbolic" if law.gap == "exponential" else "exponential")
    open_to_it = other.gap in {x.gap for x in laws}
    if fit.status == "failed" or (more is fit and open_to_it):
        return more
    fresh, price = start_numbers(other, parameters, short, linear), float(np.log(fit.problem.n_used))
    rivals = list[BearingFit]()
    for base in (fit, more)[: 1 + (more is not fit)]:
        known = {n.name: n for n in (*fresh, *base.problem.numbers)}
        problem = replace(base.problem, law=other, numbers=tuple(known[name] for name in (*other.names, *BODY)))
        rivals.append(search(problem, _carried(base, problem), iterations=_LONG, tick=tick))
    bic, rival = min(((r.criterion + r.problem.size * price, r) for r in rivals), key=lambda x: x[0])
    gain = more.criterion + more.problem.size * price - bic
    if gain <= price:
        return more
    if open_to_it:
        return rival if not rival.problem.drift or white(rival) else fit
    return replace(fit, beaten=gain)


def _drifting(
    fit: BearingFit, short: Sequence[BearingRecord], white: Callable[[BearingFit], bool], tick: Tick | None
) -> BearingFit:
    """Return a fit with a force and a voltage that drift beside what it has, where that pays (BIC) and leaves white
    residuals, on the `short` records already, or it would take up any misfit; not where the force is as slow as it may
    be, as it would stand for a law that is wrong.
    """
    if fit.problem.drift or fit.status != "converged":
        return fit
    numbers = tuple(replace(n, estimated=True) if n.name == "tau" else n for n in fit.problem.numbers)
    problem = replace(fit.problem, drift=True, numbers=numbers)
    price = (problem.size - fit.problem.size) * float(np.log(problem.n_used))
    begun = _carried(fit, problem)
    at = linearise(problem, begun)
    if at is not None and promise(at) < _LIKELY * price:
        return fit
    tried = search(replace(problem, records=tuple(short)), begun, iterations=_TRIED, tick=tick)
    if tried.status == "failed" or not white(tried):
        return fit
    more = search(problem, begun, iterations=_LONG, tick=tick)
    pays = more.status == "converged" and fit.criterion - more.criterion > price
    return more if pays and np.all(more.vector < problem.upper() - _AT) and white(more) else fit


def _bic(fit: BearingFit) -> float:
    """The criterion with the price of the vector."""
    return fit.criterion + fit.problem.size * float(np.log(fit.problem.n_used))


def _own_zeros(fit: BearingFit, tick: Tick | None) -> BearingFit:
    """Return a fit in which moving records but the first have a zero of the position of their own, taken out of them,
    where that pays (BIC); the fit itself where it does not.
    """
    records = fit.problem.records
    others = [r for r, x in enumerate(records) if not x.held][1:]
    if not others or fit.status == "failed":
        return fit
    problem = replace(
        fit.problem, records=tuple(replace(x, zero=0.0) if r in others else x for r, x in enumerate(records))
    )
    begun = _carried(fit, problem)
    at = linearise(problem, begun)
    if at is not None and promise(at) < _LIKELY * len(others) * float(np.log(problem.n_used)):
        return fit
    more = search(problem, begun, iterations=_LONG, tick=tick)
    if more.status == "failed" or _bic(more) >= _bic(fit):
        return fit
    return _folded(more)


def _folded(fit: BearingFit) -> BearingFit:
    """Return a fit with what is found, or left, of zeros taken out of the records that have their own."""
    problem, vector = fit.problem, fit.vector.copy()
    places = [problem.zero(r) for r in range(len(problem.records))]
    if fit.status == "failed" or not any(places):
        return fit
    left = [0.0 if z is None else float(vector[z]) * problem.zero_scale for z in places]
    records = tuple(x if x.zero is None else _less(x, rest) for x, rest in zip(problem.records, left, strict=True))
    vector[problem.noise_slices[-1].stop :] = 0.0
    problem = replace(problem, records=records)
    at = linearise(problem, vector)
    return fit if at is None else replace(fit, problem=problem, vector=vector, at=at, criterion=at.criterion)


def _hopeful(
    own: BearingFit, fits: Sequence[BearingFit], white: Callable[[BearingFit], bool], tick: Tick | None
) -> bool:
    """Whether zeros of their own may make residuals of short records white, with a drift if need be."""
    if own in fits or own.status == "failed":
        return False
    return white(own) or _drifting(own, own.problem.records, white, tick) is not own


def _less(record: BearingRecord, zero: float) -> BearingRecord:
    return replace(record, zero=(record.zero or 0.0) + zero, y=record.y - [zero, 0.0])


def _with_zeros_of(fit: BearingFit, records: Sequence[BearingRecord]) -> tuple[BearingRecord, ...]:
    """Return the records less the zeros that a fit has taken out of theirs."""
    return tuple(x if y.zero is None else _less(x, y.zero) for x, y in zip(records, fit.problem.records, strict=True))


def _saturates(fit: BearingFit) -> bool:
    """Whether sigma is known to be above zero, by the scatter over stretches too."""
    spread = magnet_uncertainty(fit)
    sd = dict(zip(spread.names, np.sqrt(np.diag(spread.covariance(robust=True))), strict=True))
    return bool(fit.problem.values(fit.vector)["sigma"] > _PLAIN * sd["sigma"])


def _promises(fit: BearingFit, problem: BearingProblem, least: float) -> bool:
    """Whether a hint of a rising leakage (at any of a few knees) or of saturation promises enough (score test: a search
    takes longer).
    """
    names, start = [n.name for n in problem.estimated], _carried(fit, problem)
    if problem.law.saturation and not fit.problem.law.saturation:
        start[names.index("sigma")] += np.log(_SATURATES)
    elif not {"L_leak", "L_rise"} <= set(names):
        return True
    else:
        leak = fit.problem.values(fit.vector)["L_leak"]
        start[names.index("L_leak")], start[names.index("L_rise")] = np.log(leak), np.log(_HINT * leak)
    knee = "i_knee" in names and not fit.problem.law.rise
    for share in _KNEES if knee else (1.0,):
        hinted = start.copy()
        if knee:
            hinted[names.index("i_knee")] += np.log(share)
        at = linearise(problem, hinted)
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
            else:  # drifts: a hundredth of the force and of the voltage of one sample, at first
                vector[slot.start + j] = fit.vector[old.noise_slices[r].start + had.index(level - 2)] - np.log(100.0)
    return vector


def with_fraction(fit: BearingFit, tick: Tick | None = None) -> BearingFit:
    """Free a delay that was whole where the score test says so; put one back that came out whole."""
    price = float(np.log(fit.problem.n_used))
    for rate in fit.problem.delays:
        if rate not in fit.problem.free_delay:
            assert fit.at is not None
            either = fit.problem.settled.index(rate)
            gains = [promise(fit.at, delay=2 * either + side) for side in (0, 1)]  # the slope differs on the two sides
            if max(gains) > price:
                free = replace(fit.problem, free_delay=fit.problem.free_delay | {rate})
                start = _carried(fit, free)
                start[len(free.estimated) + free.rates.index(rate)] -= 1e-9 * (gains[1] > gains[0])
                freed = search(free, start, tick=tick)
                fit = freed if fit.criterion - freed.criterion > price else fit
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
