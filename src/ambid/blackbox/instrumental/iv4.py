"""Four-step instrumental variables for A y = B u + noise of any colour, no feedback (Ljung 1999, sec. 15.3).

Least squares is biased where the equation's noise is not white. Instruments simulated from the inputs alone carry no
noise; filtering with a model of the noise makes the estimate as sharp as a method without a noise model of G can be.
The four steps from least squares end far from the plant where sampling is fast or damping light: here the first
instruments are what a long autoregression makes of the inputs, and the last two steps are repeated until they settle.
"""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.instrumental.arx_form import (
    ArxEstimate,
    ArxOrders,
    Signals,
    covariance,
    least_squares,
    operating_point,
    optimal,
    polynomials,
)
from ambid.blackbox.instrumental.corners import NOISE_ORDER, exact, searched
from ambid.blackbox.instrumental.reference import reference_part
from ambid.blackbox.instrumental.solve import weak
from ambid.blackbox.made import made
from ambid.blackbox.orders import Orders, known_orders, long_enough, per_input, single
from ambid.blackbox.polynomial_model import PolynomialModel
from ambid.blackbox.roots import reflected
from ambid.errors import EstimationError

_ROUNDS = 10  # of instruments from the model itself, at most
_SETTLED = 1e-4  # change of the filtered output by a round, relative to the innovations
_INSIDE = 0.999  # radius to which the poles of an unstable instrument are drawn


def iv4(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate G = B/A by the four-step instrumental variable method; every output by itself.

    Parameters
    ----------
    data : IOData
        Without feedback: past inputs are instruments, so the noise must not reach the input.
    orders : Mapping[str, int or tuple of int]
        ``na``; ``nb`` and ``nk`` (default 1), one or one for each input.

    Returns
    -------
    BlackBoxFit
        PolynomialModel with A, B and the noise model C/D; C is 1, or the stable counterpart of A.

    Raises
    ------
    EstimationError
        If an order breaks a rule, or the record is too short or does not excite the plant.
    """
    used = arx_orders("iv4", data, orders)
    deviations, means, sds = centred(data)
    explained = _explained(deviations)
    found = [
        _one_output(Signals(y=y, u=deviations.u), used, None if explained is None else explained[:, o])
        for o, y in enumerate(deviations.y.T)
    ]
    return arx_fit("iv4", data, used, found, means, sds)


def arx_orders(who: str, data: IOData, orders: Orders) -> ArxOrders:
    """Check na, nb and nk, and that the record is long enough for them."""
    known_orders(who, orders, ("na", "nb", "nk"), ("na", "nb"))
    n_u = data.n_inputs
    used = ArxOrders(
        na=single(who, orders, "na", 0),
        nb=per_input(who, orders, "nb", 1, n_u),
        nk=per_input(who, {"nk": 1, **orders}, "nk", 0, n_u),
    )
    long_enough(who, data, data.n_samples - (used.first if n_u else 0), used.size + 1)
    return used


def centred(data: IOData) -> tuple[IOData, tuple[Array, Array], tuple[Array, Array]]:
    """Return the data with means off (for the numbers' sake; constants are estimated), the means and the spreads.

    Returns means; standard deviations.
    """
    from dataclasses import replace

    means = (data.u.mean(axis=0), data.y.mean(axis=0))
    sds = (data.u.std(axis=0), data.y.std(axis=0))
    reference = data.reference - data.reference.mean(axis=0)
    return replace(data, u=data.u - means[0], y=data.y - means[1], reference=reference), means, sds


def arx_fit(
    who: str,
    data: IOData,
    orders: ArxOrders,
    found: list[ArxEstimate],
    means: tuple[Array, Array],
    sds: tuple[Array, Array],
    warnings: tuple[str, ...] = (),
) -> BlackBoxFit:
    """Put the estimates of all outputs together.

    `found`: for each output, of the data with the means off.
    """
    from scipy.linalg import block_diag

    rows = min(f.innovations.size for f in found)
    e = np.stack([f.innovations[-rows:] for f in found], axis=1)
    return made(
        who,
        data,
        orders={"na": orders.na, "nb": orders.nb, "nk": orders.nk},
        model=PolynomialModel(outputs=tuple(polynomials(f) for f in found), dt=data.dt),
        covariance=block_diag(*[covariance(f, orders) for f in found]),
        n_estimated=sum(orders.size + f.noise.order for f in found),
        offsets=operating_point(found, *means, *sds),
        noise_covariance=e.T @ e / max(rows - orders.size - 1, 1),
        warnings=(*warnings, *weak([f.solution for f in found], data.outputs)),
        details={
            "noise_order": [f.noise.order for f in found],
            "condition": [f.solution.condition for f in found],
            "instrument_strength": [f.solution.strength() for f in found],
        },
    )


def _one_output(signals: Signals, orders: ArxOrders, explained: Array | None) -> ArxEstimate:
    """Instruments from what the inputs explain of the output, then from the model itself, until it stands still."""
    if explained is None:
        start = least_squares("iv4", signals, orders)
        clean = _simulated(signals, start, orders)
    else:
        clean = Signals(y=explained, u=signals.u)
    found, highest = searched("iv4", signals, clean, orders), orders.size + NOISE_ORDER
    for _ in range(0 if exact(found, signals) else _ROUNDS):
        before = found.solution.theta
        found = optimal("iv4", signals, _simulated(signals, before, orders), orders, before, highest)
        moved = np.linalg.pinv(found.solution.inverse) @ (found.solution.theta - before)
        if np.linalg.norm(moved) <= _SETTLED * np.linalg.norm(found.innovations):
            break
    return found


def _explained(deviations: IOData) -> Array | None:
    """What the inputs alone make of the outputs, by an autoregression of many lags; None where none is stable."""
    from dataclasses import replace

    u, names = deviations.u, deviations.inputs
    alone = replace(deviations, u=np.empty((u.shape[0], 0)), inputs=(), reference=u, references=names)
    try:
        return reference_part("iv4", alone).y
    except EstimationError:
        return None


def _simulated(signals: Signals, theta: Array, orders: ArxOrders) -> Signals:
    """Output of the model from the inputs alone; poles outside the unit circle are drawn inside."""
    from scipy.signal import lfilter

    A = reflected(np.concatenate([[1.0], theta[: orders.na]]), _INSIDE)
    y, first = np.zeros(signals.y.size), orders.na
    for i, (nb, nk) in enumerate(zip(orders.nb, orders.nk, strict=True)):
        y += lfilter(np.concatenate([np.zeros(nk), theta[first : first + nb]]), A, signals.u[:, i])
        first += nb
    return Signals(y=y, u=signals.u)
