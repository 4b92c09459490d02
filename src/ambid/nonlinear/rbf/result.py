"""The fit that comes out of a training of a radial basis network: model in SI, covariance, noise, warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.estimation.linear import information_inverse
from ambid.estimation.uncertainty import sandwich
from ambid.nonlinear.cloud import cloud_of
from ambid.nonlinear.failed import NO_WEIGHTS, failed_fit, provenance
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.rbf.choice import error
from ambid.nonlinear.rbf.model import RbfNetwork
from ambid.nonlinear.rbf.problem import RbfProblem, problem_at
from ambid.nonlinear.records import Scaled

if TYPE_CHECKING:
    from ambid.nonlinear.rbf.estimate import Work


GIVEN_UNITS = (
    "standard deviations are those of the weights of these units: what the choice of the units adds is not "
    "in them, and intervals of 95 % for the function may hold in as few as 70 % of places"
)
_HELD = 0.01  # part of the variance before the data that is left of a number of the linear part
_CROWDED = 0.8  # part of the errors that numbers may take up


def finished(
    records: Sequence[IOData], used: Mapping[str, object], data: Scaled, work: Work, *, seed: int
) -> NonlinearFit:
    """Return the fit of trained weights.

    `used`: settings. Returns failed where the weights or the errors are not finite.
    """
    began = perf_counter()
    shape, theta = work.shape, work.theta
    problem = problem_at(shape, data.parts, theta, work.prior, work.start, everything=work.everything, free=work.free)
    if not np.isfinite(problem.cost(theta[: problem.n_active])):
        return failed_fit("rbf", records, used, seed, NO_WEIGHTS, work.timing_s)
    P, noise, effective, condition = laplace(problem, theta[: problem.n_active])
    covariance, origin, warnings = _covariance(work, problem, P, str(used["uncertainty"]))
    if covariance is not None:
        warnings += _open(problem, covariance)
    regressors = np.concatenate([shape.lags.regressors(y, u) for y, u in data.parts])
    model = RbfNetwork(
        dt=records[0].dt,
        shape=shape,
        theta=theta,
        u_level=data.u_level,
        u_scale=data.u_scale,
        y_level=data.y_level,
        y_scale=data.y_scale,
        cloud=cloud_of(regressors),
    )
    work.timing_s["result"] = perf_counter() - began
    work.timing_s["all"] = sum(work.timing_s.values())
    return NonlinearFit(
        structure="rbf",
        settings={**used, "focus": "simulation" if work.free else "prediction"},
        model=model,
        covariance=covariance,
        covariance_from=origin,
        n_estimated=problem.n_active,
        noise_covariance=noise * data.y_scale[:, None] * data.y_scale,
        seed=seed,
        status=work.status,
        curves=tuple(work.curves),
        warnings=(*work.warnings, *warnings, *_cautions(records, data, work, effective / problem.n_errors)),
        timing_s=dict(work.timing_s),
        details={
            "effective_parameters": effective,
            "condition": condition,
            "prior_by_output": work.prior.tolist(),
            "stopped_early": work.stopped_early,
            "held_out_rms": work.held_out,
            "tried": [asdict(x) for x in work.tried],
        },
        **provenance(records),
    )


def laplace(problem: RbfProblem, v: Array) -> tuple[Array | None, Array, float, float]:
    """Return the inverse of the information, the prior's included (MacKay 1992).

    `v`: (n_active,), at the optimum. Returns `covariance`: (n_active, n_active), or None, none where the data and the
    prior together leave a direction open. Errors of outputs may hang together; `noise`: (n_outputs, n_outputs), scaled,
    covariance of the errors; `effective`: numbers that the data determine; `condition`: of the scaled Jacobian, the
    prior's rows included.
    """
    errors = np.concatenate(problem.errors(v))
    n, p = errors.shape
    noise = errors.T @ errors / n
    P, effective, condition = None, float(v.size), np.inf
    for _ in range(2):  # the degrees of freedom are those that the prior leaves
        weight = 1.0 / np.sqrt(np.maximum(np.diag(noise), 1e-14))
        P, condition = information_inverse(replace(problem, weight=weight).triangle(v)[:, :-1])
        if P is None:
            break
        effective = float(v.size - np.sum(np.diag(P) * problem.precision[: v.size] ** 2))
        noise = errors.T @ errors / max(n - effective / p, 1.0)
    if P is not None and p > 1:
        P = P + P @ replace(problem, weight=1.0 / np.sqrt(np.maximum(np.diag(noise), 1e-14))).across(v, noise) @ P
    return P, noise, effective, condition


def sandwiched(problem: RbfProblem, v: Array) -> Array | None:
    """Return the covariance that does not take errors as white, as those of a free run are not.

    `v`: (n_active,), at the optimum. Returns (n_active, n_active), or None, none where the data and the prior together
    leave a direction open.
    """
    prior = np.diag(problem.precision[: v.size] ** 2)
    return sandwich(problem.triangle(v)[:, :-1], problem.scores(v), prior)[0]


def _covariance(work: Work, problem: RbfProblem, P: Array | None, how: str) -> tuple[Array | None, str, list[str]]:
    """Return the covariance of all numbers, where it is from, and what must be said of it."""
    if how == "none":
        return None, "", ["no covariance was asked for, and so there are no standard deviations"]
    if not work.arrived:
        return None, "", ["no standard deviations: the training has not come to an optimum"]
    if how == "laplace" and work.free:
        return None, "", [
            "no standard deviations: simulation errors are coloured, and Laplace's approximation takes them as white. "
            "Say uncertainty = sandwich"
        ]  # fmt: skip
    origin = "sandwich" if how == "sandwich" or work.free else "laplace"
    if origin == "sandwich":
        P = sandwiched(problem, work.theta[: problem.n_active])
    if P is None:
        return None, "", ["no standard deviations: data and prior do not determine the weights. Fewer units or lags"]
    whole = np.zeros((work.theta.size, work.theta.size))
    whole[: P.shape[0], : P.shape[0]] = P
    return whole, origin, [] if work.everything or not work.shape.neurons else [GIVEN_UNITS]


def _open(problem: RbfProblem, covariance: Array) -> list[str]:
    """Name the numbers of the linear part that only the prior holds, which is next to none."""
    held = np.diag(covariance)[: problem.n_active] * problem.precision[: problem.n_active] ** 2
    n_line = sum(problem.shape.sizes[:2])
    names = [name for name, x in zip(problem.shape.names[:n_line], held, strict=False) if x > _HELD]
    if not names:
        return []
    return [
        f"the data do not tell these numbers apart, their values mean nothing: {', '.join(names)}. Fewer lags, or a "
        "richer excitation"
    ]


def _cautions(records: Sequence[IOData], data: Scaled, work: Work, taken: float) -> list[str]:
    found = []
    if taken > _CROWDED:
        found.append(
            f"the data determine {taken:.0%} as many numbers as there are errors: the model follows the noise, and "
            "standard deviations are not to be trusted. Fewer units or lags, or a longer record"
        )
    if records[0].n_inputs and not all(x.open_loop for x in records):
        what = "the free run" if work.free else "one-step errors"
        found.append(
            f"rbf has no noise model: trained on {what}, it is biased under feedback unless its errors are white, and "
            "nothing says that these records are open loop. Use narmax or nn, or say --open-loop"
        )
    if work.stopped_early:
        found.append(
            "training was stopped where the held-out error was least: more units than the data carry; standard "
            "deviations are those of a linearisation there"
        )
    if not work.free and not np.isfinite(error(work.shape, work.theta, data.parts, free=True)):
        found.append(
            "the free run diverges on the records that the model was trained on: it predicts, but does not simulate"
        )
    return found
