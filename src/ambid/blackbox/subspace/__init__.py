"""Subspace identification: state-space models without a search, for stable and unstable plants."""

from ambid.blackbox.subspace.estimate import cva, moesp, n4sid, pbsid
from ambid.blackbox.subspace.family import OrderModel, subspace_models
from ambid.blackbox.subspace.refined import sspem

__all__ = ["OrderModel", "cva", "moesp", "n4sid", "pbsid", "sspem", "subspace_models"]
