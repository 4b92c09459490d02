"""Estimates of A y = B u + noise from given instruments, started through low-pass filters of several corners.

Solves: sampled fast, output noise drowns the differences of the output that A is read from, and without a filter the
first estimate is far off; an iteration of noise model and estimate then settles there. Of several first filters the one
that leaves the least innovation is taken.
"""

from __future__ import annotations

import numpy as np

from ambid.blackbox.instrumental.arx_form import ArxEstimate, ArxOrders, Signals, refined, step
from ambid.errors import EstimationError

NOISE_ORDER = 20  # added to na + nb; Akaike's criterion chooses below it
_CORNERS = (np.inf, 0.5, 0.1, 0.02)  # of the filters of the first step, in radians a sample
_ROUGH = 3
_ROUNDING = 1e-11
_ROUNDS = 30  # noise model and estimate in turn, at most


def searched(who: str, signals: Signals, clean: Signals, orders: ArxOrders) -> ArxEstimate:
    """Estimate one output with given instruments.

    `who`: method, for the error; `signals`, `clean`: as measured, and without what the noise does.
    """
    highest = orders.size + NOISE_ORDER
    best: ArxEstimate | None = None
    for corner in _CORNERS if orders.na else _CORNERS[:1]:
        C = np.asarray(np.poly(np.full(orders.na, np.exp(-corner)))) if np.isfinite(corner) else np.ones(1)
        try:
            theta = step(who, signals, clean, orders, C=C).theta
            found = refined(who, signals, clean, orders, theta, highest, _ROUGH)
        except EstimationError:
            continue
        if best is None or found.noise.variance < best.noise.variance:
            best = found
    if best is None:
        raise EstimationError(
            f"{who}: the input or reference does not move every term of this model, so that its coefficients have no "
            "single solution. Lower the orders, excite more frequencies, or give more independent references"
        )
    if exact(best, signals):
        return best
    return refined(who, signals, clean, orders, best.solution.theta, highest, _ROUNDS)


def exact(found: ArxEstimate, signals: Signals) -> bool:
    """Return whether nothing but rounding is left, of which no noise model can be made."""
    return bool(np.linalg.norm(found.innovations) <= _ROUNDING * np.linalg.norm(signals.y))
