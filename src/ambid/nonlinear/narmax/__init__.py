"""NARMAX: polynomial and rational difference equations with a noise model; terms chosen by orthogonal least squares."""

from ambid.nonlinear.narmax.estimate import narmax
from ambid.nonlinear.narmax.model import PolynomialNarmax
from ambid.nonlinear.narmax.selection import Selection, select_terms
from ambid.nonlinear.narmax.terms import Factor, Term

__all__ = ["Factor", "PolynomialNarmax", "Selection", "Term", "narmax", "select_terms"]
