"""What an engineer's script does as a whole process: read a CSV, fit with SciPy, print.

Run: python scipy_command.py RECORD.csv GIVEN.npz [EVALUATIONS]

GIVEN.npz holds what ambid has to find by itself: start values, scales, noise weight, delay.
"""

from __future__ import annotations

import sys

import numpy as np

import scipy_baseline


def main(record, given, evaluations=None):
    known = np.load(given)
    with open(record, encoding="utf-8") as file:
        names = [cell.split(" [")[0] for cell in file.readline().strip().split(",")]
    table = np.loadtxt(record, delimiter=",", skiprows=1)
    column = {name: table[:, j] - table[:, j].mean() for j, name in enumerate(names)}
    skip, delay, n = int(known["skip"]), int(known["delay"]), len(table)
    u, y = column["voltage"][skip - delay : n - delay], np.column_stack([column["position"], column["current"]])[skip:]
    scale = {name: known[name] for name in ("theta", "state", "output", "disturbance")}
    period = (table[-1, 0] - table[0, 0]) / (n - 1)
    found = scipy_baseline.fit(
        known["start"], scipy_baseline.by_modes, u, y, period, scale, known["weight"],
        evaluations=None if evaluations is None else int(evaluations),
    )  # fmt: skip
    sd = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    for j, name in enumerate(("m", "k_x", "k_i", "R", "L")):
        print(f"{name:4} {found.x[j] * scale['theta'][j]:.6g} +- {sd[j] * abs(scale['theta'][j]):.2g}")


if __name__ == "__main__":
    main(*sys.argv[1:])
