"""Matrices of transfer functions num/den, continuous (in s) or discrete (in z), highest power first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.model import BlackBoxModel, StateSpaceModel
from ambid.blackbox.roots import roots_at
from ambid.errors import ModelError

Complex = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TransferModel(BlackBoxModel):
    """G[o][i] = num[o][i] / den[o][i] * exp(-s delay[i]), output noise white (H = I).

    Attributes
    ----------
    num, den : tuple of tuple of ndarray, shape (degree + 1,) each
        By output, then input; highest power first, den monic.
    dt : float or None
        Sampling interval in s; None for continuous time.
    delay : tuple of float, s
        One for each input (whole samples times dt for a discrete model).
    delay_estimated : bool
        Whether the delays are real numbers that were estimated: `theta` then ends with them, so that what is open about
        them goes into every spread.
    """

    num: tuple[tuple[Array, ...], ...]
    den: tuple[tuple[Array, ...], ...]
    dt: float | None
    delay: tuple[float, ...] = ()
    delay_estimated: bool = False

    def __post_init__(self) -> None:
        for name in ("num", "den"):
            rows = tuple(
                tuple(np.atleast_1d(np.array(p, dtype=np.float64)) for p in row) for row in getattr(self, name)
            )
            object.__setattr__(self, name, rows)
        if not self.delay:
            object.__setattr__(self, "delay", (0.0,) * len(self.num[0]))
        shapes = {len(row) for row in (*self.num, *self.den)}
        if shapes != {len(self.delay)} or len(self.num) != len(self.den):
            raise ModelError("num, den and delay of a transfer function do not have the same inputs and outputs")
        for n, d in ((n, d) for rn, rd in zip(self.num, self.den, strict=True) for n, d in zip(rn, rd, strict=True)):
            if d[0] != 1.0 or n.size > d.size:
                raise ModelError(f"a transfer function {n}/{d}; its denominator must be monic and of no lower degree")

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.delay)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.num)

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficient names ``num[o,i]s2`` and ``den[o,i]s2`` with the power behind, ``delay[i]``, as in `theta`."""
        variable = "s" if self.dt is None else "z"
        coefficients = tuple(
            f"{which}[{o},{i}]{variable}{p.size - 1 - k}" for o, i, which, p, _ in self.parts() for k in range(p.size)
        )
        return coefficients + tuple(f"delay[{i}]" for i in range(self.n_inputs) if self.delay_estimated)

    @property
    def theta(self) -> Array:
        """All coefficients, leading ones included, and estimated delays in s, as in `names`, shape (n_theta,)."""
        return np.concatenate([*(p for _, _, _, p, _ in self.parts()), self.delay if self.delay_estimated else ()])

    def frequency_response(self, omega: Array) -> Complex:
        """Return G.

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_inputs), complex
        """
        s, lag = self.points(omega), np.exp(-1j * np.outer(omega, self.delay))
        g = np.empty((omega.size, self.n_outputs, self.n_inputs), dtype=np.complex128)
        for o, i in np.ndindex(self.n_outputs, self.n_inputs):
            g[:, o, i] = np.polyval(self.num[o][i], s) / np.polyval(self.den[o][i], s) * lag[:, i]
        return g

    def noise_response(self, omega: Array) -> Complex:
        """Return the identity.

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_outputs), complex
        """
        return np.broadcast_to(np.eye(self.n_outputs, dtype=np.complex128), (omega.size,) + (self.n_outputs,) * 2)

    def frequency_response_derivative(self, omega: Array) -> Complex:
        """Return dG/dtheta.

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_inputs, n_theta), complex
        """
        s, lag = self.points(omega), np.exp(-1j * np.outer(omega, self.delay))
        out = np.zeros((omega.size, self.n_outputs, self.n_inputs, self.theta.size), dtype=np.complex128)
        for o, i, which, p, place in self.parts():
            powers = s[:, None] ** np.arange(p.size - 1, -1, -1)
            den = np.polyval(self.den[o][i], s)
            factor = lag[:, i] / den if which == "num" else -lag[:, i] * np.polyval(self.num[o][i], s) / den**2
            out[:, o, i, place] = powers * factor[:, None]
        if self.delay_estimated:
            g, first = self.frequency_response(omega), self.theta.size - self.n_inputs
            for i in range(self.n_inputs):
                out[:, :, i, first + i] = -1j * omega[:, None] * g[:, :, i]
        return out

    def _poles(self) -> tuple[Complex, Complex]:
        return self._roots("den")

    def _zeros(self) -> tuple[Complex, Complex]:
        return self._roots("num")

    def state_space(self) -> StateSpaceModel:
        """Return an innovations form with K = 0; delays of a discrete model become states.

        Returns
        -------
        StateSpaceModel

        Raises
        ------
        ModelError
            If a continuous model has a delay, which no finite state holds.
        """
        from scipy.linalg import block_diag
        from scipy.signal import tf2ss

        if self.dt is None and any(self.delay):
            raise ModelError("a continuous model with a delay has no state space. Set the delay apart, or discretise")
        blocks, n_u, n_y = [], self.n_inputs, self.n_outputs
        D = np.zeros((n_y, n_u))
        for o, i in np.ndindex(n_y, n_u):
            later = 0 if self.dt is None else round(self.delay[i] / self.dt)
            num, den = self.num[o][i], np.concatenate([self.den[o][i], np.zeros(later)])
            if den.size == 1:
                D[o, i] = num[0]
                continue
            used = int(np.nonzero(num)[0][0]) if np.any(num) else num.size - 1
            a, b, c, d = tf2ss(num[used:], den)
            D[o, i] = d[0, 0]
            wide_b, wide_c = np.zeros((a.shape[0], n_u)), np.zeros((n_y, a.shape[0]))
            wide_b[:, i], wide_c[o] = b[:, 0], c[0]
            blocks.append((a, wide_b, wide_c))
        A = block_diag(*[b[0] for b in blocks]) if blocks else np.zeros((0, 0))
        B = np.vstack([np.zeros((0, n_u)), *[b[1] for b in blocks]])
        C = np.hstack([np.zeros((n_y, 0)), *[b[2] for b in blocks]])
        return StateSpaceModel(A=A, B=B, C=C, D=D, K=np.zeros((A.shape[0], n_y)), dt=self.dt)

    def parts(self) -> Iterator[tuple[int, int, str, Array, slice]]:
        """Yield (output, input, "num" or "den", coefficients, place in `theta`)."""
        first = 0
        for o, i in np.ndindex(self.n_outputs, self.n_inputs):
            for which, p in (("num", self.num[o][i]), ("den", self.den[o][i])):
                yield o, i, which, p, slice(first, first + p.size)
                first += p.size

    def _roots(self, wanted: str) -> tuple[Complex, Complex]:
        return roots_at(self.theta, *[place for _, _, which, _, place in self.parts() if which == wanted])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScaledTransfer:
    """Transfer functions of one output in p = s/w0: f_0 ... f_(n-1), then b_0 ... of each input."""

    theta: Array  # (n_theta,)
    covariance: Array  # (n_theta, n_theta)
    n: int  # degree of the denominator
    nb: tuple[int, ...]  # numerator coefficients by input
    w0: float  # rad/s
    gain: Array  # (n_inputs,), SI unit of a numerator coefficient

    def in_s(self) -> tuple[list[Array], list[Array], Array]:
        """Return numerators and denominators by input in s and SI, and their derivative by `theta`."""
        n, unit, num, rows = self.n, np.eye(self.theta.size), list[Array](), list[Array]()
        worth = self.w0 ** np.arange(n, -1, -1.0)  # of p^0 ... p^n
        by_den = np.vstack([np.zeros(self.theta.size), (unit[:n] * worth[:n, None])[::-1]])
        den = np.append(1.0, by_den[1:] @ self.theta)
        for gain, own in zip(self.gain, np.split(unit[n:], np.cumsum(self.nb)[:-1]), strict=True):
            by_num = (own * (worth[: own.shape[0]] * gain)[:, None])[::-1]
            num.append(by_num @ self.theta)
            rows += [by_num, by_den]
        return num, [den] * len(num), np.vstack(rows)


def continuous_model(outputs: Sequence[ScaledTransfer], delay: tuple[float, ...]) -> tuple[TransferModel, Array]:
    """Return the continuous model of all outputs in SI, and the covariance of all its coefficients."""
    from scipy.linalg import block_diag

    found = [one.in_s() for one in outputs]
    model = TransferModel(
        num=tuple(tuple(num) for num, _, _ in found),
        den=tuple(tuple(den) for _, den, _ in found),
        dt=None,
        delay=delay,
    )
    slopes = zip(outputs, found, strict=True)
    return model, block_diag(*[slope @ one.covariance @ slope.T for one, (_, _, slope) in slopes])
