"""A hybrid model with its scaling and its training cloud (implements `NonlinearModel`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.nonlinear.cloud import Cloud
from ambid.nonlinear.hybrid.function import HybridShape
from ambid.nonlinear.narmax.terms import term_from_json, term_to_json
from ambid.nonlinear.networks.narx_function import NarxShape
from ambid.nonlinear.signals import finite, scaled, with_head


@dataclass(frozen=True, kw_only=True, eq=False)
class HybridNarmax:
    """Polynomial, network and linear noise model in one predictor (thesis eq. 3.24).

    The predictor takes the innovations before its first prediction as zero. Implements
    `ambid.nonlinear.model.NonlinearModel`.
    """

    dt: float  # s
    shape: HybridShape
    # (n_theta,), coefficients of the polynomial and of C in SI, for deviations from `*_level`; then the weights of the
    # network, for deviations divided by `*_scale`
    theta: Array
    u_level: Array  # (n_inputs,), SI
    u_scale: Array
    y_level: Array  # (n_outputs,), SI
    y_scale: Array
    cloud: Cloud  # of the lagged outputs and inputs in training
    kind: str = "hybrid"  # ``hybrid``

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
        """Terms of the polynomial, past innovations, weights."""
        return self.shape.names

    @cached_property
    def unit(self) -> Array:
        """What a scaled number of 1 is in `theta`, shape (n_theta,)."""
        return units_of(self.shape, self.y_scale, self.u_scale)

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other numbers.

        `theta`: (n_theta,).
        """
        return replace(self, theta=theta)

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`; past innovations are its own. NaN from where they diverge on."""
        ys, us = scaled(self, u, y)
        out = np.full(ys.shape, np.nan)
        if ys.shape[0] > self.lag:
            rows = self.shape.rows(ys, us)
            out[self.lag :] = rows.y - self.shape.innovations(self.theta / self.unit, rows)[0]
        found: Array = self.y_level + self.y_scale * out
        return found

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`, past innovations included."""
        ys, us = scaled(self, u, y)
        out = np.zeros((*ys.shape, self.theta.size))
        if ys.shape[0] > self.lag:
            rows, theta = self.shape.rows(ys, us), self.theta / self.unit
            E, T = self.shape.innovations(theta, rows)
            out[self.lag :] = self.shape.slopes(theta, rows, E, T, slice(None))
        return out * (self.y_scale[:, None] / self.unit)

    def simulate(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.simulate`, innovations zero."""
        whole, head = with_head(self, u, y)
        ys, us = scaled(self, u, whole)
        out: Array = self.y_level + self.y_scale * self.shape.free_run(self.theta / self.unit, ys, us)
        out[:head] = whole[:head]
        return out

    def novelty(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.novelty`, of the lagged signals (see `nonlinear.cloud`)."""
        ys, us = scaled(self, u, y)
        out = np.full(ys.shape[0], np.nan)
        if ys.shape[0] > self.lag:
            net = self.shape.network
            out[self.lag :] = self.cloud.novelty(net.regressors(ys, us)[self.lag - net.lag :])
        return out

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        s = self.shape
        sizes = {k: getattr(s.network, k) for k in ("n_outputs", "n_inputs", "ny", "nu", "nk", "neurons")}
        arrays = {k: getattr(self, k).tolist() for k in ("theta", "u_level", "u_scale", "y_level", "y_scale")}
        return {
            "dt_s": self.dt,
            "terms": [[term_to_json(x) for x in terms] for terms in s.terms],
            "ne": s.ne,
            "sizes": sizes,
            "innovations": "network" if s.deep else "linear",
            **arrays,
            "cloud": self.cloud.as_json(),
        }

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back.

        `found`: that `as_json` made.
        """
        try:
            shape = _shape(found)
            m, p = shape.n_inputs, shape.n_outputs
            arrays: dict[str, Any] = {
                k: finite(found[k], n, k)
                for k, n in {"theta": shape.n_theta, "u_level": m, "u_scale": m, "y_level": p, "y_scale": p}.items()
            }
            cloud = Cloud.from_json(found["cloud"], shape.network.n_regressors)
            return cls(dt=float(found["dt_s"]), shape=shape, cloud=cloud, **arrays)
        except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
            raise EstimationError(f"no hybrid model ({type(error).__name__}: {error}). Write it again") from error


def units_of(shape: HybridShape, y_scale: Array, u_scale: Array) -> Array:
    """Return what a scaled number of 1 is in SI; weights of the network stay scaled.

    `y_scale`: (n_outputs,), SI; `u_scale`: (n_inputs,), SI. Returns (n_theta,).
    """
    size = {"y": y_scale, "u": u_scale, "e": y_scale}
    out: list[Array] = []
    for terms in (*shape.terms, *(shape.noise_terms,) * shape.n_outputs):
        o = len(out)
        out.append(np.array([1.0 / np.prod([size[f.kind][f.channel] for f in x]) for x in terms], dtype=np.float64))
        out[o] = out[o] * y_scale[o % shape.n_outputs]
    return np.concatenate([*out, np.ones(shape.n_theta - shape.n_linear)])


def _shape(found: dict[str, Any]) -> HybridShape:
    network = NarxShape(**{k: int(v) for k, v in found["sizes"].items()})
    terms = tuple(tuple(term_from_json(x) for x in one) for one in found["terms"])
    innovations, ne = found["innovations"], found["ne"]
    if innovations not in ("linear", "network") or not isinstance(ne, int) or ne < 0:
        raise ValueError("innovations or ne are none")
    size = {"y": network.n_outputs, "u": network.n_inputs}
    if len(terms) != network.n_outputs or any(
        f.channel >= size.get(f.kind, 0) for one in terms for x in one for f in x
    ):
        raise ValueError("terms name channels that the model does not have")
    return HybridShape(terms=terms, ne=ne, network=network, deep=innovations == "network")
