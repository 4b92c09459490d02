"""Guided commissioning: from a controller that answers to physical parameters that are tracked."""

from ambid.job.commission.folder import FILES, check_folder
from ambid.job.commission.guide import Commissioned, Declined, commission
from ambid.job.commission.step import STEPS, Step, StepName, Wishes

__all__ = ["FILES", "STEPS", "Commissioned", "Declined", "Step", "StepName", "Wishes", "check_folder", "commission"]
