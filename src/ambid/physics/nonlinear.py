"""The nonlinear one-axis plant: voltage-driven magnet, mass, gravity (thesis eq. 4.9 in physical form): m x'' = f(x, i)
- c x' + m g, V = R i + dlambda(x, i)/dt, with f and lambda from one co-energy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ambid.errors import ModelError
from ambid.physics.loop import UNLIMITED, Interval
from ambid.physics.magnet import Magnet, Number


@dataclass(frozen=True, slots=True, kw_only=True)
class PowerStage:
    """Makes v = clip(u, low, high) + offset - v_drop tanh(i/i_drop): devices and dead time act against the current.
    v_drop is V_s t_d f_s for a dead time t_d on supply V_s at f_s (Jeong and Park 1991); i_drop is about the ripple of
    the current.
    """

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
        """Return the voltage in V that is lost at a current in A."""
        lost: Number = self.v_drop * np.tanh(current / self.i_drop)
        return lost

    def slope(self, current: float) -> float:
        """Return d(drop)/di in ohm at a current in A: what the drop adds to the resistance."""
        return self.v_drop / self.i_drop / math.cosh(min(abs(current / self.i_drop), 350.0)) ** 2


IDEAL = PowerStage()
"""Gives what it is told to."""


class OperatingPoint(NamedTuple):
    """Where a plant rests, and where a linear model holds."""

    position: float = 0.0  # in m, A and V
    current: float = 0.0
    voltage: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NonlinearPlant:
    """Magnet, coil and mass on one axis, driven by a voltage.

    With an eddy pole a the force that acts is p, p' = a (f(x, i) - p) (thesis eq. 1.4).

    Attributes
    ----------
    magnet : Magnet
        `SingleMagnet`, `DifferentialPair`, or any law of `coenergy_law` as `LawMagnet`.
    m : float
        Mass in kg.
    R : float
        Resistance of the axis in ohm (of both coils for a differential pair).
    c : float
        Mechanical damping in N s/m.
    gravity : float
        Along +x in m/s^2; 0 for a horizontal axis.
    eddy_pole : float
        Pole a in rad/s of the eddy currents between current and force; infinite for none.
    stage : PowerStage
        What the amplifier makes of its command.
    """

    magnet: Magnet
    m: float
    R: float
    c: float = 0.0
    gravity: float = 0.0
    eddy_pole: float = math.inf
    stage: PowerStage = IDEAL

    def __post_init__(self) -> None:
        if not (math.isfinite(self.m) and self.m > 0.0):
            raise ModelError(f"m is {self.m} kg; a mass must be a positive number. Correct m")
        for name, value, unit in (("R", self.R, "ohm"), ("c", self.c, "N s/m")):
            if not (math.isfinite(value) and value >= 0.0):
                raise ModelError(f"{name} is {value} {unit}; it must be zero or positive. Correct {name}")
        if not math.isfinite(self.gravity):
            raise ModelError(f"gravity is {self.gravity} m/s^2; it must be a finite number. Correct gravity")
        if not self.eddy_pole > 0.0:
            raise ModelError(f"eddy_pole is {self.eddy_pole} rad/s; it must be positive. Give inf for none")

    def derivative(
        self, state: tuple[Number, Number, Number], voltage: Number, force: float = 0.0
    ) -> tuple[Number, Number, Number]:
        """Return the right-hand side of the state equation, without eddy pole and stage.

        Parameters
        ----------
        state : tuple
            Position in m, velocity in m/s, current in A.
        voltage : float
            In V, as the coil gets it.
        force : float
            Disturbance along +x in N.

        Returns
        -------
        tuple
            x' in m/s, x'' in m/s^2, i' in A/s.
        """
        x, v, i = state
        w = self.magnet.coenergy
        acceleration = (w.force(x, i) - self.c * v + force) / self.m + self.gravity
        return v, acceleration, (voltage - self.R * i - w.force_per_current(x, i) * v) / w.inductance(x, i)

    def equilibrium(self, position: float) -> OperatingPoint:
        """Return the rest point at `position`.

        Parameters
        ----------
        position : float, m

        Returns
        -------
        OperatingPoint
            Position in m, current in A and commanded voltage in V.

        Raises
        ------
        ModelError
            If the position closes a gap or the magnet cannot hold the load there.
        """
        current = self.magnet.holding_current(position, self.m * self.gravity)
        voltage = self.R * current + float(self.stage.drop(current)) - self.stage.offset
        return OperatingPoint(position, current, voltage)

    def linearise(self, position: float) -> dict[str, float]:
        """Return the parameters of the linear model ``one-axis`` at the rest point (thesis eq. 4.8).

        R holds what the stage's drop adds to it there; the eddy pole is left out.

        Parameters
        ----------
        position : float, m

        Returns
        -------
        dict of str to float
            m in kg, k_x in N/m, k_i in N/A, R in ohm, L in H, c in N s/m; f = k_i i - k_x x.
        """
        x, i, _ = self.equilibrium(position)
        w = self.magnet.coenergy
        return {
            "m": self.m,
            "k_x": w.displacement_coefficient(x, i),
            "k_i": w.force_per_current(x, i),
            "R": self.R + self.stage.slope(i),
            "L": w.inductance(x, i),
            "c": self.c,
        }

    def energy(self, state: tuple[Number, Number, Number]) -> Number:
        """Return the energy that the axis voltage works against: lambda i - W' + m x'^2/2 - m g x.

        Its rate is V i - R i^2 - c x'^2. For a pair it leaves out what the bias source gives or takes.

        Parameters
        ----------
        state : tuple of float
            Position in m, velocity in m/s, current in A.

        Returns
        -------
        float, J, up to a constant
        """
        x, v, i = state
        w = self.magnet.coenergy
        field = w.flux_linkage(x, i) * i - w.value(x, i)
        return field + 0.5 * self.m * v**2 - self.m * self.gravity * x
