"""A controller as a discrete-time state-space law, for what a PID cannot say: notches, observers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import ModelError

_RATE = 1e-6  # of the rate: how far that of a loop may be from that of its law


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateLaw:
    """Linear law from what is fed back to the commands of all axes, in SI:

        w[k] = C z[k] + D y[k],  u[k] = limited(u0 + w[k] + excitation[k]),
        z[k+1] = A z[k] + B y[k] + G (u[k] - u0 - w[k] - excitation[k])

    y: position less set point, then current less that at rest, axis by axis, as far as measured
    (`ambid.simulation.plant.signals_fed_back`). G acts where a command is limited (anti-windup); u follows w in sign.
    """

    A: Array  # (n, n)
    B: Array  # (n, n_y)
    C: Array  # (n_u, n)
    D: Array  # (n_u, n_y)
    rate_hz: float  # of the samples
    G: Array | None = None  # (n, n_u); zeros by default

    def __post_init__(self) -> None:
        rows = {name: _matrix(name, getattr(self, name)) for name in ("B", "D")}
        n, (n_u, n_y) = rows["B"].shape[0], rows["D"].shape
        if not rows["D"].size:
            raise ModelError("loop.D is empty; it has a row for each command, a column for each signal. Give them")
        shapes = {"A": (n, n), "B": (n, n_y), "C": (n_u, n), "D": (n_u, n_y), "G": (n, n_u)}
        for name, shape in shapes.items():
            matrix = getattr(self, name)
            x = np.zeros(shape) if matrix is None else _matrix(name, matrix)
            if x.size == 0 and 0 in shape:
                x = x.reshape(shape)
            if x.shape != shape:
                raise ModelError(
                    f"loop.{name} has shape {x.shape}; with {n} states, {n_y} signals fed back and {n_u} commands it "
                    f"must be {shape}. Correct the matrices"
                )
            if not np.isfinite(x).all():
                raise ModelError(f"loop.{name} is not finite everywhere. Correct the matrix")
            object.__setattr__(self, name, x)
        if not (math.isfinite(self.rate_hz) and self.rate_hz > 0.0):
            raise ModelError(f"loop.rate_hz is {self.rate_hz}; it must be a positive number. Correct it")

    @property
    def windup(self) -> Array:
        """G, (n, n_u)."""
        assert self.G is not None
        return self.G

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    def response(self, frequency_hz: Array) -> Complex:
        """Return W(z) = C (z I - A)⁻¹ B + D, from y to w, (n_frequencies, n_u, n_y)."""
        z = np.exp(2j * np.pi * frequency_hz / self.rate_hz)[:, None, None]
        return np.asarray(self.C @ np.linalg.solve(z * np.eye(self.order) - self.A, self.B[None] + 0j) + self.D)

    def scaled(self, gains: Sequence[float]) -> StateLaw:
        """Return the law that sees its signals multiplied by `gains`, (n_y,)."""
        return replace(self, B=self.B * np.asarray(gains), D=self.D * np.asarray(gains))

    def in_units(self, inputs: Sequence[float], output: float) -> StateLaw:
        """Return the law whose signals are first multiplied by `inputs`, (n_y,), and its commands last by `output`."""
        scaled = self.scaled(inputs)
        return replace(scaled, C=self.C * output, D=scaled.D * output, G=self.windup / output)

    def check(self, n_inputs: int, n_fed_back: int, rate_hz: float) -> None:
        """Refuse a plant or a rate that the law is not for."""
        if self.D.shape != (n_inputs, n_fed_back):
            raise ModelError(
                f"the law of [loop] gives {self.D.shape[0]} commands from {self.D.shape[1]} signals; the plant has "
                f"{n_inputs} inputs and feeds {n_fed_back} signals back. Give the law of this plant"
            )
        if abs(rate_hz - self.rate_hz) > _RATE * self.rate_hz:
            raise ModelError(
                f"the law of [loop] is for {self.rate_hz:g} Hz, not for {rate_hz:g} Hz: its matrices hold over one "
                "sample. Take its rate, or design it again"
            )


_STEPS = 256  # that are summed at once
_BLOCKS = 2000  # of them at most
_TAIL = 1e-4  # of an l1 norm that is not summed


def l1_norms(A: Array, B: Array, C: Array | None = None) -> Array:
    """Return the sums over all samples of |C A^k B|, (n_outputs, n_inputs); infinite where A is not stable. What is not
    summed is taken to decay as the slowest pole does: a bound, however small that pole's part is.
    """
    C = np.eye(A.shape[0]) if C is None else C
    total = np.zeros((C.shape[0], B.shape[1]))
    slowest = float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))
    if slowest >= 1.0:
        return np.full(total.shape, math.inf)
    powers = [np.eye(A.shape[0])]
    for _ in range(_STEPS):
        powers.append(A @ powers[-1])
    stack, ratio = C @ np.stack(powers[:-1]), slowest**_STEPS
    for _ in range(_BLOCKS):
        part = np.abs(stack @ B).sum(axis=0)
        total, B = total + part, powers[-1] @ B
        tail = part * (ratio / (1.0 - ratio))
        if np.all(tail <= _TAIL * total):
            break
    return np.asarray(total + tail)


def _matrix(name: str, entries: object) -> Array:
    try:
        x = np.array(entries, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError(f"loop.{name} is no matrix of numbers; give its rows, all of one length") from None
    if x.ndim != 2 and x.size:
        raise ModelError(f"loop.{name} has {x.ndim} dimensions; it must be a matrix, a list of rows. Correct it")
    return np.ascontiguousarray(x if x.ndim == 2 else x.reshape(0, 0))


def beside(laws: Sequence[StateLaw]) -> StateLaw:
    """Return several laws as one, each with its own signals and commands."""
    from scipy.linalg import block_diag

    for a, b in pairwise(laws):
        b.check(b.D.shape[0], b.D.shape[1], a.rate_hz)
    parts = {name: block_diag(*(getattr(law, name) for law in laws)) for name in ("A", "B", "C", "D", "G")}
    return StateLaw(**parts, rate_hz=laws[0].rate_hz)
