"""A state-space network with its scaling and its training cloud (implements `NonlinearModel`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.nonlinear.cloud import Cloud
from ambid.nonlinear.networks.layout import Layout, Matrices
from ambid.nonlinear.networks.segments import Shot, run, slopes
from ambid.nonlinear.signals import finite, scaled, with_head


@dataclass(frozen=True, kw_only=True, eq=False)
class StateNetwork:
    """A network x+ = A x + B u + c + K e + G(x, u), y = x[heads] + e, of which A and B are weights (thesis eq. 5.1).

    The state at the beginning is that which fits the first `lag` samples best, without G and K. Implements
    `ambid.nonlinear.model.NonlinearModel`.
    """

    layout: Layout  # which weights are free, and what they are in matrices
    theta: Array  # (n_theta,), weights; entries of A and B in SI, gains and hidden layer for scaled signals
    u_level: Array  # (n_inputs,), SI, what deviations are taken from, and their size
    u_scale: Array
    y_level: Array  # (n_outputs,), SI
    y_scale: Array
    cloud: Cloud  # of states and inputs in training, scaled
    delay: int = 0  # samples by which inputs act late
    kind: str = "nn"  # ``nn``

    @property
    def dt(self) -> float:
        """Sampling interval in s."""
        return self.layout.dt

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return self.layout.n_inputs

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return self.layout.p

    @property
    def lag(self) -> int:
        """Samples from which the first state is found."""
        return self.delay + self._head

    @property
    def _head(self) -> int:
        """Samples that the first state is fitted to."""
        return max(3 * self.layout.n, 5)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the weights."""
        return self.layout.names

    @property
    def A(self) -> Array:
        """Weights of the states, shape (n, n), SI; continuous in the form ``one-axis``, else of a sample."""
        size = np.array(self.layout.scale)[: self.layout.n]
        found: Array = self._weights[:, : self.layout.n] * size[:, None] / size
        return found

    @property
    def B(self) -> Array:
        """Weights of the inputs, shape (n, n_inputs), SI; continuous in the form ``one-axis``, else of a sample."""
        n, size = self.layout.n, np.array(self.layout.scale)
        found: Array = self._weights[:, n:-1] * size[:n, None] / size[n:]
        return found

    @property
    def _weights(self) -> Array:
        return self.layout.weights(self.theta / self.layout.unit)

    @property
    def _matrices(self) -> Matrices:
        return self.layout.matrices(self.theta / self.layout.unit)

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other weights.

        `theta`: (n_theta,).
        """
        return replace(self, theta=theta)

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`; NaN from where the predictor diverges on."""
        X = self.states(u, y)
        out: Array = self.y_level + self.y_scale * X[:, self.layout.head_table]
        out[: self.lag] = np.nan
        return out

    def states(self, u: Array, y: Array) -> Array:
        """Return the predicted states, scaled.

        `u`: (n_samples, n_inputs), SI; `y`: (n_samples, n_outputs), SI. Returns (n_samples, n), the first `delay` rows
        are NaN, and all from where the predictor diverges on.
        """
        shot, m = self._shot(u, y), self._matrices
        x0, _ = self._first_state(shot, m, derive=False)
        out = np.full((np.asarray(u).shape[0], self.layout.n), np.nan)
        out[self.delay :] = run(self.layout, m, shot, x0)[0][:-1]
        return out

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`, that of the first state included."""
        shot, m = self._shot(u, y), self._matrices
        x0, s = self._first_state(shot, m, derive=True)
        X, E = run(self.layout, m, shot, x0)
        out = np.zeros((np.asarray(u).shape[0], self.n_outputs, self.theta.size))
        out[self.delay :] = slopes(self.layout, m, shot, X, E, s) * (self.y_scale[:, None] / self.layout.unit)
        out[: self.lag] = 0.0
        return out

    def simulate(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.simulate`, from the state that these samples show."""
        whole, head = with_head(self, u, y)
        shot, m = self._shot(u, whole), self._matrices
        x0, _ = self._first_state(shot, m, derive=False)
        k = min(self._head, shot.u.shape[0])
        x = run(self.layout, m, Shot(y=shot.y[:k], u=shot.u[:k], goes_on=False), x0)[0][-1]
        rest = Shot(y=shot.y[k:], u=shot.u[k:], goes_on=True)
        free = replace_gain(m)
        whole[head:] = self.y_level + self.y_scale * run(self.layout, free, rest, x)[0][:-1, self.layout.head_table]
        return whole

    def novelty(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.novelty`, of predicted states and inputs (see `nonlinear.cloud`)."""
        out = np.full(np.asarray(u).shape[0], np.nan)
        out[self.lag :] = self.cloud.novelty(self.regressors(u, y))
        return out

    def regressors(self, u: Array, y: Array) -> Array:
        """Return state and input one sample before each prediction, scaled.

        `u`: (n_samples, n_inputs), SI; `y`: (n_samples, n_outputs), SI. Returns (n_samples - lag, n + n_inputs).
        """
        X, k = self.states(u, y), self.lag
        us = (np.asarray(u, dtype=np.float64) - self.u_level) / self.u_scale
        return np.hstack([X[k - 1 : -1], us[k - 1 - self.delay : us.shape[0] - 1 - self.delay]])

    def _shot(self, u: Array, y: Array) -> Shot:
        """Outputs from `delay` on, each with the input that acts at its time."""
        ys, us = scaled(self, u, y)
        us = us[: max(us.shape[0] - self.delay, 0)]
        return Shot(
            y=np.ascontiguousarray(ys[self.delay :]), u=np.hstack([us, np.ones((us.shape[0], 1))]), goes_on=False
        )  # fmt: skip

    def _first_state(self, shot: Shot, m: Matrices, *, derive: bool) -> tuple[Array, Array]:
        """Least squares over the first `lag` samples, O x0 = y - (forced response); its slopes by the weights.

        With r what is left: dx0 = (O'O)^-1 (dO' r - O' d(O x0 + forced)).
        """
        layout, n, P = self.layout, self.layout.n, self.layout.n_theta
        linear = replace_gain(m, hidden=False)
        head = Shot(y=shot.y[: self._head], u=shot.u[: self._head], goes_on=False)
        still = Shot(y=np.zeros_like(head.y), u=np.zeros_like(head.u), goes_on=False)
        heads = layout.head_table
        runs = [run(layout, linear, still, e) for e in np.eye(n)]
        forced = run(layout, linear, head, np.zeros(n))[0][:-1, heads].ravel()
        O = np.stack([X[:-1, heads].ravel() for X, _ in runs], axis=1)  # noqa: E741
        x0: Array = np.asarray(np.linalg.lstsq(O, head.y.ravel() - forced, rcond=None)[0], dtype=np.float64)
        if not derive:
            return x0, np.empty((n, 0))
        X, E = run(layout, linear, head, x0)
        D = slopes(layout, linear, head, X, E, np.zeros((n, P))).reshape(-1, P)
        left = head.y.ravel() - forced - O @ x0
        bent = np.stack([left @ slopes(layout, linear, still, X, E, np.zeros((n, P))).reshape(-1, P) for X, E in runs])
        bent_back: Array = np.ascontiguousarray(np.linalg.solve(O.T @ O, bent - O.T @ D), dtype=np.float64)
        return x0, bent_back

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        x = self.layout
        arrays = {k: getattr(self, k).tolist() for k in ("theta", "u_level", "u_scale", "y_level", "y_scale")}
        layout = {
            "form": x.form,
            "n_inputs": x.n_inputs,
            "heads": list(x.heads),
            "steps": list(x.steps),
            "entries": [list(e) for e in x.entries],
            "scale": list(x.scale),
            "rates": list(x.rates),
            "rows": list(x.rows),
            "gain": x.gain,
            "neurons": x.neurons,
            "anchored": x.anchored,
        }
        return {"dt_s": x.dt, "delay": self.delay, "layout": layout, **arrays, "cloud": self.cloud.as_json()}

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back.

        `found`: that `as_json` made.
        """
        try:
            given = found["layout"]
            layout = Layout(
                dt=float(found["dt_s"]),
                form=str(given["form"]),
                n_inputs=int(given["n_inputs"]),
                heads=tuple(int(k) for k in given["heads"]),
                steps=tuple(float(k) for k in given["steps"]),
                entries=tuple((int(r), int(c)) for r, c in given["entries"]),
                scale=tuple(float(k) for k in given["scale"]),
                rates=tuple(float(k) for k in given["rates"]),
                rows=tuple(int(k) for k in given["rows"]),
                gain=bool(given["gain"]),
                neurons=int(given["neurons"]),
                anchored=bool(given["anchored"]),
            )
            m, p = layout.n_inputs, layout.p
            places = [*layout.heads, *layout.rows, *(r for r, _ in layout.entries)]
            columns = [c for _, c in layout.entries]
            inside = min((*places, *columns)) >= 0 and max(places) < layout.n and max(columns) <= layout.n + m
            if layout.form not in ("one-axis", "free") or not inside:
                raise EstimationError("no state network: its states are not those of one. Write the file again")
            arrays: dict[str, Any] = {
                k: finite(found[k], n, k)
                for k, n in {"theta": layout.n_theta, "u_level": m, "u_scale": m, "y_level": p, "y_scale": p}.items()
            }
            cloud = Cloud.from_json(found["cloud"], layout.n + m)
            return cls(layout=layout, cloud=cloud, delay=int(found["delay"]), **arrays)
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise EstimationError(
                f"no state network ({type(error).__name__}: {error}). Write the file again"
            ) from error


def replace_gain(m: Matrices, *, hidden: bool = True) -> Matrices:
    """Return the matrices without gain, and without slopes by it.

    `hidden`: false to leave the hidden layer's output out as well.
    """
    bare = replace(m, K=np.zeros_like(m.K), dK=np.zeros_like(m.dK))
    return bare if hidden else replace(bare, G=np.zeros_like(m.G), dG=np.zeros_like(m.dG))
