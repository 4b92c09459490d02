"""An LPV model with schedule, scaling and cloud (implements `NonlinearModel`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.nonlinear.cloud import Cloud
from ambid.nonlinear.lpv.beginning import beginning, looks_back, settling
from ambid.nonlinear.lpv.frozen import Frozen, frozen
from ambid.nonlinear.lpv.schedule import BASES, Schedule, basis_values
from ambid.nonlinear.lpv.shape import LpvShape, Part, errors, part_of
from ambid.nonlinear.signals import finite, scaled, with_head


@dataclass(frozen=True, kw_only=True, eq=False)
class LpvModel:
    """A linear model of one output whose coefficients follow a scheduling signal; equations in `lpv.shape`.

    What was before a record the predictor estimates from the first `lag` samples, see `lpv.beginning`. Implements
    `ambid.nonlinear.model.NonlinearModel`.
    """

    dt: float  # s
    n_inputs: int  # channels, with one that only schedules
    shape: LpvShape
    schedule: Schedule
    # (n_theta,), SI, for signals in deviations from `*_level`; each coefficient's weights of the functions of p
    theta: Array
    u_level: Array  # (n_inputs,), SI
    u_scale: Array
    y_level: Array  # (1,), SI
    y_scale: Array
    cloud: Cloud  # of the training regressors and the scheduling signal

    @property
    def kind(self) -> str:
        """Under which files know it."""
        return "lpv"

    @property
    def n_outputs(self) -> int:
        """One."""
        return 1

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return looks_back(self.shape)

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficient and number of the function of p."""
        return self.shape.names

    @cached_property
    def unit(self) -> Array:
        """What a scaled parameter of 1 is in SI, shape (n_theta,)."""
        of = self.shape
        out, y = np.ones(of.n_theta), float(self.y_scale[0])
        for i, column in enumerate(of.columns):
            for k in range(of.nb):
                out[of.place(of.order + i * of.nb + k)] = y / self.u_scale[column]
        out[of.place(of.n_process - 1)] = y
        return out

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other parameters.

        `theta`: (n_theta,), SI.
        """
        return replace(self, theta=theta)

    def at(self, p: float, covariance: Array | None = None) -> Frozen:
        """Return the linear model at one value of the scheduling signal.

        `p`: outside ``schedule.low`` to ``schedule.high`` the functions of p are continued, which nothing backs;
        `covariance`: (n_theta, n_theta), SI, of `theta`; that of the fit.
        """
        of, s = self.shape, self.schedule.scaled(float(p)).reshape(1)
        n = len(of.coefficients)
        G = np.zeros((n, of.n_theta))
        for k in range(n):
            where = of.place(k)
            G[k, where] = basis_values(s, where.stop - where.start, of.basis)[0]
        values, keep = G @ self.theta, np.arange(n) != of.n_process - 1
        P = None if covariance is None else (G @ covariance @ G.T)[np.ix_(keep, keep)]
        b = values[of.order : of.n_process - 1].reshape(len(of.columns), of.nb)
        d, c = values[of.n_process : of.n_process + of.ar], values[of.n_process + of.ar :]
        return frozen(float(p), self.dt, of.nk, values[: of.order], b, c, d, P)

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`; NaN everywhere if the predictor diverges."""
        part = self._part(u, y)
        theta = self.theta / self.unit
        start = beginning(self.shape, part, theta)
        found = None if start is None else errors(self.shape, part, theta, start[0])
        out = np.full((part.y.size, 1), np.nan)
        if found is not None and found.finite:
            out[self.lag :, 0] = found.g[self.lag :]
        predicted: Array = self.y_level + self.y_scale * out
        return predicted

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`."""
        part, theta, P = self._part(u, y), self.theta / self.unit, self.theta.size
        start = beginning(self.shape, part, theta, slopes=True)
        found = None if start is None else errors(self.shape, part, theta, start[0], slopes=2)
        J = np.full((part.y.size, P), np.nan)
        if start is not None and found is not None and found.finite:
            J = found.J[:, :P] + found.J[:, P:] @ start[1]
        out = (J * (self.y_scale / self.unit))[:, None, :]
        out[: self.lag] = 0.0
        return np.asarray(out)

    def simulate(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.simulate`."""
        from ambid.nonlinear.lpv._kernels import free_run

        whole, head = with_head(self, u, y)
        ys, us = scaled(self, u, whole)
        of, found = self.shape, np.ascontiguousarray(ys[:, 0])
        share, column = self.schedule.share(self.dt), self.schedule.column
        s = np.zeros(found.size) if column < 0 else self.schedule.scaled(np.asarray(u, dtype=np.float64)[:, column])
        level, size = float(self.y_level[0]), float(self.y_scale[0])
        free_run(
            found,
            of.lagged_inputs(us),
            np.ascontiguousarray(s),
            of.degree + 1,
            of.n_offset,
            BASES.index(of.basis),
            self.theta / self.unit,
            of.order,
            head,
            share,
            (self.schedule.middle - level) / size,
            self.schedule.half / size,
        )
        out: Array = self.y_level + self.y_scale * found[:, None]
        out[:head] = whole[:head]
        return out

    def novelty(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.novelty`: the largest of p's, over half its range, and of ellipsoid and hull of the cloud.

        Holes of the cloud do not count: between set points an LPV model interpolates.
        """
        ys, us = scaled(self, u, y)
        s = self.scheduling(u, y)
        out = np.full(ys.shape[0], np.nan)
        x = regressors(self.shape, ys[:, 0], us, s)
        away = x[settling(self.shape) :] - self.cloud.mean
        ellipsoid = np.linalg.norm(away @ self.cloud.whitening.T, axis=1)
        hull = np.max(away @ self.cloud.faces.T, axis=1, initial=0.0)
        out[self.lag :] = np.maximum(np.abs(s[self.lag :]), np.maximum(ellipsoid, hull))
        return out

    def scheduling(self, u: Array, y: Array) -> Array:
        """Return the scheduling signal, scaled: -1 to 1 in training.

        `u`: (n_samples, n_inputs), SI; `y`: (n_samples, 1), SI. Returns (n_samples,).
        """
        p = self.schedule.signal(np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64), self.dt)
        return self.schedule.scaled(p)

    def _part(self, u: Array, y: Array) -> Part:
        ys, us = scaled(self, u, y)
        return part_of(self.shape, ys[:, 0], us, self.scheduling(u, y))

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        arrays = {k: getattr(self, k).tolist() for k in ("theta", "u_level", "u_scale", "y_level", "y_scale")}
        return {
            "dt_s": self.dt,
            "n_inputs": self.n_inputs,
            "shape": {**asdict(self.shape), "columns": list(self.shape.columns)},
            "schedule": asdict(self.schedule),
            **arrays,
            "cloud": self.cloud.as_json(),
        }

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back.

        `found`: that `as_json` made.
        """
        try:
            return cls(**_read(found))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise EstimationError(f"no LPV model ({type(error).__name__}: {error}). Write the file again") from error


def _read(found: Mapping[str, Any]) -> dict[str, Any]:
    """What the model is made with, checked."""
    m, words = int(found["n_inputs"]), ("form", "basis", "offset")
    sizes: dict[str, Any] = {k: int(v) for k, v in found["shape"].items() if k not in ("columns", *words)}
    columns = tuple(int(k) for k in found["shape"]["columns"])
    texts: dict[str, Any] = {k: str(found["shape"][k]) for k in words}
    shape = LpvShape(columns=columns, **sizes, **texts)
    schedule = Schedule(**found["schedule"])
    known = {"basis": BASES, "form": ("equation", "output"), "offset": ("scheduled", "constant")}
    if any(getattr(shape, k) not in v for k, v in known.items()) or not schedule.high > schedule.low:
        raise ValueError("form, basis, offset or range of the schedule make no sense")
    if not all(0 <= k < m for k in columns) or not -1 <= schedule.column < m or min(sizes.values()) < 0:
        raise ValueError("columns or orders make no sense")
    n = {"theta": shape.n_theta, "u_level": m, "u_scale": m, "y_level": 1, "y_scale": 1}
    arrays: dict[str, Any] = {k: finite(found[k], size, k) for k, size in n.items()}
    cloud = Cloud.from_json(found["cloud"], shape.n_process)
    return {"dt": float(found["dt_s"]), "n_inputs": m, "shape": shape, "schedule": schedule, "cloud": cloud, **arrays}


def regressors(shape: LpvShape, y: Array, u: Array, s: Array) -> Array:
    """Return what predictions depend on: past outputs, inputs, scheduling signal.

    `y`: (n_samples,), scaled; `u`: (n_samples, n_inputs), scaled; `s`: (n_samples,), scaled. Returns (n_samples - lag,
    order + n_exciting nb + 1).
    """
    n, lag = y.size, shape.lag
    if n <= lag:
        return np.empty((0, shape.n_process))
    past = [y[lag - k : n - k] for k in range(1, shape.order + 1)]
    return np.column_stack([*past, shape.lagged_inputs(u)[lag:, :-1], s[lag:]])
