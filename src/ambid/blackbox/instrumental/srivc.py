"""Refined instrumental variables for continuous-time transfer functions, no feedback (Young and Jakeman 1980).

y = sum of B_i(s)/F_i(s) exp(-s delay_i) u_i, inputs held over a sample, from sampled data directly: no discrete model
in between, so that the relative degree is the plant's own and fast sampling does no harm. With white noise on the
output it is as sharp as maximum likelihood; with any other noise it stays consistent, and its standard deviations hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.instrumental.iv4 import centred
from ambid.blackbox.instrumental.noise import autoregression
from ambid.blackbox.instrumental.output_error import Found, search
from ambid.blackbox.made import made
from ambid.blackbox.orders import Orders, known_orders, left_open, long_enough, per_input
from ambid.blackbox.response import Offsets
from ambid.blackbox.transfer_model import TransferModel
from ambid.errors import EstimationError
from ambid.estimation.threads import one_thread

_DELAYS = tuple(range(6))  # scanned where nk is not given
_NOISE_ORDER = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class TransferOrders:
    """Orders of a continuous-time transfer function."""

    nb: tuple[int, ...]  # numerator coefficients by input
    nf: tuple[int, ...]  # denominator degree by input
    nk: tuple[int, ...] | None  # delay in samples by input; None: to be scanned
    common: bool  # whether the inputs share one denominator

    @property
    def size(self) -> int:
        """Number of coefficients of one output."""
        return sum(self.nb) + (self.nf[0] if self.common else sum(self.nf))


def srivc(
    data: IOData,
    orders: Orders,
    *,
    noise: Literal["white", "coloured"] = "white",
    delays: Sequence[int] = _DELAYS,
) -> BlackBoxFit:
    """Estimate continuous-time transfer functions by refined instrumental variables; every output by itself.

    Parameters
    ----------
    data : IOData
        Without feedback; inputs held over a sample.
    orders : Mapping[str, int or tuple of int]
        ``nb``: numerator coefficients (1: a constant), one or one for each input. ``nf``: denominator degree; one
        number for a denominator that all inputs share, a tuple for one of each input's own. ``nk``: delay in samples,
        one or one for each input; left out: the one of `delays`, common to all inputs, that fits best.
    noise : {"white", "coloured"}, optional
        ``coloured`` also models the noise, as an autoregression of the sampled output error, and filters by it (RIVC):
        sharper where the noise is far from white.
    delays : sequence of int, optional
        Delays to scan where nk is left out, in samples.

    Returns
    -------
    BlackBoxFit
        TransferModel with ``dt`` None.

    Raises
    ------
    EstimationError
        If an order breaks a rule, the record is too short or does not excite the plant, or no stable model fits.
    """
    if noise not in ("white", "coloured"):
        raise EstimationError(f"srivc: noise {noise!r}; it must be 'white' or 'coloured'. Give one of them")
    used = transfer_orders("srivc", data, orders)
    deviations, means, _ = centred(data)
    settings = [used.nk] if used.nk is not None else [(int(k),) * data.n_inputs for k in delays]
    first = max(max(k) for k in settings)
    long_enough("srivc", data, data.n_samples - first, used.size + 1)
    with one_thread():
        tried = [(_all_outputs(deviations, used, nk, first, colour=noise == "coloured"), nk) for nk in settings]
        found, nk = min(tried, key=lambda t: _loss(t[0], deviations))
        return _fit(data, used, nk, found, means)


def transfer_orders(who: str, data: IOData, orders: Orders) -> TransferOrders:
    """Check nb, nf and nk."""
    known_orders(who, orders, ("nb", "nf", "nk"), ("nb", "nf"))
    n_u = data.n_inputs
    if not n_u:
        raise EstimationError(f"{who}: no input is named; it estimates the way from inputs to outputs. Give --input")
    nb, nf = per_input(who, orders, "nb", 1, n_u), per_input(who, orders, "nf", 1, n_u)
    for b, f in zip(nb, nf, strict=True):
        if b > f + 1:
            raise EstimationError(
                f"{who}: {b} numerator coefficients over a denominator of degree {f}; a plant that can be sampled has "
                f"at most {f + 1}. Lower nb, or raise nf"
            )
    nk = None if left_open(orders, "nk") else per_input(who, orders, "nk", 0, n_u)
    return TransferOrders(nb=nb, nf=nf, nk=nk, common=not isinstance(orders["nf"], tuple) or n_u == 1)


def _all_outputs(
    data: IOData, orders: TransferOrders, nk: tuple[int, ...], first: int, *, colour: bool
) -> list[tuple[Found, float]]:
    n = data.n_samples
    u = np.stack([data.u[first - k : n - k, i] for i, k in enumerate(nk)], axis=1)
    size = u.std(axis=0)
    out = []
    for o in range(data.n_outputs):
        y = data.y[first:, o]
        found, w0 = search(
            y / y.std(),
            u / size,
            data.dt,
            orders.nf[:1] if orders.common else orders.nf,
            orders.nb,
            common=orders.common,
            colour=colour,
        )
        out.append((found, w0))
    return out


def _loss(found: list[tuple[Found, float]], data: IOData) -> float:
    return float(sum(np.log(f.at.loss / data.n_samples + 1e-300) for f, _ in found))


def _fit(
    data: IOData,
    orders: TransferOrders,
    nk: tuple[int, ...],
    found: list[tuple[Found, float]],
    means: tuple[Array, ...],
) -> BlackBoxFit:
    from scipy.linalg import block_diag

    rows = min(f.at.output_error.size for f, _ in found)
    y_size = data.y[-rows:].std(axis=0)
    first = data.n_samples - rows
    u_size = np.array([data.u[first - k : data.n_samples - k, i].std() for i, k in enumerate(nk)])
    num, den, blocks = [], [], []
    for o, (f, w0) in enumerate(found):
        row_num, row_den, covariance = _physical(f, w0, orders, y_size[o] / u_size)
        num.append(row_num)
        den.append(row_den)
        blocks.append(covariance)
    e = np.stack([f.at.output_error[-rows:] * s for (f, _), s in zip(found, y_size, strict=True)], axis=1)
    constants = np.array([f.at.constant for f, _ in found]) * y_size
    return made(
        "srivc",
        data,
        orders={"nb": orders.nb, "nf": orders.nf[0] if orders.common else orders.nf, "nk": nk},
        model=TransferModel(num=tuple(num), den=tuple(den), dt=None, delay=tuple(k * data.dt for k in nk)),
        covariance=block_diag(*blocks),
        n_estimated=data.n_outputs * orders.size,
        offsets=Offsets(u=means[0], y=means[1] + constants),
        noise_covariance=e.T @ e / max(rows - orders.size - 1, 1),
        status="converged" if all(f.settled for f, _ in found) else "stalled",
        details={
            "condition": [f.solution().condition for f, _ in found],
            "steps": [f.steps for f, _ in found],
            "noise_order": [f.noise.order for f, _ in found],
        },
    )


def _physical(
    found: Found, w0: float, orders: TransferOrders, gain: Array
) -> tuple[tuple[Array, ...], tuple[Array, ...], Array]:
    """Numerators and denominators by input in s and SI, and the covariance of all their coefficients.

    `gain` (n_inputs,) is output unit over input unit of the search.
    """
    at = found.at
    spare = at.error.size / max(at.error.size - orders.size - 1, 1)
    inner = spare * found.solution().covariance(autoregression(at.error, _NOISE_ORDER))
    num, den = [], []
    jacobian = list[Array]()
    first = 0
    for c in found.chains:
        n = c.degree
        powers = w0 ** np.arange(n + 1)  # highest power first: f_(n-k) = p-coefficient * w0^k
        f_rows = np.zeros((n + 1, inner.shape[0]))
        f_rows[1:, first : first + n] = np.diag(powers[1:])[:, ::-1]
        place = first + n
        for j, (i, nb) in enumerate(zip(c.inputs, c.nb, strict=True)):
            b_rows = np.zeros((nb, inner.shape[0]))
            b_rows[:, place : place + nb] = np.diag(powers[n + 1 - nb :] * gain[i])[:, ::-1]
            place += nb
            num.append(c.num[j, n + 1 - nb :] * powers[n + 1 - nb :] * gain[i])
            den.append(c.den * powers)
            jacobian += [b_rows, f_rows]
        first = place
    J = np.vstack(jacobian)
    return tuple(num), tuple(den), J @ inner @ J.T
