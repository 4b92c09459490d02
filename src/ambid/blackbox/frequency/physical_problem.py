"""What is searched when physical parameters are fitted to a frequency response: residual, priors, exact slope."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.frequency.lines import Lines
from ambid.blackbox.frequency.physical import Channels, response
from ambid.physics.linear_model import LinearModel
from ambid.physics.parameters import Parameter

_FAR = 1e100  # standard deviations: worse than anything


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhysicalProblem:
    """What is estimated, and how a vector of order one means it: logarithms of what is positive, the rest over
    sizes.
    """

    model: LinearModel
    lines: Lines
    channels: Channels
    estimated: tuple[Parameter, ...]
    known: Mapping[str, float]  # the others, SI
    # (n_estimated,), SI
    size: Array  # SI
    positive: NDArray[np.bool_]  # (n_estimated,), bool, what is searched as a logarithm
    # the lower whole one where `fractional` and the input is held
    delay: float  # samples, or the lower whole one of a fraction that is estimated
    fractional: bool = False  # whether the delay is estimated as a real number, last in the vector

    def theta(self, v: Array) -> dict[str, float]:
        """Return all physical parameters in SI.

        `v`: (n_vector,).
        """
        x = v[: self.size.size]
        values = self.size * np.where(self.positive, np.exp(np.clip(np.where(self.positive, x, 0.0), -50.0, 50.0)), x)
        return {**self.known, **{p.name: float(x) for p, x in zip(self.estimated, values, strict=True)}}

    def delay_at(self, v: Array) -> float:
        """Return the delay in samples.

        `v`: (n_vector,).
        """
        if not self.fractional:
            return self.delay
        return self.delay + (float(1 / (1 + np.exp(-v[-1]))) if self.lines.held else float(v[-1]))

    def vector(self, values: Mapping[str, float]) -> Array:
        """Return the vector for given parameters, without a delay.

        `values`: SI. Returns (n_estimated,).
        """
        x = np.array([values[p.name] for p in self.estimated]) / self.size
        return np.where(self.positive, np.log(np.maximum(x, 1e-300)), x)

    def residual(self, v: Array) -> Array:
        """Return whitened model - measured, then the priors'.

        `v`: (n_vector,). Returns (n_rows,).
        """
        n_rows = 2 * self.lines.n_lines * self.lines.entries
        try:
            with np.errstate(all="ignore"):  # a step too far overflows: the search turns back from what is not finite
                G, _ = response(self.model, self.theta(v), (), self.lines, self.channels, self.delay_at(v), slope=False)
                rows = self.lines.whitened(G - self.lines.G)
        except (np.linalg.LinAlgError, ValueError):
            rows = np.full(n_rows, _FAR)
        return np.concatenate([np.where(np.isfinite(rows), rows, _FAR), self._prior(v)])

    def slope(self, v: Array, *, by_parameters: bool = False) -> Array:
        """Return the derivative of `residual`.

        `v`: (n_vector,); `by_parameters`: by parameters in SI and the delay in samples instead of the vector. Returns
        (n_rows, n_vector).
        """
        theta, names = self.theta(v), [p.name for p in self.estimated]
        _, d = response(self.model, theta, names, self.lines, self.channels, self.delay_at(v), moving=self.fractional)
        J = self.lines.whitened(d)
        rows = np.zeros((sum(p.role == "prior" for p in self.estimated), J.shape[1]))
        for row, (j, p) in zip(rows, ((j, p) for j, p in enumerate(self.estimated) if p.role == "prior"), strict=True):
            row[j] = 1.0 / float(p.sd or np.inf)
        J = np.vstack([J, rows])
        if not by_parameters:
            n = self.size.size
            J[:, :n] *= np.where(self.positive, [theta[k] for k in names], self.size)
            if self.fractional and self.lines.held:
                part = self.delay_at(v) - self.delay
                J[:, n] *= part * (1 - part)
        return J

    def _prior(self, v: Array) -> Array:
        theta = self.theta(v)
        return np.array([(theta[p.name] - float(p.value or 0.0)) / float(p.sd or np.inf)
                         for p in self.estimated if p.role == "prior"])  # fmt: skip
