"""Prediction errors of an LPV model over several records, what was before each of them eliminated.

Innovations are linear in what was before a record (states of the output form, first innovations), so that for each
theta these numbers are solved for, and their columns projected out (Golub and Pereyra 1973; Jacobian as in Kaufman
1975).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.estimation.linear import triangle_of
from ambid.nonlinear.lpv.shape import LpvShape, Part, errors, sound


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LpvProblem:
    """What is searched in (a `estimation.search.Problem`)."""

    shape: LpvShape
    parts: tuple[Part, ...]  # by record
    first: int  # errors count from this sample on
    weight: float = 1.0  # one over the standard deviation of the errors

    @property
    def n_errors(self) -> int:
        """Samples that count."""
        return sum(max(p.y.size - self.first, 0) for p in self.parts)

    @property
    def freedom(self) -> float:
        """Samples less estimated numbers, those of the starts included; at least 1."""
        return max(float(self.n_errors - self.shape.n_theta - len(self.parts) * self.shape.n_start), 1.0)

    def cost(self, theta: Array) -> float:
        """Return the sum of squared weighted innovations.

        `theta`: (n_theta,). Returns infinite where the predictor is unstable.
        """
        total = 0.0
        if not sound(self.shape, theta):
            return np.inf
        for part in self.parts:
            e = self._solved(part, theta)[1]
            if e is None:
                return np.inf
            total += float(e @ e)
        return total * self.weight**2

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | e], weighted, without what the starts explain.

        `theta`: (n_theta,). Returns (n_theta + 1, n_theta + 1), naN where the predictor diverges.
        """
        P, k, rows = self.shape.n_theta, self.shape.n_start, list[Array]()
        for part in self.parts:
            start, e = self._solved(part, theta)
            found = None if e is None else errors(self.shape, part, theta, start, slopes=2)
            if found is None or not found.finite:
                return np.full((P + 1, P + 1), np.nan)
            J = found.J[self.first :]
            R = triangle_of([np.column_stack([J[:, P:], J[:, :P], found.e[self.first :]])])
            rows.append(np.asarray(np.linalg.qr(R, mode="r"))[k:, k:])
        return triangle_of(rows) * self.weight

    def _solved(self, part: Part, theta: Array) -> tuple[Array, Array | None]:
        """Start that explains most, and the innovations with it."""
        k, P = self.shape.n_start, self.shape.n_theta
        found = errors(self.shape, part, theta, slopes=1 if k else 0)
        if not found.finite:
            return np.zeros(k), None
        e = found.e[self.first :]
        if not k:
            return np.zeros(0), e
        J = found.J[self.first :, P:]
        if not np.all(np.isfinite(J)):
            return np.zeros(k), None
        R = triangle_of([np.column_stack([J, e])])
        start = np.asarray(np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=1e-9)[0], dtype=np.float64)
        return start, e - J @ start
