"""The jobs: `identify` (one record and one rig → physical parameters), `fit` (one record → a black-box model) and `frf`
(one record → a frequency response and what is fitted to it).

Command line, benchmarks and tests call these functions, so that what is tested is what runs.
"""

from ambid.job.blackbox import compare, fit, physics, read_data
from ambid.job.frequency import frf
from ambid.job.physical import identify, judged, load, signals_of

__all__ = ["compare", "fit", "frf", "identify", "judged", "load", "physics", "read_data", "signals_of"]
