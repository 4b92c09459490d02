"""How far regressors are from the training."""

from __future__ import annotations

import numpy as np

from ambid.identify.networks.cloud import Cloud, cloud_of


def test_middle_edge_and_outside() -> None:
    x = np.random.default_rng(0).standard_normal((2000, 4)) * [1.0, 1e-3, 10.0, 1.0] + 5.0
    cloud = cloud_of(x)
    inside = cloud.novelty(x)
    assert inside.max() == 1.0 or abs(inside.max() - 1.0) < 1e-9
    assert cloud.novelty(x.mean(axis=0)[None])[0] < 0.05
    far = x.mean(axis=0) + np.eye(4) * 8.0 * x.std(axis=0)
    assert np.all(cloud.novelty(far) > 1.5)


def test_a_hole_in_the_middle_is_outside() -> None:
    angle = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    cloud = cloud_of(np.stack([np.cos(angle), np.sin(angle)], axis=1))
    assert cloud.novelty(np.zeros((1, 2)))[0] > 5.0  # Mahalanobis alone would say 0


def test_numbers_survive() -> None:
    x = np.random.default_rng(1).standard_normal((50, 3))
    cloud = cloud_of(x)
    back = Cloud.from_json(cloud.as_json(), 3)
    np.testing.assert_array_equal(back.novelty(2 * x), cloud.novelty(2 * x))


def test_directions_that_do_not_move_are_very_narrow() -> None:
    x = np.random.default_rng(2).standard_normal((100, 2))
    cloud = cloud_of(np.hstack([x, np.full((100, 1), 3.0)]))
    assert np.all(cloud.novelty(np.hstack([x, np.full((100, 1), 3.1)])) > 1.0)
