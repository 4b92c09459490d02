"""Three first-order blocks from voltage, current and position (thesis eq. 2.8-2.15, 5.4-5.6), the fast on-line form.

TFa = K_a/(s + a) from voltage to its part of the current, TFb = K_b/(s + b) from position to the other part,
TFc = K_c/(s + c) from current to position: i = TFa V + TFb x, x = TFc i. Each is estimated by instrumental variables
whose instruments come from the voltage of an open-loop record, or from the reference of a loop.

First-order blocks by instrumental variables: the two equations of the three-block model.

Solves i = K_a/(s + a) V + K_b/(s + b) x + constant and x = K_c/(s + c) i + constant with instruments that the noise did
not make. Columns are voltage, current and position, means off and scaled. The covariance of the instrumental sums comes
from the residuals' own periodogram, averaged over a width that grows with frequency: an autoregression of moderate
order misses a slow part that is hidden under white noise, and the instruments of a slow plant see just that part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.instruments import solve, span
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.estimation.uncertainty import p_text

LIMIT = (
    "limit of the three blocks: the mass is normalised to 1, so that only ratios to the mass are found (N/A, N/m per "
    "kilogram), and the term m s^2 is dropped from X/I, so that they hold where inertia is small beside damping and "
    "stiffness. The grey-box model has neither limit"
)
_UNITS = {
    "R": "ohm",
    "L": "H",
    "C": "N s/(m kg)",
    "K": "N/(m kg)",
    "k_i": "N/(A kg)",
    "k_x": "N/(m kg)",
}
_DOUBT = 1e-3  # probability under which a block is not of first order


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstOrder:
    """One block gain/(s + pole)."""

    gain: float  # ``gain`` in its unit per second; ``pole`` in rad/s, positive for a stable block
    pole: float
    gain_sd: float
    pole_sd: float
    gain_unit: str


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockParameter:
    """A physical parameter by the thesis's mapping."""

    value: float
    sd: float
    unit: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ThreeBlocks:
    """The three blocks and what the thesis reads from them.

    Attributes
    ----------
    blocks : Mapping[str, FirstOrder]
        ``a``, ``b``, ``c``.
    parameters : Mapping[str, BlockParameter]
        R, L, C, K, k_i, k_x, the last four per kilogram.
    covariance : ndarray, shape (6, 6)
        Of the parameters, in this order.
    fit : Mapping[str, float]
        ``current``, ``position``: 1 - |error|/|signal|, 1 is perfect.
    first_order : Mapping[str, float]
        ``current``, ``position``: probability of what the data show against first-order blocks, if they were true.
    status : {"converged", "stalled"}
    warnings : tuple of str
    limit : str
        What the form cannot tell; belongs to every print of the result.
    """

    blocks: Mapping[str, FirstOrder]
    parameters: Mapping[str, BlockParameter]
    covariance: Array
    fit: Mapping[str, float]
    first_order: Mapping[str, float]
    status: Literal["converged", "stalled"]
    warnings: tuple[str, ...]
    limit: str = LIMIT

    def __str__(self) -> str:
        lines = [
            f"TF{name} = ({b.gain:.6g} ± {b.gain_sd:.2g}) / (s + {b.pole:.6g} ± {b.pole_sd:.2g})   [{b.gain_unit}]"
            for name, b in self.blocks.items()
        ]
        lines += [f"{name:4s} {p.value: .6g} ± {p.sd:.2g} {p.unit}" for name, p in self.parameters.items()]
        lines += [f"warning: {w}" for w in self.warnings]
        return "\n".join([*lines, self.limit])


def block_parameters(coefficients: Array) -> tuple[Array, Array]:
    """Map the three blocks to physical parameters (thesis eq. 2.8-2.15, m = 1; derivation of table 5.1).

    s^2 + (b + c) s + b c - K_b K_c is read as s^2 + C s + K, and K_c/(s + c) as -k_i/(C s + k_x + K).

    Parameters
    ----------
    coefficients : ndarray, shape (6,)
        K_a, a, K_b, b, K_c, c.

    Returns
    -------
    ndarray, shape (6,)
        R in ohm, L in H, C, K, k_i, k_x per kilogram.
    ndarray, shape (6, 6)
        Their derivative by the coefficients.
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


def three_blocks(
    voltage: Array,
    current: Array,
    position: Array,
    rate_hz: float,
    *,
    reference: Array | None = None,
    open_loop: bool = False,
    delay: int = 0,
) -> ThreeBlocks:
    """Identify the three blocks from one record.

    Parameters
    ----------
    voltage, current, position : ndarray, shape (n_samples,), V, A, m
        The voltage is held over a sample; current and position run straight between samples.
    rate_hz : float
    reference : ndarray, shape (n_samples,) or (n_samples, n_references), optional
        Outer excitation of the loop, independent of the noise. Without it the voltage itself is the instrument.
    open_loop : bool, optional
        Declare the record open loop.
    delay : int, optional
        Whole samples by which the voltage reaches the coil late.

    Returns
    -------
    ThreeBlocks

    Raises
    ------
    EstimationError
        If the record is too short, does not move, or no blocks with a stable coil fit.
    """
    data = _data(voltage, current, position, rate_hz, reference, delay)
    with one_thread():
        scale = np.concatenate([data.u.std(axis=0), data.y.std(axis=0)])
        measured = np.hstack([data.u - data.u.mean(axis=0), data.y - data.y.mean(axis=0)]) / scale
        clean = _clean(data) / scale
        coil, coil_settled = electric(measured, clean, data.dt)
        rotor, rotor_settled = mechanic(measured, clean, data.dt)
        covariance, doubt = spread(coil, rotor, clean)
    v, i, x = scale
    unit = np.array([i / v, 1.0, i / x, 1.0, x / i, 1.0])
    coefficients = np.concatenate([coil.theta, rotor.theta]) * unit
    covariance *= np.outer(unit, unit)
    return blocks_of(
        coefficients,
        covariance,
        data.dt,
        fit={"current": coil.fit, "position": rotor.fit},
        doubt=doubt,
        settled=coil_settled and rotor_settled,
        safe=open_loop or reference is not None,
    )


def _data(
    voltage: Array, current: Array, position: Array, rate_hz: float, reference: Array | None, delay: int
) -> IOData:
    columns = [np.asarray(c, dtype=np.float64) for c in (voltage, current, position)]
    if any(c.ndim != 1 or c.size != columns[0].size for c in columns):
        raise EstimationError(
            f"three blocks: voltage, current and position have shapes {[c.shape for c in columns]}; they must be three "
            "columns of one length. Check the record"
        )
    n = columns[0].size
    if isinstance(delay, bool) or not isinstance(delay, int) or not 0 <= delay < n // 2:
        raise EstimationError(f"three blocks: delay {delay!r}; it must be a whole number of samples, 0 or more")
    if n - delay < 100:
        raise EstimationError(f"three blocks: {n} samples are too few for six coefficients; give at least 100")
    for name, c in zip(("voltage", "current", "position"), columns, strict=True):
        if np.ptp(c) == 0:
            raise EstimationError(f"three blocks: the {name} is constant; it carries no information. Excite it")
    r = (
        np.empty((n - delay, 0))
        if reference is None
        else np.asarray(reference, dtype=np.float64).reshape(n, -1)[delay:]
    )
    return IOData(
        u=columns[0][: n - delay, None],
        y=np.stack([c[delay:] for c in columns[1:]], axis=1),
        dt=1.0 / rate_hz,
        inputs=("voltage",),
        outputs=("current", "position"),
        units={"voltage": "V", "current": "A", "position": "m"},
        reference=r,
        references=tuple(f"reference {k}" for k in range(r.shape[1])),
    )


def _clean(data: IOData) -> Array:
    """Voltage, current and position without noise, shape (n_samples, 3): what voltage or reference make of them."""
    from dataclasses import replace

    from ambid.blackbox.instruments import reference_part

    u, y = data.u - data.u.mean(axis=0), data.y - data.y.mean(axis=0)
    if data.references:
        return np.hstack(reference_part("three blocks", replace(data, u=u, y=y)))
    alone = replace(data, u=np.empty((data.n_samples, 0)), inputs=(), y=y, reference=u, references=("voltage",))
    return np.hstack([u, reference_part("three blocks", alone)[1]])


def _warnings(
    doubt: Mapping[str, float], coefficients: Array, covariance: Array, dt: float, settled: bool, safe: bool
) -> tuple[str, ...]:
    out = []
    if not settled:
        out.append("the search did not converge: treat the values as a first guess")
    if not safe:
        out.append(
            "three blocks: biased by feedback. Name the loop's reference (--reference), or give --open-loop if the "
            "record is open loop"
        )
    what = {"current": "TFa and TFb do not explain the current", "position": "TFc does not explain the position"}
    for name, p in doubt.items():
        if p < _DOUBT:
            out.append(
                f"{what[name]} ({p_text(p)}): the blocks are of first order, the bench is not. Use the values as a "
                "rough guide only, and the grey-box model for the parameters"
            )
    sd = np.sqrt(np.maximum(np.diag(covariance), 0))
    for k, name in enumerate(("K_a", "a", "K_b", "b", "K_c", "c")):
        if sd[k] > abs(coefficients[k]):
            out.append(f"{name} = {coefficients[k]:.3g} ± {sd[k]:.2g} does not differ significantly from zero")
    for k, name in ((1, "a"), (3, "b")):
        if coefficients[k] * dt > np.pi:
            out.append(f"the pole {name} lies beyond the Nyquist frequency and is not identifiable")
    return tuple(out)


def blocks_of(
    coefficients: Array,
    covariance: Array,
    dt: float,
    *,
    fit: Mapping[str, float],
    doubt: Mapping[str, float],
    settled: bool,
    safe: bool,
    remarks: tuple[str, ...] = (),
) -> ThreeBlocks:
    """Say what estimated coefficients mean: parameters with their spread, and what there is to warn of.

    `coefficients`: (6,), K_a, a, K_b, b, K_c, c; `covariance`: (6, 6), of them; `dt`: sampling period, s; `fit`,
    `doubt`: `ThreeBlocks.fit` and `ThreeBlocks.first_order`; `settled`: whether the search converged; `safe`: whether
    feedback cannot have biased them; `remarks`: further warnings.
    """
    if not np.all(np.isfinite(coefficients)) or coefficients[0] == 0:
        raise EstimationError("three blocks: no finite coefficients fit this record. Check the columns and their units")
    sd = np.sqrt(np.maximum(np.diag(covariance), 0))
    units = ("A/(V s)", "A/(m s)", "m/(A s)")
    blocks = {
        name: FirstOrder(
            gain=float(coefficients[2 * k]),
            pole=float(coefficients[2 * k + 1]),
            gain_sd=float(sd[2 * k]),
            pole_sd=float(sd[2 * k + 1]),
            gain_unit=units[k],
        )
        for k, name in enumerate("abc")
    }
    warnings = _warnings(doubt, coefficients, covariance, dt, settled, safe) + remarks
    values, slope = block_parameters(coefficients)
    spread = slope @ covariance @ slope.T
    parameters = {
        name: BlockParameter(value=float(values[k]), sd=float(np.sqrt(max(spread[k, k], 0.0))), unit=unit)
        for k, (name, unit) in enumerate(_UNITS.items())
    }
    return ThreeBlocks(
        blocks=blocks,
        parameters=parameters,
        covariance=spread,
        fit=dict(fit),
        first_order=dict(doubt),
        status="converged" if settled else "stalled",
        warnings=warnings,
    )


Complex = NDArray[np.complex128]

_LEAST, _WIDTH = 2, 0.15  # lines to either side: at least, and as a part of the line number


def score_covariance_of(instruments: Sequence[Array], residuals: Sequence[Array]) -> Array:
    """Return the covariance of Z_k' e_k of several equations, stacked.

    `instruments`: (n_samples, n_k); `residuals`: (n_samples,), one for each. Returns (sum of n_k, sum of n_k).
    """
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
    """Fit i = K_a/(s + a) V + K_b/(s + b) x + constant: Z' e = 0, Z from the clean signals, by Newton's steps.

    `measured`, `clean`: (n_samples, 3). Returns whether the search settled.
    """
    best: tuple[Equation, bool] | None = None
    n = measured.shape[0]
    # instruments have false roots too, with a larger error than the voltage and the position leave of the current
    least = 1 - _ENOUGH * float(np.linalg.norm(measured[:, 1] - clean[:, 1]) / np.linalg.norm(measured[:, 1]))
    for a, b in _starts(n, dt):
        theta = _gains(measured, clean, a, b, dt)
        found, settled = _newton(measured, clean, theta, dt)
        if found is None:
            continue
        agree = best is not None and best[1] and settled and abs(found.fit - best[0].fit) < _AGREE
        if best is None or (settled and found.fit > least, found.fit) > (best[1] and best[0].fit > least, best[0].fit):
            best = (found, settled)
        if agree and found.fit > least:
            break
    if best is None:
        raise EstimationError(
            "three blocks: no stable coil fits voltage and current. Check channels.voltage, channels.current and delay"
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
    ka, kb = solve(Z, Phi, target[:, 0], who="three blocks").theta
    return np.array([ka, a, kb, b])


def _newton(measured: Array, clean: Array, theta: Array, dt: float) -> tuple[Equation | None, bool]:
    found: Equation | None = None
    for _ in range(_STEPS):
        now = _electric_at(measured, clean, theta, dt)
        try:
            change = solve(now.Z, now.Phi, now.error, who="three blocks").theta
        except EstimationError:
            return found, False
        found = now
        # poles move by at most half of themselves, so that both blocks stay stable
        limit = max(1.0, *(2 * abs(change[k]) / theta[k] for k in (1, 3)))
        if np.linalg.norm(now.Phi @ change) <= _SETTLED * np.linalg.norm(measured[:, 1]):
            return found, True
        theta = theta + change / limit
        if max(theta[1], theta[3]) * dt > 20:
            return found, False
    return found, False


def _electric_at(measured: Array, clean: Array, theta: Array, dt: float) -> Equation:
    ka, a, kb, b = theta
    n = measured.shape[0]
    basis = span(_nuisance(n, (a, b), dt))
    columns = []
    for s in (clean, measured):
        va, xb = _lag(a, dt, s[:, 0], hold=True), _lag(b, dt, s[:, 2], hold=False)
        columns.append(np.stack([va, -ka * _lag(a, dt, va, hold=False), xb, -kb * _lag(b, dt, xb, hold=False)], axis=1))
    Z, Phi = (_off(basis, c) for c in columns)
    error = _off(basis, (measured[:, 1] - ka * columns[1][:, 0] - kb * columns[1][:, 2])[:, None])[:, 0]
    fit = 1 - float(np.linalg.norm(error) / np.linalg.norm(measured[:, 1]))
    return Equation(theta=theta, error=error, Z=Z, Phi=Phi, basis=basis, fit=fit)


def mechanic(measured: Array, clean: Array, dt: float) -> tuple[Equation, bool]:
    """Fit ((s + c) x - K_c i)/(s + |c|) = 0: linear, and bounded for a magnet that pulls away (c < 0) too.

    `measured`, `clean`: (n_samples, 3). Returns whether the search settled.
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
        step = solve(Z, Phi, top[:, 0], who="three blocks")
        fit = 1 - float(np.linalg.norm(step.residual) / np.linalg.norm(measured[:, 2]))
        found = Equation(theta=step.theta, error=step.residual, Z=Z, Phi=Phi, basis=basis, fit=fit)
        if settled:
            break
        wanted = float(np.clip(abs(step.theta[1]), slowest, 3.0 / dt))
        settled = abs(wanted - filter_pole) <= 1e-6 * filter_pole
        filter_pole = wanted
    return found, settled


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
    """Return the covariance of all six coefficients, and how probable first-order blocks are (Sargan's test).

    `clean`: (n_samples, 3). Returns (6, 6); ``current`` and ``position``: probability of what spare instruments show.
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
