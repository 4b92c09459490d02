"""Polynomial models A y = (B/F) u + (C/D) e by prediction error (thesis eq. 1.10-1.12, 3.1-3.17, table 3.1).

One engine for the eight structures; every one takes several inputs and outputs (one set of polynomials per output),
estimates offsets and initial states, and nk where it is left out or "auto".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.orders import Orders
from ambid.blackbox.polynomial.polynomial import estimate

__all__ = ["ararmax", "ararx", "arma", "armax", "arx", "bj", "fir", "oe"]


def fir(
    data: IOData,
    orders: Orders,
    *,
    fixed: Mapping[str, float] | None = None,
    at_rest: bool = False,
    tick: Callable[[], None] | None = None,
) -> BlackBoxFit:
    """Finite impulse response y = B u + e, by QR (Ljung 1999, sec. 4.2).

    Parameters
    ----------
    data : IOData
    orders : Mapping[str, int or tuple of int]
        nb, nk; nb, nf and nk one number, or one for each input.
    fixed : Mapping[str, float], optional
        Known coefficients, by name (``a1``), SI.
    at_rest : bool, optional
        Say that the record begins at rest at zero, see `ambid.blackbox.polynomial.rest`.
    tick : callable, optional
        Called before each look at the data.

    Returns
    -------
    BlackBoxFit
    """
    return estimate("fir", data, orders, fixed, tick, at_rest=at_rest)


def arx(
    data: IOData,
    orders: Orders,
    *,
    fixed: Mapping[str, float] | None = None,
    at_rest: bool = False,
    tick: Callable[[], None] | None = None,
) -> BlackBoxFit:
    """A y = B u + e, by QR (Ljung 1999, sec. 4.2).

    Parameters
    ----------
    data : IOData
    orders : Mapping[str, int or tuple of int]
        na, nb, nk; nb, nf and nk one number, or one for each input.
    fixed : Mapping[str, float], optional
        Known coefficients, by name (``a1``), SI.
    at_rest : bool, optional
        Say that the record begins at rest at zero, see `ambid.blackbox.polynomial.rest`.
    tick : callable, optional
        Called before each look at the data.

    Returns
    -------
    BlackBoxFit
    """
    return estimate("arx", data, orders, fixed, tick, at_rest=at_rest)


def armax(
    data: IOData,
    orders: Orders,
    *,
    fixed: Mapping[str, float] | None = None,
    at_rest: bool = False,
    tick: Callable[[], None] | None = None,
) -> BlackBoxFit:
    """A y = B u + C e (Ljung 1999, sec. 4.2).

    Parameters
    ----------
    data : IOData
    orders : Mapping[str, int or tuple of int]
        na, nb, nc, nk; nb, nf and nk one number, or one for each input.
    fixed : Mapping[str, float], optional
        Known coefficients, by name (``a1``), SI.
    at_rest : bool, optional
        Say that the record begins at rest at zero, see `ambid.blackbox.polynomial.rest`.
    tick : callable, optional
        Called before each look at the data.

    Returns
    -------
    BlackBoxFit
    """
    return estimate("armax", data, orders, fixed, tick, at_rest=at_rest)


def arma(
    data: IOData,
    orders: Orders,
    *,
    fixed: Mapping[str, float] | None = None,
    at_rest: bool = False,
    tick: Callable[[], None] | None = None,
) -> BlackBoxFit:
    """Time series A y = C e (Ljung 1999, sec. 4.2).

    Parameters
    ----------
    data : IOData
    orders : Mapping[str, int or tuple of int]
        na, nc.
    fixed : Mapping[str, float], optional
        Known coefficients, by name (``a1``), SI.
    at_rest : bool, optional
        Say that the record begins at rest at zero, see `ambid.blackbox.polynomial.rest`.
    tick : callable, optional
        Called before each look at the data.

    Returns
    -------
    BlackBoxFit
    """
    return estimate("arma", data, orders, fixed, tick, at_rest=at_rest)


def ararx(
    data: IOData,
    orders: Orders,
    *,
    fixed: Mapping[str, float] | None = None,
    at_rest: bool = False,
    tick: Callable[[], None] | None = None,
) -> BlackBoxFit:
    """A y = B u + (1/D) e (Ljung 1999, sec. 4.2).

    Parameters
    ----------
    data : IOData
    orders : Mapping[str, int or tuple of int]
        na, nb, nd, nk; nb, nf and nk one number, or one for each input.
    fixed : Mapping[str, float], optional
        Known coefficients, by name (``a1``), SI.
    at_rest : bool, optional
        Say that the record begins at rest at zero, see `ambid.blackbox.polynomial.rest`.
    tick : callable, optional
        Called before each look at the data.

    Returns
    -------
    BlackBoxFit
    """
    return estimate("ararx", data, orders, fixed, tick, at_rest=at_rest)


def ararmax(
    data: IOData,
    orders: Orders,
    *,
    fixed: Mapping[str, float] | None = None,
    at_rest: bool = False,
    tick: Callable[[], None] | None = None,
) -> BlackBoxFit:
    """A y = B u + (C/D) e (Ljung 1999, sec. 4.2).

    Parameters
    ----------
    data : IOData
    orders : Mapping[str, int or tuple of int]
        na, nb, nc, nd, nk; nb, nf and nk one number, or one for each input.
    fixed : Mapping[str, float], optional
        Known coefficients, by name (``a1``), SI.
    at_rest : bool, optional
        Say that the record begins at rest at zero, see `ambid.blackbox.polynomial.rest`.
    tick : callable, optional
        Called before each look at the data.

    Returns
    -------
    BlackBoxFit
    """
    return estimate("ararmax", data, orders, fixed, tick, at_rest=at_rest)


def oe(
    data: IOData,
    orders: Orders,
    *,
    fixed: Mapping[str, float] | None = None,
    at_rest: bool = False,
    tick: Callable[[], None] | None = None,
) -> BlackBoxFit:
    """Output error y = (B/F) u + e (Ljung 1999, sec. 4.2).

    Parameters
    ----------
    data : IOData
    orders : Mapping[str, int or tuple of int]
        nb, nf, nk; nb, nf and nk one number, or one for each input.
    fixed : Mapping[str, float], optional
        Known coefficients, by name (``a1``), SI.
    at_rest : bool, optional
        Say that the record begins at rest at zero, see `ambid.blackbox.polynomial.rest`.
    tick : callable, optional
        Called before each look at the data.

    Returns
    -------
    BlackBoxFit
    """
    return estimate("oe", data, orders, fixed, tick, at_rest=at_rest)


def bj(
    data: IOData,
    orders: Orders,
    *,
    fixed: Mapping[str, float] | None = None,
    at_rest: bool = False,
    tick: Callable[[], None] | None = None,
) -> BlackBoxFit:
    """Box-Jenkins y = (B/F) u + (C/D) e (Ljung 1999, sec. 4.2).

    Parameters
    ----------
    data : IOData
    orders : Mapping[str, int or tuple of int]
        nb, nc, nd, nf, nk; nb, nf and nk one number, or one for each input.
    fixed : Mapping[str, float], optional
        Known coefficients, by name (``a1``), SI.
    at_rest : bool, optional
        Say that the record begins at rest at zero, see `ambid.blackbox.polynomial.rest`.
    tick : callable, optional
        Called before each look at the data.

    Returns
    -------
    BlackBoxFit
    """
    return estimate("bj", data, orders, fixed, tick, at_rest=at_rest)
