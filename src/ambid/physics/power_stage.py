"""What a power stage makes of the voltage that it is told to give: limits, and a drop against the current.

A transistor that conducts, a diode that carries on, and the dead time between two transistors all act against the
current, whatever its size: the coil gets v = clip(u, low, high) + offset - v_drop tanh(i/i_drop). For a dead time t_d
of a half bridge on the supply V_s at the switching frequency f_s, v_drop is V_s t_d f_s (Jeong and Park 1991); drops of
semiconductors add to it. The sign changes smoothly over i_drop, which is about the ripple of the current: within it,
both signs occur in every period. For a pair, i is the current of the axis, so this is the stage of a differential
winding; where each coil has its own stage and its current never changes sign, the drops are constant and cancel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ambid.errors import ModelError
from ambid.physics.loop import UNLIMITED, Interval
from ambid.physics.magnet import Number


@dataclass(frozen=True, slots=True, kw_only=True)
class PowerStage:
    """Limits, drop and offset of a power stage."""

    # between which the supply lets the voltage be, in V. The logged command may lie beyond.
    limits: Interval = UNLIMITED
    v_drop: float = 0.0  # voltage in V that is lost against the current
    i_drop: float = 0.02  # current in A over which that loss changes its sign
    offset: float = 0.0  # voltage in V that acts beside the one that is commanded

    def __post_init__(self) -> None:
        if not self.limits[0] < self.limits[1]:
            raise ModelError(
                f"stage.limits is {self.limits} V; the lower must be below the upper. Swap or correct them"
            )
        for name, value in (("v_drop", self.v_drop), ("offset", self.offset)):
            if not math.isfinite(value):
                raise ModelError(f"stage.{name} is {value} V; it must be a finite number. Correct it")
        if not (math.isfinite(self.i_drop) and self.i_drop > 0.0):
            raise ModelError(f"stage.i_drop is {self.i_drop} A; it must be a positive number. Correct it")

    def drop(self, current: Number) -> Number:
        """Return the voltage that is lost.

        `current`: in A. Returns in V.
        """
        lost: Number = self.v_drop * np.tanh(current / self.i_drop)
        return lost

    def slope(self, current: float) -> float:
        """Return d(drop)/di: what the drop adds to the resistance at a current.

        `current`: in A. Returns in ohm.
        """
        return self.v_drop / self.i_drop / math.cosh(min(abs(current / self.i_drop), 350.0)) ** 2


IDEAL = PowerStage()
"""Gives what it is told to."""
