"""The ledger with a million estimates: time of one bearing's history, and estimates written a second.

``PYTHONPATH=. python bench/ledger.py [ESTIMATES] [BEARINGS]``: five values an estimate, in SQLite and, where its
programs are, in PostgreSQL. Figures are printed; none is asserted.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from ambid.ledger import open_ledger
from tests.ledger.entries import entry, parameter
from tests.ledger.server import absent, new_database, server

BATCH = 5_000
NAMES = ("m", "k_x", "k_i", "R", "L")


def measure(place: str, n: int, bearings: int) -> None:
    numbers = tuple(parameter(name, 80.0, 0.5) for name in NAMES)
    with open_ledger(place) as ledger:
        begin, cpu = time.perf_counter(), time.process_time()
        for first in range(0, n, BATCH):
            ledger.add(
                [
                    entry(k // bearings, f"B{k % bearings}", parameters=numbers, sha=str(k))
                    for k in range(first, first + BATCH)
                ]
            )
        taken, used = time.perf_counter() - begin, time.process_time() - cpu
    print(f"{n} estimates: {n / taken:.0f}/s ({n / used:.0f} a second of this process's computing time)")
    if "://" in place:  # as the server itself does within a minute of so many new rows
        import psycopg

        with psycopg.connect(place, autocommit=True) as server_:
            server_.execute("VACUUM ANALYZE")
    whole, plain = [], []
    with open_ledger(place, write=False) as ledger:
        for k in range(min(bearings, 60)):
            begin = time.perf_counter()
            found = ledger.history(f"B{k}")
            whole.append(time.perf_counter() - begin)
            begin = time.perf_counter()
            rows = one_series(ledger, f"B{k}")
            plain.append(time.perf_counter() - begin)
            assert len(rows) == len(found["k_i"].value)
    history, query = (1e3 * np.percentile(x, (5, 50)) for x in (whole, plain))
    print(
        f"  history of {len(found.estimates)} estimates: {history[1]:.1f} ms (5 %: {history[0]:.1f}); the query of "
        f"one of its {len(NAMES)} series: {query[1]:.2f} ms ({query[0]:.2f}); ratio {history[1] / query[1]:.1f}"
    )


def one_series(ledger: Any, name: str) -> Any:
    """Ask the driver for one number of a bearing over time."""
    of = f"(SELECT id FROM bearing WHERE name = '{name}')"
    asked = f"SELECT taken_at, value FROM value WHERE bearing = {of} AND name = 'k_i' ORDER BY taken_at"
    with ledger._reading() as connection:
        return connection.exec_driver_sql(asked).cursor.fetchall()


def main(n: int, bearings: int) -> None:
    with tempfile.TemporaryDirectory() as made:
        print("SQLite")
        measure(str(Path(made) / "l.db"), n, bearings)
    why = absent()
    if why is not None:
        print(f"PostgreSQL: {why}")
        return
    with server() as url:
        print("PostgreSQL")
        measure(new_database(url, "bench"), n, bearings)


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 1_000_000, int(sys.argv[2]) if sys.argv[2:] else 1_000)
