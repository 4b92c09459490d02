"""A magnet of `coenergy_law` with its numbers, as a plant asks for one: the only bridge between law and plant."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.coenergy_law import MAGNET_NUMBERS, ORDERS, SLOPED, MagnetLaw, coenergy_derivatives
from ambid.physics.linear_model import ParameterSpec
from ambid.physics.magnet import Number

BEARING_NUMBERS: tuple[ParameterSpec, ...] = (
    ParameterSpec(
        name="k", unit="N m^2/A^2", meaning="hyperbolic law: gap inductance is k/(s + x), force k i^2/(2 (s + x)^2)",
        positive=True,
    ),
    ParameterSpec(name="s", unit="m", meaning="hyperbolic law: gap at position 0 (pair: of each magnet at the centre)"),
    ParameterSpec(
        name="L_g", unit="H", meaning="exponential law: gap inductance is L_g exp(-x/zeta)", positive=True
    ),
    ParameterSpec(name="zeta", unit="m", meaning="exponential law: its distance to 37 %", positive=True),
    ParameterSpec(name="sigma", unit="1/A^2", meaning="saturation: flux grows as i/sqrt(1 + sigma i^2)"),
    ParameterSpec(name="L_leak", unit="H", meaning="inductance that does not depend on the position"),
    ParameterSpec(name="L_rise", unit="H", meaning="its rise with the current, by i^2/(i^2 + i_knee^2)"),
    ParameterSpec(name="i_knee", unit="A", meaning="current at which half of that rise is reached", positive=True),
    ParameterSpec(name="i0", unit="A", meaning="pair: bias current of each magnet", positive=True),
    ParameterSpec(name="g", unit="m/s^2", meaning="gravity along the axis (unless given: one magnet 9.81, pair 0)"),
    ParameterSpec(name="a", unit="rad/s", meaning="pole of the eddy currents between current and force", positive=True),
    ParameterSpec(name="k_asym", unit="1", meaning="unequal pair: strengths are k (1 + k_asym) and k (1 - k_asym)"),
    ParameterSpec(name="i0_asym", unit="A", meaning="unequal pair: bias currents are i0 + i0_asym and i0 - i0_asym"),
    ParameterSpec(name="x_offset", unit="m", meaning="reading of the position sensor at the law's zero"),
    ParameterSpec(name="i_offset", unit="A", meaning="reading of the current sensor without current"),
    ParameterSpec(name="v_offset", unit="V", meaning="voltage in addition to the logged one"),
    ParameterSpec(name="v_drop", unit="V", meaning="voltage drop of the power stage, against the current"),
    ParameterSpec(name="i_drop", unit="A", meaning="current over which that drop changes its sign", positive=True),
    ParameterSpec(name="tau", unit="s", meaning="time constant in which a drifting force is forgotten", positive=True),
)  # fmt: skip
"""Every number that a rig may give of a nonlinear magnet, beside m, R and c."""

NOT_NEGATIVE = frozenset({"sigma", "L_leak", "L_rise"})
"""Those that may be zero, but not below."""


_UNITS = {spec.name: spec.unit for spec in BEARING_NUMBERS}
_FARTHEST = 1e6  # A: a load that this current does not hold is held by none


@dataclass(frozen=True, slots=True, kw_only=True)
class LawMagnet:
    """A `MagnetLaw` with numbers, its own co-energy, for real arguments; its positions are the sensor's, less
    `x_offset`.
    """

    law: MagnetLaw  # which co-energy
    # its numbers by name, SI; what the law does not have may be absent, and so may L_leak (0)
    values: Mapping[str, float]
    x_offset: float = 0.0  # what the position sensor shows at the law's zero, in m

    def __post_init__(self) -> None:
        law = self.law
        needed = [*law.names[:2], *(["i0"] if law.pair else []), *(["L_rise", "i_knee"] if law.rise else [])]
        needed += ["sigma"] if law.saturation else []
        missing = [name for name in needed if name not in self.values]
        if missing:
            raise ModelError(f"{law}: there is no value for {', '.join(missing)}. Give it")
        switches = {"sigma": law.saturation, "L_rise": law.rise, "i_knee": law.rise, "i0": law.pair}
        switches |= dict.fromkeys(("k_asym", "i0_asym"), law.asymmetric)
        kept = {n: float(self.values[n]) for n in law.names if n in self.values and switches.get(n, True)}
        positive = {law.names[0], "i0", "i_knee"} | ({law.names[1]} if law.pair or law.gap == "exponential" else set())
        for name, value in kept.items():
            least = 0.0 if name in positive or name in ("sigma", "L_leak", "L_rise") else -math.inf
            if not math.isfinite(value) or value < least or (name in positive and value == 0.0):
                rule = "positive" if name in positive else "a number, not negative" if least == 0.0 else "finite"
                raise ModelError(f"{name} is {value} {_UNITS[name]}; it must be {rule}. Correct {name}")
        if not (abs(kept.get("k_asym", 0.0)) < 1.0 and abs(kept.get("i0_asym", 0.0)) < kept.get("i0", math.inf)):
            raise ModelError(
                "k_asym must lie between -1 and 1, and i0_asym below i0: both magnets keep a strength and a bias."
                " Correct them"
            )
        if not math.isfinite(self.x_offset):
            raise ModelError(f"x_offset is {self.x_offset} m; it must be finite. Correct x_offset")
        object.__setattr__(self, "values", MappingProxyType(kept))

    @property
    def coenergy(self) -> LawMagnet:
        """Itself."""
        return self

    @property
    def vector(self) -> Array:
        """Numbers for compiled loops, shape (12,): the law's nine, whether exponential, whether a pair, x_offset."""
        more = [float(self.law.gap == "exponential"), float(self.law.pair), self.x_offset]
        return np.concatenate([self.law.vector(self.values), more])

    @property
    def range(self) -> tuple[float, float]:
        """Positions in m between which every gap is open; all where the law knows no pole face (exponential)."""
        if self.law.gap == "exponential":
            return -math.inf, math.inf
        s = self.values["s"]
        return self.x_offset - s, self.x_offset + s if self.law.pair else math.inf

    def value(self, x: Number, i: Number) -> Number:
        """Return W' in J at position `x` in m and axis current `i` in A."""
        energy: Number = self.law.value(x - self.x_offset, i, self.values)
        return energy

    def force(self, x: Number, i: Number) -> Number:
        """Return the force dW'/dx in N along +x at `x` in m and `i` in A."""
        force: Number = self._at(x, i)[0]
        return force

    def flux_linkage(self, x: Number, i: Number) -> Number:
        """Return the flux linkage dW'/di in V s at `x` in m and `i` in A, by the complex step."""
        step = 1e-30
        flux: Any = complex(self.law.value(x - self.x_offset, complex(i, step), self.values)).imag / step
        return flux  # type: ignore[no-any-return]

    def inductance(self, x: Number, i: Number | float = 0.0) -> Number:
        """Return L = dlambda/di in H at `x` in m and `i` in A."""
        inductance: Number = self._at(x, i)[3]
        return inductance

    def force_per_current(self, x: Number, i: Number) -> Number:
        """Return k_i = df/di = dlambda/dx in N/A at `x` in m and `i` in A."""
        factor: Number = self._at(x, i)[2]
        return factor

    def displacement_coefficient(self, x: Number, i: Number) -> Number:
        """Return k_x = -df/dx in N/m at `x` in m and `i` in A."""
        coefficient: Number = -self._at(x, i)[1]
        return coefficient

    def holding_current(self, x: float, load: float) -> float:
        """Return the axis current in A that holds `load` N (+x) at `x` m, of a pair with both magnets conducting."""
        from scipy.optimize import brentq

        low, high = self.range
        if not low < x < high:
            raise ModelError(f"position {x:g} m closes an air gap; it must lie between {low:g} and {high:g} m. Move it")

        def missing(i: float) -> float:
            return float(self.force(x, i)) + load

        if self.law.pair:
            bias, other = self.values["i0"], self.values.get("i0_asym", 0.0)
            ends = (-bias - other, bias - other)
            if not missing(ends[0]) <= 0.0 <= missing(ends[1]):
                raise ModelError(
                    f"a load of {load:g} N at {x:g} m needs more than the bias current of {bias:g} A; abs(i) must not"
                    " exceed the bias. Lower the load or raise the bias"
                )
        else:
            if load <= 0.0:
                raise ModelError(
                    f"a single magnet only attracts: it cannot hold a load of {load:g} N along its own pull; the load"
                    " must be positive (away from the magnet). Give gravity > 0"
                )
            most = 1.0
            while missing(most) > 0.0 and most < _FARTHEST:
                most *= 2.0
            if missing(most) > 0.0:
                raise ModelError(
                    f"no current up to {_FARTHEST:g} A holds a load of {load:g} N at {x:g} m. Correct the numbers"
                )
            ends = (0.0, most)
        return float(brentq(missing, *ends, xtol=1e-15 * max(map(abs, ends)), rtol=1e-15))

    def _at(self, x: Any, i: Any) -> Any:
        w, dw = np.zeros(len(ORDERS)), np.zeros((len(SLOPED), len(MAGNET_NUMBERS)))
        q, exponential = self.law.vector(self.values), self.law.gap == "exponential"
        coenergy_derivatives(float(x) - self.x_offset, float(i), q, exponential, self.law.pair, w, dw)
        return w.tolist()
