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


def test_coupled_drives_whose_speed_is_measured_without_sign() -> None:
    """Free run from the beginning; the error counts in the second half. State-space networks come below 0.10.

    These are the records with a binary input; figures that are published are of two others, with random amplitudes.
    """
    for name, linear, cubic in (("coupled_drives_1.csv", 0.19, 0.13), ("coupled_drives_3.csv", 0.11, 0.13)):
        whole = read(name)
        for degree, limit in ((1, linear), (3, cubic)):
            settings = {"ny": 3, "nu": 3, "degree": degree, "output": "magnitude", "criterion": "bic"}
            found = narmax([whole.part(0, 250)], {**settings, "symmetry": "odd"}).model
            assert isinstance(found, LaggedModel)
            assert free_run(found, whole, 250) < limit
        signed = narmax([whole.part(0, 250)], {"ny": 3, "nu": 3, "degree": 2, "ne": 0, "focus": "simulation"}).model
        assert isinstance(signed, LaggedModel)
        assert free_run(signed, whole, 250) > 2 * linear  # without the magnitude nothing comes of it
