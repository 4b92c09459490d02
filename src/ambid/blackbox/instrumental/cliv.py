"""Instrumental variables from the reference, for a plant in a loop, stable or not (Gilson and Van den Hof 2005).

Under feedback the noise reaches the input, so that past inputs are no instruments. What the reference makes of inputs
and outputs is, whatever the controller; with a model of the equation's noise as filter the estimate is optimal.
"""

from __future__ import annotations

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.instrumental.arx_form import ArxEstimate, ArxOrders, Signals
from ambid.blackbox.instrumental.corners import searched
from ambid.blackbox.instrumental.iv4 import arx_fit, arx_orders, centred
from ambid.blackbox.instrumental.reference import reference_part, wants_reference
from ambid.blackbox.orders import Orders


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
    """Estimate one output with the parts of the signals that the reference makes as instruments."""
    return searched("cliv", signals, clean, orders)
