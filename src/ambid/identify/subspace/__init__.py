"""Subspace identification: state-space models without a search, for stable and unstable plants."""

from ambid.identify.subspace.estimate import OrderModel, cva, moesp, n4sid, pbsid, subspace_models

__all__ = ["OrderModel", "cva", "moesp", "n4sid", "pbsid", "subspace_models"]
