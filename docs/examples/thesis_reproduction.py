"""The thesis, repeated
====================

The thesis's identification repeated: table 4.1 -> matrices (4.10) -> noisy record -> parameters, beside its (4.11).

The thesis simulates a rig of known parameters, adds white noise, and trains a network whose weights are the state
matrices. Here the same rig is simulated (open loop, 10 kHz, 2 s, multisine 1 to 2000 Hz, noise 40 dB under both
outputs) and its record goes through the main job.

Run: ``python docs/examples/thesis_reproduction.py``
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ambid import identify
from ambid.estimation.estimate import Estimate
from ambid.physics.linear_model import model
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.signals import multisine
from ambid.simulation import noise_at_snr, simulate_preset

# What the thesis prints: A and B of eq. 4.10 (from table 4.1) and of eq. 4.11 (identified by its network).
PRINTED_4_10 = {"a21": -5872.2, "a23": -3100.8, "a32": 5202.7, "a33": -20.97, "b3": 16.78}
PRINTED_4_11 = {"a21": -6231.1, "a23": -3279.2, "a32": 5315.7, "a33": -18.9, "b3": 16.61}

RATE_HZ, N_SAMPLES, SNR_DB = 10_000.0, 20_000, 40.0


def parameters_of(a: dict[str, float]) -> dict[str, float]:
    """Solve the five entries of thesis eq. 4.8 (c = 0) for the five parameters.

    L = 1/b3, R = -a33 L, k_i = -a32 L; the mass comes from the same k_i in the force: m = k_i/a23, k_x = -a21 m.
    """
    inductance = 1.0 / a["b3"]
    k_i = -a["a32"] * inductance
    m = k_i / a["a23"]
    return {"m": m, "k_x": -a["a21"] * m, "k_i": k_i, "R": -a["a33"] * inductance, "L": inductance}


def entries_of(parameters: dict[str, float]) -> dict[str, float]:
    """Return the five entries of A and B (thesis eq. 4.8)."""
    space = model("one-axis").matrices(parameters)
    return {"a21": space.A[1, 0], "a23": space.A[1, 2], "a32": space.A[2, 1], "a33": space.A[2, 2], "b3": space.B[2, 0]}


def identified(seed: int) -> Estimate:
    """Simulate the rig of table 4.1 as corrected (docs/theory.md sec. 6), and identify its record."""
    rig = preset("thesis")
    voltage = multisine(N_SAMPLES, RATE_HZ, band=(1.0, 2000.0), amplitude=1.0, shape="pink", seed=seed)
    clean = simulate_preset(rig, voltage, seed=seed, noise=Noise())
    noisy = simulate_preset(rig, voltage, seed=seed, noise=noise_at_snr(clean, SNR_DB))
    return identify(noisy.record)


def main(seed: int = 1) -> dict[str, dict[str, float]]:
    """Print both comparisons; return truth, the thesis's identified parameters, and ambid's with their sd."""
    truth = {k: float(v) for k, v in preset("thesis").parameters.items()}
    entries = entries_of(truth)
    print("Table 4.1 (corrected) gives the matrices of eq. 4.10:")
    for name, printed in PRINTED_4_10.items():
        print(f"  {name:4} {entries[name]:10.2f}   printed {printed:10.2f}")
    poles = np.linalg.eigvals(model("one-axis").matrices(truth).A)
    print("  poles [rad/s]:", ", ".join(f"{p:.4g}" for p in sorted(poles, key=lambda p: -p.real)))

    thesis, estimate = parameters_of(PRINTED_4_11), identified(seed)
    found = {p.name: p.value for p in estimate.parameters}
    sd = {p.name: p.sd for p in estimate.parameters}
    print(f"\n{'':4} {'truth':>9} {'thesis 4.11':>12} {'error':>8} {'ambid':>11} {'sd':>9} {'error':>8}")
    for p in estimate.parameters:
        if p.role == "fixed":
            continue
        true = truth[p.name]
        print(
            f"{p.name:4} {true:9.4g} {thesis[p.name]:12.4g} {thesis[p.name] / true - 1:8.2%}"
            f" {p.value:11.5g} {p.sd:9.2g} {p.value / true - 1:8.3%}  {p.unit}"
        )
    print("checks:", ", ".join(f"{name} {'passed' if c.passed else 'FAILED'}" for name, c in estimate.checks.items()))
    return {"truth": truth, "thesis": thesis, "ambid": found, "sd": sd, "entries": entries}


def draw(found: dict[str, dict[str, float]]) -> Figure:
    """Draw the errors of the parameters, those of the thesis beside those found here."""
    figure = Figure(figsize=(7.0, 2.8), layout="constrained")
    axes = figure.subplots()
    names = list(found["thesis"])
    for shift, who in ((-0.2, "thesis"), (0.2, "ambid")):
        errors = [100.0 * abs(found[who][name] / found["truth"][name] - 1.0) for name in names]
        axes.bar([k + shift for k in range(len(names))], errors, width=0.35, label=who)
    axes.set_xticks(range(len(names)), names)
    axes.set_yscale("log")
    axes.set_ylabel("error in %")
    axes.legend()
    return figure


if __name__ == "__main__":
    figure = draw(main())
