"""Models that are wrong on purpose, to see whether the checks notice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ambid.physics.linear_model import model

_AXIS = model("one-axis")


@dataclass(frozen=True)
class WithoutMotionalVoltage:
    """The one-axis plant with V = R i + L i': the rotor's motion induces nothing."""

    def __getattr__(self, name: str) -> object:
        return getattr(_AXIS, name)

    def matrices(self, theta: Mapping[str, float]) -> object:
        s = _AXIS.matrices(theta)
        a = s.A.copy()
        a[2, 1] = 0.0
        return replace(s, A=a)

    def derivative(self, theta: Mapping[str, float], parameter: str) -> object:
        s = _AXIS.derivative(theta, parameter)
        a = s.A.copy()
        a[2, 1] = 0.0
        return replace(s, A=a)


def quantised(values: np.ndarray, step: float) -> np.ndarray:
    """Values on the grid of `step`."""
    return np.round(values / step) * step
