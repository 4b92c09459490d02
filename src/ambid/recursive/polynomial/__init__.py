"""Recursive prediction error method for polynomial models (theory.md 2.5; Ljung & Söderström 1983, ch. 3)."""

from __future__ import annotations

from ambid.recursive.polynomial.recursive import RecursivePolynomial
from ambid.recursive.polynomial.state import Forgetting

__all__ = ["Forgetting", "RecursivePolynomial"]
