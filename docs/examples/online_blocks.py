"""Three blocks while a coil warms
===============================

The thesis's three blocks on-line (fig. 5.8): a coil warms by 20 % while its block is followed.

The bench is built of three first-order blocks as in three_blocks.py, excited in open loop; the pole of the coil, R/L,
rises linearly. Voltage, current and position go through one Kalman-Bucy filter each, then into the recursions. The
blocks have a limit, which the result prints: the mass is taken as 1.

Run: ``python docs/examples/online_blocks.py``
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from scipy.linalg import expm

from ambid.recursive.blocks import OnlineThreeBlocks

COIL = (653.5, 1204.0)  # K_a, a of thesis eq. 5.4: R = a/K_a, L = 1/K_a
OTHERS = (-30.0, 40.0, 2.0, 15.0)  # K_b, b, K_c, c, livelier than the thesis's
RATE_HZ, NOISE, STEP = 10_000.0, (4e-3, 1e-4), 500  # rms of current in A and position in m; samples of one coil
WARMER, SECONDS, MEMORY_S = 0.20, 20.0, 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Resistance now and then: time in s, estimate, its standard deviation and truth in ohm, shape (n,) each."""

    t: np.ndarray
    R: np.ndarray
    sd: np.ndarray
    truth: np.ndarray


def bench(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate voltage, current and position; the coil is exact and constant for STEP samples at a time."""
    (ka, a), (kb, b, kc, c) = COIL, OTHERS
    rng, n = np.random.default_rng(seed), round(SECONDS * RATE_HZ)
    voltage = np.repeat(rng.choice([-1.0, 1.0], n // 40), 40)
    states, state = np.empty((n, 3)), np.zeros(3)
    for k, v in enumerate(voltage):
        if k % STEP == 0:
            pole = a * (1 + WARMER * k / n)
            flow = np.array([[-pole, 0, 0, ka], [0, -b, kb, 0], [kc, kc, -c, 0], [0, 0, 0, 0]])
            step = expm(flow / RATE_HZ)[:3]
        states[k] = state
        state = step @ np.append(state, v)
    noise = rng.standard_normal((n, 2)) * NOISE
    return voltage, states[:, 0] + states[:, 1] + noise[:, 0], states[:, 2] + noise[:, 1]


def main(seed: int = 1) -> Result:
    """Feed the record second by second and print the resistance beside the truth."""
    voltage, current, position = bench(seed)
    blocks = OnlineThreeBlocks(RATE_HZ, memory_s=MEMORY_S, open_loop=True)
    rows, second = [], round(RATE_HZ)
    for last in range(second, voltage.size + 1, second):
        part = slice(last - second, last)
        blocks.update(voltage[part], current[part], position[part])
        R = blocks.result().parameters["R"]
        true = (1 + WARMER * last / voltage.size) * COIL[1] / COIL[0]
        rows.append((last / RATE_HZ, R.value, R.sd, true))
        if last % (4 * second) == 0:
            print(f"{last / RATE_HZ:4.0f} s  R {R.value:.4f} ± {R.sd:.4f} ohm, truth {true:.4f}")
    print(blocks.result())
    t, found, sd, truth = np.array(rows).T
    return Result(t=t, R=found, sd=sd, truth=truth)


def draw(result: Result) -> Figure:
    """Draw the resistance with its 95 % band beside the truth."""
    figure = Figure(figsize=(7.0, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(result.t, result.truth, color="0.4", linestyle="--", label="truth")
    axes.plot(result.t, result.R, label="estimate")
    axes.fill_between(result.t, result.R - 1.96 * result.sd, result.R + 1.96 * result.sd, alpha=0.3, label="95 %")
    axes.set_xlabel("time in s")
    axes.set_ylabel("R in ohm")
    axes.legend()
    return figure


if __name__ == "__main__":
    figure = draw(main())
