"""A neural NARX model with its scaling and its training cloud (implements `NonlinearModel`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.nonlinear.cloud import Cloud
from ambid.nonlinear.networks.narx_function import NarxShape
from ambid.nonlinear.signals import scaled, with_head


@dataclass(frozen=True, kw_only=True, eq=False)
class NeuralNarx:
    """A neural NARX model; the function is that of `NarxShape`, on scaled signals.

    Implements `ambid.nonlinear.model.NonlinearModel`.
    """

    dt: float  # s
    shape: NarxShape
    theta: Array  # (n_theta,), weights, for signals in deviations from `*_level` divided by `*_scale`
    u_level: Array  # (n_inputs,), SI
    u_scale: Array
    y_level: Array  # (n_outputs,), SI
    y_scale: Array
    cloud: Cloud  # of the training regressors
    kind: str = "narx"  # ``narx``

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return self.shape.n_inputs

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return self.shape.n_outputs

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return self.shape.lag

    @property
    def names(self) -> tuple[str, ...]:
        """Of the weights."""
        return self.shape.names

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other weights.

        `theta`: (n_theta,).
        """
        return replace(self, theta=theta)

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`."""
        ys, us = scaled(self, u, y)
        out = np.full(ys.shape, np.nan)
        out[self.lag :] = self.shape.values(self.theta, self.shape.regressors(ys, us))
        found: Array = self.y_level + self.y_scale * out
        return found

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`."""
        ys, us = scaled(self, u, y)
        out = np.zeros((*ys.shape, self.theta.size))
        out[self.lag :] = self.shape.slopes(self.theta, self.shape.regressors(ys, us))
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
        out[self.lag :] = self.cloud.novelty(self.shape.regressors(ys, us))
        return out

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        s = self.shape
        sizes = {k: getattr(s, k) for k in ("n_outputs", "n_inputs", "ny", "nu", "nk", "neurons")}
        arrays = {k: getattr(self, k).tolist() for k in ("theta", "u_level", "u_scale", "y_level", "y_scale")}
        return {"dt_s": self.dt, "sizes": sizes, **arrays, "cloud": self.cloud.as_json()}

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back.

        `found`: that `as_json` made.
        """
        try:
            shape = NarxShape(**{k: int(v) for k, v in found["sizes"].items()})
            m, p = shape.n_inputs, shape.n_outputs
            arrays: dict[str, Any] = {
                k: finite(found[k], n, k)
                for k, n in {"theta": shape.n_theta, "u_level": m, "u_scale": m, "y_level": p, "y_scale": p}.items()
            }
            cloud = Cloud.from_json(found["cloud"], shape.n_regressors)
            return cls(dt=float(found["dt_s"]), shape=shape, cloud=cloud, **arrays)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise EstimationError(f"no neural NARX model ({type(error).__name__}: {error}). Write it again") from error


def finite(value: Any, n: int, what: str) -> Array:
    """Return stored numbers, checked.

    `n`: how many there must be; `what`: for the message. Returns (n,).
    """
    out = np.array(value, dtype=np.float64).reshape(n)
    if not np.all(np.isfinite(out)):
        raise ValueError(f"{what} is not finite")
    return out
