"""What a physical model has to meet: points of a black box's response that it knows itself, weighed by how well, with
their whole covariance, whose rank is that of the black box's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.multistart import Moments
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import PolynomialModel, TransferModel, response_covariance
from ambid.errors import EstimationError, counted
from ambid.physics.linear_model import DiscreteSpace, LinearModel, discretise

Complex = NDArray[np.complex128]

_KNOWN = 0.3  # relative standard deviation up to which a point of the response is used
_RANK = 1e-7  # singular values below this part of the largest are rounding
_POINTS = 160  # frequencies of the match, half of them in equal steps, half in equal ratios
_LINES = 800  # frequencies of a start's regression
Indices = NDArray[np.intp]
_HATS = 14  # pieces of the weight in equal ratios, and as many in equal steps
_SMOOTH = 0.02  # pull of every piece to zero beside the match of the information


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """What a physical model has to meet."""

    response: Complex  # (n_frequencies, n_outputs, n_inputs), complex, of the black box, channels in the model's order
    known: NDArray[np.bool_]  # (n_frequencies, n_outputs, n_inputs), bool, where it knows its own response
    # (2 n_known,), what real and imaginary parts at the known points are multiplied by: about one over their noise, if
    # it were independent from point to point
    root: Array
    noise: Array  # (2 n_known, rank), half factor of the covariance of the numbers that result
    # groups of a jackknife from which the covariance was estimated; None where it is not an estimate by scatter
    groups: int | None
    omega: Array  # (n_frequencies,), rad/s
    dt: float | None  # none for a model in continuous time
    period_s: float  # sampling interval of the record
    own_delay: float  # delay that the black box's structure holds beside its poles, samples beyond the hold
    moments: tuple[Moments, ...]  # the response on the grids of the starts

    @property
    def rank(self) -> int:
        """Number of independent numbers."""
        return int(self.noise.shape[1])

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency used, Hz."""
        used = self.omega[np.any(self.known, axis=(1, 2))] / (2 * np.pi)
        return float(used[0]), float(used[-1])

    def numbers(self, response: Complex) -> Array:
        """Reduce a complex response (n_frequencies, n_outputs, n_inputs, ...), or its derivative, to weighed (2
        n_known, ...).
        """
        points = response[self.known]
        return np.asarray((np.concatenate([points.real, points.imag]).T * self.root).T)


def target_of(fit: BlackBoxFit, model: LinearModel, roles: Mapping[str, str]) -> Target:
    """Extract from a black box what a physical model has to match; `roles`: role -> channel, where names differ."""
    rows = [_place(role, fit.outputs, fit, model, roles, "output") for role in model.outputs]
    columns = [_place(role, fit.inputs, fit, model, roles, "input") for role in model.inputs]
    _check_poles(fit, model, rows, columns)
    if fit.covariance is None:
        raise EstimationError(
            f"the {fit.structure} model has no covariance. Use a method that gives one (arx, armax, oe, bj, pbsid)"
        )
    if isinstance(fit.model, TransferModel) and fit.model.delay_estimated:
        # the match holds the delay where it was found: what is open about it stands in the coefficients' own spread
        plain = replace(fit.model, delay_estimated=False)
        n = plain.theta.size
        fit = replace(fit, model=plain, covariance=fit.covariance[:n, :n])
    nyquist = np.pi / fit.dt
    samples = fit.record.get("samples")
    low = 4 * np.pi / (fit.dt * (samples if isinstance(samples, int) and samples > 64 else 8192))
    high = 0.9 * nyquist
    omega = np.unique(np.concatenate([np.linspace(low, high, _POINTS // 2), np.geomspace(low, high, _POINTS // 2)]))
    response, known = _known(fit, omega, rows, columns)
    if not np.any(known):
        raise EstimationError(
            f"the response of the {fit.structure} model has a relative sd above {_KNOWN:.0%} at every frequency. "
            "Excite more, or record longer"
        )
    grids = (np.linspace(0.0, high, _LINES), np.geomspace(low, high, _LINES // 2))
    everywhere = np.all(known, axis=(1, 2)).astype(np.float64)
    moments = tuple(
        _moments(fit, model, grid, np.interp(grid, omega, everywhere, left=0.0) > 0.5, rows, columns) for grid in grids
    )
    root, noise = _weight(fit, omega, known, rows, columns)
    return Target(
        response=response,
        known=known,
        root=root,
        noise=noise,
        groups=_groups(fit),
        omega=omega,
        dt=fit.model.dt,
        period_s=fit.dt,
        own_delay=_own_delay(fit, rows, columns),
        moments=moments,
    )


def _place(
    role: str, names: tuple[str, ...], fit: BlackBoxFit, model: LinearModel, roles: Mapping[str, str], what: str
) -> int:
    """Find the channel of a role: as given, by name, or by unit."""
    name = roles.get(role, role)
    if name in names:
        return names.index(name)
    alike = [k for k in names if fit.units.get(k) == model.units[role]]
    if role not in roles and len(alike) == 1:
        return names.index(alike[0])
    raise EstimationError(
        f"the {fit.structure} model has no {what} for {role!r} of {model.name!r} (it has "
        f"{', '.join(names) or 'none'}). Identify it with that {what}, or name the channel in roles"
    )


def _check_poles(fit: BlackBoxFit, model: LinearModel, rows: list[int], columns: list[int]) -> None:
    least = len(model.states)
    for o in rows:
        for i in columns:
            if isinstance(fit.model, PolynomialModel):
                p = fit.model.outputs[o]
                poles = p.A.size + p.F[i].size - 2
            elif isinstance(fit.model, TransferModel):
                poles = fit.model.den[o][i].size - 1
            else:
                poles = fit.model.state_space().order
            if poles < least:
                raise EstimationError(
                    f"the {fit.structure} model has {counted(poles, 'pole')} from {fit.inputs[i]!r} to "
                    f"{fit.outputs[o]!r}; "
                    f"{model.name!r} has {least}. Identify it with an order of at least {least}"
                )


def _own_delay(fit: BlackBoxFit, rows: list[int], columns: list[int]) -> float:
    """Delay in samples: that of a transfer function, or leading zeros of B but one, which the hold makes; else none."""
    if isinstance(fit.model, TransferModel):
        hold = 0.0 if fit.model.dt is None else 1.0
        degrees = [fit.model.den[o][i].size - fit.model.num[o][i].size for o in rows for i in columns]
        beyond = max(0.0, min(degrees) - hold) if hold else 0.0
        return min(fit.model.delay[i] for i in columns) / fit.dt + beyond
    if isinstance(fit.model, PolynomialModel):
        leading = [int(np.argmax(fit.model.outputs[o].B[i] != 0)) for o in rows for i in columns]
        return float(max(0, min(leading) - 1))
    return 0.0


def _known(fit: BlackBoxFit, omega: Array, rows: list[int], columns: list[int]) -> tuple[Complex, NDArray[np.bool_]]:
    """Response in the model's channels, and where its relative standard deviation is small."""
    assert fit.covariance is not None
    g = fit.model.frequency_response(omega)[np.ix_(range(omega.size), rows, columns)]
    spread = response_covariance(fit.model, fit.covariance, omega)[np.ix_(range(omega.size), rows, columns)]
    variance = np.trace(spread, axis1=-2, axis2=-1)
    return g, np.asarray(np.isfinite(variance) & (variance >= 0) & (variance < (_KNOWN * np.abs(g)) ** 2))


def _weight(
    fit: BlackBoxFit, omega: Array, known: NDArray[np.bool_], rows: list[int], columns: list[int]
) -> tuple[Array, Array]:
    """Weight of the response at the known points, and what its covariance becomes by it."""
    assert fit.covariance is not None
    slope = fit.model.frequency_response_derivative(omega)[np.ix_(range(omega.size), rows, columns)][known]
    size = np.tile(np.abs(fit.model.frequency_response(omega)[np.ix_(range(omega.size), rows, columns)][known]), 2)
    sd = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    used = sd > 0
    values, ways = np.linalg.eigh(fit.covariance[np.ix_(used, used)] / np.outer(sd[used], sd[used]))
    half = ways * np.sqrt(np.maximum(values, 0.0)) * sd[used, None]
    spread = np.vstack([slope.real[:, used] @ half, slope.imag[:, used] @ half]) / size[:, None]
    left, s, _ = np.linalg.svd(spread, full_matrices=False)
    kept = s > _RANK * s[0]
    spread = left[:, kept] * s[kept]
    frequency, row, column = np.nonzero(known)
    root = np.sqrt(np.tile(point_weight(spread, frequency, row * len(columns) + column, omega), 2))
    return root / size, root[:, None] * spread


def _groups(fit: BlackBoxFit) -> int | None:
    """Number of groups of a jackknife, None for a covariance of another kind."""
    method = fit.details.get("covariance")
    groups = method.get("groups") if isinstance(method, Mapping) else None
    return groups if isinstance(groups, int) else None


def _moments(
    fit: BlackBoxFit, model: LinearModel, omega: Array, use: NDArray[np.bool_], rows: list[int], columns: list[int]
) -> Moments:
    """The response as if it were the spectra of a record with a flat, held input; zero where it is not to be used."""
    g = np.zeros((omega.size, len(rows), len(columns)), dtype=np.complex128)
    g[use] = fit.model.frequency_response(omega[use])[np.ix_(range(int(use.sum())), rows, columns)]
    jw = 1j * omega
    half = 0.5 * omega * fit.dt
    entered = np.sinc(half / np.pi) * np.exp(-1j * half) if fit.model.dt is not None else np.ones_like(jw)
    signals = {role: g[:, o, 0] for o, role in enumerate(model.outputs)}
    signals[model.inputs[0]] = entered * use
    return Moments(omega=omega, signals={role: (v, jw * v, jw**2 * v) for role, v in signals.items()})


def physical_response(
    model: LinearModel,
    theta: Mapping[str, float],
    omega: Array,
    *,
    dt: float | None,
    delay_s: float = 0.0,
    along: Sequence[str] = (),
    with_delay: bool = False,
) -> tuple[Complex, Complex]:
    """Return complex G (n_frequencies, n_outputs, n_inputs) at all parameters `theta` (SI) and `omega` (rad/s), and on
    one more axis its derivatives by parameters `along`, `with_delay` by the delay (per second) last. `dt`: sampling
    interval in s of the held input, None for continuous time; `delay_s`: of the inputs, s.
    """
    space = model.matrices(theta)
    slopes = [model.derivative(theta, name) for name in along]
    if dt is None:
        lag = np.exp(-1j * omega * delay_s)[:, None, None]
        inner = _Resolvent(space.A, space.C, np.asarray(1j * omega, dtype=np.complex128))
        response = inner.response(np.broadcast_to(space.B, (omega.size, *space.B.shape))) * lag
        rows = [inner.slope(space.B, d.A, np.broadcast_to(d.B, (omega.size, *d.B.shape)), d.C) * lag for d in slopes]
        if with_delay:
            rows.append(-1j * omega[:, None, None] * response)
        return response, _stacked(rows, response)
    whole = int(np.floor(delay_s / dt + 1e-9))
    fraction = max(0.0, delay_s / dt - whole)
    discrete, directions = discretise(space, dt, fraction=fraction, derivatives=slopes)
    z = np.exp(1j * omega * dt)
    late, lag = (1 / z)[:, None, None], (z**-whole)[:, None, None]

    def entered(d: DiscreteSpace) -> Complex:
        return np.asarray(d.B + d.B_late * late)

    inner, b = _Resolvent(discrete.A, discrete.C, z), entered(discrete)
    rows = [inner.slope(b, d.A, entered(d), d.C) * lag for d in directions]
    wanted = rows if with_delay else rows[: len(slopes)]
    if with_delay:
        wanted[-1] = wanted[-1] / dt
    response = inner.response(b) * lag
    return response, _stacked(wanted, response)


class _Resolvent:
    """C (p I - A)^-1 at points p, ready for many right-hand sides."""

    def __init__(self, A: Array, C: Array, points: Complex) -> None:
        self._inverse = np.linalg.inv(points[:, None, None] * np.eye(A.shape[0]) - A)
        self._c = C

    def response(self, b: Complex | Array) -> Complex:
        return np.asarray(self._c @ self._inverse @ b)

    def slope(self, b: Complex | Array, d_a: Array, d_b: Complex | Array, d_c: Array) -> Complex:
        state = self._inverse @ b
        return np.asarray(d_c @ state + self._c @ self._inverse @ (d_a @ state + d_b))


def _stacked(rows: list[Complex], found: Complex) -> Complex:
    return np.stack(rows, axis=-1) if rows else np.empty((*found.shape, 0), dtype=np.complex128)


def point_weight(spread: Array, frequency: Indices, channel: Indices, omega: Array) -> Array:
    """Return the weight (n_points,) of every point, one over the unit of `spread` squared. `spread` (2 n_points, rank):
    half factor of the covariance, real parts first, full column rank; `frequency`, `channel` (n_points,): place in the
    rising `omega` (rad/s), and way from input to output.
    """
    from scipy.optimize import nnls  # a quarter of a second

    n, rank = spread.shape[0] // 2, spread.shape[1]
    places = [np.linspace(scale[0], scale[-1], _HATS) for scale in (np.log(omega), omega)]
    each = np.vstack(
        [
            [np.interp(scale, knots, one) for one in np.eye(_HATS)]
            for scale, knots in zip((np.log(omega), omega), places, strict=True)
        ]
    )
    hats = np.vstack([each[:, frequency] * (channel == c) for c in np.unique(channel)])
    hats = hats[np.any(hats > 0, axis=1)]
    i, j = np.triu_indices(rank)
    pair = np.where(i == j, 1.0, np.sqrt(2.0))
    points = (spread[:n, i] * spread[:n, j] + spread[n:, i] * spread[n:, j]) * pair
    given = (hats @ points).T
    size = np.linalg.norm(given, axis=0)
    wanted = np.concatenate([(i == j).astype(np.float64), np.zeros(size.size)])
    found = nnls(np.vstack([given / size, _SMOOTH * np.eye(size.size)]), wanted)[0]
    return np.asarray((found / size) @ hats)
