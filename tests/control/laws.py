"""Plants of presets as controllers see them, and state feedback with an observer for one axis (LQG), as a law."""

import numpy as np
from scipy.linalg import solve_discrete_are

import ambid
from ambid.control.closed import Plant
from ambid.control.gain_sets import SampledPlant
from ambid.physics.law import StateLaw
from ambid.physics.linear_model import model
from ambid.rig.draft import rig_of_preset
from ambid.simulation.rotor_bench import RotorBench


def of_preset(name, delay=None):
    bench = ambid.preset(name)
    if bench.rotor is not None:
        turning = RotorBench.of(rig_of_preset(bench), None, True)
        of, theta = turning.model, turning.plant.parameters
    else:
        of, theta = model("one-axis"), bench.parameters
    late = bench.loop.delay if delay is None else delay
    return bench, Plant(model=of, theta=theta, delays=np.full(len(of.inputs), late), rate_hz=bench.rate_hz)


def riccati(A, B, Q, R):
    """Return P of the discrete Riccati equation, and its gain (R + B'P B)⁻¹ B'P A."""
    P = solve_discrete_are(A, B, Q, R)
    return P, np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def observer_law(name, *, effort=1.0, disturbance=1.0):
    """Return a plant of one axis and its law: the position's integral is among the states, and nothing winds up."""
    bench, plant = of_preset(name)
    of, limits = SampledPlant.of(plant), bench.limits
    n, x, i, u, rate = of.A.shape[0], limits.position[1], limits.current[1], limits.voltage[1], 1e-3
    A, B, Q = np.eye(n + 1), np.vstack([of.B, [[0.0]]]), np.eye(n + 1)
    A[:n, :n], A[n, :n] = of.A, rate / x * of.C[0]
    Q[:n, :n] = of.C.T @ np.diag([x**-2, i**-2]) @ of.C
    K = u * riccati(A, B * u, Q, np.eye(1) * effort**2)[1]
    driven = of.B * (1e-3 * u * disturbance)
    size = np.max(np.abs(driven))
    weight = size / np.maximum([bench.noise.position, bench.noise.current], [1e-4 * x, 1e-4 * i])
    C = weight[:, None] * of.C
    P, _ = riccati(of.A.T, C.T, driven @ driven.T / size**2, np.eye(2))
    M = np.linalg.solve(C @ P @ C.T + np.eye(2), C @ P).T * weight
    moved, seen = of.A - of.B @ K[:, :n], np.eye(n) - M @ of.C
    law = StateLaw(
        A=np.block([[moved @ seen, -of.B @ K[:, n:]], [np.zeros((1, n)), np.eye(1)]]),
        B=np.vstack([moved @ M, [[rate / x, 0.0]]]),
        C=np.hstack([-K[:, :n] @ seen, -K[:, n:]]),
        D=-K[:, :n] @ M,
        G=np.vstack([of.B, -rate / K[:, n:]]),
        rate_hz=plant.rate_hz,
    )
    assert np.max(np.abs(np.linalg.eigvals(of.closed(law)))) < 1.0
    return plant, law
