"""Responses without a parametric model: impulse, step, correlation."""

from ambid.blackbox.nonparametric.correlation import Correlation, correlation_analysis
from ambid.blackbox.nonparametric.impulse import ImpulseResponse, impulse_response, rfir
from ambid.blackbox.nonparametric.step import StepResponse, measured_step, step_response

__all__ = [
    "Correlation",
    "ImpulseResponse",
    "StepResponse",
    "correlation_analysis",
    "impulse_response",
    "measured_step",
    "rfir",
    "step_response",
]
