"""The fit that comes out of a hybrid training: model in SI, covariance, noise, what a reader has to be warned of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.estimation.linear import information_inverse
from ambid.nonlinear.cloud import cloud_of
from ambid.nonlinear.failed import failed_fit, provenance
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.hybrid.model import HybridNarmax, units_of
from ambid.nonlinear.hybrid.revision import SHARED, inflation
from ambid.nonlinear.hybrid.settings import HybridSettings
from ambid.nonlinear.hybrid.train import HybridProblem, problem_at, whitening
from ambid.nonlinear.narmax.scaled import Scaled
from ambid.nonlinear.narmax.terms import term_name

if TYPE_CHECKING:
    from ambid.nonlinear.hybrid.estimate import Work


DIVERGED = "no one-step predictor that stays finite was found; lower ne, degree or terms, or check the columns"
_CROWDED = 0.8  # part of the errors that numbers may take up
_NEAR = 0.98  # magnitude of a root of C from which on its standard deviation is not to be trusted


def finished(records: Sequence[IOData], s: HybridSettings, data: Scaled, work: Work, *, seed: int) -> NonlinearFit:
    """Return the fit of trained numbers.

    Returns failed where the predictor diverges.
    """
    began = perf_counter()
    shape, theta = work.shape, work.theta
    used = {**s.as_mapping(), "ne": shape.ne, "neurons": shape.neurons}
    problem = problem_at(shape, data.parts, theta, s.prior)
    if not np.isfinite(problem.cost(theta)):
        return failed_fit("hybrid", records, used, seed, DIVERGED, work.timing_s)
    covariance, noise, effective, inflated = laplace(problem, theta)
    unit = units_of(shape, data.y_scale, data.u_scale)
    warnings = [*work.warnings, *_cautions(records, s, data, work, inflated, effective / problem.n_errors)]
    if covariance is None:
        warnings.append("no standard deviations: data and prior do not determine the numbers. Fewer terms or neurons")
    net = shape.network
    model = HybridNarmax(
        dt=records[0].dt,
        shape=shape,
        theta=theta * unit,
        u_level=data.u_level,
        u_scale=data.u_scale,
        y_level=data.y_level,
        y_scale=data.y_scale,
        cloud=cloud_of(np.concatenate([net.regressors(y, u)[shape.lag - net.lag :] for y, u in data.parts])),
    )
    work.timing_s["result"] = perf_counter() - began
    work.timing_s["all"] = sum(work.timing_s.values())
    return NonlinearFit(
        structure="hybrid",
        settings=used,
        model=model,
        covariance=None if covariance is None else covariance * unit[:, None] * unit,
        covariance_from="" if covariance is None else "laplace",
        n_estimated=int(theta.size),
        noise_covariance=noise * data.y_scale[:, None] * data.y_scale,
        seed=seed,
        status=work.status,
        curves=tuple(work.curves),
        warnings=tuple(warnings),
        timing_s=dict(work.timing_s),
        details=_details(records, data, work, effective),
        **provenance(records),
    )


def laplace(problem: HybridProblem, theta: Array) -> tuple[Array | None, Array, float, Array]:
    """Return the inverse of the information, the prior's included, at the most probable numbers (MacKay 1992).

    `theta`: (n_theta,). Returns `covariance`: (n_theta, n_theta), or None, none where the data and the prior together
    leave a direction open; `noise`: (n_outputs, n_outputs), scaled; `effective`: numbers that the data determine;
    `inflated`: (n_terms,), by what the network multiplies the standard deviation of each term of the polynomial.
    """
    errors = np.concatenate(problem.errors(theta))
    n, p = errors.shape
    noise, P, effective = errors.T @ errors / n, None, float(theta.size)
    n_terms, n_linear = problem.shape.sizes[0], problem.shape.n_linear
    inflated = np.ones(n_terms)
    for _ in range(2):  # the degrees of freedom are those that the prior leaves
        at = replace(problem, weight=whitening(noise))
        R = at.triangle(theta)[:, :-1]
        P, _condition = information_inverse(R)
        if P is None:
            break
        effective = float(theta.size - np.sum(np.diag(P) * at.precision**2))
        noise = errors.T @ errors / max(n - effective / p, 1.0)
        inflated = inflation(R, P, n_linear)[:n_terms]
    return P, noise, effective, inflated


def _cautions(
    records: Sequence[IOData], s: HybridSettings, data: Scaled, work: Work, inflated: Array, taken: float
) -> list[str]:
    shape, found = work.shape, []
    if s.ne == 0 and records[0].n_inputs and not all(x.open_loop for x in records):
        found.append(
            "without a noise model (ne = 0) hybrid is biased under feedback unless the equation error is white: "
            "raise ne, or say --open-loop if there was no feedback"
        )
    if taken > _CROWDED:
        found.append(
            f"the data determine {taken:.0%} as many numbers as there are errors: the model follows the noise, and "
            "standard deviations are not to be trusted. Fewer neurons or terms, or a longer record"
        )
    radius = shape.noise_radius(work.theta)
    if not shape.deep and radius > _NEAR:
        found.append(
            f"C has a root at {radius:.4g}, nearly on the unit circle, where the search must not cross: its standard "
            "deviation is not to be trusted, and the predictor forgets its beginning slowly. A differenced or "
            "detrended output does this"
        )
    if np.any(inflated > SHARED):
        names = ", ".join(name for name, x in zip(shape.names, inflated, strict=False) if x > SHARED)
        found.append(
            f"the network can take over these terms, so that their values are not theirs alone: {names}. Fewer neurons "
            "or a smaller prior"
        )
    ok = [np.all(np.isfinite(shape.free_run(work.theta, y, u))) for y, u in data.parts]
    if not all(ok):
        found.append(
            "the free run diverges on the records that the model was trained on: it predicts, but does not simulate"
        )
    return found


def _details(records: Sequence[IOData], data: Scaled, work: Work, effective: float) -> dict[str, object]:
    shape, y_all = work.shape, np.concatenate([y for y, _ in data.parts])
    n_c, p, m = shape.sizes[0], shape.n_outputs, shape.n_inputs
    terms: dict[str, list[dict[str, object]]] = {}
    for o, out in enumerate(records[0].outputs):
        named = [term_name(x, p, m) for x in (*shape.terms[o], *shape.noise_terms)]
        terms[out] = [{"term": x, "err": work.err.get((out, x))} for x in named]
    hidden = []
    for y, u in data.parts:
        rows = shape.rows(y, u)
        hidden.append(shape.innovations(work.theta, rows)[1] @ shape.parts(work.theta)[2].T)
    by_network = np.std(np.concatenate(hidden), axis=0) / np.maximum(np.std(y_all, axis=0), 1e-300)
    return {
        "terms": terms,
        "candidates": work.n_candidates,
        "effective_parameters": effective,
        "added_beside_the_network": list(work.added),
        "left_out_beside_the_network": list(work.dropped),
        "network_share": dict(zip(records[0].outputs, by_network.tolist(), strict=True)),
        "noise_model": {
            "largest_root": shape.noise_radius(work.theta),
            "coefficients": work.theta[n_c : shape.n_linear].tolist(),
            "start_drawn_in_by": work.drawn_in,
        },
        "tried": [{"neurons": x.neurons, "held_out_rms": x.held_out} for x in work.tried],
        "levels": {
            **dict(zip(records[0].inputs, data.u_level.tolist(), strict=True)),
            **dict(zip(records[0].outputs, data.y_level.tolist(), strict=True)),
        },
    }
