"""A black-box fit several steps ahead, on any record: fit, error, and the error that the model expects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.errors import EstimationError
from ambid.estimation.criteria import skipped
from ambid.validate.ahead import covariance_ahead, errors_ahead
from ambid.validate.blackbox.predictor import errors_elsewhere
from ambid.validate.prediction import fit_of

HORIZONS = (1, 5, 20, 100)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ahead:
    """One output, a number of steps ahead."""

    output: str
    steps: int
    fit: float  # 1 - |error|/|y - mean|
    rmse: float
    # what model and innovations of the fit make of it; a larger error says that the model is wrong, or that it is used
    # where it does not hold
    expected_sd: float


def ahead(fit: BlackBoxFit, data: IOData, horizons: Sequence[int] = HORIZONS) -> tuple[Ahead, ...]:
    """Predict several steps ahead, inputs known.

    `data`: the fit's own record or another; a constant in its outputs is fitted; `horizons`: steps; those above half
    the record are left out. Returns output by output, in the order of the horizons.
    """
    if any(k < 1 for k in horizons):
        raise EstimationError(f"horizons of {', '.join(map(str, horizons))} samples; each must be at least 1")
    found = errors_elsewhere(fit, data)
    m, first = found.model, skipped(data.n_samples)
    e, y = found.one_step[first:], data.y[first:]
    out = list[Ahead]()
    for j, name in enumerate(fit.outputs):
        for k in (k for k in horizons if k <= e.shape[0] // 2):
            error = errors_ahead(e, m.A, m.K, m.C, k)[:, j]
            expected = covariance_ahead(fit.noise_covariance, m.A, m.K, m.C, k)
            out.append(
                Ahead(
                    output=name,
                    steps=k,
                    fit=float(fit_of(error[:, None], y[k - 1 :, [j]])[0]),
                    rmse=float(np.sqrt(np.mean(error**2))),
                    expected_sd=float(np.sqrt(expected[j, j])),
                )
            )
    return tuple(out)
