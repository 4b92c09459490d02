"""Polynomial and rational NARMAX models, y(t) = b(y, u, e) / a(y, u, e) + e(t) (thesis eqs 3.1-3.4).

Coefficients belong to deviations of the signals from fixed levels (zero unless the data stand far from it), in SI.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.nonlinear.narmax.recursion import Tables, predicted, sensitivities, tables
from ambid.nonlinear.narmax.terms import Term, term_from_json, term_name, term_to_json
from ambid.nonlinear.signals import scaled, with_head

OUTPUTS = ("signed", "magnitude", "mean magnitude")


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloud:
    """Where the training samples lie: mean of the lagged signals and the matrix that makes their scatter round."""

    mean: Array  # (n_factors,), scaled
    # (n_factors, n_factors), such that \|whitening (x - mean)\| is 1 for the farthest training sample (Mahalanobis
    # distance)
    whitening: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class PolynomialNarmax:
    """A NARMAX model with constant coefficients (implements `ambid.nonlinear.model.NonlinearModel`).

    The predictor takes the innovations before its first prediction as zero.
    """

    dt: float  # s
    n_inputs: int
    # by output; 1 is added to the denominators, which are empty for a polynomial model
    numerators: tuple[tuple[Term, ...], ...]
    denominators: tuple[tuple[Term, ...], ...]
    theta: Array  # (n_theta,), SI, coefficients, output by output, numerator before denominator
    u_level: Array  # (n_inputs,), SI, what deviations are taken from, and the typical size of them
    u_scale: Array
    y_level: Array  # (n_outputs,), SI
    y_scale: Array
    cloud: Cloud  # of the lagged inputs and outputs in training
    # whether the outputs are those of the equation, their magnitudes, or the mean of the magnitudes now and one sample
    # ago, as a counter gives it. Past outputs get the sign that was predicted for them, the first ones that to which
    # the linear part is driven by the first inputs; a one-step prediction takes the measured mean for the magnitude
    # itself.
    output: str = "signed"

    @property
    def kind(self) -> str:
        """Under which files know it."""
        return "narmax"

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.numerators)

    @cached_property
    def tables(self) -> Tables:
        """The terms as the compiled recursions want them."""
        return tables(self.numerators, self.denominators, self.n_inputs, folded=OUTPUTS.index(self.output))

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return self.tables.lag

    @property
    def names(self) -> tuple[str, ...]:
        """Of the coefficients: their terms; denominators in the form ``1/(...)``."""
        n_y, n_u, out = self.n_outputs, self.n_inputs, []
        for o in range(n_y):
            before = f"y{o + 1}: " if n_y > 1 else ""
            out += [before + term_name(x, n_y, n_u) for x in self.numerators[o]]
            out += [f"{before}1/({term_name(x, n_y, n_u)})" for x in self.denominators[o]]
        return tuple(out)

    @cached_property
    def unit(self) -> Array:
        """What a scaled coefficient of 1 is in SI, shape (n_theta,)."""
        size = {"y": self.y_scale, "u": self.u_scale, "e": self.y_scale}
        out = []
        for o in range(self.n_outputs):
            for of, own in ((self.numerators[o], self.y_scale[o]), (self.denominators[o], 1.0)):
                out += [own / np.prod([size[f.kind][f.channel] for f in x]) for x in of]
        return np.array(out, dtype=np.float64)

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other coefficients.

        `theta`: (n_theta,), SI.
        """
        return replace(self, theta=theta)

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`; past innovations are its own. NaN from where they diverge on."""
        ys, us = scaled(self, u, y)
        found, _ = predicted(self.tables, self.theta / self.unit, ys, us)
        return self.y_level + self.y_scale * found

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`, past innovations included."""
        ys, us = scaled(self, u, y)
        theta = self.theta / self.unit
        _, z = predicted(self.tables, theta, ys, us)
        return sensitivities(self.tables, theta, z) * (self.y_scale[:, None] / self.unit)

    def simulate(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.simulate`, innovations zero."""
        whole, head = with_head(self, u, y)
        ys, us = scaled(self, u, whole)
        found, _ = predicted(self.tables, self.theta / self.unit, ys, us, free=True)
        out: Array = self.y_level + self.y_scale * found
        out[:head] = whole[:head]
        return out

    def novelty(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.novelty`: Mahalanobis distance of the lagged signals."""
        ys, us = scaled(self, u, y)
        _, z = predicted(self.tables, self.theta / self.unit, ys, us)
        x = lagged_signals(self.tables, z)
        out = np.full(ys.shape[0], np.nan)
        out[self.lag :] = np.linalg.norm((x - self.cloud.mean) @ self.cloud.whitening.T, axis=1)
        return out

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        arrays: dict[str, Any] = {
            k: getattr(self, k).tolist() for k in ("theta", "u_level", "u_scale", "y_level", "y_scale")
        }
        return {
            "dt_s": self.dt,
            "n_inputs": self.n_inputs,
            "output": self.output,
            "numerators": [[term_to_json(x) for x in terms] for terms in self.numerators],
            "denominators": [[term_to_json(x) for x in terms] for terms in self.denominators],
            **arrays,
            "cloud": {"mean": self.cloud.mean.tolist(), "whitening": self.cloud.whitening.tolist()},
        }

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back.

        `found`: that `as_json` made.
        """
        try:
            return cls(**_read(found))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise EstimationError(f"no NARMAX model ({type(error).__name__}: {error}). Write the file again") from error


def _read(found: dict[str, Any]) -> dict[str, Any]:
    """What the model is made with, checked."""
    num, den = (
        tuple(tuple(term_from_json(x) for x in terms) for terms in found[k]) for k in ("numerators", "denominators")
    )
    n_u, n_y = int(found["n_inputs"]), len(num)
    used = tables(num, den, n_u)
    n_seen = int(np.count_nonzero(used.column < n_y + n_u))
    sizes = {"theta": (used.place.shape[0],), "u_level": (n_u,), "u_scale": (n_u,), "y_level": (n_y,)}
    arrays: dict[str, Any] = {k: _numbers(found[k], shape, k) for k, shape in {**sizes, "y_scale": (n_y,)}.items()}
    cloud = Cloud(
        mean=_numbers(found["cloud"]["mean"], (n_seen,), "cloud"),
        whitening=_numbers(found["cloud"]["whitening"], (n_seen, n_seen), "cloud"),
    )
    if len(den) != n_y or np.any(used.column >= 2 * n_y + n_u):
        raise ValueError("terms name channels that the model does not have")
    if found["output"] not in OUTPUTS:
        raise ValueError(f"output is none of {', '.join(OUTPUTS)}")
    dt = float(found["dt_s"])
    return {
        "dt": dt,
        "n_inputs": n_u,
        "numerators": num,
        "denominators": den,
        "cloud": cloud,
        "output": found["output"],
        **arrays,
    }


def lagged_signals(t: Tables, z: Array) -> Array:
    """Return the lagged inputs and outputs that a model looks at, from sample `lag` on.

    `z`: (n_samples, 2 n_outputs + n_inputs), scaled, the signals that `recursion.predicted` returns. Returns (n_samples
    - lag, n_factors), innovations are left out.
    """
    n = z.shape[0]
    seen = [k for k in range(t.column.size) if t.column[k] < t.n_outputs + t.n_inputs]
    if n <= t.lag or not seen:
        return np.empty((max(n - t.lag, 0), len(seen)))
    return np.stack([z[t.lag - t.back[k] : n - t.back[k], t.column[k]] for k in seen], axis=1)


def cloud_of(parts: list[Array]) -> Cloud:
    """Return where the training samples lie.

    `parts`: (n_rows, n_factors), `lagged_signals` of each record. Returns directions in which nothing moved count as
    very narrow.
    """
    x = np.concatenate(parts)
    mean = x.mean(axis=0) if x.size else np.zeros(x.shape[1])
    if not x.size:
        return Cloud(mean=mean, whitening=np.zeros((x.shape[1],) * 2))
    _, s, Vt = np.linalg.svd(x - mean, full_matrices=False)
    if s.size < x.shape[1] or not s[0] > 0:
        return Cloud(mean=mean, whitening=np.zeros((x.shape[1],) * 2))
    narrow = np.maximum(s, 1e-6 * s[0])
    W = Vt / (narrow / np.sqrt(x.shape[0]))[:, None]
    far = float(np.max(np.linalg.norm((x - mean) @ W.T, axis=1)))
    return Cloud(mean=mean, whitening=W / far if far > 0 else W)


def _numbers(value: Any, shape: tuple[int, ...], what: str) -> Array:
    out = np.array(value, dtype=np.float64).reshape(shape)
    if not np.all(np.isfinite(out)):
        raise ValueError(f"{what} is not finite")
    return out
