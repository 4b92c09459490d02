"""Measured records, which are public and not part of this repository; tests that need them skip where they are absent.

`AMBID_RECORDS` names their folder; without it, ``shared/data`` beside the checkout is looked at. It holds

- ``maglev/``: a steel ball under one magnet, from the public student laboratory repository 062020-Lab-Mechatronics;
- ``benchmarks/``: Silverbox and coupled electric drives (nonlinearbenchmark.org; Wigren and Schoukens 2013, 2017), ball
  and beam and the hair dryer (DaISy, the database for the identification of systems).
"""

from __future__ import annotations

import os
from pathlib import Path

RECORDS = Path(os.environ.get("AMBID_RECORDS") or Path(__file__).resolve().parents[2] / "shared" / "data")
MAGLEV, BENCHMARKS = RECORDS / "maglev", RECORDS / "benchmarks"
ABSENT = "the public records of tests/measured.py are not here; AMBID_RECORDS names their folder"
