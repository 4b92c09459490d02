"""Three first-order blocks from voltage, current and position (thesis eq. 2.8-2.15, 5.4-5.6), the fast on-line form.

TFa = K_a/(s + a) from voltage to its part of the current, TFb = K_b/(s + b) from position to the other part,
TFc = K_c/(s + c) from current to position: i = TFa V + TFb x, x = TFc i. Each is estimated by instrumental variables
whose instruments come from the voltage of an open-loop record, or from the reference of a loop.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread

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
        Say that no feedback was at work.
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
    from ambid.bearing.first_order import electric, mechanic, spread

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
            raise EstimationError(f"three blocks: the {name} is constant; nothing can be learned from it. Excite it")
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
        part = reference_part("three blocks", replace(data, u=u, y=y))
        return np.hstack([part.u, part.y])
    alone = replace(data, u=np.empty((data.n_samples, 0)), inputs=(), y=y, reference=u, references=("voltage",))
    return np.hstack([u, reference_part("three blocks", alone).y])


def _warnings(
    doubt: Mapping[str, float], coefficients: Array, covariance: Array, dt: float, settled: bool, safe: bool
) -> tuple[str, ...]:
    out = []
    if not settled:
        out.append("the search did not converge: treat the numbers as a first guess")
    if not safe:
        out.append(
            "three blocks: biased where a controller was at work, and nothing says that this record is open loop: name "
            "the loop's reference (--reference), or say --open-loop if there was no feedback"
        )
    what = {"current": "TFa and TFb do not make the current", "position": "TFc does not make the position"}
    for name, p in doubt.items():
        if p < _DOUBT:
            out.append(
                f"{what[name]} (p = {p:.2g}): the blocks are of first order, the bench is not. Take the numbers as a "
                "rough guide, and the grey-box model for the parameters"
            )
    sd = np.sqrt(np.maximum(np.diag(covariance), 0))
    for k, name in enumerate(("K_a", "a", "K_b", "b", "K_c", "c")):
        if sd[k] > abs(coefficients[k]):
            out.append(f"{name} = {coefficients[k]:.3g} ± {sd[k]:.2g}: the record does not tell it from zero")
    for k, name in ((1, "a"), (3, "b")):
        if coefficients[k] * dt > np.pi:
            out.append(f"the pole {name} lies beyond half the sampling rate; the record does not show it")
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
