"""What the tests of a nonlinear fit mean, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambid.blackbox.data import IOData
from ambid.estimation.estimate import Check
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.structures import nonlinear_structure
from ambid.validate.checks import explained_by_inputs, residual_check
from ambid.validate.nonlinear.residual_tests import NonlinearTests
from ambid.validate.nonlinear.runs import Run
from ambid.validate.residuals import P_LEAST, ResidualTest

_REACH = 10.0  # spans of what was measured that a free run may reach
_SHARE = 0.01  # of a record outside the training data, from which it is worth a warning


def residual_verdicts(fit: NonlinearFit, tests: NonlinearTests, *, coloured: bool) -> dict[str, Check]:
    """Put residual tests into words.

    `coloured`: whether the model leaves the colour of the noise open. Returns ``residuals_white``, and with inputs
    ``residuals_uncorrelated``, ``residuals_nonlinear``, ``residual_variance`` and ``feedback``.
    """
    white = residual_check(tests.white, "residuals against past residuals")
    if not white.passed and coloured:
        white = Check(
            passed=True,
            p=white.p,
            values=white.values,
            detail=f"residuals are coloured; this {fit.structure} does not describe noise, and need not",
        )
    checks = {"residuals_white": white}
    if tests.uncorrelated is not None:
        checks["residuals_uncorrelated"] = residual_check(tests.uncorrelated, "residuals against past inputs")
    if tests.squares is not None:
        checks["residuals_nonlinear"] = _nonlinear(tests.squares, tests.products)
    if tests.variance is not None:
        checks["residual_variance"] = _variance(tests.variance)
    if tests.feedback is not None:
        checks["feedback"] = _feedback(fit, tests, coloured=coloured)
    return checks


def _nonlinear(squares: ResidualTest, products: ResidualTest | None) -> Check:
    """One verdict of both; p by Bonferroni's rule."""
    both = [(squares, "residuals against squares of past inputs")]
    if products is not None:
        both.append((products, "residuals against past residuals times inputs"))
    worst, what = min(both, key=lambda x: x[0].p)
    joined = ResidualTest(
        p=min(1.0, len(both) * worst.p),
        statistic=worst.statistic,
        degrees=worst.degrees,
        largest=worst.largest,
        largest_lag=worst.largest_lag,
    )
    check = residual_check(joined, what)
    values = {**check.values, "p_squares": squares.p}
    if products is not None:
        values["p_products"] = products.p
    return Check(passed=check.passed, p=check.p, detail=check.detail, values=values)


def _variance(test: ResidualTest) -> Check:
    check = residual_check(test, "squared residuals against squares of past inputs")
    if check.passed:
        return check
    detail = (
        "the size of the residuals depends on past inputs: standard deviations take it as constant, or a nonlinearity "
        f"is missing (largest correlation {test.largest:.3f} at lag {test.largest_lag}, p = {test.p:.2g})"
    )
    return Check(passed=False, p=check.p, detail=detail, values=check.values)


def feedback_biases(fit: NonlinearFit, *, coloured: bool) -> bool:
    """Return whether feedback biases a fit.

    `coloured`: whether the model leaves the colour of the noise open. Returns true for structures that the register
    calls biased, and for fits without a noise model.
    """
    kind = nonlinear_structure(fit.structure).feedback
    return kind == "biased" or (kind == "with noise model" and coloured)


def _feedback(fit: NonlinearFit, tests: NonlinearTests, *, coloured: bool) -> Check:
    test, biased = tests.feedback, feedback_biases(fit, coloured=coloured)
    assert test is not None
    seen = test.p < P_LEAST
    if not seen:
        detail = "no sign of feedback, which is no proof that there is none: inputs do not depend on past residuals"
    elif explained_by_inputs(tests.uncorrelated, tests.squares):
        detail = "inputs depend on past residuals, which hold what inputs explain: feedback, or what the model misses"
    elif biased:
        detail = f"inputs depend on past residuals: there is feedback, and this {fit.structure} is biased by it"
    else:
        detail = f"inputs depend on past residuals: there is feedback, which this {fit.structure} allows for"
    return Check(
        passed=not (seen and biased),
        p=test.p,
        values={"largest_correlation": test.largest, "largest_lag": float(test.largest_lag), "seen": float(seen)},
        detail=f"{detail} (p = {test.p:.2g})",
    )


def feedback_warnings(
    fit: NonlinearFit, records: Sequence[IOData], tests: NonlinearTests | None, *, coloured: bool
) -> list[str]:
    """Warn where feedback biases a fit, or where the data show one that the user excludes.

    `coloured`: whether the model leaves the colour of the noise open. Returns nothing that the estimator has said
    already.
    """
    if not fit.inputs:
        return []
    told_open = all(x.open_loop for x in records)
    seen = tests is not None and tests.feedback is not None and tests.feedback.p < P_LEAST
    if seen and told_open and tests is not None and not explained_by_inputs(tests.uncorrelated, tests.squares):
        return ["the records are said to be open loop, but inputs depend on past residuals: leave --open-loop out"]
    said = any("biased" in x and "open loop" in x for x in fit.warnings)
    if told_open or said or not feedback_biases(fit, coloured=coloured):
        return []
    return [
        f"this {fit.structure} has no noise model and is biased where a controller was at work, and nothing says that "
        "these records are open loop: use narmax with ne > 0, or say --open-loop if there was no feedback"
    ]


def finite_prediction(runs: Sequence[Run]) -> Check:
    """Check that the one-step errors are finite on all records."""
    bad = [k + 1 for k, r in enumerate(runs) if not r.finite]
    where = f"record {bad[0]}" if bad else ""
    detail = (
        f"one-step errors grow beyond all numbers on {where}" if bad else "one-step errors are finite on all records"
    )
    return Check(passed=not bad, detail=detail, values={"diverged": float(len(bad))})


def simulation_stable(records: Sequence[IOData], runs: Sequence[Run], tests: NonlinearTests | None) -> Check | None:
    """Check that the free run stays finite, and within ten times the span of what was measured.

    An unstable plant under feedback cannot be simulated from its input: where the data show feedback, a free run that
    runs away is reported and not held against the model.

    Returns none without inputs.
    """
    if any(r.simulation is None for r in runs):
        return None
    gone = [(k, r.diverges_at) for k, r in enumerate(runs) if r.diverges_at is not None]
    reach = max(
        (
            float(np.max(np.ptp(x.y - r.simulation, axis=0) / np.maximum(np.ptp(x.y, axis=0), 1e-300)))
            for x, r in zip(records, runs, strict=True)
            if r.simulation is not None and r.diverges_at is None
        ),
        default=0.0,
    )
    values = {"diverged": float(len(gone)), "reach": reach}
    loop = tests is not None and tests.feedback is not None and tests.feedback.p < P_LEAST
    excuse = (
        "; there is feedback, and the plant may be unstable: judge by predictions"
        if loop
        else ": the model predicts, but does not simulate"
    )
    if gone:
        k, at = gone[0]
        assert at is not None
        detail = f"the free run of record {k + 1} diverges {at * records[k].dt:.3g} s after its start{excuse}"
        return Check(passed=loop, detail=detail, values=values)
    if reach > _REACH:
        detail = f"the free run reaches {reach:.3g} times the span of what was measured{excuse}"
        return Check(passed=loop, detail=detail, values=values)
    return Check(
        passed=True, detail=f"the free run stays finite, at {reach:.3g} times the measured span", values=values
    )


def extrapolation_warnings(share: float, where: str) -> list[str]:
    """Warn where a record leaves what the model was trained on.

    `share`: part of its samples with a novelty above 1; `where`: which record.
    """
    if share <= _SHARE:
        return []
    return [
        f"{100 * share:.2g} % of {where} lies outside what the model was trained on: there it extrapolates, and its "
        "standard deviations say nothing"
    ]


def unconverged_warnings(fit: NonlinearFit) -> list[str]:
    """Say that a search did not converge, where the estimator has not."""
    if fit.status != "stalled" or any("converge" in x or "interrupted" in x for x in fit.warnings):
        return []
    return ["the training did not converge: the best of its steps is given; more iterations may go on from there"]
