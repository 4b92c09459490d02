"""Physical parameters of one axis: linear grey box, nonlinear magnet, coil, three blocks, physics from a black box."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.bearing.coil import coil_least_squares as coil_least_squares
    from ambid.bearing.linear import greybox as greybox
    from ambid.bearing.magnet_result import NonlinearBearingEstimate as NonlinearBearingEstimate
    from ambid.bearing.measured import Measured as Measured
    from ambid.bearing.physical import physical_parameters as physical_parameters

__getattr__, __dir__, __all__ = exports(__name__)
