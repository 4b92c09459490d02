"""Alarms over simulated fleets of three years: found and missed, false ones, causes and dates.

``PYTHONPATH=. python bench/monitoring.py [BEARINGS] [SEED...]``; what is simulated stands in tests/ledger/simulated.py.
Figures are printed; none is asserted.
"""

from __future__ import annotations

import sys

from tests.ledger.simulated import YEARS, fleet, judge


def main(n: int, seeds: list[int]) -> None:
    for seed in seeds:
        score = judge(fleet(n, seed))
        print(
            f"seed {seed}: {score.found} of {score.due} alarms found, {score.false} false in {n * YEARS:.0f} "
            f"bearing-years, cause right {score.cause}, date right {score.dated} of {score.found}"
        )
        for line in score.wrong:
            print("   ", line)


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 200, [int(x) for x in sys.argv[2:]] or [11, 12, 13])
