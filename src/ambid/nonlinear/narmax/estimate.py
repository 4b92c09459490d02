"""NARMAX from records: terms by orthogonal least squares, coefficients by prediction (or simulation) errors.

Linear start -> process terms -> denominators -> noise terms -> pruning -> Levenberg-Marquardt with exact derivatives.
Standard deviations are those of the coefficients of the terms chosen; that the terms were chosen from the same data
makes them too small where a term was a close call (Leeb and Poetscher 2005).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.criteria import information
from ambid.estimation.linear import information_inverse
from ambid.estimation.progress import Tick, part_of, portions
from ambid.nonlinear.fit import LearningCurve, NonlinearFit, Settings, failed_fit, provenance
from ambid.nonlinear.narmax.choice import (
    add_all_noise,
    add_noise_terms,
    is_sampled_fast,
    process_terms,
    prune_by_prediction,
    prune_by_simulation,
    rational_terms,
)
from ambid.nonlinear.narmax.model import OUTPUTS, Draft, PolynomialNarmax, cloud_of, lagged_signals, predict
from ambid.nonlinear.narmax.settings import NarmaxSettings, narmax_settings, stage_costs
from ambid.nonlinear.narmax.simulated import choose_by_simulation
from ambid.nonlinear.narmax.terms import term_name
from ambid.nonlinear.records import Scaled, scaled_records

_CLEAR = 10.0  # of the information criterion, which all candidates have to gain over those of the ratios
_MOST_AT_ONCE = 60  # candidates of an output: searches and prunings of more take minutes
_PRUNINGS = 6
_ITERATIONS, _ROUGHLY = 60, 12  # of a search at most; of one between, with terms too many, which creeps
DIVERGED = "no one-step predictor that stays finite was found; lower ne, degree or terms, or check the columns"


@dataclass(slots=True)
class Fitting:
    """What a fit has come to, so that an interruption loses nothing."""

    draft: Draft  # the best model so far that runs
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)
    status: Literal["converged", "stalled"] = "converged"
    focus: str = "prediction"  # which errors the coefficients of the draft are fitted to


def narmax(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify a polynomial or rational NARMAX model, y(t) = b/a + e(t) (thesis eqs 3.1-3.4).

    Consistent under feedback as long as the terms hold the true ones and ``focus`` is ``prediction``; not random.
    """
    if not records:
        raise EstimationError("narmax: no record is given. Pass one at least")
    s = narmax_settings(settings, n_inputs=records[0].n_inputs)
    began = perf_counter()
    scaled = scaled_records("narmax", records, lag=s.lag, levels=s.levels, fewest=10)
    _check_magnitude(s, records)
    fitting = Fitting(draft=_linear_start(s, scaled))
    try:
        _fit_terms(s, scaled, fitting, tick)
    except KeyboardInterrupt:
        fitting.status = "stalled"
        fitting.warnings.insert(0, "interrupted: the best model so far")
    else:
        if fitting.status == "stalled":
            fitting.warnings.insert(0, "the search did not converge: treat the numbers as a first guess")
    fitting.timing_s["all"] = perf_counter() - began
    if not np.isfinite(fitting.draft.cost(scaled.parts, free=False)):
        return failed_fit("narmax", records, s.as_mapping(), seed, DIVERGED, fitting.timing_s)
    return _finish(records, s, scaled, fitting, seed)


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


def _fit_terms(s: NarmaxSettings, scaled: Scaled, fitting: Fitting, tick: Tick | None) -> None:
    if tick is not None:
        tick("start", 0.0)
    if s.selection != "auto":
        _run_stages(s, scaled, fitting, tick)
        return
    first = process_terms(replace(s, selection="frols"), scaled.parts, None)
    if not is_sampled_fast(first) or s.kind != "polynomial" or not _few(s, scaled, first):
        _run_stages(replace(s, selection="frols"), scaled, fitting, tick)
        return
    _run_stages(replace(s, selection="frols"), scaled, fitting, part_of(tick, 0.0, 0.2))
    by_ratio, status, curves, focus = fitting.draft, fitting.status, len(fitting.curves), fitting.focus
    weight = _weight(scaled, by_ratio, free=False)
    _run_stages(replace(s, selection="all"), scaled, fitting, part_of(tick, 0.2, 1.0))
    gained = _value(s, scaled, by_ratio, weight) - _value(s, scaled, fitting.draft, weight)
    if gained > _CLEAR and fitting.focus == focus:
        fitting.warnings.append(
            "sampled so fast that the last output takes nearly all of an error reduction ratio and hides what drives "
            "the plant: terms are what is left of all candidates (selection = all), which predict better than those "
            "chosen by the ratios"
        )
        return
    fitting.draft, fitting.status, fitting.focus = by_ratio, status, focus
    del fitting.curves[curves:]


def _few(s: NarmaxSettings, scaled: Scaled, draft: Draft) -> bool:
    """Whether all candidates can be in a model at once."""
    n = sum(max(y.shape[0] - s.lag, 0) for y, _ in scaled.parts)
    return bool(draft.n_candidates <= min(_MOST_AT_ONCE, n // 20))


def _run_stages(s: NarmaxSettings, scaled: Scaled, fitting: Fitting, tick: Tick | None) -> None:
    """All stages, one after the other."""
    terms, below, noise, pruning, free = portions(tick, stage_costs(s, scaled.y_level.size, scaled.u_level.size))
    with _timed(fitting, "terms"):
        if s.selection == "simulation":
            draft = choose_by_simulation(s, scaled.parts, terms, lambda x: _keep_simulated(fitting, x))
        else:
            draft = process_terms(s, scaled.parts, terms)
        if s.kind == "rational":
            draft = rational_terms(s, draft, scaled.parts, part_of(below, 0.0, 0.5))
            draft = _search(scaled, draft, fitting, part_of(below, 0.5, 1.0), free=False)
        if not (s.selection == s.focus == "simulation"):
            draft = _refit(s, scaled, draft)
            _keep(fitting, scaled, draft)
    if s.selection == s.focus == "simulation":
        with _timed(fitting, "simulation errors"):
            _fit_to_simulation(scaled, draft, fitting, free)
        return
    with _timed(fitting, "noise terms"):
        if s.ne:
            draft = add_noise_terms(s, draft, scaled.parts, part_of(noise, 0.0, 0.4))
            draft = _search(scaled, draft, fitting, part_of(noise, 0.4, 1.0), free=False)
    with _timed(fitting, "pruning"):
        draft = _prune(s, scaled, draft, fitting, pruning)
    with _timed(fitting, "simulation errors"):
        if s.focus == "simulation":
            _fit_to_simulation(scaled, draft, fitting, free)


@contextmanager
def _timed(fitting: Fitting, name: str) -> Iterator[None]:
    """Add what a stage takes to the timings, also where it is interrupted."""
    began = perf_counter()
    try:
        yield
    finally:
        fitting.timing_s[name] = fitting.timing_s.get(name, 0.0) + perf_counter() - began


def _weight(scaled: Scaled, draft: Draft, *, free: bool) -> Array:
    """One over the standard deviation of each output's error; ones where the model does not run."""
    errors = np.concatenate(draft.problem(scaled.parts, free=free).errors(draft.theta))
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.sqrt(np.mean(errors**2, axis=0))
    return 1.0 / np.maximum(size, 1e-12) if np.all(np.isfinite(size)) else np.ones(size.size)


def _refit(s: NarmaxSettings, scaled: Scaled, draft: Draft) -> Draft:
    """Coefficients by one-step errors for terms that were chosen, and fitted, by the free run."""
    return draft if s.selection != "simulation" else draft.with_theta(draft.search(scaled.parts, free=False).theta)


def _keep_simulated(fitting: Fitting, draft: Draft) -> None:
    fitting.draft, fitting.focus = draft, "simulation"


def _keep(fitting: Fitting, scaled: Scaled, draft: Draft) -> None:
    """Keep a draft if it runs."""
    if np.isfinite(draft.cost(scaled.parts, free=False)):
        fitting.draft, fitting.focus = draft, "prediction"


def _search(
    scaled: Scaled, draft: Draft, fitting: Fitting, tick: Tick | None, *, free: bool, most: int = _ITERATIONS
) -> Draft:
    """Search for coefficients; a model that is linear in them and has no innovations is where it should be already."""
    if not free and not draft.tables.noisy and not any(draft.denominators):
        _keep(fitting, scaled, draft)
        return draft
    weight = _weight(scaled, draft, free=free)

    def keep(theta: Array) -> None:
        fitting.draft, fitting.focus = draft.with_theta(theta), "simulation" if free else "prediction"

    found = draft.search(scaled.parts, weight=weight, free=free, most=most, tick=tick, keep=keep)
    if not np.isfinite(found.cost):
        return draft
    n = sum(max(y.shape[0] - draft.tables.lag, 1) * y.shape[1] for y, _ in scaled.parts)
    fitting.status = "converged" if found.converged else "stalled"
    fitting.curves.append(
        LearningCurve(
            method=f"Levenberg-Marquardt, {'simulation' if free else 'prediction'} errors",
            seconds=np.array(found.seconds),
            training=np.sqrt(np.array(found.costs) / n) / float(np.sqrt(np.mean(weight**2))),
        )
    )
    keep(found.theta)
    return draft.with_theta(found.theta)


def _prune(s: NarmaxSettings, scaled: Scaled, draft: Draft, fitting: Fitting, tick: Tick | None) -> Draft:
    if s.pruning == "none":
        return draft
    if s.pruning == "simulation":
        fewer = prune_by_simulation(draft, scaled.parts, s.criterion, part_of(tick, 0.0, 0.6))
        return draft if fewer is draft else _search(scaled, fewer, fitting, part_of(tick, 0.6, 1.0), free=False)
    weight = _weight(scaled, draft, free=False)

    def pruned(d: Draft, share: float, *, noise: bool = True, most: int = _ITERATIONS) -> Draft:
        for k in range(_PRUNINGS):  # a search between, for what may go is judged where the rest is at its best
            fewer = prune_by_prediction(d, scaled.parts, weight, s.criterion, noise=noise)
            same, begin = fewer.theta.size == d.theta.size, share + 0.25 * k / _PRUNINGS
            d = _search(scaled, fewer, fitting, part_of(tick, begin, begin + 0.25 / _PRUNINGS), free=False, most=most)
            if same:
                break
        return d

    best = pruned(draft, 0.0)
    ended = fitting.status
    richer = add_all_noise(s, draft)
    if richer is not draft and draft.tables.noisy:
        # An equation multiplied by a polynomial in q^-1 predicts as well, with other noise terms: only where all of
        # these are there can the surplus process terms go one by one.
        other = _search(scaled, richer, fitting, part_of(tick, 0.25, 0.5), free=False, most=_ROUGHLY)
        other = pruned(pruned(other, 0.5, noise=False, most=_ROUGHLY), 0.75)
        if _value(s, scaled, other, weight) < _value(s, scaled, best, weight):
            best, ended = other, fitting.status
    fitting.status = ended
    _keep(fitting, scaled, best)
    return best


def _value(s: NarmaxSettings, scaled: Scaled, draft: Draft, weight: Array) -> float:
    """Information criterion of the one-step errors."""
    cost = draft.cost(scaled.parts, weight=weight, free=False)
    n = sum(max(y.shape[0] - draft.tables.lag, 0) * y.shape[1] for y, _ in scaled.parts)
    m = max(draft.n_candidates, draft.theta.size)
    return information(s.criterion, cost / n, draft.theta.size, n, m) if np.isfinite(cost) else np.inf


def _fit_to_simulation(scaled: Scaled, draft: Draft, fitting: Fitting, tick: Tick | None) -> None:
    if any(f.kind == "e" for terms in draft.numerators for x in terms for f in x):
        draft = _without_noise(draft)
    if not np.isfinite(draft.cost(scaled.parts, free=True)):
        fitting.status = "stalled"
        fitting.warnings.append(
            "the free run of the chosen terms diverges, so that their coefficients are those of the one-step errors: "
            "choose terms by simulation (selection or pruning), or lower degree"
        )
        return
    _search(scaled, draft, fitting, tick, free=True)


def _without_noise(draft: Draft) -> Draft:
    """The process part: a free run does not see innovations."""
    k, drop = 0, []
    for num, den in zip(draft.numerators, draft.denominators, strict=True):
        for x in (*num, *den):
            if any(f.kind == "e" for f in x):
                drop.append(k)
            k += 1
    return draft.without(drop, np.delete(draft.theta, drop))


# --- the fit ---------------------------------------------------------------------------------------------------------


def _finish(records: Sequence[IOData], s: NarmaxSettings, scaled: Scaled, fitting: Fitting, seed: int) -> NonlinearFit:
    """Return the fit of a draft that runs."""
    draft, free = fitting.draft, fitting.focus == "simulation"
    model = _make_model(records, scaled, draft)
    errors = np.concatenate(draft.problem(scaled.parts, free=free).errors(draft.theta))
    freedom = max(errors.shape[0] - draft.theta.size / errors.shape[1], 1.0)
    noise = errors.T @ errors / freedom
    covariance, why = _covariance(scaled, draft, noise, free=free)
    warnings = [*fitting.warnings, *why, *_caution(records, s, scaled, draft, free=free)]
    if covariance is None:
        warnings.append("no covariance, and so no standard deviations: the data do not determine the coefficients")
    else:
        covariance = covariance * model.unit[:, None] * model.unit
    return NonlinearFit(
        structure="narmax",
        settings={**s.as_mapping(), "focus": fitting.focus},
        model=model,
        covariance=covariance,
        covariance_from="" if covariance is None else "information",
        n_estimated=int(draft.theta.size),
        noise_covariance=noise * scaled.y_scale[:, None] * scaled.y_scale,
        seed=seed,
        status=fitting.status,
        curves=tuple(fitting.curves),
        warnings=tuple(warnings),
        timing_s=dict(fitting.timing_s),
        details=_details(draft, model, records),
        **provenance(records),
    )


def _make_model(records: Sequence[IOData], scaled: Scaled, draft: Draft) -> PolynomialNarmax:
    t = draft.tables
    model = PolynomialNarmax(
        dt=records[0].dt,
        n_inputs=draft.n_inputs,
        numerators=draft.numerators,
        denominators=draft.denominators,
        theta=np.ones(draft.theta.size),
        u_level=scaled.u_level,
        u_scale=scaled.u_scale,
        y_level=scaled.y_level,
        y_scale=scaled.y_scale,
        cloud=cloud_of([lagged_signals(t, predict(t, draft.theta, y, u)[1]) for y, u in scaled.parts]),
        output=OUTPUTS[draft.folded],
    )
    return model.with_theta(draft.theta * model.unit)


def _covariance(scaled: Scaled, draft: Draft, noise: Array, *, free: bool) -> tuple[Array | None, list[str]]:
    """Covariance of the scaled coefficients from the information matrix.

    Simulation errors are coloured: there the scatter of the scores over the record takes the place of white noise
    (Newey and West 1987).
    """
    problem = draft.problem(scaled.parts, weight=1.0 / np.sqrt(np.maximum(np.diag(noise), 1e-300)), free=free)
    R = problem.triangle(draft.theta)
    if R.shape[0] < draft.theta.size or not np.all(np.isfinite(R)):
        return None, []
    inverse, condition = information_inverse(R[:, :-1])
    if inverse is None:
        return None, [
            f"the data do not tell the chosen terms apart (condition number {condition:.1e}). "
            "Lower terms or degree, or excite more"
        ]
    P = inverse @ _scatter(problem.rows(draft.theta)) @ inverse if free else inverse
    return (P + P.T) / 2, []


def _scatter(rows: Sequence[Array]) -> Array:
    """Covariance of the sum of the scores, neighbours included as far as their correlation reaches."""
    total = np.zeros((rows[0].shape[2] - 1,) * 2)
    for x in rows:
        g = np.einsum("toq,to->tq", x[:, :, :-1], x[:, :, -1])
        reach = int(np.ceil(4 * g.shape[0] ** (1 / 3)))
        total += g.T @ g
        for k in range(1, min(reach, g.shape[0] - 1) + 1):
            cross = g[k:].T @ g[:-k]
            total += (1 - k / (reach + 1)) * (cross + cross.T)
    return total


def _caution(records: Sequence[IOData], s: NarmaxSettings, scaled: Scaled, draft: Draft, *, free: bool) -> list[str]:
    found = []
    told_open = all(x.open_loop for x in records) or not draft.n_inputs
    if free and not told_open:
        found.append(
            "fitted to the free run, narmax is biased where a controller was at work, and nothing says that these "
            "records are open loop: use focus = prediction, or say --open-loop if there was no feedback"
        )
    elif not s.ne and not told_open:
        found.append(
            "without a noise model (ne = 0) narmax is biased under feedback unless the equation error is white: "
            "raise ne, or say --open-loop if there was no feedback"
        )
    if not free and not np.isfinite(draft.cost(scaled.parts, free=True)):
        found.append(
            "the free run diverges on the records that the model was fitted to: it predicts, but does not simulate. "
            "Choose terms by simulation (selection or pruning), or lower degree"
        )
    if any(draft.denominators) and _denominator_vanishes(scaled, draft):
        found.append("a denominator comes near zero on the training data: predictions there are not to be trusted")
    return found


def _denominator_vanishes(scaled: Scaled, draft: Draft) -> bool:
    t = draft.tables
    for y, u in scaled.parts:
        _, z = predict(t, draft.theta, y, u)
        for o in range(t.n_outputs):
            a = np.ones(z.shape[0] - t.lag)
            for k in np.flatnonzero((t.place[:, 0] == o) & (t.place[:, 1] == 1)):
                p = np.full(a.size, draft.theta[k])
                for v in t.terms[k][t.terms[k] >= 0]:
                    p = p * z[t.lag - t.back[v] : z.shape[0] - t.back[v], t.column[v]]
                a = a + p
            if np.min(a) < 0.05 * np.max(np.abs(a)):
                return True
    return False


def _details(draft: Draft, model: PolynomialNarmax, records: Sequence[IOData]) -> dict[str, object]:
    terms: dict[str, list[dict[str, object]]] = {}
    n_y = len(draft.numerators)
    for o, num in enumerate(draft.numerators):
        terms[records[0].outputs[o]] = [
            {"term": term_name(x, n_y, draft.n_inputs), "err": draft.err.get((o, x))} for x in num
        ]
    return {
        "terms": terms,
        "candidates": draft.n_candidates,
        "passes": draft.passes,
        "levels": {
            **dict(zip(records[0].inputs, model.u_level.tolist(), strict=True)),
            **dict(zip(records[0].outputs, model.y_level.tolist(), strict=True)),
        },
    }
