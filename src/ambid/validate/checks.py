"""All checks of an estimate on its own record, in the order of the report."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ambid.arrays import Array
from ambid.bearing.hints import experiment_hint
from ambid.bearing.uncertainty import Uncertainty
from ambid.estimation.estimate import Check
from ambid.estimation.likelihood import Fit
from ambid.record import Record
from ambid.signals.faults import find_dropouts, find_outliers, find_saturation
from ambid.validate.agreement import Agreement
from ambid.validate.plausibility import implausible
from ambid.validate.residuals import P_LEAST, ResidualTest, residual_tests

_INFLATION = 1.7  # robust over information standard deviation from which the model, not the noise, sets the error
_ERRONEOUS = 5e-4  # part of the samples that may be outliers or drop-outs
_SATURATED = 0.005  # part of the samples at a limit that a check lets pass


def residual_checks(fit: Fit, e: Array, known: Uncertainty, moved: Agreement) -> dict[str, Check]:
    """Check what the innovations say of the model, and with that of its standard deviations.

    `e`: (n_used, n_outputs), innovations, scaled; `moved`: estimates from the record used in other ways. Returns
    ``residuals_white``, ``residuals_uncorrelated``, ``uncertainty_consistent``, ``estimates_agree``. Where one fails,
    the robust standard deviations are to be used.
    """
    own, inputs = residual_tests(fit, e)
    return {
        "residuals_white": residual_check(own, "innovations against their own past"),
        "residuals_uncorrelated": residual_check(inputs, "innovations against past inputs"),
        "uncertainty_consistent": Check(
            passed=known.inflation < _INFLATION,
            values={"inflation": known.inflation},
            detail=f"standard deviations from the scatter over the record are {known.inflation:.2f} times those from "
            f"the information matrix (at most {_INFLATION:g})",
        ),
        "estimates_agree": _agreement_check(moved),
    }


def _agreement_check(moved: Agreement) -> Check:
    every = " and ".join(f"{s}{'nd' if s == 2 else 'th'}" for s in moved.strides)
    if not moved.strides:
        detail = "the record could not be fitted with every 2nd or 4th output alone: one step ahead is all that fits"
    elif moved.passed:
        detail = f"refits with every {every} output give the same parameters (largest shift {moved.largest:.1f} sd)"
    else:
        far = ", ".join(f"{k} by {s:.3g}" for k, s in zip(moved.names, moved.disagreement(), strict=True))
        detail = (
            f"refits with every {every} output move the parameters by up to {moved.largest:.1f} sd ({far} in SI): "
            "the model does not fit this record; excite more, work in a smaller range, or look for what is missing"
        )
    return Check(
        passed=moved.passed,
        values={"largest_shift_sd": moved.largest, "refits": float(len(moved.strides))},
        detail=detail,
    )


def explained_by_inputs(*against_inputs: ResidualTest | None) -> bool:
    """Return whether residuals hold a function of past inputs: then inputs depend on them without any feedback."""
    return any(x is not None and x.p < P_LEAST for x in against_inputs)


def residual_check(test: ResidualTest, what: str) -> Check:
    """Put a residual test into words.

    `what`: what was tested against what.
    """
    verdict = "nothing is left" if test.passed else "something is left that the model does not explain"
    return Check(
        passed=test.passed,
        p=test.p,
        values={
            "statistic": test.statistic,
            "degrees_of_freedom": float(test.degrees),
            "largest_correlation": test.largest,
            "largest_lag": float(test.largest_lag),
        },
        detail=f"{what}: {verdict} "
        f"(largest correlation {test.largest:.3f} at lag {test.largest_lag}, p = {test.p:.2g})",
    )


def physical_checks(fit: Fit, known: Uncertainty, record: Record, *, robust: bool) -> dict[str, Check]:
    """Check whether the parameters are shown by the data, can exist, and come from signals within their limits.

    `record`: channels named by role; `robust`: which standard deviations count. Returns ``identifiable``,
    ``plausible``, ``within_limits``, ``signals_sound``.
    """
    theta = fit.problem.parameters(fit.vector)
    sd = dict(zip(known.names, known.standard_deviations(robust=robust).tolist(), strict=True))
    wrong = implausible(fit.problem.model, theta, sd)
    return {
        "identifiable": _identifiable(fit, known, theta, robust=robust),
        "plausible": Check(passed=not wrong, detail="; ".join(wrong) or "signs are physical and the coil is passive"),
        "within_limits": _within_limits(record),
        "signals_sound": _signals_sound(record, fit.problem.model.outputs),
    }


def _identifiable(fit: Fit, known: Uncertainty, theta: Mapping[str, float], *, robust: bool) -> Check:
    seen = known.identifiable_at(robust=robust)
    unseen = [
        f"{name} (sd {100 * r:.0f} %)"
        for name, ok, r in zip(known.names, seen, known.relative_sd(robust=robust), strict=True)
        if not ok
    ]
    values = {"condition": float(known.singular_values[0] / known.singular_values[-1])}
    if not unseen:
        return Check(passed=True, values=values, detail="the record shows every estimated parameter")
    if np.any(np.abs(known.disagreement) > 0.5 * known.standard_deviations(robust=robust)):
        hint = "Not noise but disagreement of the refits makes it so: repeat it away from limits, with more excitation"
        return Check(passed=False, values=values, detail=f"the record does not show {', '.join(unseen)}. {hint}")
    rate, length = fit.problem.rate_hz, fit.problem.u.shape[0]
    band = (rate / length, lowest_power_hz(fit.problem.u, rate), rate / 2)
    hint = experiment_hint(known, theta, band, robust=robust) or ""
    return Check(passed=False, values=values, detail=f"the record does not show {', '.join(unseen)}. {hint}")


def lowest_power_hz(u: Array, rate_hz: float) -> float:
    """Return the frequency below which the inputs have 0.1 % of their power.

    `u`: (n_samples, n_inputs). Returns hz.
    """
    power = np.sum(np.abs(np.fft.rfft(u - u.mean(axis=0), axis=0)) ** 2, axis=1)
    total = np.cumsum(power)
    return float(np.searchsorted(total, 1e-3 * total[-1]) * rate_hz / u.shape[0])


def _within_limits(record: Record) -> Check:
    found = {c.name: find_saturation(record, c.name) for c in record.channels}
    bad = {name: s for name, s in found.items() if s.fraction > _SATURATED}
    detail = "; ".join(str(s) for s in bad.values())
    return Check(
        passed=not bad,
        values={f"{name}_fraction": s.fraction for name, s in found.items()},
        detail=f"{detail}. Lower the excitation, or cut those parts out" if bad else "no channel dwells at its limits",
    )


def _signals_sound(record: Record, outputs: tuple[str, ...]) -> Check:
    """Outliers and drop-outs of the measured outputs; an input may rightly stand still or kick."""
    found = [(role, find(record, role)) for role in outputs for find in (find_outliers, find_dropouts)]
    some = [f"{role}: {f}" for role, f in found if f.count]
    few = max(f.count for _, f in found) <= _ERRONEOUS * record.n_samples
    return Check(
        passed=few,
        values={f"{role}_{type(f).__name__.lower()}": float(f.count) for role, f in found},
        detail=f"{'; '.join(some)}. They are used as they are; replace them (signals.replace_samples) or cut them out"
        if some
        else "no outliers and no drop-outs in the measured outputs",
    )
