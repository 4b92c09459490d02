"""Instrumental variables for one output of A y = B u + noise of any colour: the steps that iv4 and cliv share.

Regressors are lagged outputs and inputs and a constant; instruments are the same lags of signals that the noise did not
make. Filtering with an autoregressive model of the equation's own noise makes the estimate optimal (Ljung 1999,
sec. 15.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.instrumental.noise import Autoregression, autoregression, noise_covariance
from ambid.blackbox.instrumental.solve import Solution, solve, without
from ambid.blackbox.polynomial_model import Polynomials
from ambid.blackbox.response import Offsets
from ambid.blackbox.roots import reflected

_NO_NOISE_MODEL = Autoregression(D=np.ones(1), variance=0.0)
_NO_AVERAGE = np.ones(1)
_SETTLED = 1e-4  # change of the filtered output by a round, relative to the innovations
_INSIDE = 0.9999  # radius to which poles on the unit circle are drawn


@dataclass(frozen=True, slots=True, kw_only=True)
class ArxOrders:
    """Orders of one output."""

    na: int
    nb: tuple[int, ...]  # for each input
    nk: tuple[int, ...]

    @property
    def first(self) -> int:
        """First sample whose lags are all in the record."""
        return max([self.na, *(b + k - 1 for b, k in zip(self.nb, self.nk, strict=True))])

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.na + sum(self.nb)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signals:
    """One output and the inputs, offsets roughly off."""

    y: Array  # (n_samples,)
    u: Array  # (n_samples, n_inputs)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArxEstimate:
    """Outcome of one output."""

    A: Array  # (na + 1,)
    B: tuple[Array, ...]  # for each input
    constant: float  # of the equation, for the signals as given
    noise: Autoregression  # of the equation error: A y = B u + constant + C w/D
    C: Array  # (n + 1,), 1, or A with the poles outside the unit circle mirrored: noise that enters at the output
    solution: Solution  # last step; its unknowns are a_1 ..., b of every input, and the constant
    innovations: Array  # (n_rows,), ending with the last sample


def regressors(signals: Signals, orders: ArxOrders, first: int) -> Array:
    """Return -y(t-1) ... -y(t-na), u_i(t-nk) ..., 1 for t >= first, shape (n_samples - first, size + 1).

    Returns (n_rows, n_coefficients + 1).
    """
    n = signals.y.size
    columns = [-signals.y[first - k : n - k] for k in range(1, orders.na + 1)]
    for i, (nb, nk) in enumerate(zip(orders.nb, orders.nk, strict=True)):
        columns += [signals.u[first - k : n - k, i] for k in range(nk, nk + nb)]
    return np.stack([*columns, np.ones(n - first)], axis=1)


def step(
    who: str,
    data: Signals,
    instruments: Signals,
    orders: ArxOrders,
    noise: Autoregression = _NO_NOISE_MODEL,
    C: Array = _NO_AVERAGE,
) -> Solution:
    """Make one instrumental variable step; all columns are filtered by D/C.

    `who`: method, for errors; `C`: (n + 1,).
    """
    first, p = orders.first, noise.order
    rows, Z, target = regressors(data, orders, first), regressors(instruments, orders, first), data.y[first:]
    if p or C.size > 1:
        from scipy.signal import lfilter

        rows, Z, target = (lfilter(noise.D, C, x, axis=0)[p:] for x in (rows, Z, target))
    if C.size > 1:  # what the filter does not know of the time before the record fades with the plant's own poles
        free = _free(C, rows.shape[0])
        rows, Z, target = without(free, rows), without(free, Z), without(free, target[:, None])[:, 0]
    return solve(Z, rows, target, who=who)


def least_squares(who: str, data: Signals, orders: ArxOrders) -> Array:
    """Return the least-squares coefficients: instruments equal to regressors; biased by coloured noise.

    Returns (n_coefficients + 1,).
    """
    return step(who, data, data, orders).theta


def equation_error(data: Signals, theta: Array, orders: ArxOrders) -> Array:
    """Return A y - B u - constant from the first sample with all lags on.

    `theta`: (n_coefficients + 1,). Returns (n_rows,).
    """
    first = orders.first
    return np.asarray(data.y[first:] - regressors(data, orders, first) @ theta)


def optimal(
    who: str, data: Signals, instruments: Signals, orders: ArxOrders, theta: Array, highest: int
) -> ArxEstimate:
    """Model the noise of the equation at `theta` and make the filtered, optimal step (Ljung 1999, eq. 15.25-15.29).

    The noise is modelled twice, as 1/D and as C/D with C the stable counterpart of A, and the sharper model is taken.
    The second is that of noise on the output: sampled fast, it has zeros next to the unit circle, which no
    autoregression of moderate order holds. For an unstable plant C mirrors its poles: noise spectra do not tell them.

    `theta`: (n_coefficients + 1,), consistent estimate from a step before; `highest`: highest order of the noise model.
    """
    from scipy.signal import lfilter

    error = equation_error(data, theta, orders)
    noise, C = autoregression(error, highest), _NO_AVERAGE
    mirrored = reflected(np.concatenate([[1.0], theta[: orders.na]]), _INSIDE)
    outer = np.asarray(lfilter([1.0], mirrored, error))
    at_output = autoregression(without(_free(mirrored, outer.size), outer[:, None])[:, 0], highest)
    if _cost(at_output, error.size) < _cost(noise, error.size):
        noise, C = at_output, mirrored
    solution = step(who, data, instruments, orders, noise, C)
    found = solution.theta
    A = np.concatenate([[1.0], found[: orders.na]])
    B, first = list[Array](), orders.na
    for nb, nk in zip(orders.nb, orders.nk, strict=True):
        B.append(np.concatenate([np.zeros(nk), found[first : first + nb]]))
        first += nb
    return ArxEstimate(
        A=A,
        B=tuple(B),
        constant=float(found[-1]),
        noise=noise,
        C=C,
        solution=solution,
        innovations=solution.residual,
    )


def refined(
    who: str, data: Signals, instruments: Signals, orders: ArxOrders, theta: Array, highest: int, rounds: int
) -> ArxEstimate:
    """Repeat `optimal` until noise model and estimate agree.

    `theta`: (n_coefficients + 1,); `rounds`: at most.
    """
    for _ in range(rounds):
        found = optimal(who, data, instruments, orders, theta, highest)
        before, theta = theta, found.solution.theta
        moved = np.linalg.pinv(found.solution.inverse) @ (theta - before)
        if np.linalg.norm(moved) <= _SETTLED * np.linalg.norm(found.innovations):
            break
    return found


def _free(C: Array, n: int) -> Array:
    """Free responses of 1/C, shape (n, order of C)."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], C, np.eye(n, C.size - 1), axis=0))


def _cost(noise: Autoregression, n: int) -> float:
    return float(n * np.log(noise.variance + 1e-300) + 2 * noise.order)


def polynomials(found: ArxEstimate) -> Polynomials:
    """Return A, B and, as the noise model, C/D."""
    return Polynomials(A=found.A, B=found.B, C=found.C, D=found.noise.D, F=tuple(np.ones(1) for _ in found.B))


def covariance(found: ArxEstimate, orders: ArxOrders) -> Array:
    """Return the covariance of all coefficients of `polynomials`, leading ones and zeros included.

    C follows from A and has zeros. The noise of the filtered equation is modelled once more, so that a noise model of
    too low an order costs efficiency but does not make the standard deviations too small.

    Returns (n_theta, n_theta).
    """
    rows = found.innovations.size
    left = autoregression(found.innovations, 10)
    spare = rows / max(rows - orders.size - 1, 1)
    inner = found.solution.covariance(left)[:-1, :-1] * spare
    sizes = [found.A.size, *(b.size for b in found.B), found.C.size, found.noise.D.size, *(1 for _ in found.B)]
    free = [slice(1, found.A.size)]
    start = found.A.size
    for b, nk in zip(found.B, orders.nk, strict=True):
        free.append(slice(start + nk, start + b.size))
        start += b.size
    places = np.concatenate([np.arange(s.start, s.stop) for s in free])
    out = np.zeros((sum(sizes), sum(sizes)))
    out[np.ix_(places, places)] = inner
    d = slice(start + found.C.size, start + found.C.size + found.noise.D.size)
    out[d, d] = noise_covariance(found.noise, rows)
    return out


def operating_point(found: list[ArxEstimate], u_mean: Array, y_mean: Array, u_sd: Array, y_sd: Array) -> Offsets:
    """Share the constants of the equations out over input and output offsets, each moved as little as possible.

    A(1) y0 - B(1) u0 = constant; where A(1) is near zero (an integrating plant) the input takes it.

    `found`: one for each output, for signals with the means taken off; `u_mean`, `u_sd`: (n_inputs,), SI; `y_mean`,
    `y_sd`: (n_outputs,), SI.
    """
    n_y = y_mean.size
    rows = np.zeros((n_y, n_y + u_mean.size))
    for o, f in enumerate(found):
        rows[o, o] = f.A.sum() * y_sd[o]
        rows[o, n_y:] = -np.array([b.sum() for b in f.B]) * u_sd
    move = np.linalg.lstsq(rows, np.array([f.constant for f in found]), rcond=None)[0]
    return Offsets(u=u_mean + move[n_y:] * u_sd, y=y_mean + move[:n_y] * y_sd)
