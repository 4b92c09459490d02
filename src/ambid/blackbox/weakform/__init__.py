"""Weak form: differential equations integrated against test functions, so that no measured signal is differentiated."""

from ambid.blackbox.weakform.ode import weakform
from ambid.blackbox.weakform.physics import WeakFit, weak_parameters

__all__ = ["WeakFit", "weak_parameters", "weakform"]
