"""A fit without a model, and the part of a fit that every network has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambid.blackbox.data import IOData
from ambid.nonlinear.fit import NonlinearFit

NO_WEIGHTS = "no finite weights were found: the columns differ too much in size from sample to sample; check them"
"""Why the weights of a network that looks at measured signals alone come to nothing."""


def provenance(records: Sequence[IOData]) -> dict[str, Any]:
    """Return channels, units, rate and records, by the names that `NonlinearFit` has for them."""
    first = records[0]
    return {
        "inputs": first.inputs,
        "outputs": first.outputs,
        "units": dict(first.units),
        "dt": first.dt,
        "records": tuple(dict(x.record) for x in records),
    }


def failed_fit(
    structure: str,
    records: Sequence[IOData],
    settings: Mapping[str, object],
    seed: int,
    reason: str,
    timing_s: Mapping[str, float],
) -> NonlinearFit:
    """Return a fit without a model.

    `reason`: one line. Returns with status ``failed``.
    """
    p = records[0].n_outputs
    return NonlinearFit(
        structure=structure,
        settings=dict(settings),
        model=None,
        covariance=None,
        n_estimated=0,
        noise_covariance=np.full((p, p), np.nan),
        seed=seed,
        status="failed",
        reason=reason,
        timing_s=dict(timing_s),
        **provenance(records),
    )
