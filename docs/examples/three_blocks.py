"""The thesis's three blocks
=========================

The three first-order blocks of the thesis (eq. 2.8-2.15): table 5.1 corrected, and the blocks found from a record.

The blocks are a fast form with a limit, which the result prints: the mass is taken as 1, so only ratios to it come out.
The simulated bench is built of such blocks, V -> i through the coil, i -> x, and x back to i.

Run: ``python docs/examples/three_blocks.py``
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.linalg import expm

from ambid import fit
from ambid.blackbox import BlackBoxFit
from ambid.blackbox.blocks import block_parameters

PRINTED = np.array([653.5, 1204.0, 0.003496, 1.752, 1.049, 0.07209])  # thesis eq. 5.4-5.6: K_a, a, K_b, b, K_c, c
NAMES = ("R", "L", "C", "K", "k_i", "k_x")
TABLE_5_1 = {"L": 1.5302, "k_x": 0.933}  # as printed; L is in millihenry, k_x does not follow from 5.5 and 5.6
BENCH = np.array([653.5, 1204.0, -30.0, 40.0, 2.0, 15.0])  # livelier blocks b and c behind the coil of eq. 5.4
RATE_HZ, N_SAMPLES, NOISE = 10_000.0, 10_000, (4e-3, 1e-4)  # rms of current in A and position in m


def bench(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate voltage, current and position of a bench of three blocks, exactly sampled, with white noise."""
    ka, a, kb, b, kc, c = BENCH
    flow = np.array([[-a, 0, 0, ka], [0, -b, kb, 0], [kc, kc, -c, 0], [0, 0, 0, 0]])  # i_a, i_b, x, held voltage
    step = expm(flow / RATE_HZ)
    rng = np.random.default_rng(seed)
    voltage = np.repeat(rng.choice([-1.0, 1.0], N_SAMPLES // 40), 40)
    states, state = np.empty((N_SAMPLES, 3)), np.zeros(3)
    for k, v in enumerate(voltage):
        states[k] = state
        state = step[:3] @ np.append(state, v)
    noise = rng.standard_normal((N_SAMPLES, 2)) * NOISE
    return voltage, states[:, 0] + states[:, 1] + noise[:, 0], states[:, 2] + noise[:, 1]


def main(seed: int = 1) -> tuple[dict[str, float], BlackBoxFit]:
    """Print table 5.1 corrected and the blocks of the simulated bench; return both."""
    corrected = dict(zip(NAMES, block_parameters(PRINTED)[0].tolist(), strict=True))
    print("table 5.1   corrected   printed")
    for name, value in corrected.items():
        print(f"{name:10} {value:10.5g}   {TABLE_5_1.get(name, '')}")

    voltage, current, position = bench(seed)
    found = fit(
        {"voltage": voltage, "current": current, "position": position},
        structure="blocks", input="voltage", output=("current", "position"), orders="nk=0", open_loop=True,
        rate_hz=RATE_HZ, units={"voltage": "V", "current": "A", "position": "m"},
    )  # fmt: skip
    truth = dict(zip(NAMES, block_parameters(BENCH)[0].tolist(), strict=True))
    print("\nsimulated bench, truth", ", ".join(f"{k} {v:.4g}" for k, v in truth.items()))
    print(found.summary())
    print(found.details["limit"])
    return corrected, found


def draw(done: tuple[dict[str, float], BlackBoxFit]) -> Figure:
    """Draw how far each parameter of the simulated bench is from the truth, with its 95 % interval."""
    figure = Figure(figsize=(7.0, 2.8), layout="constrained")
    axes = figure.subplots()
    found, truth = done[1].details["parameters"], block_parameters(BENCH)[0].tolist()
    off = [100.0 * (p["value"] / true - 1.0) for p, true in zip(found.values(), truth, strict=True)]
    bars = [196.0 * p["sd"] / abs(true) for p, true in zip(found.values(), truth, strict=True)]
    axes.errorbar(list(found), off, yerr=bars, fmt="o", capsize=4)
    axes.axhline(0.0, color="0.3", linewidth=0.8)
    axes.set_ylabel("error in %, with 95 % interval")
    return figure


if __name__ == "__main__":
    figure = draw(main())
