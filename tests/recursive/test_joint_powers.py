"""Matrices as products of powers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.physics.linear_model import OneAxis, StateSpace, model, model_names
from ambid.recursive.joint import powers_of


@pytest.mark.parametrize("name", model_names())
def test_every_linear_model_is_one(name):
    of, rng = model(name), np.random.default_rng(1)
    names = [p.name for p in of.parameters]
    at, other = (dict(zip(names, rng.uniform(0.3, 3.0, len(names)), strict=True)) for _ in range(2))
    place, entries, power = powers_of(of, at, names)
    space = of.matrices(other)
    wanted = np.hstack([space.A, space.B, space.E])
    found = np.zeros(wanted.shape)
    ratio = np.array([other[k] / at[k] for k in names])
    found[place[:, 0], place[:, 1]] = entries * np.prod(ratio ** power.astype(float), axis=1)
    np.testing.assert_allclose(found, wanted, rtol=1e-13)


@dataclass(frozen=True, slots=True)
class Summed(OneAxis):
    """A model in which an entry is a sum of products."""

    def matrices(self, theta):
        s = OneAxis.matrices(self, theta)
        A = s.A.copy()
        A[1, 0] -= theta["c"]
        return StateSpace(A=A, B=s.B, E=s.E, C=s.C)


def test_a_model_that_is_none_is_refused():
    with pytest.raises(EstimationError, match="products of powers"):
        powers_of(Summed(), {p.name: 2.0 for p in Summed().parameters}, [p.name for p in Summed().parameters])
