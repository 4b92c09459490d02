"""Linear differential equations between noisy signals, solved in weak form by maximum likelihood.

Rows r(theta) = V(theta) (signals) are what the equations leave over, V the moments of each signal. Noise enters through
the same V: cov r = V Sigma V^T, so the noise of a signal stands in regressors and left side alike. Minimising
r^T (V Sigma V^T)^-1 r is least squares on the signals themselves under the equations as constraints; it has no
errors-in-variables bias, needs no initial state, and runs through unstable plants (Bortz, Messenger and Dukic 2023).
Gauss-Newton: the regressors of a step are moments of the signals freed from their estimated noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.weakform._rows import Rows
from ambid.blackbox.weakform.bumps import Bump
from ambid.blackbox.weakform.system import System
from ambid.errors import EstimationError
from ambid.estimation.linear import directions

_ROUNDS = 40
_SETTLED = 1e-7  # step in standard deviations
_SAME_NOISE = 1.05  # factor on the noise within which the shortest support does not contradict


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """Parameters of a system."""

    theta: Mapping[str, float]
    covariance: Array  # (n, n), in the order of the system's names
    scale: float  # noise standard deviation, by which the relative ones of the signals are multiplied
    half: int  # half support of the test functions in samples
    rows: int
    condition: float  # of the scaled regressors
    converged: bool
    # noise that the shortest support finds with these parameters, over that of their own; about 1 where all is well
    contradiction: float = 1.0


def solve(system: System, bump: Bump, start: Mapping[str, float] | None = None) -> Solution:
    """Estimate the parameters with one test function.

    `start`: by default from ordinary least squares.
    """
    work = Rows(system, bump)
    theta = work.ordinary()
    converged, state = False, work.at(theta)
    if start is not None:
        other = np.array([start[k] for k in system.names])
        there = work.at(other)
        if not state.cost <= there.cost:
            theta, state = other, there
    for _ in range(_ROUNDS):
        step = work.step(state)
        expected = float(np.sum((state.Z @ step) ** 2))
        if expected <= _SETTLED * max(state.cost, 1e-300) / state.r.size:
            converged = True
            break
        length, moved = 1.0, work.at(theta + step)
        while moved.cost > state.cost and length > 1e-3:
            length *= 0.5
            moved = work.at(theta + length * step)
        if moved.cost > state.cost:
            converged = expected <= 1e-3 * state.cost / state.r.size
            break
        theta, state = theta + length * step, moved
    rows = state.r.size - int(np.sum(np.isfinite(system.prior_sd)))
    scale2 = state.cost / max(rows - theta.size, 1)
    size = np.maximum(np.linalg.norm(state.Z, axis=0), 1e-300)
    s = np.linalg.svd(state.Z / size, compute_uv=False)
    return Solution(
        theta=dict(zip(system.names, theta.tolist(), strict=True)),
        covariance=scale2 * directions(state.Z).inverse(),
        scale=float(np.sqrt(scale2)),
        half=bump.half,
        rows=rows,
        condition=float(s[0] / max(s[-1], 1e-300)),
        converged=converged,
    )


def best_support(
    system: System, halves: Sequence[int], degree: int, shortest: int
) -> tuple[Solution, list[dict[str, float]]]:
    """Solve from long supports to short, from the one before or anew; keep the one that predicts least variance.

    Long supports average most but see low frequencies alone, where a wrong plant may fit as well; short ones see all.
    So every solution is also held against the shortest support, and those that it contradicts do not count.

    `halves`: half supports in samples; `degree`: of the bumps; `shortest`: half support against which solutions are
    held. Returns `best`: its `contradiction` tells what the shortest support makes of it; `tried`: half support, noise
    scale, log determinant of the covariance and contradiction of every one with a result.
    """
    found: Solution | None = None
    results, tried, why = list[tuple[float, Solution]](), list[dict[str, float]](), "the record is too short"
    judge = Rows(system, Bump(half=shortest, degree=degree, dt=system.dt))
    for half in sorted(halves, reverse=True):
        try:
            found = solve(system, Bump(half=half, degree=degree, dt=system.dt), None if found is None else found.theta)
            all_band = judge.at(np.array([found.theta[k] for k in system.names]))
        except EstimationError as error:
            why = str(error)
            continue
        sd = np.sqrt(np.diag(found.covariance))
        sign, size = np.linalg.slogdet(found.covariance / np.outer(sd, sd))
        size = float(size + 2 * np.sum(np.log(sd))) if sign > 0 else np.inf
        found = replace(found, contradiction=float(np.sqrt(all_band.cost / max(all_band.r.size - sd.size, 1))))
        results.append((size, found))
        tried.append({
            "half_width_samples": float(half), "noise_sd": found.scale, "log_det_covariance": size,
            "noise_sd_all_band": found.contradiction,
        })  # fmt: skip
    if not results:
        raise EstimationError(f"weak form: no support of the test functions gives a result ({why}). Record longer")
    settled = [r for r in results if r[1].converged] or results
    noise = min(r[1].contradiction for r in settled)
    chosen = min((r for r in settled if r[1].contradiction <= _SAME_NOISE * noise), key=lambda r: r[0])[1]
    return replace(chosen, contradiction=chosen.contradiction / max(chosen.scale, 1e-300)), tried
