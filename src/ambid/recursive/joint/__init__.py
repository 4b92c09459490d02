"""Joint filters of plant states and physical parameters: extended and unscented."""

from ambid.recursive.joint.ekf import JointEkf
from ambid.recursive.joint.filter import JointFilter, rates_of
from ambid.recursive.joint.start import JointStart, start_from
from ambid.recursive.joint.ukf import JointUkf

__all__ = ["JointEkf", "JointFilter", "JointStart", "JointUkf", "rates_of", "start_from"]
