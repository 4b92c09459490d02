"""The first window of a recursion that begins with nothing: stored, fitted off-line, used once.

Gradients of a recursion are exact only near the truth; what a one-pass start learns far from it stays in its estimate.
A search over a stored window starts inside the valley instead, and its cost is paid once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify.blackbox.data import IOData
from ambid.identify.blackbox.fit import BlackBoxFit
from ambid.identify.blackbox.structures import structure
from ambid.identify.polynomial.orders import shown_orders
from ambid.track.polynomial.start import Identity

Array = NDArray[np.float64]


class Window:
    """Samples without a gap, until there are enough of them.

    Attributes
    ----------
    u, y : ndarray, shape (size, n_inputs), (size,)
    filled : int

    Parameters
    ----------
    size : int
    n_inputs : int
    """

    def __init__(self, *, size: int, n_inputs: int) -> None:
        self.u, self.y = np.zeros((size, n_inputs)), np.zeros(size)
        self.filled = 0

    @property
    def full(self) -> bool:
        """Whether it can be fitted."""
        return self.filled == self.y.size

    def copy(self) -> Window:
        """Return an independent window with the same samples.

        Returns
        -------
        Window
        """
        twin = Window(size=self.y.size, n_inputs=self.u.shape[1])
        twin.u[:], twin.y[:], twin.filled = self.u, self.y, self.filled
        return twin

    def take(self, u: Array, y: Array) -> tuple[int, int, int]:
        """Take samples until the window is full; one that is not finite empties it.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs)
        y : ndarray, shape (n_samples,)

        Returns
        -------
        tuple of int
            Samples taken, of those rejected, and good ones that were stored and are lost with them.
        """
        n = min(y.size, self.y.size - self.filled)
        bad = np.flatnonzero(~(np.isfinite(y[:n]) & np.all(np.isfinite(u[:n]), axis=1)))
        if bad.size:
            lost = self.filled + int(bad[0])
            self.filled = 0
            return int(bad[0]) + 1, 1, lost
        at = slice(self.filled, self.filled + n)
        self.u[at], self.y[at] = u[:n], y[:n]
        self.filled += n
        return n, 0, 0

    def drop_half(self) -> int:
        """Make room for as many samples as half the window.

        Returns
        -------
        int
            How many were dropped.
        """
        n = (self.filled + 1) // 2
        keep = self.filled - n
        self.u[:keep], self.y[:keep] = self.u[n : self.filled].copy(), self.y[n : self.filled].copy()
        self.filled = keep
        return n

    def fit(self, who: Identity, *, open_loop: bool) -> BlackBoxFit | None:
        """Return the off-line fit of the window.

        Parameters
        ----------
        who : Identity
        open_loop : bool

        Returns
        -------
        BlackBoxFit or None
            None where the search did not converge, or the window does not hold what it needs.
        """
        try:
            data = IOData(
                u=self.u[: self.filled],
                y=self.y[: self.filled, None],
                dt=who.dt,
                inputs=who.inputs,
                outputs=who.outputs,
                units=who.units,
                open_loop=open_loop,
            )
            found = structure(who.structure).estimator(data, shown_orders(who.structure, who.layout))
        except EstimationError:
            return None
        usable = found.status == "converged" and float(found.noise_covariance[0, 0]) > 0.0
        return found if usable else None
