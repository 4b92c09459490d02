"""The first samples of a recursion that begins with nothing: stored, fitted off-line, counted once.

Gradients of a recursion are exact only near the truth: what it learns far from it stays in its estimate. So the first
estimate is an off-line fit of a window; while the window grows, the recursion follows, and at every doubling the
whole window is fitted anew from where the recursion stands. When the window is dropped, coefficients, covariance and
filters are those of the off-line fit of all samples so far, and near enough to the truth for one pass to do.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.polynomial.orders import shown_orders
from ambid.blackbox.structures import structure
from ambid.errors import EstimationError
from ambid.recursive.polynomial.start import Identity

_MOST = 20  # evaluations of a fit that begins near its end


class Window:
    """Samples without a gap, and the counts at which they are fitted.

    `first`, `last`: samples at the first and at most at the last fit.

    `u`: (last, n_inputs), (last,); `y`: (last, n_inputs), (last,); `filled`: samples stored; samples at the next fit;
    `target`: samples stored; samples at the next fit.
    """

    def __init__(self, *, first: int, last: int, n_inputs: int) -> None:
        self.u, self.y = np.zeros((last, n_inputs)), np.zeros(last)
        self.first, self.filled, self.target = first, 0, first

    def copy(self) -> Window:
        """Return an independent window with the same samples."""
        twin = Window(first=self.first, last=self.y.size, n_inputs=self.u.shape[1])
        twin.u[:], twin.y[:], twin.filled, twin.target = self.u, self.y, self.filled, self.target
        return twin

    def take(self, u: Array, y: Array) -> tuple[int, bool]:
        """Take samples until the next fit, or up to and without one that is not finite.

        `u`: (n_samples, n_inputs); `y`: (n_samples,). Returns samples taken, and whether the next one is not finite.
        """
        n = min(y.size, self.target - self.filled)
        bad = np.flatnonzero(~(np.isfinite(y[:n]) & np.all(np.isfinite(u[:n]), axis=1)))
        gap = bad.size > 0
        n = int(bad[0]) if gap else n
        at = slice(self.filled, self.filled + n)
        self.u[at], self.y[at] = u[:n], y[:n]
        self.filled += n
        return n, gap

    def clear(self) -> int:
        """Begin anew; return how many samples were stored."""
        n, self.filled, self.target = self.filled, 0, self.first
        return n

    def grow(self) -> bool:
        """Move the next fit to twice as many samples.

        Returns false where the window cannot grow: it is at its largest.
        """
        at_end = self.target >= self.y.size
        self.target = min(2 * self.target, self.y.size)
        return not at_end

    def drop_half(self) -> int:
        """Make room for as many samples as half of those stored.

        Returns how many were dropped.
        """
        n = (self.filled + 1) // 2
        keep = self.filled - n
        self.u[:keep], self.y[:keep] = self.u[n : self.filled].copy(), self.y[n : self.filled].copy()
        self.filled = keep
        return n

    def fit(self, who: Identity, near: Array | None, *, stalled: bool) -> BlackBoxFit | None:
        """Return the off-line fit of the window.

        `near`: (n_theta,), or None, coefficients to begin with; None: the search finds its own start. Returns none
        where the window does not hold what it needs, or the search did not converge and more samples may help.
        """
        try:
            data = IOData(
                u=self.u[: self.filled],
                y=self.y[: self.filled, None],
                dt=who.dt,
                inputs=who.inputs,
                outputs=who.outputs,
                units=who.units,
                open_loop=True,  # whether it is, is no question of the coefficients
            )
            if near is None:
                found = structure(who.structure).estimator(data, shown_orders(who.structure, who.layout))
            else:
                found = _fit_near(who, data, near)
        except EstimationError:
            return None
        last_resort = stalled and self.filled == self.y.size
        usable = found.status == "converged" or last_resort
        return found if usable and float(found.noise_covariance[0, 0]) > 0.0 else None


def _fit_near(who: Identity, data: IOData, near: Array) -> BlackBoxFit:
    from ambid.blackbox.polynomial.predictor import predictor
    from ambid.blackbox.polynomial.result import result
    from ambid.blackbox.polynomial.scaled import scaled_data, unit
    from ambid.blackbox.polynomial.search import searched

    scaled = scaled_data(who.structure, data)
    worth = unit(who.layout, scaled, 0)
    found = searched(predictor(who.layout), scaled.y[0], scaled.u, near / worth, most=_MOST)
    return result(who.structure, data, scaled, [who.layout], [found], estimated_delay=False)
