"""Black-box models from records and from frequency responses, one or two files a method."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.blackbox.data import IOData as IOData
    from ambid.blackbox.fit import BlackBoxFit as BlackBoxFit
    from ambid.blackbox.model import BlackBoxModel as BlackBoxModel
    from ambid.blackbox.model import PolynomialModel as PolynomialModel
    from ambid.blackbox.model import Polynomials as Polynomials
    from ambid.blackbox.model import StateSpaceModel as StateSpaceModel
    from ambid.blackbox.model import TransferModel as TransferModel
    from ambid.blackbox.prediction import to_control as to_control

__getattr__, __dir__, __all__ = exports(__name__)
