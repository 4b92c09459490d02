"""A network of radial basis functions with its scaling and its training cloud (implements `NonlinearModel`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.nonlinear.cloud import Cloud
from ambid.nonlinear.networks.narx_function import NarxShape
from ambid.nonlinear.networks.narx_model import finite
from ambid.nonlinear.rbf.shape import RbfShape
from ambid.nonlinear.rbf.units import UNITS
from ambid.nonlinear.signals import scaled, with_head


@dataclass(frozen=True, kw_only=True, eq=False)
class RbfNetwork:
    """A network of radial basis functions; the function is that of `RbfShape`, on scaled signals.

    Implements `ambid.nonlinear.model.NonlinearModel`.
    """

    dt: float  # s
    shape: RbfShape
    # (n_theta,), output weights, centres, logarithms of widths, for signals in deviations from `*_level` divided by
    # `*_scale`
    theta: Array
    u_level: Array  # (n_inputs,), SI
    u_scale: Array
    y_level: Array  # (n_outputs,), SI
    y_scale: Array
    cloud: Cloud  # of the training regressors
    kind: str = "rbf"  # ``rbf``

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return self.shape.lags.n_inputs

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return self.shape.n_outputs

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return self.shape.lags.lag

    @property
    def names(self) -> tuple[str, ...]:
        """Of all numbers."""
        return self.shape.names

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other numbers.

        `theta`: (n_theta,).
        """
        return replace(self, theta=theta)

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`."""
        ys, us = scaled(self, u, y)
        out = np.full(ys.shape, np.nan)
        out[self.lag :] = self.shape.values(self.theta, self.shape.lags.regressors(ys, us))
        found: Array = self.y_level + self.y_scale * out
        return found

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`."""
        ys, us = scaled(self, u, y)
        out = np.zeros((*ys.shape, self.theta.size))
        out[self.lag :] = self.shape.slopes(self.theta, self.shape.lags.regressors(ys, us))
        return out * self.y_scale[:, None]

    def simulate(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.simulate`."""
        whole, head = with_head(self, u, y)
        ys, us = scaled(self, u, whole)
        out: Array = self.y_level + self.y_scale * self.shape.free_run(self.theta, ys, us)[:, : self.n_outputs]
        out[:head] = whole[:head]
        return out

    def novelty(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.novelty`, of the regressors (see `nonlinear.cloud`)."""
        ys, us = scaled(self, u, y)
        out = np.full(ys.shape[0], np.nan)
        out[self.lag :] = self.cloud.novelty(self.shape.lags.regressors(ys, us))
        return out

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        s = self.shape
        lags = {k: getattr(s.lags, k) for k in ("n_outputs", "n_inputs", "ny", "nu", "nk")}
        arrays = {k: getattr(self, k).tolist() for k in ("theta", "u_level", "u_scale", "y_level", "y_scale")}
        return {
            "dt_s": self.dt,
            "sizes": {**lags, "neurons": s.neurons, "linear": int(s.linear)},
            "unit": s.unit,
            "metric": s.metric.tolist(),
            **arrays,
            "cloud": self.cloud.as_json(),
        }

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back.

        `found`: that `as_json` made.
        """
        try:
            sizes = {k: int(v) for k, v in found["sizes"].items()}
            neurons, linear = sizes.pop("neurons"), bool(sizes.pop("linear"))
            lags = NarxShape(**sizes, neurons=0)
            size = np.size(found["metric"])
            metric = finite(found["metric"], size, "metric").reshape(-1, lags.n_regressors)
            unit = UNITS[UNITS.index(found["unit"])]
            shape = RbfShape(lags=lags, metric=metric, linear=linear, neurons=neurons, unit=unit)
            m, p = lags.n_inputs, lags.n_outputs
            arrays: dict[str, Any] = {
                k: finite(found[k], n, k)
                for k, n in {"theta": shape.n_theta, "u_level": m, "u_scale": m, "y_level": p, "y_scale": p}.items()
            }
            cloud = Cloud.from_json(found["cloud"], lags.n_regressors)
            return cls(dt=float(found["dt_s"]), shape=shape, cloud=cloud, **arrays)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise EstimationError(
                f"no network of radial basis functions ({type(error).__name__}: {error}). Write it again"
            ) from error
