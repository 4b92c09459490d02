"""Three first-order blocks from voltage, current and position (thesis eq. 2.8-2.15, 5.4-5.6), the fast on-line form.

TFa = K_a/(s + a), TFb = K_b/(s + b), TFc = K_c/(s + c): i = TFa V + TFb x, x = TFc i. Both equations are solved by
instrumental variables: what the voltage (open loop) or the reference (loop) makes of the channels. The covariance of
the instrumental sums comes from the residuals' periodogram, averaged over a width that grows with frequency: an
autoregression of moderate order misses the slow part under white noise that instruments of a slow plant see.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders, check_length, check_order_names, order_per_input
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.instrumental import reference_part, solve, span
from ambid.blackbox.model import Offsets, TransferModel
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.estimation.uncertainty import p_text
from ambid.settings.caller import setting

LIMIT = (
    "limit of the three blocks: the mass is normalised to 1, so that only ratios to the mass are found (N/A, N/m per "
    "kilogram), and the term m s^2 is dropped from X/I, so that they hold where inertia is small beside damping and "
    "stiffness. The grey-box model has neither limit"
)
COEFFICIENTS = {"K_a": "A/(V s)", "a": "rad/s", "K_b": "A/(m s)", "b": "rad/s", "K_c": "m/(A s)", "c": "rad/s"}
PARAMETERS = {"R": "ohm", "L": "H", "C": "N s/(m kg)", "K": "N/(m kg)", "k_i": "N/(A kg)", "k_x": "N/(m kg)"}
_DOUBT = 1e-3  # probability under which a block is not of first order
_LEAST_ROWS = 100
_TINY = 1e-20  # complex step


def blocks(data: IOData, orders: Orders) -> BlackBoxFit:
    """Identify the three blocks from `data`: voltage in, current and position out, in this order; without feedback, or
    with the loop's reference. `orders`: ``nk`` (default 0), samples by which the voltage reaches the coil late. Returns
    a TransferModel from voltage to both, the blocks' ``coefficients`` and physical ``parameters`` in its details.
    """
    check_order_names("blocks", orders, ("nk",))
    (nk,), n = order_per_input("blocks", {"nk": 0, **orders}, "nk", 0, 1), data.n_samples
    if (data.n_inputs, data.n_outputs) != (1, 2):
        raise EstimationError(
            f"blocks: {data.n_inputs} inputs and {data.n_outputs} outputs; it takes one input, the voltage, and two "
            "outputs, current and position in this order. Name these columns"
        )
    if n - nk < _LEAST_ROWS:
        raise EstimationError(f"blocks: {n} samples are too few for six coefficients; give at least {_LEAST_ROWS}")
    check_length("blocks", data, n - nk, len(COEFFICIENTS))
    u, y = data.u[: n - nk], data.y[nk:]
    means, scale = (u.mean(axis=0), y.mean(axis=0)), np.concatenate([u.std(axis=0), y.std(axis=0)])
    late = replace(data, u=u - means[0], y=y - means[1], reference=data.reference[nk:])
    with one_thread():
        measured, clean = np.hstack([late.u, late.y]) / scale, _clean(late) / scale
        coil, coil_settled = electric(measured, clean, data.dt)
        rotor, rotor_settled = mechanic(measured, clean, data.dt)
        covariance, doubt = spread(coil, rotor, clean)
    v, i, x = scale
    unit = np.array([i / v, 1.0, i / x, 1.0, x / i, 1.0])
    theta = np.concatenate([coil.theta, rotor.theta]) * unit
    covariance *= np.outer(unit, unit)
    if not np.all(np.isfinite(theta)) or theta[0] == 0:
        raise EstimationError("blocks: no finite coefficients fit this record. Check the columns and their units")
    (num_i, den, num_x), slope = transfer_functions(theta)
    error = np.stack([coil.error, rotor.error], axis=1) * scale[1:]
    values, mapping = block_parameters(theta)
    return build_fit(
        "blocks",
        data,
        orders={"nk": nk},
        model=TransferModel(num=((num_i,), (num_x,)), den=((den,), (den,)), dt=None, delay=(nk * data.dt,)),
        covariance=slope @ covariance @ slope.T,
        n_estimated=theta.size,
        offsets=Offsets(u=means[0], y=means[1]),
        noise_covariance=error.T @ error / (error.shape[0] - theta.size - 2),
        status="converged" if coil_settled and rotor_settled else "stalled",
        warnings=_warnings(data, theta, covariance, doubt),
        details={
            "coefficients": _table(COEFFICIENTS, theta, covariance),
            "parameters": _table(PARAMETERS, values, mapping @ covariance @ mapping.T),
            "equation_fit": {"current": coil.fit, "position": rotor.fit},
            "first_order": doubt,  # probability of what the data show against first-order blocks, if they were true
            "limit": LIMIT,
        },
    )


def block_parameters(coefficients: Array) -> tuple[Array, Array]:
    """Map `coefficients` K_a, a, K_b, b, K_c, c to R in ohm, L in H, C, K, k_i, k_x per kilogram (thesis eq. 2.8-2.15,
    m = 1; table 5.1), and their (6, 6) derivative: s^2 + (b + c) s + b c - K_b K_c is read as s^2 + C s + K, and K_c/(s
    + c) as -k_i/(C s + k_x + K).
    """
    ka, a, kb, b, kc, c = (float(x) for x in coefficients)
    big_c = b + c
    values = np.array([a / ka, 1 / ka, big_c, b * c - kb * kc, -kc * big_c, c * big_c - (b * c - kb * kc)])
    slope = np.zeros((6, 6))
    slope[0, :2] = -a / ka**2, 1 / ka
    slope[1, 0] = -1 / ka**2
    slope[2, [3, 5]] = 1.0
    slope[3, 2:] = -kc, c, -kb, b
    slope[4, 3:] = -kc, -big_c, -kc
    slope[5, 2:] = kc, 0.0, kb, 2 * c
    return values, slope


def transfer_functions(coefficients: Array) -> tuple[tuple[Array, Array, Array], Array]:
    """Eliminate the loop: i/V = K_a (s + b)(s + c)/F, x/V = K_a K_c (s + b)/F, F = (s + a)((s + b)(s + c) - K_b K_c).
    Returns numerator of i, F, numerator of x, and the model's dtheta/dcoefficients, (13, 6), by complex steps.
    """

    def parts(theta: NDArray[np.inexact]) -> tuple[NDArray[np.inexact], NDArray[np.inexact], NDArray[np.inexact]]:
        ka, a, kb, b, kc, c = theta
        inner = np.convolve([1.0, b], [1.0, c])
        return ka * inner, np.convolve([1.0, a], inner - [0.0, 0.0, kb * kc]), ka * kc * np.array([1.0, b])

    columns = []
    for step in _TINY * np.eye(coefficients.size):
        num_i, den, num_x = parts(coefficients + 1j * step)
        columns.append(np.concatenate([num_i, den, num_x, den]).imag / _TINY)
    num_i, den, num_x = (np.asarray(p, dtype=np.float64) for p in parts(coefficients))
    return (num_i, den, num_x), np.stack(columns, axis=1)


def _table(units: Mapping[str, str], values: Array, covariance: Array) -> dict[str, dict[str, object]]:
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return {
        name: {"value": float(values[k]), "sd": float(sd[k]), "unit": unit}
        for k, (name, unit) in enumerate(units.items())
    }


def _clean(data: IOData) -> Array:
    """Voltage, current and position without noise, shape (n_samples, 3): what voltage or reference make of them."""
    if data.references:
        return np.hstack(reference_part("blocks", data))
    alone = replace(data, u=np.empty((data.n_samples, 0)), inputs=(), reference=data.u, references=data.inputs)
    return np.hstack([data.u, reference_part("blocks", alone)[1]])


def _warnings(data: IOData, theta: Array, covariance: Array, doubt: Mapping[str, float]) -> list[str]:
    out = []
    if not (data.open_loop or data.references):
        out.append(
            f"blocks is biased by feedback. Name the loop's reference ({setting('reference')}), or give "
            f"{setting('open_loop', True)} if the record "
            "is open loop"
        )
    what = {"current": "TFa and TFb do not explain the current", "position": "TFc does not explain the position"}
    for name, p in doubt.items():
        if p < _DOUBT:
            out.append(
                f"{what[name]} ({p_text(p)}): the blocks are of first order, the bench is not. Use the values as a "
                "rough guide only, and the grey-box model for the parameters"
            )
    for name, value, sd in zip(COEFFICIENTS, theta, np.sqrt(np.maximum(np.diag(covariance), 0)), strict=True):
        if sd > abs(value):
            out.append(f"{name} = {value:.3g} ± {sd:.2g} does not differ significantly from zero")
    for k, name in ((1, "a"), (3, "b")):
        if theta[k] * data.dt > np.pi:
            out.append(f"the pole {name} lies beyond the Nyquist frequency and is not identifiable")
    return out


Complex = NDArray[np.complex128]

_LEAST, _WIDTH = 2, 0.15  # lines to either side: at least, and as a part of the line number


def score_covariance_of(instruments: Sequence[Array], residuals: Sequence[Array]) -> Array:
    """Covariance of Z_k' e_k of several equations, stacked; Z_k (n_samples, n_k) and e_k (n_samples,), one for each."""
    n = residuals[0].size
    S = _smoothed(np.stack(residuals, axis=1))  # at the lines of n samples
    size = 1 << int(np.ceil(np.log2(2 * n)))
    lines = np.arange(size // 2 + 1) * (n / size)
    weight = np.full(lines.size, 2.0)
    weight[[0, -1]] = 1.0
    F = [np.fft.rfft(z, size, axis=0) for z in instruments]
    k_all = range(len(residuals))
    grid = np.arange(S.shape[0])

    def block(k: int, m: int) -> Array:
        s = np.interp(lines, grid, S[:, k, m].real) + 1j * np.interp(lines, grid, S[:, k, m].imag)
        return np.asarray((np.conj(F[k]).T @ (F[m] * (weight * s)[:, None])).real / size)

    out = np.block([[block(k, m) for m in k_all] for k in k_all])
    return np.asarray((out + out.T) / 2)


def _smoothed(e: Array) -> Complex:
    """Cross spectra of the columns, shape (n // 2 + 1, m, m), a taper against leakage of slow noise."""
    n, m = e.shape
    taper = np.sin(np.pi * (np.arange(n) + 0.5) / n)
    X = np.fft.rfft(e * taper[:, None] / np.sqrt(np.mean(taper**2)), axis=0) / np.sqrt(n)
    raw = X[:, :, None] * np.conj(X[:, None, :])
    total = np.concatenate([np.zeros((1, m, m)), np.cumsum(raw, axis=0)])
    k = np.arange(raw.shape[0])
    half = np.maximum(_LEAST, (_WIDTH * k).astype(int))
    low, high = np.maximum(k - half, 0), np.minimum(k + half + 1, k.size)
    return np.asarray((total[high] - total[low]) / (high - low)[:, None, None])


_STEPS = 50
_SETTLED = 1e-8  # change of a block's output by a step, relative to that output
_AGREE = 1e-7  # difference in fit of two starts that found the same blocks
_ENOUGH = 1.1  # error over what no block explains, from which a root of the equations may be a false one
_LAGS = 3  # of the spare instruments that tell whether a block is of first order


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Equation:
    """One equation, linearised at its solution; offsets and free responses taken off."""

    theta: Array  # (n_theta,), gain and pole of each block
    error: Array  # (n_samples,)
    Z: Array  # (n_samples, n_theta), instruments and regressors
    Phi: Array
    basis: Array  # (n_samples, n_nuisance), orthonormal; what was taken off
    fit: float  # 1 - |error|/|signal|


def electric(measured: Array, clean: Array, dt: float) -> tuple[Equation, bool]:
    """Fit i = K_a/(s + a) V + K_b/(s + b) x + constant by Newton's steps on Z' e = 0, Z from the clean signals
    (n_samples, 3); returns whether it settled.
    """
    best: tuple[Equation, bool] | None = None
    n = measured.shape[0]
    # instruments have false roots too, with a larger error than the voltage and the position leave of the current
    least = 1 - _ENOUGH * float(np.linalg.norm(measured[:, 1] - clean[:, 1]) / np.linalg.norm(measured[:, 1]))
    for a, b in _starts(n, dt):
        theta = _gains(measured, clean, a, b, dt)
        equation, settled = _newton(measured, clean, theta, dt)
        if equation is None:
            continue
        agree = best is not None and best[1] and settled and abs(equation.fit - best[0].fit) < _AGREE
        if best is None or (settled and equation.fit > least, equation.fit) > (
            best[1] and best[0].fit > least,
            best[0].fit,
        ):
            best = (equation, settled)
        if agree and equation.fit > least:
            break
    if best is None:
        raise EstimationError(
            "blocks: no stable coil fits voltage and current. Check channels.voltage, channels.current and delay"
        )
    return best


def _starts(n: int, dt: float) -> list[tuple[float, float]]:
    """Poles to start from, rad/s: a coil is fast, what position does to the current often slow."""
    grid = np.geomspace(20.0 / (n * dt), 1.0 / dt, 5)
    return [(float(a), float(b)) for a in grid[[3, 2, 4, 1]] for b in grid[[1, 2, 3, 0]] if a != b]


def _gains(measured: Array, clean: Array, a: float, b: float, dt: float) -> Array:
    n = measured.shape[0]
    basis = span(_nuisance(n, (a, b), dt))
    rows = [
        np.stack([_lag(a, dt, s[:, 0], hold=True), _lag(b, dt, s[:, 2], hold=False)], axis=1) for s in (clean, measured)
    ]
    Z, Phi, target = (_off(basis, m) for m in (rows[0], rows[1], measured[:, 1:2]))
    ka, kb = solve(Z, Phi, target[:, 0], who="blocks").theta
    return np.array([ka, a, kb, b])


def _newton(measured: Array, clean: Array, theta: Array, dt: float) -> tuple[Equation | None, bool]:
    last: Equation | None = None
    for _ in range(_STEPS):
        ka, a, kb, b = theta
        n = measured.shape[0]
        basis = span(_nuisance(n, (a, b), dt))
        columns = []
        for s in (clean, measured):
            va, xb = _lag(a, dt, s[:, 0], hold=True), _lag(b, dt, s[:, 2], hold=False)
            columns.append(
                np.stack([va, -ka * _lag(a, dt, va, hold=False), xb, -kb * _lag(b, dt, xb, hold=False)], axis=1)
            )
        Z, Phi = (_off(basis, c) for c in columns)
        error = _off(basis, (measured[:, 1] - ka * columns[1][:, 0] - kb * columns[1][:, 2])[:, None])[:, 0]
        fit = 1 - float(np.linalg.norm(error) / np.linalg.norm(measured[:, 1]))
        now = Equation(theta=theta, error=error, Z=Z, Phi=Phi, basis=basis, fit=fit)
        try:
            change = solve(now.Z, now.Phi, now.error, who="blocks").theta
        except EstimationError:
            return last, False
        last = now
        # poles move by at most half of themselves, so that both blocks stay stable
        limit = max(1.0, *(2 * abs(change[k]) / theta[k] for k in (1, 3)))
        if np.linalg.norm(now.Phi @ change) <= _SETTLED * np.linalg.norm(measured[:, 1]):
            return last, True
        theta = theta + change / limit
        if max(theta[1], theta[3]) * dt > 20:
            return last, False
    return last, False


def mechanic(measured: Array, clean: Array, dt: float) -> tuple[Equation, bool]:
    """Fit ((s + c) x - K_c i)/(s + |c|) = 0 to (n_samples, 3) signals: linear, and bounded also for a magnet that pulls
    away (c < 0); returns whether it settled.
    """
    n = measured.shape[0]
    slowest = 1.0 / (n * dt)
    filter_pole, settled = 30.0 / (n * dt), False
    for _ in range(_STEPS):
        basis = span(_nuisance(n, (filter_pole,), dt))
        rows = [
            np.stack([_lag(filter_pole, dt, s[:, 1], hold=False), -_lag(filter_pole, dt, s[:, 2], hold=False)], axis=1)
            for s in (clean, measured)
        ]
        target = measured[:, 2] + filter_pole * rows[1][:, 1]
        Z, Phi, top = (_off(basis, m) for m in (rows[0], rows[1], target[:, None]))
        step = solve(Z, Phi, top[:, 0], who="blocks")
        fit = 1 - float(np.linalg.norm(step.residual) / np.linalg.norm(measured[:, 2]))
        equation = Equation(theta=step.theta, error=step.residual, Z=Z, Phi=Phi, basis=basis, fit=fit)
        if settled:
            break
        wanted = float(np.clip(abs(step.theta[1]), slowest, 3.0 / dt))
        settled = abs(wanted - filter_pole) <= 1e-6 * filter_pole
        filter_pole = wanted
    return equation, settled


def _nuisance(n: int, poles: tuple[float, ...], dt: float) -> Array:
    t = dt * np.arange(n)
    return np.stack([np.ones(n), *(np.exp(-np.minimum(p * t, 700.0)) for p in poles)], axis=1)


def _off(basis: Array, columns: Array) -> Array:
    return np.asarray(columns - basis @ (basis.T @ columns))


def _lag(pole: float, dt: float, x: Array, *, hold: bool) -> Array:
    """1/(s + pole) x from rest; x held over a sample, or straight between samples."""
    from scipy.signal import lfilter

    z = pole * dt
    alpha = float(np.exp(-z))
    if hold:
        return np.asarray(lfilter([0.0, -np.expm1(-z) / pole], [1.0, -alpha], x))
    if z < 1e-3:  # series: the closed form loses digits
        new, old = dt * (0.5 - z / 6 + z * z / 24), dt * (0.5 - z / 3 + z * z / 8)
    else:
        new = (1 - (1 - alpha) / z) / pole
        old = (1 - alpha) / pole - new
    return np.asarray(lfilter([new, old], [1.0, -alpha], x, zi=[-new * x[0]])[0])


def spread(electric: Equation, mechanic: Equation, clean: Array) -> tuple[Array, dict[str, float]]:
    """Covariance (6, 6) of the coefficients, and how probable first-order blocks are: Sargan's test of spare
    instruments.
    """
    from scipy.stats import chi2

    equations = {"current": electric, "position": mechanic}
    spare = np.stack([np.roll(clean[:, k], j) for j in range(1, _LAGS + 1) for k in (0, 2)], axis=1)
    spare[:_LAGS] = 0.0
    bases, inverses = [], []
    for e in equations.values():
        own = np.linalg.qr(e.Z / np.linalg.norm(e.Z, axis=0))[0]
        inverses.append(np.linalg.inv(own.T @ e.Phi))
        rest = _off(e.basis, spare)
        rest = span(_off(own, rest / np.linalg.norm(rest, axis=0)))
        bases.append(np.hstack([own, rest]))
    scores = score_covariance_of(bases, [e.error for e in equations.values()])
    sizes = [b.shape[1] for b in bases]
    whole = np.zeros((6, sum(sizes)))
    whole[:4, :4] = inverses[0]
    whole[4:, sizes[0] : sizes[0] + 2] = inverses[1]
    doubt = {}
    for k, (name, e) in enumerate(equations.items()):
        n_own = e.Z.shape[1]
        part = slice(sum(sizes[:k]), sum(sizes[: k + 1]))
        D = bases[k].T @ e.Phi
        keep = np.hstack([-D[n_own:] @ inverses[k], np.eye(sizes[k] - n_own)])
        g = bases[k][:, n_own:].T @ e.error
        value = float(g @ np.linalg.lstsq(keep @ scores[part, part] @ keep.T, g, rcond=1e-10)[0])
        doubt[name] = float(chi2.sf(value, sizes[k] - n_own))
    n = clean.shape[0]
    return whole @ scores @ whole.T * (n / (n - 8)), doubt
