"""Training of a state-space network: weights and first states by Levenberg-Marquardt, gain, hidden layer, covariance.

Hidden weights are N(0, prior^2), output 1 the size of their row's linear part. Units are anchored, without value and
slope at the operating point: A and B are the linearisation there (thesis eq. 4.9).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.estimation.linear import information_inverse
from ambid.estimation.progress import Tick, part_of, portions
from ambid.estimation.search import search
from ambid.estimation.uncertainty import explained_by_past
from ambid.nonlinear.fit import Attempt, LearningCurve, NonlinearFit
from ambid.nonlinear.lagged_problem import sandwich_at
from ambid.nonlinear.records import Scaled, cloud_of
from ambid.nonlinear.state_network import Layout, StateNetwork, StateProblem, largest_pole
from ambid.settings.caller import setting

_ROUNDS = 3  # of weighting: the errors' covariance is known only afterwards
_SHARES = (0.0, 0.6, 0.85, 1.0)  # of the time that is over before each round
_ENOUGH = 1e-3  # gain that ends a search: a step of 0.03 standard deviations
_PAST = 10  # samples of errors and inputs that a regression of the errors looks at
_PRIOR = 3.0  # deviation of hidden weights before the data, scaled
_LEAST = 1e-7  # deviation of errors, in that of the outputs: less is rounding
_FAR = 0.3  # part of the errors' variance that a linear regression may explain before a fit counts as failed ..
_SUSPECT = 0.005  # .. and from which it is worth a warning, if it is more than chance
_CHANCE = 1e-3
_AS_GOOD = 0.02  # logarithm of an output's error variance, by which a start may be worse: 1 % of the error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class State:
    """A network on its way."""

    layout: Layout
    theta: Array  # (n_theta,), scaled
    x0: Array  # (n_records, n), scaled, first states
    noise: Array  # (n_outputs, n_outputs), scaled, covariance of its errors
    n_rows: int = 0  # samples in all
    prior: float | None = None  # deviation of the hidden layer's weights before the data

    @classmethod
    def of(cls, layout: Layout, theta: Array, data: Scaled) -> State:
        """Return a network that starts each record from its first outputs."""
        x0 = np.zeros((len(data.parts), layout.n))
        for k, (y, _) in enumerate(data.parts):
            x0[k, layout.heads] = y[0]
        return cls(layout=layout, theta=theta, x0=x0, noise=np.eye(layout.p))

    @property
    def vector(self) -> Array:
        """Weights and first states, shape (n_theta + n_records n,)."""
        return np.concatenate([self.theta, self.x0.ravel()])

    @property
    def K(self) -> Array:
        """Gain, shape (n, n_outputs)."""
        return self.layout.matrices(self.theta).K

    @property
    def score(self) -> float:
        """Logarithm of the determinant of the errors' covariance: what maximum likelihood makes small."""
        return float(np.linalg.slogdet(self.noise + _LEAST**2 * np.eye(self.layout.p))[1])

    @property
    def size(self) -> float:
        """Errors in deviations of the outputs, the geometric mean over outputs."""
        return float(np.exp(self.score / self.layout.p / 2.0))

    @property
    def bic(self) -> float:
        """Bayes' criterion, first states counted."""
        return self.n_rows * self.score + self.vector.size * float(np.log(self.n_rows))

    @property
    def stable(self) -> bool:
        """Whether no pole lies outside the unit circle, integrators allowed."""
        return bool(np.max(np.abs(np.linalg.eigvals(self.layout.matrices(self.theta).A))) < 1.0 + 1e-4)

    def simulates(self, data: Scaled) -> bool:
        """Return whether it runs freely with errors no larger than twice the outputs' deviations."""
        at = self.at(self.problem(data), self.vector)
        return at is not None and bool(np.all(np.diag(at.noise) < 4.0))

    def widen(self, **changes: Any) -> State:
        """Return the same network with another ``gain`` or number of ``neurons``; new weights are zero."""
        layout, theta = self.layout.widen(self.theta, **changes)
        return replace(self, layout=layout, theta=theta)

    def problem(self, data: Scaled) -> StateProblem:
        """Return the problem whose errors have unit covariance here."""
        noise = self.noise + _LEAST**2 * np.eye(self.layout.p)
        return StateProblem(
            layout=self.layout,
            parts=tuple(
                (np.ascontiguousarray(y), np.hstack([u, np.ones((u.shape[0], 1))])) for y, u in data.parts
            ),
            weight=np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(noise)).T),
            prior=self.prior,
        )  # fmt: skip

    def at(self, problem: StateProblem, v: Array) -> State | None:
        """Return the network at another vector, with the covariance of its errors; None where it diverges."""
        theta, x0 = problem.split(v)
        with np.errstate(over="ignore", invalid="ignore"):
            e = np.concatenate(problem.errors(v)[1])
            noise = e.T @ e / e.shape[0]
        if not np.all(np.isfinite(noise)):
            return None
        return replace(self, theta=theta, x0=x0, noise=noise, n_rows=e.shape[0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Training:
    """What a training came to."""

    state: State
    curve: LearningCurve
    converged: bool


@dataclass(slots=True, kw_only=True)
class Fitting(Attempt):
    """What a fit has come to."""

    whole: Scaled
    data: Scaled  # each output beside the input that acts at its time
    delay: int = 0
    state: State | None = None  # the best network so far; None before the first
    rivals: list[State] = field(default_factory=list)  # what every start of a hidden layer came to

    @property
    def dt(self) -> float:
        """Sampling interval in s."""
        return self.records[0].dt

    @property
    def counts_states(self) -> bool:
        """Whether the number of states is to be chosen."""
        return self.settings["form"] == "free" and "states" not in self.settings

    def shift(self, delay: int) -> None:
        """Put each output beside the input that acts at its time, `delay` samples late."""
        self.delay, self.data = delay, shift_inputs(self.whole, delay)

    def take(self, trained: Training) -> None:
        """Take over a learning curve, and the network if it is better, or has units or a gain that the last had not."""
        self.curves.append(trained.curve)
        at, now = trained.state, self.state
        kinds = [(x.layout.neurons, x.layout.gain) for x in (at, now) if x is not None]
        if now is None or kinds[0] != kinds[1] or at.score < now.score:
            self.state, self.status = at, "converged" if trained.converged else "stalled"


def shift_inputs(data: Scaled, delay: int) -> Scaled:
    """Put each output beside the input that acts at its time, `delay` samples late."""
    if not delay:
        return data
    return replace(data, parts=tuple((y[delay:], u[:-delay]) for y, u in data.parts))


# --- training --------------------------------------------------------------------------------------------------------


def train(
    state: State,
    data: Scaled,
    *,
    stage: str,
    iterations: int,
    tick: Tick | None = None,
    fitting: Fitting | None = None,
    rounds: int = _ROUNDS,
    damping: float | None = None,
) -> Training | None:
    """Search weights and first states over whole records, None where the start diverges; `fitting` keeps what was
    found, also of an interrupted search.
    """
    if damping is None:  # physics alone begins near: Gauss-Newton at once
        damping = 1e-3 if state.layout.neurons else 1e-9
    at = state.at(state.problem(data), state.vector)
    if at is None:
        return None
    seconds, errors = [0.0], list[float]()
    what = "prediction" if state.layout.gain else "simulation"
    for k in range(rounds):
        before, problem = at, at.problem(data)
        if at.layout.gain:  # a start that is not stable may stay so
            problem = replace(problem, farthest=max(1.0, largest_pole(at.layout, at.theta) * (1.0 + 1e-9)))
        ended = search(
            problem, at.vector, stage=stage, most=iterations, tolerance=0.0, enough=_ENOUGH * 100.0 ** (k == 0),
            damping=damping, tick=part_of(tick, *_SHARES[k : k + 2]), keep_best=True,
        )  # fmt: skip
        seconds += [seconds[-1] + t for t in ended.seconds]
        errors += [before.size * float(np.sqrt(c / (at.n_rows * at.layout.p))) for c in ended.costs]
        at = at.at(problem, ended.theta) or at
        curve = LearningCurve(
            method=f"Levenberg-Marquardt, {what} errors", seconds=np.array(seconds[1:]), training=np.array(errors)
        )
        result = Training(state=at, curve=curve, converged=ended.converged)
        if ended.interrupted or abs(before.score - at.score) < 0.02:
            break
    if fitting is not None:
        fitting.take(result)
    if ended.interrupted:
        raise KeyboardInterrupt
    return result


def train_each(starts: Sequence[State], data: Scaled, tick: Tick | None, **how: Any) -> list[Training]:
    """Train from several starts, one after the other, best first; those that diverge are left out."""
    parts = portions(tick, [1.0] * len(starts))
    trained = [train(start, data, tick=own, **how) for start, own in zip(starts, parts, strict=True)]
    return sorted((x for x in trained if x is not None), key=lambda x: x.state.score)


def add_gain(state: State, data: Scaled, K: Array) -> State | None:
    """Return the network with a predictor gain near `K` (n, p), scaled; None if it diverges with every try."""
    wide = state.widen(gain=True)
    layout, problem = wide.layout, wide.problem(data)
    k = len(layout.entries)
    heads = np.zeros((layout.n, layout.p))
    heads[layout.heads, range(layout.p)] = 0.5

    def with_gain(gain: Array) -> State | None:
        v = wide.vector
        v[k : layout.n_directions] = gain.ravel()
        return wide.at(problem, v)

    return best_of(with_gain(gain) for gain in (K, 0.5 * K, heads, 0.0 * K))


def best_of(states: Iterable[State | None]) -> State | None:
    """Return the network with the least errors of those that there are."""
    return min((x for x in states if x is not None), key=lambda x: x.score, default=None)


def add_units(state: State, neurons: int, seed: list[int]) -> State:
    """Put a hidden layer on the physics, in place of one that may be there, with random directions and no effect."""
    new = state.widen(neurons=0).widen(neurons=neurons)
    layout, rng = new.layout, np.random.default_rng(seed)
    k, (n_W1, n_b1, _) = layout.n_directions, layout.hidden_sizes
    new.theta[k : k + n_W1] = rng.standard_normal(n_W1) / np.sqrt(layout.n + layout.n_inputs)
    new.theta[k + n_W1 : k + n_W1 + n_b1] = rng.standard_normal(n_b1)
    return replace(new, prior=_PRIOR)


# --- judgement -------------------------------------------------------------------------------------------------------


def is_white(state: State, data: Scaled) -> bool:
    """Return whether past errors say no more of the errors than by chance."""
    return misfit(state, data, inputs=False).p > _CHANCE


@dataclass(frozen=True, slots=True, kw_only=True)
class Misfit:
    """What a linear regression on the past makes of the errors; little where a search ended well."""

    share: float  # of the errors' variance that it explains, corrected for chance; 1 where the network diverges
    p: float  # chance of so much where the past says nothing

    @property
    def failed(self) -> bool:
        """Whether the training went nowhere."""
        return self.share > _FAR

    @property
    def suspect(self) -> bool:
        """Whether the training may have ended in a wrong minimum."""
        return self.share > _SUSPECT and self.p < _CHANCE

    def __str__(self) -> str:
        return f"a linear regression on the past explains {100 * self.share:.2g} % of the errors' variance"


def misfit(state: State, data: Scaled, *, inputs: bool = True) -> Misfit:
    """Regress errors on past inputs, and with a gain on past errors (else perhaps coloured): a linear model of high
    order predicts no better than the best network, unless the plant has more to it.
    """
    from scipy.stats import chi2

    problem = state.problem(data)
    with np.errstate(over="ignore", invalid="ignore"):
        errors = problem.errors(state.vector)[1]
    if not all(np.all(np.isfinite(e)) for e in errors):
        return Misfit(share=1.0, p=0.0)
    parts = [
        (e, [(e, _PAST)] * (state.layout.gain or not inputs) + [(u[:, :-1], _PAST)] * inputs)
        for e, (_, u) in zip(errors, problem.parts, strict=True)
    ]
    share, statistic, freedom = explained_by_past(parts, least=1.0)
    return Misfit(share=share, p=float(chi2.sf(statistic, freedom)))


# --- standard deviations ---------------------------------------------------------------------------------------------


def _estimate_spread(fitting: Fitting, state: State) -> tuple[Array | None, str]:
    """Covariance of trained weights in the model's units, first states counted, and its source; warnings say what to
    mind.
    """
    data, how = fitting.data, fitting.settings["uncertainty"]
    problem, v = state.problem(data), state.vector
    P, fitting.details["condition"] = information_inverse(problem.triangle(v)[:, :-1])
    reason = ""
    if how == "none":
        reason = "no standard deviations: no covariance was requested"
    elif state.layout.form == "one-axis" and state.layout.neurons:
        reason = (
            "no standard deviations: A and B are the slope of the network at the operating point, and the error of "
            "its units there is unknown; 95 % intervals without it hold in half of the cases. Compare fits with "
            "more neurons or smaller motion, or give neurons = 0"
        )
    elif P is None:
        reason = (
            "no standard deviations: the data do not determine all weights (condition number "
            f"{fitting.details['condition']:.1e}). Use fewer states or neurons, or more excitation"
        )
    if reason:
        fitting.warnings.append(reason)
        return None, ""
    assert P is not None
    origin = "laplace" if state.layout.neurons else "information"
    if how == "sandwich" or (how == "auto" and not is_white(state, data)):
        robust = sandwich_at(problem, v)
        assert robust is not None
        P, origin = robust, "sandwich"
    unit, k = state.layout.unit, state.theta.size
    covariance = P[:k, :k] * unit[:, None] * unit
    extra, warnings = disagreement(state, fitting.rivals, covariance)
    if state.layout.neurons:
        fitting.warnings.append(
            "A and B are the slope of the network at the operating point; their standard deviations do not include "
            "the error of its units there. Compare a fit with more neurons, or with smaller motion"
        )
    fitting.warnings += warnings
    return covariance + extra, origin


def disagreement(state: State, rivals: Sequence[State], covariance: Array) -> tuple[Array, tuple[str, ...]]:
    """Return what starts that fit about as well disagree by, to be added to `covariance` (in the units of the model's
    weights), and what to say of it: few hidden units only come near the plant, and the likelihood is too sure of A and
    B.
    """
    k = len(state.layout.entries)
    unit, extra = state.layout.unit[:k], np.zeros_like(covariance)
    close = [r for r in rivals if r.score < state.score + _AS_GOOD * state.layout.p and r.layout.neurons]
    if len(close) < 2:
        return extra, ()
    apart = np.array([(r.theta[:k] - state.theta[:k]) * unit for r in close])
    extra[:k, :k] = apart.T @ apart / (len(close) - 1.0)
    ratio = np.sqrt(np.diag(extra)[:k] / np.maximum(np.diag(covariance)[:k], 1e-300))
    if not np.max(ratio) > 1.0:
        return extra, ()
    worst = int(np.argmax(ratio))
    return extra, (
        f"starts of the hidden layer that fit about equally well disagree about {state.layout.names[worst]} by "
        f"{ratio[worst]:.1f} of the standard deviations of the likelihood; the standard deviations include that. "
        "Use more neurons or starts, or smaller motion",
    )


# --- the fit ---------------------------------------------------------------------------------------------------------


def finish(fitting: Fitting, reason: str) -> NonlinearFit:
    """Return a trained network's fit, failed where there is none (`reason`), or none that runs on its own records."""
    state, data, records = fitting.state, fitting.data, fitting.records
    fitting.settings = {"states": 0, "neurons": 0, **fitting.settings, "delay": fitting.delay}
    if state is None:
        return fitting.failed(reason)
    fitting.settings |= {"states": state.layout.n, "neurons": state.layout.neurons}
    state = state.at(state.problem(data), state.vector)
    model = None if state is None else _make_model(records, data, state, fitting.delay)
    if state is None or model is None:
        return fitting.failed("the network does not stay finite on its training records: check the columns")
    if records[0].n_inputs and not all(x.open_loop for x in records) and not state.layout.gain:
        fitting.warnings.append(
            "trained on simulation errors, nn is biased by feedback: give noise = innovations, or give "
            f"{setting('open_loop', True)} if the records are open loop"
        )
    with fitting.stage("standard deviations"):
        covariance, origin = _estimate_spread(fitting, state)
    fitting.timing_s["all"] = sum(fitting.timing_s.values())
    freedom = max(state.n_rows - state.layout.n_theta / state.layout.p, 1.0)
    noise = state.noise * state.n_rows / freedom
    fitting.details |= {
        "form": state.layout.form, "gain": state.layout.gain, "A": model.A.tolist(), "B": model.B.tolist(),
        "K": state.K.tolist(),
    }  # fmt: skip
    return fitting.result(
        model=model, covariance=covariance, covariance_from=origin,
        n_estimated=int(state.theta.size), noise_covariance=noise * data.y_scale[:, None] * data.y_scale,
    )  # fmt: skip


def _make_model(records: Sequence[IOData], data: Scaled, state: State, delay: int) -> StateNetwork | None:
    """The model with the cloud of its own states in training; None where it leaves the finite numbers there."""
    model = StateNetwork(
        layout=state.layout, theta=state.theta * state.layout.unit, delay=delay, u_level=data.u_level,
        u_scale=data.u_scale, y_level=data.y_level, y_scale=data.y_scale,
        cloud=cloud_of(np.zeros((1, state.layout.n + state.layout.n_inputs))),
    )  # fmt: skip
    with np.errstate(over="ignore", invalid="ignore"):
        z = np.concatenate([model.regressors(x.u, x.y) for x in records])
    if not np.all(np.isfinite(z)) or not np.all(np.isfinite(model.theta)):
        return None
    return replace(model, cloud=cloud_of(z))
