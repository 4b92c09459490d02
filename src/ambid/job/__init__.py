"""The jobs: `identify` (one record and one rig → physical parameters), `fit` (one record → a black-box model),
`fit_nonlinear` (records → a nonlinear model) and `frf` (one record → a frequency response and what is fitted to it).

Command line, benchmarks and tests call these functions, so that what is tested is what runs.
"""

from ambid.job.blackbox import compare, fit, physics, read_data
from ambid.job.frequency import frf
from ambid.job.nonlinear import fit_nonlinear
from ambid.job.physical import identify, judged, load, signals_of

__all__ = ["compare", "fit", "fit_nonlinear", "frf", "identify", "judged", "load", "physics", "read_data", "signals_of"]
