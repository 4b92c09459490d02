"""Estimators that go sample by sample: adaptive filters, Kalman filters, recursive polynomial models."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.recursive.arx import RecursiveArx as RecursiveArx
    from ambid.recursive.arx import RecursiveIvArx as RecursiveIvArx
    from ambid.recursive.blocks import OnlineThreeBlocks as OnlineThreeBlocks
    from ambid.recursive.estimator import RecursiveEstimator as RecursiveEstimator
    from ambid.recursive.filters.kalman import KalmanFilter as KalmanFilter
    from ambid.recursive.filters.kalman import LinearState as LinearState
    from ambid.recursive.filters.kalman import constant_velocity as constant_velocity
    from ambid.recursive.filters.kalman import linear_state as linear_state
    from ambid.recursive.filters.scalar import PassiveLowpass as PassiveLowpass
    from ambid.recursive.filters.scalar import ScalarKalman as ScalarKalman
    from ambid.recursive.filters.synchronous import SynchronousFilter as SynchronousFilter
    from ambid.recursive.fusion.fusion import SensorFusion as SensorFusion
    from ambid.recursive.fusion.motion import free_motion as free_motion
    from ambid.recursive.fusion.motion import levitated_motion as levitated_motion
    from ambid.recursive.fusion.sensor import FusedSensor as FusedSensor
    from ambid.recursive.instrumental import RecursiveInstrumentalVariables as RecursiveInstrumentalVariables
    from ambid.recursive.joint.ekf import JointEkf as JointEkf
    from ambid.recursive.joint.start import JointStart as JointStart
    from ambid.recursive.joint.ukf import JointUkf as JointUkf
    from ambid.recursive.lines import Event as Event
    from ambid.recursive.lines import Track as Track
    from ambid.recursive.lines import TrackLine as TrackLine
    from ambid.recursive.polynomial import RecursivePolynomial as RecursivePolynomial
    from ambid.recursive.regression import Lms as Lms
    from ambid.recursive.regression import Nlms as Nlms
    from ambid.recursive.regression import RecursiveLeastSquares as RecursiveLeastSquares

__getattr__, __dir__, __all__ = exports(__name__)
