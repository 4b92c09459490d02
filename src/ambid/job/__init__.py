"""The jobs: `identify` (one record and one rig → physical parameters) and `fit` (one record → a black-box model).

Command line, benchmarks and tests call these functions, so that what is tested is what runs.
"""

from ambid.job.blackbox import compare, fit, read_data
from ambid.job.physical import identify, judged, load, signals_of

__all__ = ["compare", "fit", "identify", "judged", "load", "read_data", "signals_of"]
