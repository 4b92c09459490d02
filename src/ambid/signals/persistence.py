"""Persistent excitation: how many parameters a signal can tell apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError


@dataclass(frozen=True, slots=True, kw_only=True)
class PersistentExcitation:
    """Persistent excitation of a signal.

    Attributes
    ----------
    order : int
        Largest order, up to `asked`, at which the signal is persistently exciting; 0 for a constant signal.
    asked : int
        Order looked at.
    smallest, largest : float
        Singular values of the Hankel matrix of order `asked`, of the signal scaled to mean 0 and rms 1 and divided by
        the square root of the number of rows: both are 1 for white noise.
    """

    order: int
    asked: int
    smallest: float
    largest: float

    @property
    def condition(self) -> float:
        """Ratio of the largest to the smallest singular value; inf if the smallest is 0."""
        return self.largest / self.smallest if self.smallest > 0 else float("inf")

    def __str__(self) -> str:
        least = "at least " if self.order == self.asked else ""
        values = f"singular values {self.smallest:.3g} to {self.largest:.3g}"
        return f"persistently exciting of order {least}{self.order} ({values})"


def persistent_excitation(u: Array, order: int, *, tolerance: float = 1e-9) -> PersistentExcitation:
    """Measure the order of persistent excitation of a signal.

    A signal is persistently exciting of order n if the Hankel matrix of its samples with n columns has full column rank
    (Ljung 1999, def. 13.2). The mean is removed, because an identification that estimates an offset has no use of it:
    a sum of k sines has order 2k.

    Parameters
    ----------
    u : ndarray, shape (n_samples,), any unit
        Signal.
    order : int
        Largest order to look at, at least 1; the record needs twice as many samples.
    tolerance : float
        Ratio of smallest to largest singular value under which the rank counts as lost. The default is for round-off; a
        noise level in parts of the signal's rms tells what can be seen above that noise.

    Returns
    -------
    PersistentExcitation
        The order and the singular values.

    Raises
    ------
    EstimationError
        If the order does not fit the record or a sample is not finite.
    """
    from scipy.linalg import hankel

    u = np.asarray(u, dtype=np.float64)
    if order < 1 or u.ndim != 1 or u.size < 2 * order:
        raise EstimationError(
            f"persistent excitation of order {order} from samples of shape {u.shape}; the order must be at least 1 and "
            "the samples (n_samples,) at least twice as many. Use a lower order or a longer record"
        )
    if not np.isfinite(u).all():
        raise EstimationError("persistent excitation of a signal that is not finite everywhere. Repair or cut it first")
    centred = u - u.mean()
    rms = float(np.sqrt(np.mean(centred**2)))
    if rms <= 1e-14 * float(np.max(np.abs(u), initial=0.0)):
        return PersistentExcitation(order=0, asked=order, smallest=0.0, largest=0.0)
    rows = u.size - order + 1
    matrix = hankel(centred[:rows], centred[rows - 1 :]) / (rms * np.sqrt(rows))
    # Each column has its own mean over its own samples: only their removal takes the constant out exactly.
    matrix -= matrix.mean(axis=0)
    # The leading n columns of the triangle are those of the Hankel matrix of order n: one QR serves all orders.
    triangle: Array = np.asarray(np.linalg.qr(matrix, mode="r"))
    values = np.linalg.svd(triangle, compute_uv=False)
    return PersistentExcitation(
        order=_full_rank(triangle, order, tolerance), asked=order, smallest=float(values[-1]), largest=float(values[0])
    )


def _full_rank(triangle: Array, order: int, tolerance: float) -> int:
    """Largest n whose leading n columns have full rank, by bisection: a lost rank does not come back."""

    def full(n: int) -> bool:
        values = np.linalg.svd(triangle[:n, :n], compute_uv=False)
        return bool(values[-1] > tolerance * values[0])

    low, high = 1, order
    if full(order):
        return order
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if full(middle) else (low, middle)
    return low
