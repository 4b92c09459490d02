"""Hybrid NARMAX and network from records, by prediction errors.

Polynomial and noise terms by orthogonal least squares (`narmax`) -> number of neurons by held-out errors -> network on
what they leave, from several starts -> all numbers together by Levenberg-Marquardt with exact slopes through the
innovations -> terms that no longer pay, order of C -> covariance by Laplace's approximation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, portions
from ambid.estimation.search import search
from ambid.nonlinear.failed import failed_fit
from ambid.nonlinear.fit import LearningCurve, NonlinearFit, Settings
from ambid.nonlinear.hybrid.choice import Tried, chosen_neurons, chosen_noise, inverted, learning, moved, trained
from ambid.nonlinear.hybrid.function import HybridShape
from ambid.nonlinear.hybrid.result import finished
from ambid.nonlinear.hybrid.revision import Candidates, revised
from ambid.nonlinear.hybrid.settings import HybridSettings, hybrid_settings
from ambid.nonlinear.hybrid.train import HybridProblem, problem_at
from ambid.nonlinear.narmax import PolynomialNarmax, narmax
from ambid.nonlinear.narmax.scaled import Scaled, scaled_records
from ambid.nonlinear.narmax.terms import Term, lagged, products
from ambid.nonlinear.networks.narx_function import NarxShape

_ENOUGH = 1e-4  # gain of the cost, errors of unit variance (squared standard deviations), below which a search is over


@dataclass(slots=True)
class Work:
    """What a fit has come to, so that an interruption loses nothing."""

    shape: HybridShape
    theta: Array  # (n_theta,), scaled
    n_candidates: int = 0  # terms that the polynomial's were chosen from
    # error reduction ratios in the choice of the polynomial's terms
    err: Mapping[tuple[str, str], float] = field(default_factory=dict)
    status: Literal["converged", "stalled"] = "converged"
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)
    tried: tuple[Tried, ...] = ()
    # terms of the polynomial that pay only beside the network, and that it made superfluous
    added: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()
    drawn_in: float = 1.0  # by what the roots of the first C were multiplied to make it invertible

    def keep(self, shape: HybridShape, theta: Array) -> None:
        """Hold on to a model.

        `theta`: (n_theta,), scaled.
        """
        self.shape, self.theta = shape, theta


def hybrid(records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None) -> NonlinearFit:
    """Identify polynomial, network and noise model together, yhat = g(y, u) + (C(q^-1) - 1) e (thesis eqs
    3.23-3.24).

    Consistent under feedback as long as polynomial, network and C hold the truth.

    `records`: of one bench; `settings`: described in the register of structures; `seed`: of the network's starts;
    `tick`: called with the stage and the share that is over; may raise KeyboardInterrupt.
    """
    if not records:
        raise EstimationError("hybrid: no record is given. Pass one at least")
    s = hybrid_settings(settings, n_inputs=records[0].n_inputs)
    data = scaled_records("hybrid", records, lag=s.lag, levels=s.levels)
    ticks = portions(tick, _costs(s))
    began = perf_counter()
    first = narmax(records, s.polynomial, seed=seed, tick=ticks[0])
    timing = {"polynomial": perf_counter() - began}
    if not isinstance(first.model, PolynomialNarmax):
        return failed_fit("hybrid", records, s.as_mapping(), seed, first.reason, timing)
    work = _polynomial(s, first, first.model)
    work.timing_s.update(timing)
    try:
        if any(w.startswith("interrupted") for w in first.warnings):
            raise KeyboardInterrupt
        _identify(s, data, work, seed, ticks[1:])
    except KeyboardInterrupt:
        work.status = "stalled"
        work.warnings.insert(0, "interrupted: the best model so far")
    except np.linalg.LinAlgError as error:
        return failed_fit("hybrid", records, s.as_mapping(), seed, f"the training broke down: {error}", work.timing_s)
    else:
        if work.status == "stalled":
            work.warnings.insert(0, "the search did not converge: treat the numbers as a first guess")
    return finished(records, s, data, work, seed=seed)


def _costs(s: HybridSettings) -> tuple[float, ...]:
    """What the parts of a fit are expected to take, of each other: as `_identify` goes through them."""
    h = float(s.neurons if s.neurons is not None else 4)
    return 3.0, 1.0, 100.0 if s.neurons is None else 0.0, 2 + h, 2 + h, 2 + h, 3.0 if s.ne is None else 0.0, 1 + h


def _polynomial(s: HybridSettings, first: NonlinearFit, model: PolynomialNarmax) -> Work:
    """The polynomial model as a hybrid without neurons, its chosen noise terms in a full C."""
    terms = tuple(tuple(x for x in one if all(f.kind != "e" for f in x)) for one in model.numerators)
    ne = max((f.lag for one in model.numerators for x in one for f in x if f.kind == "e"), default=0)
    p, m = model.n_outputs, model.n_inputs
    shape = HybridShape(
        terms=terms,
        ne=ne if s.ne is None else s.ne,
        network=NarxShape(n_outputs=p, n_inputs=m, ny=s.ny, nu=s.nu, nk=s.nk, neurons=0),
        deep=s.innovations == "network",
    )
    known = dict(zip(model.names, model.theta / model.unit, strict=True))
    theta, factor = inverted(shape, np.array([known.get(name, 0.0) for name in shape.names], dtype=np.float64))
    found = first.details.get("candidates", 0)
    return Work(
        shape=shape,
        theta=theta,
        n_candidates=found if isinstance(found, int) else 0,
        err=_ratios(first.details.get("terms")),
        curves=[replace(c, method=f"polynomial: {c.method}") for c in first.curves],
        drawn_in=factor,
    )


def _ratios(terms: object) -> dict[tuple[str, str], float]:
    """Error reduction ratios by output and term, from the details of the polynomial's fit."""
    if not isinstance(terms, Mapping):
        return {}
    return {(out, x["term"]): x["err"] for out, one in terms.items() for x in one if x["err"] is not None}


def _identify(s: HybridSettings, data: Scaled, work: Work, seed: int, ticks: list[Tick | None]) -> None:
    began = perf_counter()
    work.shape = lean = _lean(work.shape)
    _searched(s, data, work, "polynomial and noise model", ticks[0])
    full, start = _prepared(s, lean, work.theta)
    neurons = s.neurons
    if neurons is None:
        neurons, work.tried = chosen_neurons(full, start, data.parts, s.prior, s.held_out, seed, ticks[1])
        if not neurons:
            why = (
                "predicts held-out data as well as with a network" if work.tried else "is all that so few samples carry"
            )
            work.warnings.append(f"the polynomial alone {why}: no neurons were added")
    work.timing_s["choice of neurons"] = perf_counter() - began
    began = perf_counter()
    if neurons:
        shape = full.with_sizes(neurons=neurons)
        theta, curve = trained(shape, start, data.parts, s.prior, s.starts, seed, ticks[2])
        work.keep(shape, theta)
        work.curves.append(curve)
        problem = _searched(s, data, work, "all together", ticks[3])
        if s.pruning == "prediction":
            found_terms = Candidates(terms=_candidates(s, full), criterion=s.criterion)
            revised(problem.at(work.theta), work.theta, found_terms, work.keep, ticks[4])
            old, new = (x.names[: x.sizes[0]] for x in (lean, work.shape))
            work.added, work.dropped = (tuple(x for x in a if x not in b) for a, b in ((new, old), (old, new)))
    if s.ne is None:
        problem = problem_at(work.shape, data.parts, work.theta, s.prior)
        work.keep(*chosen_noise(problem, work.theta, s.criterion, ticks[5]))
        if not neurons:
            shape = _lean(work.shape)
            work.keep(shape, moved(work.shape, work.theta, shape))
    _searched(s, data, work, "all together", ticks[6])
    work.timing_s["all together"] = perf_counter() - began


def _prepared(s: HybridSettings, lean: HybridShape, theta: Array) -> tuple[HybridShape, Array]:
    """The shape that a network joins, with all its regressors in the polynomial too: it shall not do what is linear."""
    shape = replace(lean, network=replace(lean.network, ny=s.ny, nu=s.nu))
    if s.pruning == "none":
        return shape, theta
    linear = tuple((f,) for f in lagged(shape.n_outputs, shape.n_inputs, ny=s.ny, nu=s.nu, nk=s.nk, ne=0))
    shape = replace(shape, terms=tuple((*t, *(x for x in linear if x not in t)) for t in shape.terms))
    return shape, moved(lean, theta, shape)


def _candidates(s: HybridSettings, shape: HybridShape) -> tuple[Term, ...]:
    """What the terms of the polynomial are chosen from."""
    factors = lagged(shape.n_outputs, shape.n_inputs, ny=s.ny, nu=s.nu, nk=s.nk, ne=0)
    return products(factors, s.degree, constant=bool(s.constant))


def _lean(shape: HybridShape) -> HybridShape:
    """Without neurons, no more lags than the polynomial looks at: a model of as little past as there can be."""
    reach = {"y": 0, "u": 0}
    for f in (f for one in shape.terms for x in one for f in x):
        reach[f.kind] = max(reach[f.kind], f.lag - (shape.network.nk - 1 if f.kind == "u" else 0))
    if not any(reach.values()):
        return shape
    return replace(shape, network=replace(shape.network, ny=reach["y"], nu=reach["u"]))


def _searched(s: HybridSettings, data: Scaled, work: Work, stage: str, tick: Tick | None) -> HybridProblem:
    """Search for all numbers, errors of unit variance."""
    shape = work.shape
    problem = problem_at(shape, data.parts, work.theta, s.prior)
    if tick is not None:
        tick(stage, 0.0)
    found = search(
        problem,
        work.theta,
        stage=stage,
        most=s.iterations,
        tolerance=1e-8 if shape.neurons else 1e-10,
        enough=_ENOUGH if shape.neurons else 0.0,
        damping=1e-4,
        tick=tick,
        keep=lambda theta: work.keep(shape, theta),
    )
    work.keep(shape, found.theta)
    work.curves.append(learning(found, problem, stage))
    work.status = "converged" if found.converged else "stalled"
    return problem
