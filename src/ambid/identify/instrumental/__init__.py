"""Instrumental variables: iv4 and srivc without feedback; cliv, clsrivc and two_stage with the reference of a loop."""

from ambid.identify.instrumental.cliv import cliv
from ambid.identify.instrumental.clsrivc import clsrivc
from ambid.identify.instrumental.iv4 import iv4
from ambid.identify.instrumental.srivc import srivc
from ambid.identify.instrumental.two_stage import two_stage

__all__ = ["cliv", "clsrivc", "iv4", "srivc", "two_stage"]
