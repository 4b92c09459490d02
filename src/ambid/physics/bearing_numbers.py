"""The numbers of a nonlinear bearing: magnet law (`coenergy_law`), gravity, eddy pole and offsets, with units.

Mass, resistance and damping are those of the linear model and stand with it (`one_axis`).
"""

from __future__ import annotations

from ambid.physics.linear_model import ParameterSpec

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
)  # fmt: skip
"""Every number that a rig may give of a nonlinear magnet, beside m, R and c."""

NOT_NEGATIVE = frozenset({"sigma", "L_leak", "L_rise"})
"""Those that may be zero, but not below."""
