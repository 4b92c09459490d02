"""Instrumental variables: iv4 and srivc without feedback; cliv, clsrivc and two_stage with the reference of a loop."""

from ambid.blackbox.instrumental.cliv import cliv
from ambid.blackbox.instrumental.clsrivc import clsrivc
from ambid.blackbox.instrumental.iv4 import iv4
from ambid.blackbox.instrumental.srivc import srivc
from ambid.blackbox.instrumental.two_stage import two_stage

__all__ = ["cliv", "clsrivc", "iv4", "srivc", "two_stage"]
