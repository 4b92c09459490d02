"""Covariance of the numbers of a nonlinear bearing: from Fisher information, and robust (as `identify.uncertainty`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.bearing.magnet.likelihood import BearingFit
from ambid.estimation.linear import directions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingUncertainty:
    """What a fit knows of its numbers."""

    names: tuple[str, ...]  # estimated numbers
    # (n, n), SI, covariance from the Fisher information (priors and noise levels included), and the sandwich over
    # stretches
    information: Array
    robust: Array
    delay_sd: dict[float, float]  # by rate, in samples, where it was estimated
    inflation: float  # largest ratio of robust to information standard deviation

    def covariance(self, *, robust: bool) -> Array:
        """Return the covariance; the robust one is nowhere smaller than that of the information.

        Returns (n, n), SI.
        """
        if not robust:
            return self.information
        ratio = np.sqrt(np.diag(self.information) / np.maximum(np.diag(self.robust), 1e-300))
        wider = np.maximum(ratio, 1.0)
        return np.asarray(self.robust * np.outer(wider, wider))


def uncertainty(fit: BearingFit) -> BearingUncertainty:
    """Compute the covariances of a fit.

    `fit`: not failed.
    """
    assert fit.at is not None
    problem, at = fit.problem, fit.at
    n, chain = len(problem.estimated), problem.chain(fit.vector)
    whole = directions(at.J).inverse()
    centred = at.scores - at.scores.mean(axis=0)
    middle = centred * np.sqrt(len(centred) / max(len(centred) - 1, 1))
    half = whole @ middle.T
    sandwich = half @ half.T
    unit = np.outer(chain, chain)
    information, wide = whole[:n, :n] * unit, sandwich[:n, :n] * unit
    for j in np.flatnonzero(fit.vector[:n] >= problem.upper()[:n]).tolist():
        # at its bound: the records do not tell it from anything beyond
        information[j, j], wide[j, j] = (max(c[j, j], chain[j] ** 2) for c in (information, wide))
    ratio = np.sqrt(np.diag(wide) / np.maximum(np.diag(information), 1e-300))
    extra = [float(np.sqrt(whole[n + j, n + j])) for j in range(len(problem.rates))]
    return BearingUncertainty(
        names=tuple(number.name for number in problem.estimated),
        information=information,
        robust=wide,
        delay_sd=dict(zip(problem.rates, extra, strict=True)),
        inflation=float(ratio.max()),
    )
