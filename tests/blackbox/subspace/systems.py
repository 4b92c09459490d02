"""Small systems of known truth in innovations form, and records of them with and without a loop."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.signal import lfilter

from ambid.blackbox.data import IOData
from ambid.blackbox.model import StateSpaceModel

DT = 0.01

COLOURED = StateSpaceModel(  # two well damped poles and a slow one, noise with a colour of its own
    A=[[1.5, -0.7, 0], [1, 0, 0], [0, 0.1, 0.6]],
    B=[[1.0], [0], [0.3]],
    C=[[1.0, 0.5, 1]],
    D=[[0.0]],
    K=[[0.5], [0.2], [0.1]],
    dt=DT,
)
UNSTABLE = StateSpaceModel(  # poles 1.05 and 0.7; held by `hold`
    A=[[1.05, 0.2], [0, 0.7]],
    B=[[0.1], [0.5]],
    C=[[1.0, 0]],
    D=[[0.0]],
    K=[[0.6], [0.1]],
    dt=DT,
)
SERIES = StateSpaceModel(
    A=[[1.6, -0.8], [1, 0]], B=np.zeros((2, 0)), C=[[1.0, 0.3]], D=np.zeros((1, 0)), K=[[0.8], [0.2]], dt=DT
)


def modal(n: int, n_u: int, n_y: int, seed: int) -> StateSpaceModel:
    """A system of `n` / 2 damped pairs, evenly spread, that all inputs move and all outputs see."""
    rng = np.random.default_rng(seed)
    A = np.zeros((n, n))
    for k in range(n // 2):
        angle, radius = 0.25 + 0.7 * k, 0.93
        c, s = radius * np.cos(angle), radius * np.sin(angle)
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[c, s], [-s, c]]
    B, C = rng.standard_normal((n, n_u)), rng.standard_normal((n_y, n))
    P = solve_discrete_are(A.T, C.T, 0.05 * np.eye(n), 0.25 * np.eye(n_y))
    K = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + 0.25 * np.eye(n_y))
    return StateSpaceModel(A=A, B=B, C=C, D=np.zeros((n_y, n_u)), K=K, dt=DT)


def record(
    of: StateSpaceModel,
    n: int,
    seed: int,
    *,
    sd: float = 0.5,
    hold: float | None = None,
    open_loop: bool = True,
    offsets: tuple[float, float] = (3.0, -2.0),
    units: tuple[float, float] = (1.0, 1.0),
) -> IOData:
    """Simulate `n` samples with white inputs; with `hold` the first input is excitation - hold y of the same sample."""
    rng = np.random.default_rng(seed)
    r = rng.standard_normal((n, of.n_inputs))
    e = sd * rng.standard_normal((n, of.n_outputs))
    gain = np.zeros((of.n_inputs, of.n_outputs))
    if hold is not None:
        gain[0, 0] = hold
    A, E = of.A - of.B @ gain @ of.C, np.hstack([of.B, of.K - of.B @ gain])
    values, vectors = np.linalg.eig(A)
    drive = np.hstack([r, e]) @ np.linalg.solve(vectors, E.astype(complex)).T
    modes = [lfilter([0, 1], [1, -p], drive[:, j]) for j, p in enumerate(values)]
    x = (np.stack(modes, axis=1) @ vectors.T).real
    free = x @ of.C.T + e
    u = r - free @ gain.T
    y = free + u @ of.D.T
    names_u = tuple(f"u{j}" for j in range(of.n_inputs))
    names_y = tuple(f"y{j}" for j in range(of.n_outputs))
    return IOData(
        u=units[0] * (u + offsets[0]),
        y=units[1] * (y + offsets[1]),
        dt=DT,
        inputs=names_u,
        outputs=names_y,
        units=dict.fromkeys((*names_u, *names_y), "1"),
        open_loop=open_loop and hold is None,
    )
