"""Public records with published results: free runs on data that were not used to estimate the model."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.nonlinear.lagged import LaggedModel
from ambid.nonlinear.narmax import narmax
from tests.measured import ABSENT, BENCHMARKS
from tests.nonlinear.narmax.systems import record

DATA = BENCHMARKS


def read(name: str) -> IOData:
    if not (DATA / name).exists():
        pytest.skip(ABSENT)
    found = np.loadtxt(DATA / name, delimiter=",", skiprows=1)
    return record(found[:, 1], found[:, 2])


def free_run(model: LaggedModel, data: IOData, first: int) -> float:
    """Root mean square error of the free run from sample `first` on."""
    return float(np.sqrt(np.mean((model.simulate(data.u, data.y) - data.y)[first:] ** 2)))


def test_silverbox_by_a_polynomial_narx_model() -> None:
    """Published: 7.7 mV on the multisine for a polynomial NARX model, about 0.44 % for nonlinear state-space models."""
    whole = read("silverbox.csv")
    multisine = whole.part(40650, 127400)
    training, test = multisine.part(0, 65062), multisine.part(65062, multisine.n_samples)
    settings = {"ny": 2, "nu": 3, "nk": 0, "ne": 0, "degree": 3, "criterion": "bic", "terms": 20}
    found = narmax([training], {**settings, "focus": "simulation", "pruning": "simulation"})
    assert isinstance(found.model, LaggedModel)
    assert free_run(found.model, test, 50) < 0.27e-3
    assert free_run(found.model, test, 50) / np.std(test.y[50:]) < 0.005
    arrow = whole.part(100, 40575)
    assert free_run(found.model, arrow, 50) < 0.6e-3  # it goes beyond the amplitudes of the training data
    novelty = found.model.novelty(arrow.u, arrow.y)[found.model.lag :]
    assert np.max(novelty[-2000:]) > 1.0 > np.max(novelty[:10000])
