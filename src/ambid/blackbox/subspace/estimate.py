"""N4SID, PO-MOESP, CVA and PBSID-opt: state-space models in innovations form without a search (thesis eq. 1.1-1.3).

Solves: x+ = A x + B u + w, y = C x + D u + v, cov [w; v] = [Q S; S' R], and its Kalman gain, for stable and unstable
plants, any number of inputs (none: a time series) and outputs. N4SID, MOESP and CVA are biased under feedback; PBSID
is not. The record is compressed once to triangular factors; everything else is done on those.
"""

from __future__ import annotations

from collections.abc import Callable

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.orders import Orders
from ambid.blackbox.subspace.engine import fitted

Tick = Callable[[], None] | None


def n4sid(
    data: IOData,
    orders: Orders,
    *,
    horizon: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = None,
    tick: Tick = None,
) -> BlackBoxFit:
    """Identify a state-space model by N4SID (Van Overschee and De Moor 1996, fig. 4.8; thesis eq. 1.1-1.3).

    Parameters
    ----------
    data : IOData
    orders : Mapping
        ``n``: number of states, ``"auto"`` or missing to choose it. ``nk``: known delay of the inputs in samples, one
        or one for each, at least 1 (default); larger ones become states of their own.
    horizon, past : int, optional
        Samples of future and past; chosen by an autoregression if missing.
    feedthrough : bool, optional
        Whether to estimate D. Missing: only where the record is said to be open loop and shows one, because a
        controller that acts within the sample cannot be told from a feedthrough.
    tick : callable, optional
        Called between steps.

    Returns
    -------
    BlackBoxFit

    Raises
    ------
    EstimationError
        If orders or horizons break a rule, a channel is constant, or the record is too short.
    """
    return fitted("n4sid", data, orders, horizon, past, feedthrough, tick)


def moesp(
    data: IOData,
    orders: Orders,
    *,
    horizon: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = None,
    tick: Tick = None,
) -> BlackBoxFit:
    """Identify a state-space model by PO-MOESP (Verhaegen 1994; Van Overschee and De Moor 1996, sec. 4.3.2).

    Parameters
    ----------
    data : IOData
    orders : Mapping
        As for `n4sid`.
    horizon, past : int, optional
        Samples of future and past.
    feedthrough : bool, optional
        As for `n4sid`.
    tick : callable, optional

    Returns
    -------
    BlackBoxFit

    Raises
    ------
    EstimationError
        As for `n4sid`.
    """
    return fitted("moesp", data, orders, horizon, past, feedthrough, tick)


def cva(
    data: IOData,
    orders: Orders,
    *,
    horizon: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = None,
    tick: Tick = None,
) -> BlackBoxFit:
    """Identify a state-space model by canonical variates (Larimore 1990; Van Overschee and De Moor 1996, sec. 4.3.3).

    Parameters
    ----------
    data : IOData
    orders : Mapping
        As for `n4sid`.
    horizon, past : int, optional
        Samples of future and past.
    feedthrough : bool, optional
        As for `n4sid`.
    tick : callable, optional

    Returns
    -------
    BlackBoxFit

    Raises
    ------
    EstimationError
        As for `n4sid`.
    """
    return fitted("cva", data, orders, horizon, past, feedthrough, tick)


def pbsid(
    data: IOData,
    orders: Orders,
    *,
    horizon: int | None = None,
    past: int | None = None,
    feedthrough: bool | None = None,
    tick: Tick = None,
) -> BlackBoxFit:
    """Identify a state-space model by PBSID-opt, consistent under feedback (Chiuso 2007, Automatica 43, 1034).

    The controller has to hold a delay of a sample; where it does not, D stays zero (the default) and the estimate
    stays consistent, but D itself cannot be identified.

    Parameters
    ----------
    data : IOData
    orders : Mapping
        As for `n4sid`.
    horizon, past : int, optional
        Samples of future and past, horizon <= past.
    feedthrough : bool, optional
        As for `n4sid`.
    tick : callable, optional

    Returns
    -------
    BlackBoxFit

    Raises
    ------
    EstimationError
        As for `n4sid`.
    """
    return fitted("pbsid", data, orders, horizon, past, feedthrough, tick)
