"""Where the training regressors lie, and how far others are from them: ellipsoid, convex hull, nearest neighbour.

Three distances, each 1 at the edge. Mahalanobis, from the middle, in that of the farthest training regressor. The gauge
of the convex hull: in two and three dimensions of the hull itself; in more, where hulls have too many faces, of the
polytope whose faces touch the hull across some hundred directions (towards its corners, along every regressor, along
the principal axes), so that whatever counts as outside is outside the hull. And, because a cloud may have holes, the
distance to the nearest of some hundred training regressors that were spread over the cloud (farthest first), in the
farthest that any training regressor has. The first two count inside; the third where it says "outside".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ambid.arrays import Array

_MARKS = 300  # training regressors that stand for all
_LOOKED_AT = 4000  # of which they are chosen
_EXACT = 3  # dimensions up to which the hull itself is computed
_FACES = 400  # of the hull, at most
_DIRECTIONS = 200  # across which the polytope touches it
_NARROW = 1e-6  # part of the widest direction below which a direction counts as that wide


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Training regressors in brief."""

    mean: Array  # (n_regressors,)
    # (n_regressors, n_regressors), |whitening (x - mean)| is the Mahalanobis distance, in that of the farthest
    # training regressor
    whitening: Array
    scale: Array  # (n_regressors,), deviations, in which neighbours are compared
    marks: Array  # (n_marks, n_regressors), training regressors
    reach: float  # largest distance of a training regressor to the nearest mark, in deviations
    # (n_faces, n_regressors), normals; the largest product with x - mean is the gauge of the hull, 1 on its surface
    faces: Array

    def novelty(self, x: Array) -> Array:
        """Return how far regressors (n, n_regressors) are from the training: 0 in the middle, 1 at the edge."""
        from scipy.spatial import KDTree

        out: Array = np.linalg.norm((x - self.mean) @ self.whitening.T, axis=1)
        if not self.marks.size:
            return out
        out = np.maximum(out, np.max((x - self.mean) @ self.faces.T, axis=1, initial=0.0))
        sound = np.all(np.isfinite(x), axis=1)
        near = np.full(x.shape[0], np.nan)
        if np.any(sound):
            near[sound] = KDTree(self.marks / self.scale).query(x[sound] / self.scale)[0] / self.reach
        return np.where(near > 1.0 + 1e-9, np.maximum(out, near), out)

    def as_json(self) -> dict[str, Any]:
        """Return all that `from_json` needs."""
        ellipsoid = {"mean": self.mean.tolist(), "whitening": self.whitening.tolist()}
        if not self.marks.size:
            return ellipsoid
        more = {k: getattr(self, k).tolist() for k in ("scale", "marks", "faces")}
        return {**ellipsoid, **more, "reach": self.reach}

    @classmethod
    def from_json(cls, found: Mapping[str, Any], n: int) -> Self:
        """Read the cloud of `n` regressors back."""
        whole = found if "marks" in found else {**found, "scale": [1.0] * n, "marks": [], "faces": [], "reach": 1.0}
        shapes = {"mean": (n,), "whitening": (n, n), "scale": (n,), "marks": (-1, n), "faces": (-1, n)}
        arrays = {
            k: np.array(whole[k], dtype=np.float64).reshape(shape if n else (0,) * len(shape))
            for k, shape in shapes.items()
        }
        if not all(np.all(np.isfinite(x)) for x in arrays.values()):
            raise ValueError("a number of the cloud is not finite")
        return cls(**arrays, reach=float(whole["reach"]))


def cloud_of(x: Array, *, ellipsoid: bool = False) -> Cloud:
    """Return where training regressors (n, n_regressors) lie, with hull and neighbours or by their ellipsoid alone."""
    from scipy.spatial import KDTree

    mean, scale = x.mean(axis=0), x.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, s, Vt = np.linalg.svd(np.linalg.qr(x - mean, mode="r"))
    wide = np.zeros(x.shape[1])
    wide[: s.size] = s
    narrow = np.maximum(wide, _NARROW * max(s.max(initial=0.0), 1e-300))
    W = Vt / (narrow / np.sqrt(x.shape[0]))[:, None]
    far = float(np.max(np.linalg.norm((x - mean) @ W.T, axis=1)))
    W_far = W / far if far > 0 else W
    if ellipsoid:
        none = np.zeros((0, x.shape[1]))
        return Cloud(mean=mean, whitening=W_far, scale=np.ones(x.shape[1]), marks=none, reach=1.0, faces=none)
    marks = _spread(x[:: max(1, x.shape[0] // _LOOKED_AT)], mean, scale)
    reach = float(np.max(KDTree(marks / scale).query(x / scale)[0]))
    return Cloud(
        mean=mean,
        whitening=W_far,
        scale=scale,
        marks=marks,
        reach=reach if reach > 0 else 1.0,
        faces=_faces(x - mean, W, scale),
    )


def _faces(x: Array, W: Array, scale: Array) -> Array:
    """Normals of the hull, or of a polytope that touches it across many directions."""
    z = x @ W.T
    if z.shape[1] == 1 or not np.all(np.isfinite(z)):
        found = np.array([[1.0], [-1.0]]) if z.shape[1] == 1 else np.zeros((0, z.shape[1]))
    else:
        exact = _hull(z) if z.shape[1] <= _EXACT else None
        if exact is not None:
            return np.asarray(exact @ W)
        d = z.shape[1]
        axes = (np.eye(d) / scale) @ np.linalg.pinv(W)  # along every regressor as it was given
        length = np.linalg.norm(z, axis=1)
        corners = z[np.argsort(length)[::-1][: max(_DIRECTIONS - 4 * d, 0)]]
        found = np.concatenate([np.eye(d), -np.eye(d), axes, -axes, corners])
        found = found / np.maximum(np.linalg.norm(found, axis=1), 1e-300)[:, None]
    support = np.max(z @ found.T, axis=0, initial=0.0)
    live = support > 1e-9 * np.max(support, initial=1e-300)
    return np.asarray((found[live] / support[live, None]) @ W)


def _hull(z: Array) -> Array | None:
    """Normals of the hull's faces, over their distance from the origin; None where it has too many, or no volume."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        equations = np.unique(np.round(ConvexHull(z).equations, 12), axis=0)
    except (QhullError, ValueError):
        return None
    if equations.shape[0] > _FACES or not np.all(equations[:, -1] < -1e-12):
        return None
    found = -equations[:, :-1] / equations[:, -1:]
    return np.asarray(found / max(float(np.max(z @ found.T)), 1.0))


def _spread(x: Array, mean: Array, scale: Array) -> Array:
    """Choose regressors farthest first (Gonzalez 1985), beginning with the one nearest to the middle."""
    z = np.ascontiguousarray((x / scale).T)  # samples last: sums over few regressors are slow otherwise
    at = int(np.argmin(np.linalg.norm(z - (mean / scale)[:, None], axis=0)))
    away = np.full(z.shape[1], np.inf)
    chosen = []
    for _ in range(min(_MARKS, z.shape[1])):
        chosen.append(at)
        away = np.minimum(away, np.sum((z - z[:, at, None]) ** 2, axis=0))
        at = int(np.argmax(away))
        if not away[at] > 0:
            break
    return np.array(x[chosen])
