"""Subspace identification: state-space models without a search, for stable and unstable plants."""

from ambid.identify.subspace.estimate import cva, moesp, n4sid, pbsid
from ambid.identify.subspace.family import OrderModel, subspace_models

__all__ = ["OrderModel", "cva", "moesp", "n4sid", "pbsid", "subspace_models"]
