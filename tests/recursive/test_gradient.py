"""LMS and normalised LMS against theory."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.recursive.regression import Lms, Nlms


def test_lms_step_and_covariance_follow_their_recursions() -> None:
    rng = np.random.default_rng(1)
    phi, y = rng.normal(size=(200, 3)), rng.normal(size=200)
    lms = Lms(3, step=0.02, prior=2.0, noise_sd=0.5)
    lms.update(phi, y)
    theta, C = np.zeros(3), 2 * np.eye(3)
    for row, out in zip(phi, y, strict=True):
        theta = theta + 0.02 * row * (out - row @ theta)
        left = np.eye(3) - 0.02 * np.outer(row, row)
        C = left @ C @ left.T + 0.02**2 * np.outer(row, row)
    np.testing.assert_allclose(lms.estimate, theta, rtol=1e-10)
    np.testing.assert_allclose(lms.covariance, 0.25 * C, rtol=1e-9, atol=1e-14)


def test_misadjustment_of_lms_with_white_gaussian_regressors() -> None:
    """C = step / (2 - step (p + 2) r) for white Gaussian regressors of power r (Haykin 2002, sec. 5.4)."""
    rng = np.random.default_rng(2)
    p, r, step = 4, 2.0, 0.02
    lms = Lms(p, step=step)
    sizes = []
    for _ in range(300):
        phi = np.sqrt(r) * rng.normal(size=(200, p))
        lms.update(phi, phi @ np.ones(p) + 0.3 * rng.normal(size=200))
        sizes.append(np.diag(lms.covariance) / lms.noise_variance)
    np.testing.assert_allclose(np.mean(sizes[100:]), step / (2 - step * (p + 2) * r), rtol=0.03)
    np.testing.assert_allclose(lms.noise_variance, 0.09, rtol=0.05)


def test_a_step_that_overshoots_is_limited_and_counted() -> None:
    lms = Lms(2, step=0.5)
    lms.update(np.array([10.0, 0.0]), 30.0)
    assert lms.n_limited == 1
    np.testing.assert_allclose(lms.estimate, [3.0, 0.0])
    lms.update(np.array([1.0, 0.0]), 3.0)
    assert lms.n_limited == 1


def test_nlms_meets_the_output_with_a_full_step_and_stands_still_on_small_regressors() -> None:
    nlms = Nlms(2, step=1.0, small=1e-6)
    nlms.update(np.array([3.0, 4.0]), 10.0)
    np.testing.assert_allclose(nlms.estimate @ [3.0, 4.0], 10.0, rtol=1e-6)
    at = nlms.estimate
    nlms.update(np.array([1e-9, 0.0]), 1.0)
    np.testing.assert_allclose(nlms.estimate, at + np.array([1e-3, 0.0]), rtol=1e-5)
    nlms.update(np.zeros(2), 5.0)
    np.testing.assert_allclose(nlms.estimate, at + np.array([1e-3, 0.0]), rtol=1e-5)
    assert nlms.n_used == 3


@pytest.mark.parametrize("step", [0.0, 2.0, -1.0, np.nan])
def test_steps_out_of_range_are_refused(step: float) -> None:
    with pytest.raises(EstimationError):
        Nlms(2, step=step, small=1.0)
    with pytest.raises(EstimationError):
        Lms(2, step=-abs(step))
    with pytest.raises(EstimationError):
        Nlms(2, step=1.0, small=0.0)


@pytest.mark.parametrize("size", [1e-6, 1e3])
def test_without_a_prior_the_start_may_be_far_off_in_any_unit(size: float) -> None:
    rng = np.random.default_rng(4)
    phi = rng.normal(size=(30, 3)) * size
    y = phi @ np.ones(3) + 1e-3 * size * rng.normal(size=30)
    for made in (Lms(3, step=0.1 / size**2, noise_sd=1e-3 * size), Nlms(3, step=0.5, small=1e-3 * size**2)):
        made.update(phi, y)
        assert (np.abs(made.estimate - 1.0) < 4 * np.sqrt(np.diag(made.covariance))).all()
