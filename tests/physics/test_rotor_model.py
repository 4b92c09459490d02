"""The rotor on many axes against an independent simulator's matrices, and its derivatives."""

import numpy as np
import pytest

from tests.rotor_benches import model_and_truth, needs_simulator, truth


@needs_simulator
@pytest.mark.parametrize("name", ["rigid", "rigid-spin", "flexible", "utrc"])
def test_the_response_is_that_of_the_independent_simulator(name: str) -> None:
    model, theta = model_and_truth(name)
    space = model.matrices(theta)
    A, B, C = truth.plant(truth.BENCHES[name])
    A, B, C = A[:-2, :-2], B[:-2, :4], C[:, :-2]
    for s in 2j * np.pi * np.array([3.0, 123.0, 900.0]):
        wanted = C @ np.linalg.solve(s * np.eye(len(A)) - A, B)
        found = space.C @ np.linalg.solve(s * np.eye(len(space.A)) - space.A, space.B)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * abs(wanted).max())


@needs_simulator
@pytest.mark.parametrize("name", ["rigid-spin", "utrc"])
def test_derivatives_agree_with_central_differences(name: str) -> None:
    model, theta = model_and_truth(name)
    for p in model.parameters:
        h = 1e-6 * max(abs(theta[p.name]), 1e-3)
        up, down = (model.matrices({**theta, p.name: theta[p.name] + d}) for d in (h, -h))
        exact = model.derivative(theta, p.name)
        for what in "ABEC":
            differences = (getattr(up, what) - getattr(down, what)) / (2 * h)
            size = max(abs(differences).max(), abs(getattr(model.matrices(theta), what)).max() * 1e-3)
            np.testing.assert_allclose(getattr(exact, what), differences, rtol=0, atol=2e-6 * size)
