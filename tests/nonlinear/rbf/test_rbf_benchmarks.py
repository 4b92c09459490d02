"""The Silverbox by a radial basis network: free runs on data that were not used to estimate it."""

from __future__ import annotations

import numpy as np

from ambid.blackbox.data import IOData
from ambid.nonlinear.rbf import rbf
from tests.nonlinear.narmax.test_benchmarks import read


def test_silverbox_by_a_radial_basis_network() -> None:
    """Published: 7.7 mV on the multisine for a polynomial NARX model, about 0.44 % for nonlinear state-space models."""
    whole = read("silverbox.csv")
    multisine = whole.part(40650, 127400)
    training, test = multisine.part(0, 65062), multisine.part(65062, multisine.n_samples)
    told = {"ny": 2, "nu": 3, "nk": 0, "neurons": 8, "width": 5.6}
    found = rbf([training], {**told, "focus": "simulation", "iterations": 10, "uncertainty": "none"}).model
    assert found is not None

    def off(data: IOData) -> float:
        return float(np.sqrt(np.mean((found.simulate(data.u, data.y) - data.y)[50:] ** 2)))

    assert off(test) < 0.3e-3
    assert off(test) / np.std(test.y[50:]) < 0.0055
    assert off(whole.part(100, 40575)) < 0.6e-3
