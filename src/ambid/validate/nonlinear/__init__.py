"""Judging nonlinear fits: fit, criteria, linear and nonlinear residual tests, free run, extrapolation, feedback."""

from ambid.validate.nonlinear.judge import judged, validation

__all__ = ["judged", "validation"]
