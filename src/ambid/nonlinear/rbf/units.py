"""Radial units: their value and slope as functions of the squared distance from the centre in widths."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

UNITS: tuple[str, ...] = ("gaussian", "inverse-multiquadric", "thin-plate")
"""exp(-q/2), 1/sqrt(1 + q), (q log q)/2 = r^2 log r; the place of a name is its number in the compiled loops."""

_NONE = 1e-300  # squared distance below which a thin plate is at its centre


def value(unit: str, q: NDArray[Any]) -> NDArray[Any]:
    """Return the value of units.

    `unit`: one of `UNITS`; `q`: (n, neurons), squared distance from the centre in widths. Returns (n, neurons).
    """
    if unit == "gaussian":
        return np.exp(-0.5 * q)
    if unit == "inverse-multiquadric":
        return 1.0 / np.sqrt(1.0 + q)
    safe = np.where(q.real > _NONE, q, 1.0)
    return 0.5 * safe * np.log(safe)


def slope(unit: str, q: NDArray[Any]) -> NDArray[Any]:
    """Return the derivative of the value by the squared distance.

    `unit`: one of `UNITS`; `q`: (n, neurons), squared distance from the centre in widths. Returns (n, neurons), zero at
    the centre of a thin plate, where it is infinite but multiplies a distance of zero.
    """
    if unit == "gaussian":
        return -0.5 * np.exp(-0.5 * q)
    if unit == "inverse-multiquadric":
        return -0.5 * (1.0 + q) ** -1.5
    inside = q.real > _NONE
    return np.where(inside, 0.5 * (np.log(np.where(inside, q, 1.0)) + 1.0), 0.0)
