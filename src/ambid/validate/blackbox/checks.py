"""What the residual tests of a black-box fit mean, in words."""

from __future__ import annotations

import numpy as np

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.structures import structure
from ambid.estimation.estimate import Check
from ambid.validate.blackbox.predictor import Errors
from ambid.validate.blackbox.residual_tests import ResidualTests
from ambid.validate.checks import explained_by_inputs, residual_check
from ambid.validate.residuals import P_LEAST


def stable_predictor(found: Errors) -> Check:
    """Check that the one-step errors do not grow by themselves."""
    m = found.model
    radius = float(np.max(np.abs(np.linalg.eigvals(m.A - m.K @ m.C)), initial=0.0)) if m.order else 0.0
    ok = radius < 1.0
    return Check(
        passed=ok,
        values={"radius": radius},
        detail=f"the predictor's poles are within {radius:.4g} of zero"
        + ("" if ok else ": its errors grow without bound. Take a structure with a noise model, or other orders"),
    )


def residual_verdicts(fit: BlackBoxFit, data: IOData, found: Errors, tests: ResidualTests) -> dict[str, Check]:
    """Put residual tests into words.

    Returns ``residuals_white``, and with inputs ``residuals_uncorrelated`` and ``feedback``.
    """
    of = f" of {tests.white_output}" if data.n_outputs > 1 else ""
    white = residual_check(tests.white, f"residuals{of} against past residuals")
    if not white.passed and not found.claims_noise:
        white = Check(
            passed=True,
            p=white.p,
            values=white.values,
            detail=f"residuals{of} are coloured; {fit.structure} does not describe noise, and need not",
        )
    checks = {"residuals_white": white}
    if tests.uncorrelated is not None:
        of = f" of {tests.uncorrelated_output}" if data.n_outputs > 1 else ""
        checks["residuals_uncorrelated"] = residual_check(tests.uncorrelated, f"residuals{of} against past inputs")
    if tests.feedback is not None:
        checks["feedback"] = _feedback(fit, tests)
    return checks


def _feedback(fit: BlackBoxFit, tests: ResidualTests) -> Check:
    test, biased = tests.feedback, structure(fit.structure).feedback == "biased"
    assert test is not None
    seen, told = test.p < P_LEAST, f"input {tests.feedback_input!r} depends on past residuals"
    if not seen:
        detail = "no sign of feedback, which is no proof that there is none: inputs do not depend on past residuals"
    elif explained_by_inputs(tests.uncorrelated):
        detail = f"{told}, which hold what inputs explain: feedback, or what the model misses"
    elif biased:
        detail = f"{told}: there is feedback, and {fit.structure} is biased by it"
    else:
        detail = f"{told}: there is feedback, which {fit.structure} allows for"
    return Check(
        passed=not (seen and biased),
        p=test.p,
        values={"largest_correlation": test.largest, "largest_lag": float(test.largest_lag), "seen": float(seen)},
        detail=f"{detail} (p = {test.p:.2g})",
    )


def feedback_warning(fit: BlackBoxFit, data: IOData, tests: ResidualTests) -> list[str]:
    """Warn where the data show feedback that the user or the structure excludes."""
    if tests.feedback is None or tests.feedback.p >= P_LEAST:
        return []
    evidence = f"input {tests.feedback_input!r} depends on past residuals (p = {tests.feedback.p:.2g})"
    biased, missed = structure(fit.structure).feedback == "biased", explained_by_inputs(tests.uncorrelated)
    if biased:
        if missed:
            return [f"{evidence}: feedback, by which {fit.structure} is biased, or what the model misses"]
        return [
            f"there is feedback in this record: {evidence}; {fit.structure} is biased by it. Use bj, armax or pbsid"
        ]
    if data.open_loop and not missed:
        return [f"the record is said to be open loop, but {evidence}: leave --open-loop out"]
    return []


def coloured_warning(fit: BlackBoxFit, *, adjusted: bool) -> list[str]:
    """Say how far the standard deviations of an output-error model hold under coloured noise.

    `adjusted`: whether the covariance accounts for the colour.
    """
    if adjusted:
        return [
            f"the noise is coloured, which {fit.structure} does not describe: standard deviations allow for it; "
            "a noise model (bj) would make them smaller"
        ]
    if fit.covariance is None:
        return []
    return [
        f"the noise is coloured, which {fit.structure} does not describe; its standard deviations are those of "
        "white noise: they may be too small. Use a structure with a noise model"
    ]
