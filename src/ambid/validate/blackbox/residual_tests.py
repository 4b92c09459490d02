"""Residual tests of a black-box fit: autocorrelation, cross-correlation with the inputs, and evidence for feedback.

Each test is a score test (`score`), output by output, so that the estimated numbers are accounted for; p-values of
several outputs are joined by Bonferroni's rule. Only the past is tested, so that feedback does not disturb the verdict
on the model; whether future inputs depend on present residuals is a question of its own, about the loop.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.estimation.criteria import skipped
from ambid.validate.blackbox.gradient import Gradient
from ambid.validate.blackbox.predictor import Errors
from ambid.validate.blackbox.score import Score, autoregression, instrumental_score, score
from ambid.validate.residuals import P_LEAST, ResidualTest

WHITE_LAGS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 13, 16, 20, 25)
_INPUT_LAGS, _LONGEST = 16, 400
_LOOP_LAGS, _OWN_LAGS = 10, 20
_MOST = 2e7  # numbers in a test's regressors: of longer records the last part is tested
_NORMAL_99 = 2.5758293035489004


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correlations:
    """Correlation coefficients of a residual, with bounds, ready to be drawn."""

    output: str  # whose residual
    other: str  # what it is correlated with: an output's residual (``kind`` "auto") or an input ("cross")
    kind: str
    # (n_lags,), samples, the other signal comes before the residual by this much; for an input also negative: after it
    lags: NDArray[np.int64]
    values: Array  # (n_lags,)
    # (n_lags,), 99 % of the values are within -+ band if the model is right; the estimated numbers are accounted for.
    # For negative lags: if, besides, there is no feedback.
    band: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualTests:
    """What the residuals say."""

    white: ResidualTest  # residuals against past residuals, worst output
    uncorrelated: ResidualTest | None  # residuals against past inputs, worst output; None without inputs
    feedback: ResidualTest | None  # inputs against past residuals: small p is evidence for feedback
    white_output: str  # which output, or input, that was
    uncorrelated_output: str
    feedback_input: str
    # autoregression of every residual where the model does not describe the noise; [1] otherwise
    colours: tuple[Array, ...]


def residual_tests(data: IOData, found: Errors, slopes: Gradient, *, with_reference: bool = False) -> ResidualTests:
    """Test the residuals of a fit.

    `found`: the data run through the fit; `slopes`: derivatives of its predictions.
    """
    e, u = found.one_step, data.u
    source = data.reference if with_reference else u
    colours = tuple(
        np.ones(1) if found.claims_noise else autoregression(column[skipped(e.shape[0]) :]) for column in e.T
    )
    white_lags = tuple(k for k in WHITE_LAGS if k < e.shape[0] // 10) or (1,)
    white = [_tested(e[:, o], J, e, white_lags) for o, J in enumerate(slopes.rows)]
    loop = _feedback(u, e)
    # Under feedback the present input may depend on the present residual, whatever the user says of the loop.
    lags = input_lags(e.shape[0], with_now=data.open_loop and all(s.p * len(loop) >= P_LEAST for s, _ in loop))
    against = [
        _tested(
            e[:, o],
            J,
            source,
            lags,
            colour=colours[o] if with_reference or colours[o].size > 1 else None,
            instrumental=with_reference,
        )
        for o, J in enumerate(slopes.rows)
        if data.n_inputs
    ]
    k, j, i = (int(np.argmin([s.p for s, _ in x])) if x else 0 for x in (white, against, loop))
    return ResidualTests(
        white=_worst(white, k),
        uncorrelated=_worst(against, j) if against else None,
        feedback=_worst(loop, i) if loop else None,
        white_output=data.outputs[k],
        uncorrelated_output=data.outputs[j],
        feedback_input=data.inputs[i] if loop else "",
        colours=colours,
    )


def input_lags(n_samples: int, *, with_now: bool) -> tuple[int, ...]:
    """Return the lags at which inputs are tested.

    Returns every one up to 16, then in even ratios up to a twentieth of the record, at most 400.
    """
    longest = max(3, min(n_samples // 20, _LONGEST))
    near = range(0 if with_now else 1, min(_INPUT_LAGS, longest) + 1)
    far = (round(float(k)) for k in np.geomspace(_INPUT_LAGS, longest, 7)) if longest > _INPUT_LAGS else ()
    return tuple(sorted({*near, *far}))


def correlations(
    fit: BlackBoxFit, data: IOData, found: Errors, slopes: Gradient, *, n_lags: int = 30
) -> tuple[Correlations, ...]:
    """Correlate every residual with every residual and every input.

    `n_lags`: largest lag. Returns output by output: own residual first, then the other outputs' residuals, then the
    inputs.
    """
    out, e = list[Correlations](), found.one_step
    ahead = np.arange(1, min(n_lags, e.shape[0] // 4) + 1)
    both = np.concatenate([-ahead[::-1], [0], ahead])
    for o, J in enumerate(slopes.rows):
        colour = None if found.claims_noise else autoregression(e[skipped(e.shape[0]) :, o])
        for other in (o, *(k for k in range(data.n_outputs) if k != o)):
            s = _tested(e[:, o], J, e[:, [other]], tuple(ahead.tolist()))[0]
            out.append(_drawn(fit.outputs[o], fit.outputs[other], "auto", ahead, s))
        for i in range(data.n_inputs):
            s = _tested(e[:, o], J, data.u[:, [i]], tuple(both.tolist()), colour=colour)[0]
            out.append(_drawn(fit.outputs[o], fit.inputs[i], "cross", both, s))
    return tuple(out)


def _drawn(output: str, other: str, kind: str, lags: NDArray[np.int64], s: Score) -> Correlations:
    return Correlations(output=output, other=other, kind=kind, lags=lags, values=s.correlation, band=_NORMAL_99 * s.sd)


def _tested(
    e: Array,
    J: Array,
    signals: Array,
    lags: tuple[int, ...],
    *,
    colour: Array | None = None,
    instrumental: bool = False,
) -> tuple[Score, tuple[int, ...]]:
    """Score test of lagged signals; the second is the lag of each regressor."""
    n = e.size
    width = max(1, J.shape[1] + len(lags) * signals.shape[1])
    first = max(skipped(n), max(lags), n - int(_MOST / width))
    last = n + min(0, *lags)
    centred = signals - signals.mean(axis=0)
    lagged = np.hstack([centred[first - k : last - k] for k in lags])
    at = tuple(np.repeat(lags, signals.shape[1]).tolist())
    if instrumental and colour is not None:
        return instrumental_score(e[first:last], J[first:last], lagged, colour=colour), at
    return score(e[first:last], J[first:last], lagged, colour=colour), at


def _feedback(u: Array, e: Array) -> list[tuple[Score, tuple[int, ...]]]:
    """Granger's test of residuals -> inputs: do past residuals say more of an input than its own past (Caines 1975)?"""
    n = u.shape[0]
    own, loop = min(_OWN_LAGS, n // 20), min(_LOOP_LAGS, n // 20)
    if not u.shape[1] or loop < 1:
        return []
    longest = int(_MOST / (own * u.shape[1] + loop * e.shape[1]))
    u, e = u[-longest:], e[-longest:]
    n = u.shape[0]
    centred = u - u.mean(axis=0)
    past = np.zeros((n, own * u.shape[1]))
    for k in range(1, own + 1):
        past[k:, (k - 1) * u.shape[1] : k * u.shape[1]] = centred[:-k]
    lags = tuple(range(1, loop + 1))
    found = []
    for i in range(u.shape[1]):
        s, at = _tested(centred[:, i], past, e, lags)
        found.append((s, at))
    return found


def _worst(tests: list[tuple[Score, tuple[int, ...]]], place: int) -> ResidualTest:
    s, lags = tests[place]
    k = int(np.argmax(np.abs(s.correlation))) if s.correlation.size else 0
    return ResidualTest(
        p=min(1.0, s.p * len(tests)),
        statistic=s.statistic,
        degrees=s.degrees,
        largest=float(np.abs(s.correlation[k])) if s.correlation.size else 0.0,
        largest_lag=lags[k],
    )
