"""Guided commissioning: from a controller that answers to physical parameters that are tracked."""

from ambid.job.commission.guide import FILES, Commissioned, Declined, check_folder, commission
from ambid.job.commission.step import STEPS, Step, StepName, Wishes

__all__ = ["FILES", "STEPS", "Commissioned", "Declined", "Step", "StepName", "Wishes", "check_folder", "commission"]
