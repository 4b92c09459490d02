"""Joint filters of plant states and physical parameters: extended and unscented."""

from ambid.track.joint.ekf import JointEkf
from ambid.track.joint.filter import JointFilter, rates_of
from ambid.track.joint.start import JointStart, start_from
from ambid.track.joint.ukf import JointUkf

__all__ = ["JointEkf", "JointFilter", "JointStart", "JointUkf", "rates_of", "start_from"]
