"""The fit that comes out of a NARMAX draft: model in SI, covariance, noise, what a reader has to be warned of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.nonlinear.fit import LearningCurve, NonlinearFit
from ambid.nonlinear.narmax.choose import Draft
from ambid.nonlinear.narmax.model import OUTPUTS, PolynomialNarmax, cloud_of, lagged_signals
from ambid.nonlinear.narmax.recursion import predicted, sensitivities
from ambid.nonlinear.narmax.scaled import Scaled
from ambid.nonlinear.narmax.search import BLIND, evaluated, triangle
from ambid.nonlinear.narmax.settings import NarmaxSettings
from ambid.nonlinear.narmax.terms import term_name


def failed_fit(
    records: Sequence[IOData], s: NarmaxSettings, seed: int, reason: str, timing_s: Mapping[str, float]
) -> NonlinearFit:
    """Return a fit without a model.

    `reason`: one line.
    """
    first = records[0]
    return NonlinearFit(
        structure="narmax",
        settings=s.as_mapping(),
        model=None,
        covariance=None,
        n_estimated=0,
        noise_covariance=np.full((first.n_outputs,) * 2, np.nan),
        inputs=first.inputs,
        outputs=first.outputs,
        units=dict(first.units),
        dt=first.dt,
        records=tuple(dict(x.record) for x in records),
        seed=seed,
        status="failed",
        reason=reason,
        timing_s=dict(timing_s),
    )


def finished_fit(
    records: Sequence[IOData],
    s: NarmaxSettings,
    scaled: Scaled,
    draft: Draft,
    *,
    seed: int,
    status: Literal["converged", "stalled"],
    focus: str,
    curves: tuple[LearningCurve, ...],
    warnings: tuple[str, ...],
    timing_s: Mapping[str, float],
) -> NonlinearFit:
    """Return the fit of a draft that runs.

    `focus`: which errors the coefficients were fitted to.
    """
    model = _model(records, scaled, draft)
    free = focus == "simulation"
    one = np.ones(scaled.n_outputs)
    errors = np.concatenate(evaluated(draft.tables, draft.theta, scaled.parts, one, free=free).errors)
    freedom = max(errors.shape[0] - draft.theta.size / scaled.n_outputs, 1.0)
    noise = errors.T @ errors / freedom
    covariance, said = _covariance(scaled, draft, noise, free=free)
    first = records[0]
    found = [*warnings, *said, *_cautions(records, s, scaled, draft, free=free)]
    if covariance is None:
        found.append("no covariance, and so no standard deviations: the data do not determine the coefficients")
    else:
        covariance = covariance * model.unit[:, None] * model.unit
    return NonlinearFit(
        structure="narmax",
        settings={**s.as_mapping(), "focus": focus},
        model=model,
        covariance=covariance,
        covariance_from="" if covariance is None else "information",
        n_estimated=int(draft.theta.size),
        noise_covariance=noise * scaled.y_scale[:, None] * scaled.y_scale,
        inputs=first.inputs,
        outputs=first.outputs,
        units=dict(first.units),
        dt=first.dt,
        records=tuple(dict(x.record) for x in records),
        seed=seed,
        status=status,
        curves=curves,
        warnings=tuple(found),
        timing_s=dict(timing_s),
        details=_details(draft, model, records),
    )


def _model(records: Sequence[IOData], scaled: Scaled, draft: Draft) -> PolynomialNarmax:
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
        cloud=cloud_of([lagged_signals(t, predicted(t, draft.theta, y, u)[1]) for y, u in scaled.parts]),
        output=OUTPUTS[draft.folded],
    )
    return model.with_theta(draft.theta * model.unit)


def _covariance(scaled: Scaled, draft: Draft, noise: Array, *, free: bool) -> tuple[Array | None, list[str]]:
    """Covariance of the scaled coefficients from the information matrix.

    Simulation errors are coloured: there the scatter of the scores over the record takes the place of white noise
    (Newey and West 1987).
    """
    weight = 1.0 / np.sqrt(np.maximum(np.diag(noise), 1e-300))
    R = triangle(draft.tables, draft.theta, scaled.parts, weight, free=free)
    if R.shape[0] < draft.theta.size or not np.all(np.isfinite(R)):
        return None, []
    scale = np.maximum(np.linalg.norm(R[:, :-1], axis=0), 1e-150)
    _, sv, Vt = np.linalg.svd(R[:, :-1] / scale, full_matrices=False)
    if not sv[-1] > BLIND * sv[0]:
        return None, [
            f"the data do not tell the chosen terms apart (condition number {sv[0] / max(sv[-1], 1e-300):.1e}). "
            "Lower terms or degree, or excite more"
        ]
    half = Vt.T / sv
    inverse = half @ half.T
    middle = _scatter(scaled, draft, weight, scale) if free else None
    P = inverse if middle is None else inverse @ middle @ inverse
    return (P + P.T) / 2 / scale[:, None] / scale, []


def _scatter(scaled: Scaled, draft: Draft, weight: Array, scale: Array) -> Array:
    """Covariance of the sum of the scores, neighbours included as far as their correlation reaches."""
    t, total = draft.tables, np.zeros((draft.theta.size,) * 2)
    for y, u in scaled.parts:
        yhat, z = predicted(t, draft.theta, y, u, free=True)
        J = sensitivities(t, draft.theta, z, free=True)[t.lag :] * weight[:, None] / scale
        g = np.einsum("toq,to->tq", J, ((y - yhat)[t.lag :] * weight))
        reach = int(np.ceil(4 * g.shape[0] ** (1 / 3)))
        total += g.T @ g
        for k in range(1, min(reach, g.shape[0] - 1) + 1):
            cross = g[k:].T @ g[:-k]
            total += (1 - k / (reach + 1)) * (cross + cross.T)
    return total


def _cautions(records: Sequence[IOData], s: NarmaxSettings, scaled: Scaled, draft: Draft, *, free: bool) -> list[str]:
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
    one = np.ones(scaled.n_outputs)
    if not free and not evaluated(draft.tables, draft.theta, scaled.parts, one, free=True).finite:
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
        _, z = predicted(t, draft.theta, y, u)
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
