"""Black-box models from records and from frequency responses, one or two files a method."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.blackbox.convert import to_control as to_control
    from ambid.blackbox.data import IOData as IOData
    from ambid.blackbox.fit import BlackBoxFit as BlackBoxFit
    from ambid.blackbox.frequency import frf_ml as frf_ml
    from ambid.blackbox.frequency_subspace import best_conditioned as best_conditioned
    from ambid.blackbox.frequency_subspace import block_rows_condition as block_rows_condition
    from ambid.blackbox.frequency_subspace import frf_subspace as frf_subspace
    from ambid.blackbox.instrumental import cliv as cliv
    from ambid.blackbox.instrumental import iv4 as iv4
    from ambid.blackbox.instrumental_continuous import clsrivc as clsrivc
    from ambid.blackbox.instrumental_continuous import srivc as srivc
    from ambid.blackbox.model import PolynomialModel as PolynomialModel
    from ambid.blackbox.model import Polynomials as Polynomials
    from ambid.blackbox.model import StateSpaceModel as StateSpaceModel
    from ambid.blackbox.model import TransferModel as TransferModel
    from ambid.blackbox.polynomial import ararmax as ararmax
    from ambid.blackbox.polynomial import ararx as ararx
    from ambid.blackbox.polynomial import arma as arma
    from ambid.blackbox.polynomial import armax as armax
    from ambid.blackbox.polynomial import arx as arx
    from ambid.blackbox.polynomial import bj as bj
    from ambid.blackbox.polynomial import fir as fir
    from ambid.blackbox.polynomial import oe as oe
    from ambid.blackbox.state_space_search import sspem as sspem
    from ambid.blackbox.subspace import cva as cva
    from ambid.blackbox.subspace import moesp as moesp
    from ambid.blackbox.subspace import n4sid as n4sid
    from ambid.blackbox.subspace import pbsid as pbsid
    from ambid.blackbox.subspace import subspace_models as subspace_models
    from ambid.blackbox.weak_form import weakform as weakform

__getattr__, __dir__, __all__ = exports(__name__)
