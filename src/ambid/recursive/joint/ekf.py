"""Joint extended Kalman filter of plant states, physical parameters and offsets.

z = [q, o, x] with x+ = A(q) x + B(q) u + E(q) (o + w), y = C x + v: the matrices are exact at a linearisation point and
first-order about it; the covariance is carried as a square root (Carlson and Bierman forms).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Self

import numpy as np

from ambid.arrays import Array
from ambid.estimation.innovations import gain_derivatives, predictor_gain
from ambid.physics.discretise import DiscreteSpace, discretise
from ambid.physics.linear_model import StateSpace
from ambid.recursive.joint.filter import EVERY, JointFilter
from ambid.recursive.joint.start import JointStart, start_from

if TYPE_CHECKING:
    from ambid.estimation.estimate import Estimate

_CURVED = 0.1  # of the squared relative error at the start: what linearising may leave
_AMOUNT = 2e-3  # relative movement of a parameter after which the matrices are renewed: what is left is its square


class JointEkf(JointFilter):
    """Joint extended Kalman filter.

    Consistent under feedback where the noise levels are right and the start lies where the plant is about linear in its
    parameters: an off-line estimate is such a start. It leaves out how its own gain depends on the parameters, and is
    therefore biased where the levels are wrong and the noise itself is what moves the plant (Ljung 1979): on the
    unstable bearing without excitation, a force level three times too low moves the mass by 12 % while 2 % are claimed;
    with excitation far above the noise a factor of ten does not move it. Where the start is wrong by more than the
    plant is linear (20 % on that bearing, 5 % on a lightly damped resonance), it settles beside the truth and claims a
    standard deviation that is far too small; `warnings` says so where it must be feared. `JointUkf` keeps the second
    order. The recursive prediction error method of `ambid.track.rpem`, whose noise is estimated off-line with the
    parameters and whose gain knows of them, is the one to prefer.

    Parameters
    ----------
    start : JointStart
    corrected : bool
        Add the dependence of the stationary gain on the parameters to the sensitivity of the state (Ljung 1979). The
        filter is then a recursive prediction error method with given noise levels: where these are right, standard
        deviations shrink by what the colour of the noise says (a few per cent, a fifth for the mass without
        excitation); where they are wrong the parameters make up for them: disturbances ten times too large move the
        mass by 21 % even with excitation. Hence only for levels that are known.

    Attributes
    ----------
    start : JointStart
    names : tuple of str
        Parameters, then offsets of the disturbances.
    n_renewed : int
        Times that the matrices were renewed at a new linearisation point.
    """

    def __init__(self, start: JointStart, *, corrected: bool = False) -> None:
        from ambid.recursive.joint._kernels import ekf_block

        super().__init__(start)
        self._kernel = ekf_block
        self._corrected = corrected
        n, n_y, p = self._wide.size, self._C.shape[0], self._logs.size
        wide = n + 2 * self._past.shape[1] + self._dist.size
        self._at = self._z[:p].copy()
        self._begun = np.sqrt(np.sum(self._T[:p, :p] ** 2, axis=0))
        self._M, self._dM, self._dG = np.zeros((n, wide)), np.zeros((p, n, wide)), np.zeros((p, n, n_y))
        self._work = np.zeros((3 + 3 * n, max(self._z.size + n, wide)))
        self.n_renewed = -1
        self._renew()

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
        corrected: bool = False,
    ) -> Self:
        """Return a filter that starts from an off-line estimate.

        Parameters
        ----------
        estimate : Estimate
        rate_hz : float
        rates, offset_sd, sensor_sd, disturbance_sd : Mapping[str, float], optional
            As in `start_from`.
        corrected : bool

        Returns
        -------
        JointEkf

        Raises
        ------
        EstimationError
            As `start_from`.
        """
        start = start_from(
            estimate, rate_hz, rates=rates, offset_sd=offset_sd, sensor_sd=sensor_sd, disturbance_sd=disturbance_sd
        )
        return cls(start, corrected=corrected)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader has to know before using the numbers; empty where nothing is known against them.

        A relative error d at the start leaves an error of order d^2 in the first linearisations, which the filter takes
        for measured. On four benches it came to a tenth of that at most: once less is claimed, it may be what is left.
        """
        p = self._at.size
        now = np.sqrt(np.sum(self._T[:p, :p] ** 2, axis=0))
        lost = _CURVED * self._begun**2 / now
        worst = int(np.argmax(lost))
        if lost[worst] <= 1.0:
            return super().warnings
        return (
            f"{self.start.free[worst]} began with a standard deviation of {self._begun[worst]:.2%} and is claimed to "
            f"{now[worst]:.2%}: linearising about the start may have left an error of {lost[worst] * now[worst]:.2%}. "
            "Start from an off-line estimate, or use JointUkf",
            *super().warnings,
        )

    def _run(self, u: Array, y: Array, e: Array) -> None:
        done = 0
        while True:
            done = self._kernel(
                done, u, y, e, self._z, self._T, self._at, self._M, self._dM, self._dG, self._C, self._dist, self._walk,
                self._io, self._wide, self._past, self._counts, EVERY, _AMOUNT, self._work,
            )  # fmt: skip
            if self._counts[6]:
                self._renew()
                self._counts[6] = 0
            if done == u.shape[0]:
                return

    def _renew(self) -> None:
        """Put the linearisation point at the estimate: exact matrices, exact derivatives by the scaled parameters."""
        with np.errstate(over="ignore", invalid="ignore"):
            now, slopes = self._discrete()
        if not all(np.isfinite(d.A).all() and np.isfinite(d.E).all() for d in (now, *slopes)):
            return  # an estimate beyond all numbers: the last matrices stay, innovations say the rest
        self._at[:] = self._z[: self._at.size]
        self._M[:] = np.hstack([now.A, now.B, now.B_late, now.E])
        for j, d in enumerate(slopes):
            self._dM[j] = np.hstack([d.A, d.B, d.B_late, d.E])
        if self._corrected:
            self._correct(now, slopes)
        self.n_renewed += 1

    def _discrete(self) -> tuple[DiscreteSpace, tuple[DiscreteSpace, ...]]:
        """Discrete matrices at the estimate and their derivatives, in scaled units."""
        model, theta, unit = self.start.model, self.values, self._unit()
        spaces = [model.matrices(theta), *(model.derivative(theta, name) for name in self.start.free)]
        scaled = [
            StateSpace(
                A=k * s.A * self._state / self._state[:, None],
                B=k * s.B / self._state[:, None],
                E=k * s.E * self._disturbance / self._state[:, None],
                C=s.C,
            )
            for k, s in zip(np.r_[1.0, unit[: len(self.start.free)]], spaces, strict=True)
        ]
        now, slopes = discretise(scaled[0], 1.0 / self.start.rate_hz, fraction=self._fraction, derivatives=scaled[1:])
        return now, slopes[: len(self.start.free)]

    def _correct(self, now: DiscreteSpace, slopes: tuple[DiscreteSpace, ...]) -> None:
        """Sensitivity of the stationary gain: of K = A K_f the filter sees dA K_f already, A dK_f is what it lacks."""
        power = self._dist**2
        try:
            at = predictor_gain(now.A, self._C, (now.E * power) @ now.E.T, np.eye(self._C.shape[0]))
        except (np.linalg.LinAlgError, ValueError):
            return  # no stationary gain here (no disturbance, say): the last sensitivity, at first none, stays
        dA, dE = np.array([d.A for d in slopes]), np.array([d.E for d in slopes])
        half = (dE * power) @ now.E.T
        dR = np.zeros((len(slopes), *at.S.shape))
        dK = gain_derivatives(now.A, self._C, at, dA, half + np.swapaxes(half, 1, 2), dR)
        self._dG[:] = dK - dA @ np.linalg.solve(now.A, at.K)
