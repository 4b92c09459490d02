"""Instrumental variables from the reference, for a plant in a loop, stable or not (Gilson and Van den Hof 2005).

Under feedback the noise reaches the input, so that past inputs are no instruments. What the reference makes of inputs
and outputs is, whatever the controller; with a model of the equation's noise as filter the estimate is optimal.
"""

from __future__ import annotations

import numpy as np

from ambid.errors import EstimationError
from ambid.identify.blackbox.data import IOData
from ambid.identify.blackbox.fit import BlackBoxFit
from ambid.identify.blackbox.orders import Orders
from ambid.identify.instrumental.arx_form import ArxEstimate, ArxOrders, Signals, refined, step
from ambid.identify.instrumental.iv4 import arx_fit, arx_orders, centred
from ambid.identify.instrumental.reference import reference_part, wants_reference

_NOISE_ORDER = 20  # added to na + nb; Akaike's criterion chooses below it
_CORNERS = (np.inf, 0.5, 0.1, 0.02)  # of the filters of the first step, in radians a sample
_ROUGH = 3
_ROUNDS = 30  # noise model and estimate in turn, at most; sampled fast, the first estimate is a poor start


def cliv(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate G = B/A of a plant in a loop, with instruments from the reference; every output by itself.

    Parameters
    ----------
    data : IOData
        With a reference that the noise does not reach.
    orders : Mapping[str, int or tuple of int]
        ``na``; ``nb`` and ``nk`` (default 1), one or one for each input.

    Returns
    -------
    BlackBoxFit
        PolynomialModel with A, B and the noise model C/D; C is 1, or the stable counterpart of A.

    Raises
    ------
    EstimationError
        If there is no reference, an order breaks a rule, or the record is too short or does not excite the plant.
    """
    wants_reference("cliv", data)
    used = arx_orders("cliv", data, orders)
    deviations, means, sds = centred(data)
    clean = reference_part("cliv", deviations)
    found = [
        in_loop(Signals(y=deviations.y[:, o], u=deviations.u), Signals(y=clean.y[:, o], u=clean.u), used)
        for o in range(data.n_outputs)
    ]
    fit = arx_fit("cliv", data, used, found, means, sds)
    return fit


def in_loop(signals: Signals, clean: Signals, orders: ArxOrders) -> ArxEstimate:
    """Estimate one output with the parts of the signals that the reference makes as instruments.

    Parameters
    ----------
    signals, clean : Signals
    orders : ArxOrders

    Returns
    -------
    ArxEstimate

    Raises
    ------
    EstimationError
        If the reference does not move every term.
    """
    highest = orders.size + _NOISE_ORDER
    best: ArxEstimate | None = None
    for corner in _CORNERS:
        C = np.asarray(np.poly(np.full(orders.na, np.exp(-corner)))) if np.isfinite(corner) else np.ones(1)
        try:
            theta = step("cliv", signals, clean, orders, C=C).theta
            found = refined("cliv", signals, clean, orders, theta, highest, _ROUGH)
        except EstimationError:
            continue
        if best is None or found.noise.variance < best.noise.variance:
            best = found
    if best is None:
        raise EstimationError(
            "cliv: the reference does not move every term of this model. Lower the orders, or excite more frequencies"
        )
    theta = best.solution.theta
    return refined("cliv", signals, clean, orders, theta, highest, _ROUNDS)
