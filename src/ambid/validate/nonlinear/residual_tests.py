"""Residual tests of a nonlinear fit: is anything left that past outputs, inputs, or products of them explain?

Linear correlations miss what a nonlinear model leaves over: a residual that holds u^2 is uncorrelated with u. So the
residual e is tested against its own past and past inputs, against past u^2 and past e u, and e^2 against past u^2
(Billings and Voon 1986). Each is a score test (`validate.blackbox.score`), so that the estimated numbers are accounted
for, and all look at the past alone, so that feedback does not disturb them. u^2 is the square of the deviation from the
mean over all records. Outputs are joined by Bonferroni's rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.estimation.criteria import skipped
from ambid.nonlinear.fit import NonlinearFit
from ambid.validate.blackbox.residual_tests import WHITE_LAGS, input_lags
from ambid.validate.blackbox.score import Score, autoregression, instrumental_score, score
from ambid.validate.nonlinear.runs import Run, looks_back, model_of
from ambid.validate.residuals import ResidualTest

_PRODUCT_LAGS = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20)
_LOOP_LAGS, _OWN_LAGS = 10, 20
_MOST = 2e7  # numbers in a test's regressors: of longer records the last part is tested
_LEAST = 60  # samples of a record from which its residuals are tested
_NORMAL_99 = 2.5758293035489004


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Material:
    """What the tests look at, record by record, without the samples at the start."""

    e: list[Array]  # (n_used, n_outputs), one-step errors over their size
    u: list[Array]  # (n_used, n_inputs), deviations of the inputs from their mean over all records, over their size
    J: list[Array]  # (n_used, n_outputs, n_theta), derivatives of the predictions
    # autoregression of each output's error, where the model leaves the colour of the noise open
    colours: tuple[Array, ...] | None
    # whether `J` holds noise that such errors depend on: for a model that was fitted to its free run, but predicts
    # from measured outputs. Then inputs serve as instruments.
    instrumental: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NonlinearTests:
    """What the residuals say; each the worst output."""

    white: ResidualTest  # e against past e
    # e against past u, e against past u^2, e^2 against past u^2; None without inputs, and where the model has more
    # parameters than a test has instruments
    uncorrelated: ResidualTest | None
    squares: ResidualTest | None
    # e against past e u; None without inputs, and where the model leaves the colour of the noise open
    products: ResidualTest | None
    variance: ResidualTest | None
    feedback: ResidualTest | None  # inputs against past e: small p is evidence for feedback


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correlation:
    """Correlation coefficients, ready to be drawn."""

    output: str  # whose error; what is correlated with what
    title: str
    lags: NDArray[np.int64]  # (n_lags,), samples, the second comes before the first by this much
    # (n_lags,), 99 % of the values are within -+ band if the model is right; the estimated numbers are accounted for
    values: Array
    band: Array


def material(fit: NonlinearFit, records: Sequence[IOData], runs: Sequence[Run], *, coloured: bool) -> Material | None:
    """Prepare errors, inputs and derivatives for the tests.

    `fit`: with a model; `runs`: of these records, all finite; `coloured`: whether the model leaves the colour of the
    noise open. Returns none where no record has samples enough.
    """
    used = [(x, r) for x, r in zip(records, runs, strict=True) if x.n_samples - r.lag >= _LEAST]
    if not used:
        return None
    width = len(fit.outputs) * max(model_of(fit, used[0][0]).theta.size, 1) + 40 * (len(fit.inputs) + len(fit.outputs))
    most = max(int(_MOST / width / len(used)), _LEAST)
    e, u, J = list[Array](), list[Array](), list[Array]()
    for x, r in used:
        first = max(r.lag, skipped(x.n_samples), x.n_samples - most)
        lead = min(first, r.lag + skipped(x.n_samples))  # for derivatives that are recursions to settle
        slopes = model_of(fit, x).jacobian(x.u[first - lead :], x.y[first - lead :])[lead:]
        e.append(r.one_step[first:])
        u.append(x.u[first:])
        J.append(slopes)
    e = [x / np.where(s > 0, s, 1.0) for s in (np.sqrt(np.mean(np.concatenate(e) ** 2, axis=0)),) for x in e]
    whole = np.concatenate(u)
    level, size = (whole.mean(axis=0), whole.std(axis=0)) if whole.shape[1] else (np.zeros(0), np.zeros(0))
    u = [(x - level) / np.where(size > 0, size, 1.0) for x in u]
    longest = max(e, key=len)
    colours = tuple(autoregression(column) for column in longest.T) if coloured else None
    instrumental = coloured and any(looks_back(x, r) for x, r in used)
    return Material(e=e, u=u, J=J, colours=colours, instrumental=instrumental)


def residual_tests(of: Material, *, with_now: bool) -> NonlinearTests:
    """Test the residuals."""
    shortest = min(x.shape[0] for x in of.e)
    white = tuple(k for k in WHITE_LAGS if k < shortest // 10) or (1,)
    products = tuple(k for k in _PRODUCT_LAGS if k < shortest // 10) or (1,)
    inputs = bool(of.u[0].shape[1])
    loop = _feedback(of) if inputs else None
    lags = input_lags(shortest, with_now=with_now and (loop is None or loop.passed))
    squares = _squares(of)
    # As instruments, squares alone are too few for most models.
    instruments = [np.hstack([a, b]) for a, b in zip(of.u, squares, strict=True)] if of.instrumental else squares
    return NonlinearTests(
        white=_worst([_tested(of, o, of.e, white) for o in _outputs(of)], white, of.e[0].shape[1]),
        uncorrelated=_against(of, of.u, lags) if inputs else None,
        squares=_against(of, instruments, products) if inputs else None,
        products=_products(of, products) if inputs and of.colours is None else None,
        variance=_worst([_variance(of, o, squares, products) for o in _outputs(of)], products, squares[0].shape[1])
        if inputs
        else None,
        feedback=loop,
    )


def correlations(of: Material, inputs: Sequence[str], outputs: Sequence[str], *, n_lags: int = 20) -> list[Correlation]:
    """Correlate the errors of each output with what the tests look at, lag by lag.

    `inputs`, `outputs`: names. Returns output by output: with its own past, then for each input with u, u^2, e u, and
    of e^2 with u^2.
    """
    lags = tuple(range(1, min(n_lags, min(x.shape[0] for x in of.e) // 4) + 1))
    squares = _squares(of)
    found = list[Correlation]()
    for o, output in enumerate(outputs):
        one = [(f"e of {output}, its past", _tested(of, o, [x[:, [o]] for x in of.e], lags))]
        for i, name in enumerate(inputs):
            u, u2 = [x[:, [i]] for x in of.u], [x[:, [i]] for x in squares]
            one.append((f"e of {output}, {name}", _tested(of, o, u, lags, coloured=True)))
            one.append((f"e of {output}, {name}²", _tested(of, o, u2, lags, coloured=True)))
            if of.colours is None:
                mixed = [e[:, [o]] * v for e, v in zip(of.e, u, strict=True)]
                one.append((f"e of {output}, e × {name}", _tested(of, o, mixed, lags)))
            one.append((f"e² of {output}, {name}²", _variance(of, o, u2, lags)))
        found += [
            Correlation(output=output, title=t, lags=np.array(lags), values=s.correlation, band=_NORMAL_99 * s.sd)
            for t, s in one
        ]
    return found


def _squares(of: Material) -> list[Array]:
    """Squares of the inputs' deviations, less their mean over all records."""
    level = np.mean(np.concatenate(of.u) ** 2, axis=0)
    return [x**2 - level for x in of.u]


def _outputs(of: Material) -> range:
    return range(of.e[0].shape[1])


def _tested(of: Material, o: int, signals: list[Array], lags: tuple[int, ...], *, coloured: bool = False) -> Score:
    """Score test of lagged signals as regressors of the errors of one output."""
    longest = max(lags)
    e = np.concatenate([x[longest:, o] for x in of.e])
    J = np.concatenate([x[longest:, o] for x in of.J])
    colour = of.colours[o] if coloured and of.colours is not None else None
    if of.instrumental and colour is not None:
        return instrumental_score(e, J, _lagged(signals, lags), colour=colour)
    return score(e, J, _lagged(signals, lags), colour=colour)


def _variance(of: Material, o: int, squares: list[Array], lags: tuple[int, ...]) -> Score:
    """Test e^2 against past u^2; the estimated numbers shift e^2 in second order only, and need no account."""
    longest = max(lags)
    power = np.concatenate([x[longest:, o] ** 2 for x in of.e])
    colour = None if of.colours is None else autoregression(power)
    return score(power, np.zeros((power.size, 0)), _lagged(squares, lags), colour=colour)


def _lagged(signals: list[Array], lags: tuple[int, ...]) -> Array:
    """Columns of all signals at all lags, lag by lag; the first rows of each record are its past."""
    longest = max(lags)
    return np.concatenate([np.hstack([s[longest - k : s.shape[0] - k] for k in lags]) for s in signals])


def _against(of: Material, signals: list[Array], lags: tuple[int, ...]) -> ResidualTest | None:
    """Test errors against inputs; None where no instrument is left over."""
    found = [_tested(of, o, signals, lags, coloured=True) for o in _outputs(of)]
    worst = _worst(found, lags, signals[0].shape[1])
    return None if of.instrumental and not worst.degrees else worst


def _products(of: Material, lags: tuple[int, ...]) -> ResidualTest:
    """Test each output's error against its own past times the inputs'."""
    found = []
    for o in _outputs(of):
        mixed = [e[:, [o]] * u for e, u in zip(of.e, of.u, strict=True)]
        found.append(_tested(of, o, mixed, lags))
    return _worst(found, lags, of.u[0].shape[1])


def _feedback(of: Material) -> ResidualTest:
    """Granger's test of errors -> inputs: do past errors say more of an input than its own past (Caines 1975)?"""
    shortest = min(x.shape[0] for x in of.e)
    own, loop = max(1, min(_OWN_LAGS, shortest // 20)), max(1, min(_LOOP_LAGS, shortest // 20))
    longest = max(own, loop)
    past = np.concatenate([np.hstack([u[longest - k : u.shape[0] - k] for k in range(1, own + 1)]) for u in of.u])
    lags = tuple(range(1, loop + 1))
    errors = [x[longest - loop :] for x in of.e]
    found = []
    for i in range(of.u[0].shape[1]):
        now = np.concatenate([u[longest:, i] for u in of.u])
        found.append(score(now, past, _lagged(errors, lags)))
    return _worst(found, lags, of.e[0].shape[1])


def _worst(tests: list[Score], lags: tuple[int, ...], n_signals: int) -> ResidualTest:
    s = min(tests, key=lambda x: x.p)
    k = int(np.argmax(np.abs(s.correlation))) if s.correlation.size else 0
    return ResidualTest(
        p=min(1.0, s.p * len(tests)),
        statistic=s.statistic,
        degrees=s.degrees,
        largest=float(np.abs(s.correlation[k])) if s.correlation.size else 0.0,
        largest_lag=lags[k // n_signals],
    )
