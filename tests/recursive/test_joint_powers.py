"""Matrices as products of powers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.physics.linear_model import StateSpace
from ambid.physics.models import model, model_names
from ambid.physics.one_axis import OneAxis
from ambid.recursive.joint import powers_of


@pytest.mark.parametrize("name", model_names())
def test_every_linear_model_is_one(name):
    of = model(name)
    values = 0.3 + np.arange(len(of.parameters)) ** 1.5
    space = of.matrices({p.name: v for p, v in zip(of.parameters, values, strict=True)})
    wanted = np.hstack([space.A, space.B, space.E])
    np.testing.assert_allclose(powers_of(of).matrix(values, wanted.shape), wanted, rtol=1e-13)


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
        powers_of(Summed())
