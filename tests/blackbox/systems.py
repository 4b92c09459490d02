"""Simulated records whose truth is known, for all black-box estimators."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.signal

from ambid.blackbox.blocks import transfer_functions
from ambid.blackbox.data import IOData
from ambid.blackbox.model import BlackBoxModel, TransferModel
from ambid.blackbox.prediction import held_transfer
from tests.blackbox.instrumental import block_benches

DT = 0.01
A = np.array([1.0, -1.5, 0.7])
B = np.array([0.0, 1.0, 0.5])
C = np.array([1.0, 0.4])
SIGMA = 0.2

ORDERS = {"na": 2, "nb": 2, "nc": 1, "nd": 1, "nf": 2, "nk": 1, "n": 2}
_OWN = {
    "fir": {"nb": 40},
    "arx": {"na": 6, "nb": 6},  # long enough for the moving average of the noise
    "oe": {},
    "bj": {"nd": 2},
    "ararx": {"nd": 5},
    "arma": {},
    "blocks": {"nk": 0},
}


def orders_for(name: str, wanted: tuple[str, ...]) -> dict[str, int]:
    """Orders that hold the truth, or come near it."""
    return {k: _OWN.get(name, {}).get(k, ORDERS[k]) for k in wanted}


def noise_response(model: BlackBoxModel, omega: np.ndarray) -> np.ndarray:
    """H at `omega` in rad/s, shape (n_frequencies, n_outputs, n_outputs), from the innovations form."""
    m = model.state_space()
    assert m.dt is not None
    z = np.exp(1j * omega * m.dt)[:, None, None]
    return np.eye(m.n_outputs) + m.C @ np.linalg.solve(z * np.eye(m.order) - m.A, m.K[None] + 0j)


def truth(omega: np.ndarray) -> np.ndarray:
    """Frequency response of the plant."""
    z = np.exp(-1j * omega * DT)
    return np.polynomial.polynomial.polyval(z, B) / np.polynomial.polynomial.polyval(z, A)


def open_loop(n: int = 3000, seed: int = 0, *, told: bool = True, inputs: bool = True, sigma: float = SIGMA) -> IOData:
    """A y = B u + C e about an operating point; without inputs A y = C e."""
    rng = np.random.default_rng(seed)
    u, e = np.repeat(rng.choice([-1.0, 1.0], n // 2 + 1), 2)[:n], sigma * rng.standard_normal(n)
    y = scipy.signal.lfilter(C, A, e)
    if inputs:
        y = y + scipy.signal.lfilter(B, A, u)
    return IOData(
        u=u[:, None] + 2.0 if inputs else np.empty((n, 0)),
        y=y[:, None] + 5.0,
        dt=DT,
        inputs=("drive",) if inputs else (),
        outputs=("place",),
        units={"drive": "V", "place": "m"} if inputs else {"place": "m"},
        open_loop=told,
        reference=u[:, None].copy() if inputs else np.empty((n, 0)),
        references=("wish",) if inputs else (),
        record={"samples": n, "rate_hz": 1 / DT, "sha256": None, "file": None, "history": []},
    )


BLOCKS = np.array([653.5, 1204.0, -30.0, 40.0, 2.0, 15.0])  # K_a, a, K_b, b, K_c, c


def three_blocks(n: int = 10_000, seed: int = 0, *, told: bool = True) -> IOData:
    """i = K_a/(s + a) u + K_b/(s + b) x, x = K_c/(s + c) i about an operating point."""
    v, i, x, r = block_benches.record(seed, n, truth=BLOCKS)
    data = block_benches.io(v, i, x, r, open_loop=told)
    return replace(
        data, inputs=("drive",), outputs=("place", "other"), units=dict.fromkeys(("drive", "place", "other"), "m")
    )


def truth_of_blocks(omega: np.ndarray) -> np.ndarray:
    """Frequency response from voltage to current, held over a sample."""
    model = TransferModel(
        num=((transfer_functions(BLOCKS)[0][0],),), den=((transfer_functions(BLOCKS)[0][1],),), dt=None
    )
    return held_transfer(model, 1 / block_benches.RATE).frequency_response(omega)[:, 0, 0]


UNSTABLE_A = np.array([1.0, -2.1, 1.08])  # poles 0.9 and 1.2
UNSTABLE_B = np.array([0.0, 0.0, 1.0])


def unstable_truth(omega: np.ndarray) -> np.ndarray:
    """Frequency response of the unstable plant."""
    z = np.exp(-1j * omega * DT)
    return np.polynomial.polynomial.polyval(z, UNSTABLE_B) / np.polynomial.polynomial.polyval(z, UNSTABLE_A)


def closed_loop(n: int = 4000, seed: int = 0, *, sigma: float = 0.1) -> IOData:
    """An unstable plant A y = B u + e under u = r - K(q) y, K stabilising (dead-beat like), reference white."""
    rng = np.random.default_rng(seed)
    r, e = rng.choice([-1.0, 1.0], n), sigma * rng.standard_normal(n)
    y, u = np.zeros(n), np.zeros(n)
    s, t = _controller()
    for k in range(n):
        y[k] = e[k] - sum(UNSTABLE_A[j] * y[k - j] for j in (1, 2) if k >= j) + (u[k - 2] if k >= 2 else 0.0)
        past = sum(t[j] * y[k - j] for j in range(len(t)) if k >= j)
        u[k] = r[k] - past - (s[1] * (u[k - 1] - r[k - 1]) if k >= 1 else 0.0)
    return IOData(
        u=u[:, None],
        y=y[:, None],
        dt=DT,
        inputs=("drive",),
        outputs=("place",),
        units={"drive": "V", "place": "m"},
        reference=r[:, None],
        references=("wish",),
        record={"samples": n, "rate_hz": 1 / DT, "sha256": None, "file": None, "history": []},
    )


def _controller() -> tuple[np.ndarray, np.ndarray]:
    """S u = S r - T y with A S + q^-2 T = (1 - 0.3 q^-1)^2 (pole placement)."""
    # A (1 + s1 q^-1) + q^-2 (t0 + t1 q^-1) = 1 - 0.6 q^-1 + 0.09 q^-2
    s1 = -0.6 - UNSTABLE_A[1]
    t0 = 0.09 - UNSTABLE_A[2] - s1 * UNSTABLE_A[1]
    t1 = -s1 * UNSTABLE_A[2]
    return np.array([1.0, s1]), np.array([t0, t1])
