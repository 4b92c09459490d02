"""Judging black-box fits: fit, criteria, residual tests, feedback, identifiability, k-step prediction, sensitivity."""

from ambid.validate.blackbox.judge import judged

__all__ = ["judged"]
