"""A state-space network behind a sensor without sign, with its scaling and cloud (implements `NonlinearModel`)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.nonlinear.cloud import Cloud
from ambid.nonlinear.networks.magnitude_problem import FoldedLayout, slopes, states
from ambid.nonlinear.signals import finite, scaled, with_head

_ITERATIONS = 30  # of the search for the first state
_SIGNS = (0.0, 1.0, -1.0)  # of the state that the search begins at, in sizes of the first output


@dataclass(frozen=True, kw_only=True, eq=False)
class MagnitudeNetwork:
    """A network x+ = A x + B u + W2 tanh(W1 [x; u]) whose x1 is seen by a sensor without sign: y = low pass of |x1|.

    It has no one-step predictor: what is measured does not correct the state, and a prediction is the free run from the
    state that fits the first `lag` samples best.
    """

    layout: FoldedLayout
    theta: Array  # (n_theta,), for scaled signals
    dt: float  # s
    u_scale: Array  # (n_inputs,), SI
    y_scale: Array  # (1,), SI, levels are zero: a magnitude has none to take off
    cloud: Cloud  # of states and inputs in training, scaled
    kind: str = "nn-magnitude"  # ``nn-magnitude``

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return self.layout.n_inputs

    @property
    def n_outputs(self) -> int:
        """Number of outputs: one."""
        return 1

    @property
    def lag(self) -> int:
        """Samples from which the first state is found."""
        return 5 * (self.layout.n + 1)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the weights."""
        return self.layout.names

    @property
    def u_level(self) -> Array:
        """Zeros, shape (n_inputs,)."""
        return np.zeros(self.n_inputs)

    @property
    def y_level(self) -> Array:
        """Zero, shape (1,)."""
        return np.zeros(1)

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other weights.

        `theta`: (n_theta,).
        """
        return replace(self, theta=theta)

    def predict(self, u: Array, y: Array) -> Array:
        """Return the free run from the state that the first `lag` samples show.

        `u`: (n_samples, n_inputs), SI; `y`: (n_samples, 1), SI. Returns (n_samples, 1), SI, the first `lag` rows are
        NaN, and all from where the run diverges on.
        """
        _, _, X = self._run(u, y)
        out: Array = self.y_scale * X[:-1, -1:]
        out[: self.lag] = np.nan
        return out

    def simulate(self, u: Array, y: Array) -> Array:
        """Run freely from the state that the first `lag` measured samples show.

        `u`: (n_samples, n_inputs), SI; `y`: (at least lag, 1), SI, only the first `lag` rows are looked at. Returns
        (n_samples, 1), SI, the first `lag` rows are those of `y`; NaN from where the run leaves a million times the
        size of the training data.
        """
        whole, head = with_head(self, u, y)
        whole[head:] = self.predict(u, whole)[head:]
        return whole

    def jacobian(self, u: Array, y: Array) -> Array:
        """Return the derivative of `predict` by `theta`.

        That of the first state is included as least squares has it (Gauss-Newton): exact where the head is fitted
        exactly, else to first order in what it leaves over.

        `u`: (n_samples, n_inputs), SI; `y`: (n_samples, 1), SI. Returns (n_samples, 1, n_theta), the first `lag` rows
        are zero.
        """
        us, _, X = self._run(u, y)
        J, P, k = slopes(self.layout, self.theta, us, X), self.layout.n_theta, self.lag
        bend = -np.linalg.lstsq(J[:k, P:], J[:k, :P], rcond=1e-10)[0] if np.all(np.isfinite(J[:k])) else 0.0
        out = np.zeros((us.shape[0], 1, P))
        out[k:, 0] = (J[:, :P] + J[:, P:] @ bend)[k:] * self.y_scale
        return out

    def novelty(self, u: Array, y: Array) -> Array:
        """Return how far states and inputs are from those of the training (see `nonlinear.cloud`).

        `u`: (n_samples, n_inputs), SI; `y`: (n_samples, 1), SI. Returns (n_samples,), 0 in the middle, 1 at the edge,
        above 1 outside; the first `lag` rows are NaN.
        """
        us, _, X = self._run(u, y)
        out = np.full(us.shape[0], np.nan)
        out[self.lag :] = self.cloud.novelty(np.hstack([X[:-1], us])[self.lag - 1 : -1])
        return out

    def _run(self, u: Array, y: Array) -> tuple[Array, Array, Array]:
        """Scaled inputs and outputs, and the states from the first state on that fits the head best."""
        ys, us = scaled(self, u, y)
        k = min(self.lag, us.shape[0])
        x0 = first_state(self.layout, self.theta, us[:k], ys[:k, 0])
        return us, ys, states(self.layout, self.theta, us, x0)

    def as_json(self) -> dict[str, Any]:
        """Return all that `from_json` needs."""
        arrays = {k: getattr(self, k).tolist() for k in ("theta", "u_scale", "y_scale")}
        return {"dt_s": self.dt, "layout": asdict(self.layout), **arrays, "cloud": self.cloud.as_json()}

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back.

        `found`: that `as_json` made.
        """
        try:
            given = found["layout"]
            layout = FoldedLayout(
                n=int(given["n"]),
                n_inputs=int(given["n_inputs"]),
                neurons=int(given["neurons"]),
                step=float(given["step"]),
            )
            sizes = {"theta": layout.n_theta, "u_scale": layout.n_inputs, "y_scale": 1}
            arrays: dict[str, Any] = {k: finite(found[k], n, k) for k, n in sizes.items()}
            cloud = Cloud.from_json(found["cloud"], layout.n + 1 + layout.n_inputs)
            return cls(layout=layout, dt=float(found["dt_s"]), cloud=cloud, **arrays)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise EstimationError(
                f"no network of a magnitude ({type(error).__name__}: {error}). Write the file again"
            ) from error


def first_state(layout: FoldedLayout, theta: Array, u: Array, y: Array) -> Array:
    """Return the state from which the run fits the first outputs best: from rest and from both signs, the best.

    `theta`: (n_theta,). Returns (n + 1,).
    """
    first = float(y[0]) if y.size else 0.0
    best, least = np.zeros(layout.n + 1), np.inf
    for sign in _SIGNS:
        x0 = np.zeros(layout.n + 1)
        x0[0], x0[-1] = sign * first, first
        found, cost = _searched(layout, theta, u, y, x0)
        if cost < least:
            best, least = found, cost
    return best


def _searched(layout: FoldedLayout, theta: Array, u: Array, y: Array, x0: Array) -> tuple[Array, float]:
    """Levenberg-Marquardt over the first state alone."""

    def left(x: Array) -> Array:
        e: Array = y - states(layout, theta, u, x)[:-1, -1]
        return e

    e = left(x0)
    cost, damping = float(e @ e), 1e-3
    for _ in range(_ITERATIONS if np.isfinite(cost) else 0):
        J = slopes(layout, theta, u, states(layout, theta, u, x0))[:, layout.n_theta :]
        size = np.linalg.norm(J, axis=0) + 1e-150
        U, s, Vt = np.linalg.svd(J / size, full_matrices=False)
        before = cost
        while damping < 1e6:
            trial = x0 + Vt.T @ (s / (s**2 + damping) * (U.T @ e)) / size
            then = left(trial)
            if float(then @ then) < cost:
                x0, e, cost, damping = trial, then, float(then @ then), max(damping / 10.0, 1e-12)
                break
            damping *= 10.0
        if before - cost <= 1e-10 * before:
            break
    return x0, cost if np.isfinite(cost) else np.inf
