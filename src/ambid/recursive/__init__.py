"""Estimators that go sample by sample: adaptive filters, Kalman filters, recursive polynomial models."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.recursive.estimator import RecursiveEstimator as RecursiveEstimator
    from ambid.recursive.joint import JointEkf as JointEkf
    from ambid.recursive.joint import JointStart as JointStart
    from ambid.recursive.joint import JointUkf as JointUkf
    from ambid.recursive.kalman import KalmanFilter as KalmanFilter
    from ambid.recursive.kalman import LinearState as LinearState
    from ambid.recursive.kalman import constant_velocity as constant_velocity
    from ambid.recursive.kalman import linear_state as linear_state
    from ambid.recursive.lines import Event as Event
    from ambid.recursive.lines import Track as Track
    from ambid.recursive.lines import TrackLine as TrackLine
    from ambid.recursive.polynomial import RecursivePolynomial as RecursivePolynomial
    from ambid.recursive.regression import Lms as Lms
    from ambid.recursive.regression import Nlms as Nlms
    from ambid.recursive.regression import RecursiveArx as RecursiveArx
    from ambid.recursive.regression import RecursiveLeastSquares as RecursiveLeastSquares

__getattr__, __dir__, __all__ = exports(__name__)
