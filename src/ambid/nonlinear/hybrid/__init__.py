"""Hybrid NARMAX model: polynomial, network for what it leaves, linear noise model (thesis eqs 3.23-3.24)."""

from ambid.nonlinear.hybrid.estimate import hybrid
from ambid.nonlinear.hybrid.model import HybridNarmax

__all__ = ["HybridNarmax", "hybrid"]
