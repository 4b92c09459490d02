"""Frequency responses of known truth: of plants, with drawn noise, and measured in simulated closed loops."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from ambid.physics.linear_model import Parameter, discretise, model
from ambid.physics.presets import preset
from ambid.signals import multisine
from ambid.signals.periodic_response import frf_periodic
from ambid.signals.response import FrequencyResponse
from ambid.simulation import simulate_preset

RATE = 20_000.0


def noisy(
    f: np.ndarray, G: np.ndarray, relative: float, seed: int, *, freedom: float = np.inf, hold: str = "band-limited"
) -> FrequencyResponse:
    """A response with circular errors, correlated between entries; `freedom` complex draws for its covariance."""
    rng = np.random.default_rng(seed)
    n, n_y, n_u = G.shape
    m = n_y * n_u

    def circular(*shape: int) -> np.ndarray:
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)

    sd = relative * np.abs(G).reshape(n, m)
    root = sd[:, :, None] * np.linalg.cholesky(np.full((m, m), 0.3) + 0.7 * np.eye(m))
    measured = G + (root @ circular(n, m, 1))[..., 0].reshape(G.shape)
    covariance = (root @ np.swapaxes(root, 1, 2)).astype(complex)
    if np.isfinite(freedom):
        draws = root @ circular(n, m, int(freedom))
        covariance = draws @ np.swapaxes(draws, 1, 2).conj() / freedom
    one_axis = (n_y, n_u) == (2, 1)
    return FrequencyResponse(
        frequency_hz=f,
        G=measured,
        covariance=covariance,
        method="drawn",
        inputs=("voltage",) if one_axis else tuple(f"u{k}" for k in range(n_u)),
        outputs=("position", "current") if one_axis else tuple(f"y{k}" for k in range(n_y)),
        rate_hz=RATE,
        hold=hold,
        degrees_of_freedom=2 * freedom,
    )


def plant(name: str, f: np.ndarray, *, hold: str = "band-limited", delay: float = 0.0) -> np.ndarray:
    """Response of a preset's plant, voltage to position and current; the delay in samples, below one for "zoh"."""
    s, w = model("one-axis").matrices(preset(name).parameters), 2 * np.pi * f
    if hold == "zoh":
        d, _ = discretise(s, 1 / RATE, fraction=delay % 1)
        z = np.exp(1j * w / RATE)[:, None, None]
        return d.C @ np.linalg.solve(z * np.eye(3) - d.A, d.B + d.B_late / z) / z ** (delay // 1)
    lag = np.exp(-1j * w * delay / RATE)[:, None, None]
    return continuous(s.A, s.B, s.C, w) * lag


def continuous(A: np.ndarray, B: np.ndarray, C: np.ndarray, w: np.ndarray) -> np.ndarray:
    """C (jw - A)^-1 B."""
    wide = np.broadcast_to(B.astype(complex), (w.size, *B.shape))
    return C @ np.linalg.solve(1j * w[:, None, None] * np.eye(A.shape[0]) - A, wide)


def poles_of(name: str) -> np.ndarray:
    return np.sort_complex(np.linalg.eigvals(model("one-axis").matrices(preset(name).parameters).A))


def closed_loop(name: str, seed: int, *, period: int, periods: int, rms: float) -> FrequencyResponse:
    """The preset in its own loop and noise, measured with the reference: what a user of an unstable bearing does."""
    bench = preset(name)
    excitation = multisine(
        period * (periods + 1), bench.rate_hz, amplitude=rms, amplitude_is="rms", band=(5.0, 2000.0),
        periods=periods + 1, phases="schroeder", shape="pink",
    )  # fmt: skip
    done = simulate_preset(bench, excitation, seed=seed)
    assert not done.warnings
    y = np.stack([done.record["position"], done.record["current"]], axis=1)
    return frf_periodic(
        done.record["voltage"][:, None], y, bench.rate_hz, r=excitation[:, None], period=period, drop_periods=1,
        inputs=("voltage",), outputs=("position", "current"),
    )  # fmt: skip


def free(name: str = "one-axis", **known: tuple[str, float, float | None]) -> list[Parameter]:
    """All parameters of a model free, but `known` as (role, value, sd)."""
    return [
        Parameter(name=p.name, unit=p.unit, role=known[p.name][0], value=known[p.name][1], sd=known[p.name][2])
        if p.name in known
        else Parameter(name=p.name, unit=p.unit)
        for p in model(name).parameters
    ]


def extrapolated(function: Callable[[np.ndarray], np.ndarray], v: np.ndarray, steps: Sequence[float]) -> np.ndarray:
    """Derivative by central differences at five steps, extrapolated to none (Richardson): about 1e-10."""
    columns = []
    for k, h in enumerate(steps):
        table = []
        for j in range(5):
            e = np.zeros(v.size)
            e[k] = h / 2**j
            table.append((function(v + e) - function(v - e)) / (2 * e[k]))
        for order in range(1, 5):
            table = [(4**order * b - a) / (4**order - 1) for a, b in pairwise(table)]
        columns.append(table[0])
    return np.stack(columns, axis=1)
