"""NARMAX: polynomial and rational difference equations with a noise model; terms chosen by orthogonal least squares."""

from ambid.identify.narmax.estimate import narmax
from ambid.identify.narmax.model import PolynomialNarmax
from ambid.identify.narmax.selection import Selection, select_terms
from ambid.identify.narmax.terms import Factor, Term

__all__ = ["Factor", "PolynomialNarmax", "Selection", "Term", "narmax", "select_terms"]
