"""Cramer-Rao bound by brute force: the exact Gaussian likelihood of a plain Kalman filter, by complex step.

Everything that the estimator does not know is unknown here too: physical parameters, four noise variances, constant
disturbances and the initial state. Nothing is scaled, concentrated out or assumed stationary.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from tests.bearing.benches import Bench
from tests.estimation.reference import STEP, continuous


def filtered(bench: Bench, names: tuple[str, ...], numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Innovations (n, n_y) and their covariances (n, n_y, n_y), in units of the sensors' noise.

    `numbers`: physical parameters over the truth, log of all noise standard deviations over the truth
    (disturbances, sensors), offsets in disturbance units, initial state in units of its sensor's noise. The initial
    state is a number, so its covariance is 0.
    """
    of, rate = bench.model, bench.signals.rate_hz
    n_d, n_y, n = len(of.disturbances), len(of.outputs), len(of.states)
    parts = np.split(numbers, np.cumsum([len(names), n_d, n_y, n_d]))
    p = {**bench.truth, **{k: v * bench.truth[k] for k, v in zip(names, parts[0], strict=True)}}
    a, b, e, c = continuous(of.name, p)
    unit = np.array(
        [bench.sensor[of.outputs.index(s)] if s in of.outputs else bench.sensor[0] * rate / 30 for s in of.states]
    )
    a, b = a * unit / unit[:, None], b / unit[:, None]
    e, c = e * bench.disturbance / unit[:, None], c * unit / bench.sensor[:, None]
    m = b.shape[1] + n_d
    big = np.zeros((n + m, n + m), dtype=complex)
    big[:n, :n], big[:n, n:] = a, np.hstack([b, e])
    big = expm(big / rate)
    a, b, e = big[:n, :n], big[:n, n : n + b.shape[1]], big[:n, n + b.shape[1] :]
    q, r = (e * np.exp(2 * parts[1])) @ e.T, np.diag(np.exp(2 * parts[2]))
    whole = int(bench.delay)
    u, y = bench.signals.u, bench.signals.y / bench.sensor
    x, cov = parts[4] + 0j, np.zeros((n, n), dtype=complex)
    errors, spreads = [], []
    for t in range(whole, y.shape[0]):
        s = c @ cov @ c.T + r
        k = a @ cov @ c.T @ np.linalg.inv(s)
        errors.append(y[t] - c @ x)
        spreads.append(s)
        x = a @ x + b @ u[t - whole] + e @ parts[3] + k @ errors[-1]
        cov = a @ cov @ a.T - k @ s @ k.T + q
    return np.array(errors), np.array(spreads)


def cramer_rao_sd(bench: Bench, names: tuple[str, ...]) -> np.ndarray:
    """Smallest standard deviations of an unbiased estimator of `names`, SI.

    Information of one sample: de^T S^-1 de + tr(S^-1 dS S^-1 dS)/2.
    """
    of = bench.model
    state = [bench.states[int(bench.delay), j] for j in range(len(of.states))]
    unit = [
        bench.sensor[of.outputs.index(s)] if s in of.outputs else bench.sensor[0] * bench.signals.rate_hz / 30
        for s in of.states
    ]
    zeros = np.zeros(2 * len(of.disturbances) + len(of.outputs))
    at = np.concatenate([np.ones(len(names)), zeros, np.divide(state, unit)])
    d_e, d_s = [], []
    for j in range(at.size):
        moved = at.astype(complex)
        moved[j] += 1j * STEP
        e, s = filtered(bench, names, moved)
        d_e.append(e.imag / STEP)
        d_s.append(s.imag / STEP)
    inverse = np.linalg.inv(s.real)
    de, ds = np.array(d_e), np.array(d_s)
    information = np.einsum("itk,tkl,jtl->ij", de, inverse, de)
    inside = np.einsum("tkl,itlm->itkm", inverse, ds)
    information += 0.5 * np.einsum("itkm,jtmk->ij", inside, inside)
    size = np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
    return np.sqrt(np.diag(covariance))[: len(names)] * np.abs([bench.truth[k] for k in names])
