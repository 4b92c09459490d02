"""Joint unscented Kalman filter of plant states, physical parameters and offsets, in square-root form.

Points of the scaled unscented transform go through the plant's own A(q) by the Taylor series of its matrix exponential
(no linearisation point), so that the mean and covariance keep their second-order terms (Julier and Uhlmann 2004; van
der Merwe and Wan 2001).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.joint.filter import EVERY, JointFilter
from ambid.recursive.joint.powers import powers_of
from ambid.recursive.joint.start import JointStart, start_from

if TYPE_CHECKING:
    from ambid.estimation.estimate import Estimate

_MOST_TERMS = 40
_REST = 1e-15  # of the Taylor series, relative


class JointUkf(JointFilter):
    """Joint unscented Kalman filter.

    Of the augmented state only the parameters enter nonlinearly, so that points are needed along their columns alone;
    along the others (states, offsets) the points of the full transform are known in closed form, and the result is that
    of all 2 n + 1 points. Measurements are linear and are taken in exactly. It converges from farther than `JointEkf`
    (5 % on a lightly damped resonance) at about a quarter of its speed; near the truth they agree to a hundredth of a
    standard deviation. What is said there of wrong noise levels holds here too: prefer `ambid.track.rpem`.

    Parameters
    ----------
    start : JointStart
    alpha : float
        Spread of the points: sqrt(n) alpha standard deviations, n the length of the augmented state. At 1 all weights
        are positive; well below, the covariance is downdated, and a downdate that leaves nothing positive is left out
        and counted.
    beta : float
        What is known of the distribution's kurtosis; 2 for a Gaussian one.

    Attributes
    ----------
    start : JointStart
    names : tuple of str
        Parameters, then offsets of the disturbances.

    Raises
    ------
    EstimationError
        If alpha is not positive, the model is no product of powers, or its sampling too slow for the series.
    """

    def __init__(self, start: JointStart, *, alpha: float = 1.0, beta: float = 2.0) -> None:
        from ambid.recursive.joint._kernels import ukf_block

        super().__init__(start)
        if not (np.isfinite(alpha) and alpha > 0 and np.isfinite(beta)):
            raise EstimationError(f"alpha {alpha} must be positive and beta {beta} a number. Correct them")
        self._kernel = ukf_block
        n, n_u, p = self._wide.size, self._past.shape[1], self._logs.size
        square = alpha**2 * self._z.size
        mean_0 = 1.0 - self._z.size / square
        self._scaled = np.array([square, mean_0, mean_0 + 1.0 - alpha**2 + beta, self._fraction])
        self._logs = self._logs.astype(np.int64)
        self._place, self._entry, self._first, self._factor = self._matrices()
        self._terms = self._series()
        width = max(self._z.size + n, 2 * n + p, n + 2 * self._dist.size + n_u + p + 1)
        self._work = np.zeros((7 + 6 * n, width))

    @classmethod
    def from_estimate(
        cls,
        estimate: Estimate,
        rate_hz: float,
        *,
        rates: Mapping[str, float] | None = None,
        offset_sd: Mapping[str, float] | None = None,
        sensor_sd: Mapping[str, float] | None = None,
        disturbance_sd: Mapping[str, float] | None = None,
        alpha: float = 1.0,
        beta: float = 2.0,
    ) -> Self:
        """Return a filter that starts from an off-line estimate.

        Parameters
        ----------
        estimate : Estimate
        rate_hz : float
        rates, offset_sd, sensor_sd, disturbance_sd : Mapping[str, float], optional
            As in `start_from`.
        alpha, beta : float

        Returns
        -------
        JointUkf

        Raises
        ------
        EstimationError
            As `start_from`.
        """
        start = start_from(
            estimate, rate_hz, rates=rates, offset_sd=offset_sd, sensor_sd=sensor_sd, disturbance_sd=disturbance_sd
        )
        return cls(start, alpha=alpha, beta=beta)

    @property
    def n_refused(self) -> int:
        """Downdates of the covariance that were left out because nothing positive would have been left."""
        return int(self._counts[7])

    def _matrices(self) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], NDArray[np.int64]]:
        """[A, B, E] T in scaled units as products of powers of the followed numbers; the others are taken in."""
        model, start = self.start.model, self.start
        found, names = powers_of(model), [p.name for p in model.parameters]
        columns = np.r_[self._state, np.ones(len(model.inputs)), self._disturbance]
        size = found.size * columns[found.place[:, 1]] / self._state[found.place[:, 0]] / start.rate_hz
        # a followed number stands in units of its start (a logarithm) or of its size
        unit = dict(zip(start.free, np.where(self._logs, self._values0, self._size), strict=True))
        kept, first = [], [0]
        for i in range(size.size):
            for j, power in found.factor[found.start[i] : found.start[i + 1]]:
                name = names[j]
                if name in unit:
                    size[i] *= unit[name] ** float(power)
                    kept.append((start.free.index(name), power))
                else:
                    size[i] *= start.values[name] ** float(power)
            first.append(len(kept))
        factor = np.array(kept, dtype=np.int64).reshape(-1, 2)
        return found.place, size, np.array(first, dtype=np.int64), factor

    def _series(self) -> int:
        """Terms of the Taylor series that leave nothing, with parameters twice as large as at the start."""
        n = self._wide.size
        A = np.zeros((n, n))
        for i, (row, column) in enumerate(self._place):
            if column < n:
                q = self._factor[self._first[i] : self._first[i + 1]]
                start = np.where(self._logs, 1.0, self._z[: self._logs.size])
                A[row, column] = self._entry[i] * np.prod(start[q[:, 0]] ** q[:, 1].astype(float))
        norm = 2.0 * float(np.abs(A).sum(axis=1).max())
        term = 1.0
        for order in range(1, _MOST_TERMS + 1):
            term *= norm / order
            if order > norm and term < _REST:
                return order
        raise EstimationError(
            f"at {self.start.rate_hz:g} Hz the plant moves too far in a sample (|A| T = {norm / 2:.3g}) for the "
            "unscented filter's series. Use JointEkf, or sample faster"
        )

    def _run(self, u: Array, y: Array, e: Array) -> None:
        self._kernel(
            u, y, e, self._z, self._T, self._logs, self._place, self._entry, self._first, self._factor, self._C,
            self._dist, self._walk, self._io, self._wide, self._past, self._counts, EVERY, self._terms, self._scaled,
            self._work,
        )  # fmt: skip
