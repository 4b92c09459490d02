"""NARMAX from records: terms by orthogonal least squares, coefficients by prediction (or simulation) errors.

Linear start -> process terms -> denominators -> noise terms -> pruning -> Levenberg-Marquardt with exact derivatives.
Standard deviations are those of the coefficients of the terms chosen; that the terms were chosen from the same data
makes them too small where a term was a close call (Leeb and Poetscher 2005).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.criteria import information
from ambid.estimation.progress import Tick, part_of, portions
from ambid.nonlinear.fit import LearningCurve, NonlinearFit, Settings
from ambid.nonlinear.narmax.choose import Draft, process_terms, sampled_fast
from ambid.nonlinear.narmax.costs import stage_costs
from ambid.nonlinear.narmax.noise_model import with_all_noise, with_noise_terms
from ambid.nonlinear.narmax.pruning import pruned_by_prediction, pruned_by_simulation
from ambid.nonlinear.narmax.rational import rational_terms
from ambid.nonlinear.narmax.result import failed_fit, finished_fit
from ambid.nonlinear.narmax.scaled import Scaled, scaled_records
from ambid.nonlinear.narmax.search import Fitted, evaluated, search
from ambid.nonlinear.narmax.settings import NarmaxSettings, narmax_settings
from ambid.nonlinear.narmax.simulated_choice import terms_by_simulation

_CLEAR = 10.0  # of the information criterion, which all candidates have to gain over those of the ratios
_MOST_AT_ONCE = 60  # candidates of an output: searches and prunings of more take minutes
_PRUNINGS = 6
_ITERATIONS, _ROUGHLY = 60, 12  # of a search at most; of one between, with terms too many, which creeps
DIVERGED = "no one-step predictor that stays finite was found; lower ne, degree or terms, or check the columns"


@dataclass(slots=True)
class Work:
    """What a fit has come to, so that an interruption loses nothing."""

    draft: Draft  # the best model so far that runs
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)
    status: Literal["converged", "stalled"] = "converged"
    focus: str = "prediction"  # which errors the coefficients of the draft are fitted to


def narmax(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a polynomial or rational NARMAX model, y(t) = b/a + e(t) (thesis eqs 3.1-3.4).

    Consistent under feedback as long as the terms hold the true ones and ``focus`` is ``prediction``.

    Parameters
    ----------
    records : sequence of IOData
        Of one bench.
    settings : Mapping
        Described in the register of structures.
    seed : int, optional
        Taken for the contract's sake: nothing here is random.
    tick : callable, optional
        Called with the stage; may raise KeyboardInterrupt.

    Returns
    -------
    NonlinearFit

    Raises
    ------
    EstimationError
        If a setting is not known, records do not belong together, are too short, or a channel does not move.
    """
    if not records:
        raise EstimationError("narmax: no record is given. Pass one at least")
    s = narmax_settings(settings, n_inputs=records[0].n_inputs)
    began = perf_counter()
    scaled = scaled_records("narmax", records, lag=s.lag, levels=s.levels)
    _check_magnitude(s, records)
    work = Work(draft=_linear_start(s, scaled))
    try:
        _identify(s, scaled, work, tick)
    except KeyboardInterrupt:
        work.status = "stalled"
        work.warnings.insert(0, "interrupted: the best model so far")
    else:
        if work.status == "stalled":
            work.warnings.insert(0, "the search did not converge: treat the numbers as a first guess")
    work.timing_s["all"] = perf_counter() - began
    one = np.ones(scaled.n_outputs)
    if not evaluated(work.draft.tables, work.draft.theta, scaled.parts, one, free=False).finite:
        return failed_fit(records, s, seed, DIVERGED, work.timing_s)
    return finished_fit(
        records,
        s,
        scaled,
        work.draft,
        seed=seed,
        status=work.status,
        focus=work.focus,
        curves=tuple(work.curves),
        warnings=tuple(work.warnings),
        timing_s=work.timing_s,
    )


def _check_magnitude(s: NarmaxSettings, records: Sequence[IOData]) -> None:
    if s.output == "signed":
        return
    if (records[0].n_inputs, records[0].n_outputs) != (1, 1):
        raise EstimationError(f"narmax: output = {s.output} is for one input and one output. Choose one of each")
    for r, x in enumerate(records):
        if np.min(x.y) < 0:
            raise EstimationError(
                f"narmax: output {x.outputs[0]!r} of record {r + 1} is negative at sample {int(np.argmin(x.y))}; a "
                "magnitude is not. Use output = signed"
            )


def _linear_start(s: NarmaxSettings, scaled: Scaled) -> Draft:
    """A linear model: something to hand over when the very next thing is an interruption."""
    return process_terms(replace(s, degree=1, ne=0, selection="frols", output="signed"), scaled.parts, None)


def _identify(s: NarmaxSettings, scaled: Scaled, work: Work, tick: Tick | None) -> None:
    if tick is not None:
        tick("start", 0.0)
    if s.selection != "auto":
        _along(s, scaled, work, tick)
        return
    first = process_terms(replace(s, selection="frols"), scaled.parts, None)
    if not sampled_fast(first) or s.kind != "polynomial" or not _few(s, scaled, first):
        _along(replace(s, selection="frols"), scaled, work, tick)
        return
    _along(replace(s, selection="frols"), scaled, work, part_of(tick, 0.0, 0.2))
    by_ratio, status, curves, focus = work.draft, work.status, len(work.curves), work.focus
    weight = _weight(scaled, by_ratio, free=False)
    _along(replace(s, selection="all"), scaled, work, part_of(tick, 0.2, 1.0))
    gained = _value(s, scaled, by_ratio, weight) - _value(s, scaled, work.draft, weight)
    if gained > _CLEAR and work.focus == focus:
        work.warnings.append(
            "sampled so fast that the last output takes nearly all of an error reduction ratio and hides what drives "
            "the plant: terms are what is left of all candidates (selection = all), which predict better than those "
            "chosen by the ratios"
        )
        return
    work.draft, work.status, work.focus = by_ratio, status, focus
    del work.curves[curves:]


def _few(s: NarmaxSettings, scaled: Scaled, draft: Draft) -> bool:
    """Whether all candidates can be in a model at once."""
    n = sum(max(y.shape[0] - s.lag, 0) for y, _ in scaled.parts)
    return bool(draft.n_candidates <= min(_MOST_AT_ONCE, n // 20))


def _along(s: NarmaxSettings, scaled: Scaled, work: Work, tick: Tick | None) -> None:
    """All stages, one after the other."""
    terms, below, noise, pruning, free = portions(tick, stage_costs(s, scaled.n_outputs, scaled.parts[0][1].shape[1]))
    with _Timed(work, "terms"):
        if s.selection == "simulation":
            draft = terms_by_simulation(s, scaled.parts, terms, lambda x: _keep_simulated(work, x))
        else:
            draft = process_terms(s, scaled.parts, terms)
        if s.kind == "rational":
            draft = rational_terms(s, draft, scaled.parts, part_of(below, 0.0, 0.5))
            draft = _searched(scaled, draft, work, part_of(below, 0.5, 1.0), free=False)
        if not (s.selection == s.focus == "simulation"):
            draft = _refitted(s, scaled, draft)
            _keep(work, scaled, draft)
    if s.selection == s.focus == "simulation":
        with _Timed(work, "simulation errors"):
            _fit_to_simulation(scaled, draft, work, free)
        return
    with _Timed(work, "noise terms"):
        if s.ne:
            draft = with_noise_terms(s, draft, scaled.parts, part_of(noise, 0.0, 0.4))
            draft = _searched(scaled, draft, work, part_of(noise, 0.4, 1.0), free=False)
    with _Timed(work, "pruning"):
        draft = _pruned(s, scaled, draft, work, pruning)
    with _Timed(work, "simulation errors"):
        if s.focus == "simulation":
            _fit_to_simulation(scaled, draft, work, free)


class _Timed:
    """Add what a stage takes to the timings, also where it is interrupted."""

    def __init__(self, work: Work, name: str) -> None:
        self.work, self.name, self.began = work, name, 0.0

    def __enter__(self) -> None:
        self.began = perf_counter()

    def __exit__(self, *_: object) -> None:
        self.work.timing_s[self.name] = self.work.timing_s.get(self.name, 0.0) + perf_counter() - self.began


def _weight(scaled: Scaled, draft: Draft, *, free: bool) -> Array:
    """One over the standard deviation of each output's error; ones where the model does not run."""
    one = np.ones(scaled.n_outputs)
    found = evaluated(draft.tables, draft.theta, scaled.parts, one, free=free)
    if not found.finite:
        return one
    size = np.sqrt(np.mean(np.concatenate(found.errors) ** 2, axis=0))
    out: Array = 1.0 / np.maximum(size, 1e-12)
    return out


def _refitted(s: NarmaxSettings, scaled: Scaled, draft: Draft) -> Draft:
    """Coefficients by one-step errors for terms that were chosen, and fitted, by the free run."""
    if s.selection != "simulation":
        return draft
    one = np.ones(scaled.n_outputs)
    return draft.with_theta(search(draft.tables, draft.theta, scaled.parts, one, free=False).theta)


def _keep_simulated(work: Work, draft: Draft) -> None:
    work.draft, work.focus = draft, "simulation"


def _keep(work: Work, scaled: Scaled, draft: Draft) -> None:
    """Hold on to a draft if it runs."""
    if evaluated(draft.tables, draft.theta, scaled.parts, np.ones(scaled.n_outputs), free=False).finite:
        work.draft, work.focus = draft, "prediction"


def _searched(
    scaled: Scaled, draft: Draft, work: Work, tick: Tick | None, *, free: bool, most: int = _ITERATIONS
) -> Draft:
    """Search for coefficients; a model that is linear in them and has no innovations is where it should be already."""
    t = draft.tables
    if not free and not t.noisy and not any(draft.denominators):
        _keep(work, scaled, draft)
        return draft
    weight = _weight(scaled, draft, free=free)
    n = sum(max(y.shape[0] - t.lag, 1) for y, _ in scaled.parts) * scaled.n_outputs

    def keep(theta: Array) -> None:
        work.draft, work.focus = draft.with_theta(theta), "simulation" if free else "prediction"

    found = search(t, draft.theta, scaled.parts, weight, free=free, most=most, tick=tick, keep=keep)
    if not found.finite:
        return draft
    _note(work, found, n, weight, free=free)
    keep(found.theta)
    return draft.with_theta(found.theta)


def _note(work: Work, found: Fitted, n: int, weight: Array, *, free: bool) -> None:
    work.status = "converged" if found.converged else "stalled"
    work.curves.append(
        LearningCurve(
            method=f"Levenberg-Marquardt, {'simulation' if free else 'prediction'} errors",
            seconds=np.array(found.seconds),
            training=np.sqrt(np.array(found.costs) / n) / float(np.sqrt(np.mean(weight**2))),
        )
    )


def _pruned(s: NarmaxSettings, scaled: Scaled, draft: Draft, work: Work, tick: Tick | None) -> Draft:
    if s.pruning == "none":
        return draft
    if s.pruning == "simulation":
        one = np.ones(scaled.n_outputs)
        fewer = pruned_by_simulation(draft, scaled.parts, one, s.criterion, part_of(tick, 0.0, 0.6))
        return draft if fewer is draft else _searched(scaled, fewer, work, part_of(tick, 0.6, 1.0), free=False)
    weight = _weight(scaled, draft, free=False)

    def pruned(d: Draft, share: float, *, noise: bool = True, most: int = _ITERATIONS) -> Draft:
        for k in range(_PRUNINGS):  # a search between, for what may go is judged where the rest is at its best
            fewer = pruned_by_prediction(d, scaled.parts, weight, s.criterion, noise=noise)
            same, begin = fewer.theta.size == d.theta.size, share + 0.25 * k / _PRUNINGS
            d = _searched(scaled, fewer, work, part_of(tick, begin, begin + 0.25 / _PRUNINGS), free=False, most=most)
            if same:
                break
        return d

    best = pruned(draft, 0.0)
    ended = work.status
    richer = with_all_noise(s, draft)
    if richer is not draft and draft.tables.noisy:
        # An equation multiplied by a polynomial in q^-1 predicts as well, with other noise terms: only where all of
        # these are there can the surplus process terms go one by one.
        other = _searched(scaled, richer, work, part_of(tick, 0.25, 0.5), free=False, most=_ROUGHLY)
        other = pruned(pruned(other, 0.5, noise=False, most=_ROUGHLY), 0.75)
        if _value(s, scaled, other, weight) < _value(s, scaled, best, weight):
            best, ended = other, work.status
    work.status = ended
    _keep(work, scaled, best)
    return best


def _value(s: NarmaxSettings, scaled: Scaled, draft: Draft, weight: Array) -> float:
    """Information criterion of the one-step errors."""
    found = evaluated(draft.tables, draft.theta, scaled.parts, weight, free=False)
    n = sum(x.size for x in found.errors)
    m = max(draft.n_candidates, draft.theta.size)
    return information(s.criterion, found.cost / n, draft.theta.size, n, m) if found.finite else np.inf


def _fit_to_simulation(scaled: Scaled, draft: Draft, work: Work, tick: Tick | None) -> None:
    one = np.ones(scaled.n_outputs)
    if any(f.kind == "e" for terms in draft.numerators for x in terms for f in x):
        draft = _without_noise(draft)
    if not evaluated(draft.tables, draft.theta, scaled.parts, one, free=True).finite:
        work.status = "stalled"
        work.warnings.append(
            "the free run of the chosen terms diverges, so that their coefficients are those of the one-step errors: "
            "choose terms by simulation (selection or pruning), or lower degree"
        )
        return
    _searched(scaled, draft, work, tick, free=True)


def _without_noise(draft: Draft) -> Draft:
    """The process part: a free run does not see innovations."""
    k, drop = 0, []
    for num, den in zip(draft.numerators, draft.denominators, strict=True):
        for x in (*num, *den):
            if any(f.kind == "e" for f in x):
                drop.append(k)
            k += 1
    return draft.without(drop, np.delete(draft.theta, drop))
