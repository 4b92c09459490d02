"""Records of one bench in scaled deviations from common levels, models on them, and where a model was trained.

Distances from training regressors, each 1 at the edge: Mahalanobis, over the farthest's; the gauge of the convex hull,
beyond three dimensions of a polytope that touches it across some hundred directions (corners, regressors, principal
axes), so that what counts as outside is; and, for holes, to the nearest of some hundred spread over the cloud, over the
farthest's. The first two count inside; the third where it says "outside".
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError

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
    def from_json(cls, fields: Mapping[str, Any], n: int) -> Self:
        """Read the cloud of `n` regressors back."""
        whole = fields if "marks" in fields else {**fields, "scale": [1.0] * n, "marks": [], "faces": [], "reach": 1.0}
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
        normals = np.array([[1.0], [-1.0]]) if z.shape[1] == 1 else np.zeros((0, z.shape[1]))
    else:
        exact = _hull(z) if z.shape[1] <= _EXACT else None
        if exact is not None:
            return np.asarray(exact @ W)
        d = z.shape[1]
        axes = (np.eye(d) / scale) @ np.linalg.pinv(W)  # along every regressor as it was given
        length = np.linalg.norm(z, axis=1)
        corners = z[np.argsort(length)[::-1][: max(_DIRECTIONS - 4 * d, 0)]]
        normals = np.concatenate([np.eye(d), -np.eye(d), axes, -axes, corners])
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    support = np.max(z @ normals.T, axis=0, initial=0.0)
    live = support > 1e-9 * np.max(support, initial=1e-300)
    return np.asarray((normals[live] / support[live, None]) @ W)


def _hull(z: Array) -> Array | None:
    """Normals of the hull's faces, over their distance from the origin; None where it has too many, or no volume."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        equations = np.unique(np.round(ConvexHull(z).equations, 12), axis=0)
    except (QhullError, ValueError):
        return None
    if equations.shape[0] > _FACES or not np.all(equations[:, -1] < -1e-12):
        return None
    normals = -equations[:, :-1] / equations[:, -1:]
    return np.asarray(normals / max(float(np.max(z @ normals.T)), 1.0))


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


Parts = tuple[tuple[Array, Array], ...]
"""Outputs (n_samples, n_outputs) and inputs (n_samples, n_inputs) of each record, scaled."""

_FEWEST = 20  # rows of a record beyond its lags
_NUMBERS = ("theta", "u_level", "u_scale", "y_level", "y_scale")
_FAR = 2.0  # a mean of more than so many standard deviations makes powers of a signal alike


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scaled:
    """Outputs and inputs of all records."""

    parts: Parts  # by record
    y_level: Array  # (n_outputs,), SI, mean and standard deviation over all records
    y_scale: Array
    u_level: Array  # (n_inputs,), SI
    u_scale: Array

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return int(self.y_level.size)

    def levels(self, record: IOData) -> dict[str, float]:
        """Return the level of each channel, SI."""
        values = (*self.u_level.tolist(), *self.y_level.tolist())
        return dict(zip((*record.inputs, *record.outputs), values, strict=True))


def scaled_records(
    structure: str, records: Sequence[IOData], *, lag: int, levels: str = "mean", fewest: int = _FEWEST
) -> Scaled:
    """Check that records belong together, for `structure` with `lag` past samples and `fewest` more, and scale
    deviations from `levels`: means, or (auto) means where signals stand far from zero. Levels change what
    polynomial terms mean.
    """
    if not records:
        raise EstimationError(f"{structure}: no record was given. Pass at least one")
    first = records[0]
    for r, x in enumerate(records):
        if (x.inputs, x.outputs) != (first.inputs, first.outputs):
            raise EstimationError(
                f"{structure}: record {r + 1} has channels {x.inputs} and {x.outputs}, the first {first.inputs} and "
                f"{first.outputs}; all must be of one bench. Name the same columns"
            )
        if abs(x.dt - first.dt) > 1e-6 * first.dt:
            raise EstimationError(
                f"{structure}: record {r + 1} is sampled at {1 / x.dt:g} Hz, the first at {1 / first.dt:g} Hz; the "
                "rates must agree. Resample one of them"
            )
        if x.n_samples < lag + fewest:
            raise EstimationError(
                f"{structure}: record {r + 1} has {x.n_samples} samples; {lag + fewest} are needed. "
                "Give a longer record, or a smaller model"
            )
    y, y_level, y_scale = _group(structure, [x.y for x in records], first.outputs, levels)
    u, u_level, u_scale = _group(structure, [x.u for x in records], first.inputs, levels)
    return Scaled(
        parts=tuple(zip(y, u, strict=True)), y_level=y_level, y_scale=y_scale, u_level=u_level, u_scale=u_scale
    )


def _group(
    structure: str, values: list[Array], names: tuple[str, ...], levels: str
) -> tuple[list[Array], Array, Array]:
    whole = np.concatenate(values)
    mean, sd = whole.mean(axis=0), whole.std(axis=0)
    for k, channel in enumerate(names):
        if not sd[k] > 1e-13 * max(abs(mean[k]), 1e-300):
            raise EstimationError(
                f"{structure}: {channel!r} is constant at {whole[0, k]:g} and carries no information. Excite it, "
                "or omit it"
            )
    off = np.abs(mean) > _FAR * sd if levels == "auto" else np.ones(mean.shape, dtype=np.bool_)
    level, scale = np.where(off, mean, 0.0), np.where(off, sd, np.hypot(mean, sd))
    return [(x - level) / scale for x in values], level, scale


@dataclass(frozen=True, kw_only=True, eq=False)
class ScaledModel(ABC):
    """What all models have that work on scaled deviations of the signals; implements part of `NonlinearModel`."""

    theta: Array  # (n_theta,), parameters for signals in deviations from `*_level`, in `unit` times those of the scaled
    u_level: Array  # (n_inputs,), SI
    u_scale: Array
    y_level: Array  # (n_outputs,), SI
    y_scale: Array
    cloud: Cloud  # of the training regressors

    @property
    @abstractmethod
    def unit(self) -> Array | float:
        """What a scaled parameter of 1 is in `theta`."""

    @property
    @abstractmethod
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return int(self.u_level.size)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return int(self.y_level.size)

    @property
    def scaled_theta(self) -> Array:
        """Parameters for scaled signals."""
        return self.theta / self.unit

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other parameters."""
        return replace(self, theta=theta)

    def numbers_json(self) -> dict[str, Any]:
        """Return the fields that all models share as JSON-able values."""
        return {**{k: getattr(self, k).tolist() for k in _NUMBERS}, "cloud": self.cloud.as_json()}


def read_numbers(fields: Mapping[str, Any], n_theta: int, m: int, p: int, n_cloud: int) -> dict[str, Any]:
    """Read back what `ScaledModel.numbers_json` made, of `m` inputs and `p` outputs."""
    sizes = zip(_NUMBERS, (n_theta, m, m, p, p), strict=True)
    return {**{k: finite(fields[k], n, k) for k, n in sizes}, "cloud": Cloud.from_json(fields["cloud"], n_cloud)}


def scaled(model: ScaledModel, u: Array, y: Array) -> tuple[Array, Array]:
    """Return outputs and inputs, given in SI, in a model's scaled units."""
    u, y = np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64)
    n = y.shape[0] if y.ndim else 0
    if (u.shape, y.shape) != ((n, model.n_inputs), (n, model.n_outputs)):
        raise EstimationError(
            f"inputs of shape {u.shape} and outputs of shape {y.shape} for a model of {model.n_inputs} and "
            f"{model.n_outputs} channels; time is axis 0. Pass (n_samples, n_channels)"
        )
    return (y - model.y_level) / model.y_scale, (u - model.u_level) / model.u_scale


def with_head(model: ScaledModel, u: Array, y: Array) -> tuple[Array, int]:
    """Return outputs as long as the inputs, and how many rows of `y` were taken over: `lag`, the others are zero."""
    u, y = np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64)
    head = min(model.lag, u.shape[0])
    if y.ndim != 2 or y.shape[0] < head:
        raise EstimationError(f"{y.shape[0]} samples of the outputs; a simulation starts from {head}. Give more")
    whole = np.zeros((u.shape[0], y.shape[1]))
    whole[:head] = y[:head]
    return whole, head


def finite(value: Any, n: int, what: str) -> Array:
    """Return `n` stored numbers, shape (n,); raises ValueError about `what` where they are not finite."""
    out = np.array(value, dtype=np.float64).reshape(n)
    if not np.all(np.isfinite(out)):
        raise ValueError(f"{what} is not finite")
    return out
