"""How far regressors are from the training."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.nonlinear.records import Cloud, cloud_of


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


def drawn(d: int, n: int, kind: str, seed: int) -> np.ndarray:
    """Regressors in d dimensions, of very different sizes, that hang together."""
    rng, mixed = np.random.default_rng(seed), np.random.default_rng(d)
    draw = {"normal": rng.standard_normal, "skewed": rng.standard_exponential}.get(kind)
    x = draw((n, d)) if draw else rng.uniform(-1.0, 1.0, (n, d))
    return np.asarray(x @ mixed.standard_normal((d, d)) * 10.0 ** mixed.integers(-3, 4, d) + 3.0)


@pytest.mark.parametrize("kind", ["normal", "uniform", "skewed"])
@pytest.mark.parametrize("d", range(2, 9))
def test_outside_the_hull_is_novel_and_the_dense_part_is_not(d: int, kind: str) -> None:
    x = drawn(d, 3000, kind, 1)
    cloud = cloud_of(x)
    middle = x.mean(axis=0)
    assert cloud.novelty(x).max() == pytest.approx(1.0, abs=1e-9)
    # a plane parts these from all training regressors: they are beyond the farthest one along a direction
    white = np.linalg.inv(np.linalg.cholesky(np.cov(x.T)))
    z, v = (x - middle) @ white.T, np.random.default_rng(2).standard_normal((500, d))
    v /= np.linalg.norm(v, axis=1)[:, None]
    far = v * ((1.05 if d < 4 else 1.5) * np.max(z @ v.T, axis=0))[:, None]
    assert np.mean(cloud.novelty(middle + far @ np.linalg.inv(white).T) > 1.0) > (0.999 if d < 4 else 0.85)
    corners = np.argsort(np.linalg.norm(z, axis=1))[-20:]
    assert np.mean(cloud.novelty(middle + 1.2 * (x - middle)[corners]) > 1.0) >= 0.85
    new = drawn(d, 2000, kind, 3)
    depth = np.linalg.norm((new - middle) @ white.T, axis=1)
    assert np.mean(cloud.novelty(new[depth < np.median(depth)]) < 1.0) > 0.98


def test_the_corner_between_two_clouds_sides_is_outside_the_hull_though_inside_the_ellipsoid() -> None:
    x = np.abs(np.random.default_rng(4).standard_normal((2000, 2)))  # no regressor is negative
    cloud = cloud_of(x)
    point = np.array([[-0.05, 1.0]])
    assert np.linalg.norm((point - cloud.mean) @ cloud.whitening.T) < 0.5
    assert cloud.novelty(point)[0] > 1.0
