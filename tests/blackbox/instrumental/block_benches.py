"""Simulated benches of the three-block model, whose truth is known."""

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit

RATE = 1e4
TRUTH = np.array([653.5, 1204.0, -30.0, 40.0, 2.0, 15.0])  # K_a, a, K_b, b, K_c, c; the coil of eq. 5.4
NOISE = np.array([4e-3, 1e-4])


def record(seed, n, *, truth=TRUTH, noise=NOISE, gain=0.0, rate=RATE, hold=40, slope=0.0, until=None):
    """Voltage, current, position and reference; the coil's resistance grows by `slope` from end to end.

    From sample `until` on the reference stands still.
    """
    ka, a, kb, b, kc, c = truth
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-1.0, 1.0], n // hold + 1), hold)[:n]
    r[until or n :] = 0.0
    e = rng.standard_normal((n, 2)) * noise
    y, x, drive, step = np.empty((n, 3)), np.zeros(3), r - gain * e[:, 1], 500 if slope else n
    for k in range(0, n, step):
        M = np.zeros((4, 4))
        M[:3] = [[-a * (1 + slope * k / n), 0, 0, ka], [0, -b, kb, 0], [kc, kc, -c, 0]]
        E = expm(M / rate)
        values, vectors = np.linalg.eig(E[:3, :3] - gain * np.outer(E[:3, 3], [0.0, 0.0, 1.0]))
        into = np.linalg.solve(vectors, np.column_stack([E[:3, 3], x]).astype(complex))
        modes = [
            lfilter([0.0, 1.0], [1.0, -p], g * drive[k : k + step], zi=[z])
            for p, (g, z) in zip(values, into, strict=True)
        ]
        y[k : k + step] = (np.column_stack([m for m, _ in modes]) @ vectors.T).real
        x = (vectors @ [left[0] for _, left in modes]).real
    v = drive - gain * y[:, 2]
    return v + 2.0, y[:, 0] + y[:, 1] + e[:, 0] + 0.2, y[:, 2] + e[:, 1] + 0.01, r


def io(v, i, x, reference=None, *, rate=RATE, open_loop=False):
    """Columns of a record as the estimator takes them."""
    r = np.empty((v.size, 0)) if reference is None else np.reshape(reference, (v.size, -1))
    return IOData(
        u=v[:, None], y=np.stack([i, x], axis=1), dt=1 / rate, inputs=("voltage",), outputs=("current", "position"),
        units={"voltage": "V", "current": "A", "position": "m"}, open_loop=open_loop, reference=r,
        references=tuple(f"r{k}" for k in range(r.shape[1])),
        record={"samples": v.size, "rate_hz": rate, "sha256": None, "file": None, "history": []},
    )  # fmt: skip


def table(found: BlackBoxFit, which="coefficients"):
    """Values and standard deviations of a table in the details of a fit."""
    rows = found.details[which].values()
    return np.array([r["value"] for r in rows]), np.array([r["sd"] for r in rows])
