"""Frequency responses as every fit sees them, and transfer functions from them by maximum likelihood, in s or in z.

The likelihood of circular complex errors is the sum of e^H C^-1 e over the lines (Pintelon and Schoukens 2012, ch. 9);
`Lines` corrects cost and standard deviations for a C estimated with few degrees of freedom (complex Wishart moments;
their ch. 12 for one output). `frf_ml` minimises it with e = G - N/D exp(-j omega tau) by Levenberg-Marquardt, exact
Jacobian, from iterated linear fits (Sanathanan and Koerner 1963) that begin with D = 1 and with poles over the band
(Gustavsen and Semlyen 1999). N and D are searched in polynomials orthogonal on the lines (Forsythe 1957; Rolain et al.
1995; Brubeck, Nakatsukasa and Trefethen 2021), one common factor left free: well-conditioned at any order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import (
    Orders,
    UsedOrders,
    check_order_names,
    compact_order,
    left_open,
    order_per_input,
    single_order,
)
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import BlackBoxModel, Offsets, TransferModel
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check
from ambid.estimation.linear import one_thread
from ambid.estimation.search import Rows, search
from ambid.signals.response import FrequencyResponse

Complex = NDArray[np.complex128]

SUSPICIOUS = 1e-3  # probability below which a cost speaks of model errors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lines:
    """Checked lines of a frequency response."""

    omega: Array  # (n_frequencies,), rad/s
    G: Complex  # (n_frequencies, n_outputs, n_inputs), complex
    # (n_frequencies, m, m), complex, inverse of the lower Cholesky factor of the covariance of G, row by row, m =
    # n_outputs * n_inputs
    root: Complex
    # (n_frequencies, n_outputs, n_inputs), standard deviations of the entries of G (of the complex number: real and
    # imaginary part share the variance)
    sd: Array
    # (n_frequencies,), complex degrees of freedom of the covariance (half the real ones); infinite where it is known
    freedom: Array
    # numbers on a line whose covariance was estimated from the same draws: the size of its Wishart matrix
    together: int
    alike: float  # neighbouring lines that share one independent error
    dt: float
    held: bool  # whether G is from a command that is held over a sample to samples of the output

    @property
    def n_lines(self) -> int:
        """Number of lines."""
        return int(self.omega.size)

    @property
    def entries(self) -> int:
        """Complex numbers on each line."""
        return int(self.root.shape[1])

    def whitened(self, error: Complex) -> Array:
        """Return complex errors (n_frequencies, n_outputs, n_inputs, ...) as independent real numbers of unit variance,
        (2 * n_frequencies * m, ...); last axes are taken along, such as columns of a Jacobian.
        """
        flat = error.reshape(self.n_lines, self.entries, -1)
        white = (self.root @ flat).reshape(self.n_lines * self.entries, -1) * np.sqrt(2.0)
        rows = np.concatenate([white.real, white.imag])
        return np.asarray(rows[:, 0] if error.ndim == 3 else rows)

    @property
    def widening(self) -> float:
        """Factor on the inverse information, for a covariance that was estimated and for lines that share errors."""
        v = float(np.min(self.freedom))
        q = v - self.together
        return self.alike * (1.0 if np.isinf(v) else v**2 / (q**2 - 1.0))

    def covariance(self, J: Array, n_seen: int) -> tuple[Array, float]:
        """Return the covariance by a Jacobian of `whitened` rows, zero but along the `n_seen` strongest directions, and
        the condition of the scaled Jacobian.
        """
        norm = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        _, s, vt = np.linalg.svd(J / norm, full_matrices=False)
        half = (vt[:n_seen].T / np.maximum(s[:n_seen], 1e-15 * s[0])) / norm[:, None]
        return half @ half.T * self.widening, float(s[0] / s[n_seen - 1])

    def verdict(self, cost: float, n_estimated: int, n_extra: int = 0) -> Check:
        """Compare `cost`, the sum of e^H C^-1 e, with what noise alone would leave; `p` is the probability of so large
        a cost. Periods short beside the noise's memory make its scatter, and so the standard deviations, a little too
        large: the cost then comes out low. `n_estimated`, `n_extra`: real numbers estimated, and real data beside the
        lines (priors).
        """
        from scipy.stats import gamma

        p, columns, v = self.together, self.entries // self.together, self.freedom
        mean, variance = np.full(v.size, float(p * columns)), np.full(v.size, float(p * columns))
        few = np.isfinite(v)
        v, q = v[few], v[few] - p
        mean[few] = p * columns * v / q
        variance[few] = columns * (v**2 * p * (p + 1) / (q * (q - 1)) - (p * v / q) ** 2)
        share = max(1.0 - (n_estimated - n_extra) / (2.0 * self.n_lines * self.entries), 1e-6)
        expected, sd = share * float(np.sum(mean)), float(np.sqrt(share * np.sum(variance) * self.alike))
        probability = float(gamma.sf(cost, (expected / sd) ** 2, scale=sd**2 / expected))
        passed = probability > SUSPICIOUS
        say = "as expected from noise alone" if passed else "larger than noise explains: model errors, or a wrong order"
        return Check(
            passed=passed,
            detail=f"cost {cost:.5g}, expected {expected:.5g} with sd {sd:.3g}: {say}",
            p=probability,
            values={"cost": cost, "expected_cost": expected, "cost_sd": sd},
        )


def check_lines(frf: FrequencyResponse, n_estimated: int) -> Lines:
    """Check a frequency response for `n_estimated` real numbers, and take its covariance apart."""
    f, G = np.asarray(frf.frequency_hz, dtype=np.float64), np.asarray(frf.G, dtype=np.complex128)
    n, m = f.size, int(np.prod(G.shape[1:]))
    C = np.asarray(frf.covariance, dtype=np.complex128)
    if G.ndim != 3 or G.shape[0] != n or C.shape != (n, m, m):
        raise EstimationError(
            f"the frequency response has {n} frequencies, G {G.shape} and covariance {C.shape}; they must be "
            "(n,), (n, n_outputs, n_inputs) and (n, m, m) with m = n_outputs * n_inputs. Pass them so"
        )
    for what, values in (("frequency", f[:, None]), ("G", G.reshape(n, -1)), ("covariance", C.reshape(n, -1))):
        bad = np.nonzero(~np.all(np.isfinite(values), axis=1))[0]
        if bad.size:
            raise EstimationError(f"the {what} is not finite on line {bad[0]}; omit lines without excitation")
    if np.any(f < 0) or np.any(np.diff(f) <= 0):
        raise EstimationError("the frequencies must increase from 0 or above; sort the lines and remove duplicates")
    if 2 * n * m < n_estimated or n < 2:
        raise EstimationError(
            f"{n} lines of {m} numbers are too few for {n_estimated} coefficients. Lower the orders, or measure "
            "more lines"
        )
    sd = np.sqrt(np.maximum(np.real(np.diagonal(C, axis1=1, axis2=2)), 0.0))
    if np.any(sd == 0.0):
        line = int(np.nonzero(sd == 0.0)[0][0])
        raise EstimationError(
            f"line {line} ({f[line]:g} Hz) has no variance; weights would be infinite. Measure two or more periods, or "
            "give the covariance of the noise"
        )
    freedom = np.broadcast_to(np.asarray(frf.degrees_of_freedom, dtype=np.float64), f.shape) / 2.0
    # scatter over realisations takes all numbers of a line together, noise of single experiments one input at a time
    together = m if frf.details.get("realisations", 1) != 1 else G.shape[1]
    if not np.min(freedom) > together + 1:
        raise EstimationError(
            f"the covariance has {2 * np.min(freedom):g} degrees of freedom for {together} number(s) on a line; "
            f"it must have more than {2 * (together + 1)}. Measure more periods, or average more"
        )
    try:
        unit = C / (sd[:, :, None] * sd[:, None, :])
        factor = np.linalg.cholesky(unit)
    except np.linalg.LinAlgError:
        raise EstimationError(
            "the covariance of G is not positive definite on every line; more periods than numbers on a line are "
            "needed. Measure more periods, or fit fewer channels together"
        ) from None
    root = np.linalg.solve(factor, np.broadcast_to(np.eye(m), C.shape)) / sd[:, None, :]
    return Lines(
        omega=2 * np.pi * f,
        G=G,
        root=np.asarray(root, dtype=np.complex128),
        sd=sd.reshape(G.shape),
        freedom=freedom,
        together=together,
        alike=frf.lines_per_independent,
        dt=1.0 / frf.rate_hz,
        held=frf.hold == "zoh",
    )


def search_lines(
    residual: Callable[[Array], Array], slope: Callable[[Array], Array], start: Array
) -> tuple[float, Array, bool]:
    """Return half the least sum of squares, where it is, and whether the search converged; `residual`, `slope`:
    whitened rows (n_rows,) and their derivative (n_rows, n_vector) at a vector.
    """
    end = search(Rows(residual, slope), start, most=200, tolerance=1e-13, settled=1e-12)
    return end.cost / 2, end.theta, end.converged


def build_response_fit(
    name: str,
    frf: FrequencyResponse,
    checked: Lines,
    *,
    orders: UsedOrders,
    model: BlackBoxModel,
    covariance: Array,
    cost: float,
    n_estimated: int,
    converged: bool = True,
    details: Mapping[str, object] | None = None,
    warnings: Sequence[str] = (),
) -> BlackBoxFit:
    """Put a fit to a frequency response together, with the check ``cost`` and a warning where it fails. It has no
    innovations: `noise_covariance` is zero, and noise stands in the `covariance` (n_theta, n_theta) that comes from the
    response's.
    """
    if not np.all(np.isfinite(model.theta)) or not np.all(np.isfinite(covariance)):
        raise EstimationError(
            f"{name}: no finite coefficients fit these lines. Lower the orders, or check the response"
        )
    check = checked.verdict(cost, n_estimated)
    remarks = [*warnings, *frf.warnings]
    if not converged:
        remarks.insert(0, "the search did not converge: treat the values as a first guess")
    if not check.passed:
        remarks.insert(0, f"{name}: {check.detail}; standard deviations cover noise only")
    return BlackBoxFit(
        structure=name,
        orders=dict(orders),
        model=model,
        covariance=covariance,
        n_estimated=n_estimated,
        offsets=Offsets(u=np.zeros(frf.n_inputs), y=np.zeros(frf.n_outputs)),
        noise_covariance=np.zeros((frf.n_outputs, frf.n_outputs)),
        inputs=frf.inputs,
        outputs=frf.outputs,
        units=dict(frf.units),
        dt=checked.dt,
        record={"lines": checked.n_lines, "rate_hz": frf.rate_hz, "method": frf.method, "hold": frf.hold},
        status="converged" if converged else "stalled",
        checks={"cost": check},
        warnings=tuple(remarks),
        details={**dict(check.values), "p": check.p, **({} if details is None else dict(details))},
    )


def orthogonal_polynomials(points: Complex, weight: Array, degree: int) -> tuple[Complex, Array]:
    """Return polynomials orthonormal for Re sum_f weight_f^2 conj(a_f) b_f, the sum over lines and their conjugates:
    complex `values` (n_frequencies, degree + 1) at `points` of order one, and `powers`, lowest first, of polynomial k
    in column k.
    """
    n = points.size
    q = np.empty((n, degree + 1), dtype=np.complex128)
    powers = np.zeros((degree + 1, degree + 1))
    first = float(np.linalg.norm(weight))
    q[:, 0], powers[0, 0] = weight / first, 1.0 / first
    for k in range(degree):
        v, c = points * q[:, k], np.concatenate([[0.0], powers[:-1, k]])
        for _ in range(2):  # once more, against round-off
            h = np.real(q[:, : k + 1].conj().T @ v)
            v, c = v - q[:, : k + 1] @ h, c - powers[:, : k + 1] @ h
        size = max(float(np.linalg.norm(v)), 1e-300)
        q[:, k + 1], powers[:, k + 1] = v / size, c / size
    return q / weight[:, None], powers


MAX_DELAY = 6  # samples, searched when the delay is "auto"
_STARTING = 40  # iterated linear fits from each start
_RACE = 5  # starts from which the likelihood is searched
_DAMPING = (0.01, 0.1)  # of the poles that a start spreads over the band


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Form:
    """Degrees and points: what a vector of coefficients, numerators before the denominator that they share, means."""

    lines: Lines
    variable: Complex  # the points, scaled
    size: float  # rad/s that the points are scaled by; 1 for z
    dt: float | None
    extra: Complex  # known factor of the response (hold)
    nb: tuple[int, ...]  # numerator coefficients of each entry
    nf: int  # degree of the denominator
    delay_free: bool
    # polynomials up to the denominator's degree on the lines, (n_frequencies, nf + 1), and their coefficients
    values: Complex = field(default_factory=lambda: np.empty((0, 0), dtype=np.complex128))
    powers: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def places(self) -> tuple[list[slice], slice]:
        """Where the numerator of each entry stands, and the denominator."""
        edges = [0, *np.cumsum(self.nb).tolist()]
        return [slice(a, b) for a, b in pairwise(edges)], slice(edges[-1], edges[-1] + self.nf + 1)

    @property
    def n_vector(self) -> int:
        return sum(self.nb) + self.nf + 1 + int(self.delay_free)

    @property
    def n_estimated(self) -> int:
        """The common factor is not a parameter of the model."""
        return self.n_vector - 1


def frf_ml(
    frf: FrequencyResponse,
    orders: Orders,
    *,
    domain: Literal["s", "z"] | None = None,
    delay: float | Literal["auto"] = 0.0,
) -> BlackBoxFit:
    """Fit transfer functions to a frequency response by maximum likelihood. `orders`: ``nf`` of the common denominator,
    ``nb`` numerator coefficients (a tuple, row by row, where entries differ), at most nf + 1; `domain`: z by default
    for held inputs, where it is exact, else s, where a hold's own response is taken out, what it folds down stays, and
    the check sees it; `delay`: of all inputs in s, "auto" estimates it (in whole samples for z).
    """
    domain = domain or ("z" if frf.hold == "zoh" else "s")
    if domain not in ("s", "z"):
        raise EstimationError(f"domain {domain!r}; it must be 's' or 'z'. Give one of them")
    if domain == "z" and frf.hold != "zoh":
        raise EstimationError("a model in z needs an input that is held over a sample; this one is not. Use domain 's'")
    if delay != "auto" and not (np.isfinite(delay) and delay >= 0):
        raise EstimationError(f"a delay of {delay} s; it must be zero or positive, or 'auto'. Correct it")
    form = _form(frf, orders, domain)
    period = form.lines.dt
    if domain == "z" and delay != "auto" and abs(delay / period - round(delay / period)) > 1e-9:
        raise EstimationError(f"a delay of {delay} s is not a whole number of samples of {period} s. Use domain 's'")
    lags = period * np.arange(MAX_DELAY + 1.0) if delay == "auto" else np.array([delay])
    ends = list[tuple[float, _Form, Array, float, bool]]()  # cost, form, vector, delay and whether it converged
    with one_thread():
        starts = sorted((start for lag in lags for start in _starts(form, float(lag))), key=lambda c: c[0])
        if not starts:
            raise EstimationError("no starting values fit these lines; lower the orders, or check G and its covariance")
        for _, at, vector, lag in starts[:_RACE]:
            free = replace(at, delay_free=delay == "auto" and domain == "s")
            begin = np.append(vector, lag / period) if free.delay_free else vector
            cost, end, converged = _search(free, begin, lag)
            ends.append((cost, free, end, lag, converged))
    return _result(frf, min(ends, key=lambda e: e[0]), domain)


def _form(frf: FrequencyResponse, orders: Orders, domain: Literal["s", "z"]) -> _Form:
    """Check the orders and lay the coefficients out."""
    m = int(np.prod(np.shape(frf.G)[1:]))
    who, pair = "frf-ml", "input-output pair"
    check_order_names(who, orders, ("nb", "nf"), ("nf",))
    nf = single_order(who, orders, "nf", 0)
    nb = (max(nf, 1),) * m if left_open(orders, "nb") else order_per_input(who, orders, "nb", 1, m, each=pair)
    if max(nb) > nf + 1:
        raise EstimationError(
            f"{who}: order nb = {nb} with nf = {nf}; a numerator has at most nf + 1 coefficients. Lower nb"
        )
    checked = check_lines(frf, sum(nb) + nf)
    size = float(np.median(checked.omega)) if domain == "s" else 1.0
    dt = None if domain == "s" else checked.dt
    s = 1j * checked.omega
    hold = np.sinc(checked.omega * checked.dt / (2 * np.pi)) * np.exp(-s * checked.dt / 2)
    return _Form(
        lines=checked,
        variable=np.asarray(s / size if dt is None else np.exp(s * dt), dtype=np.complex128),
        size=size,
        dt=dt,
        extra=hold if checked.held and dt is None else np.ones(s.size, dtype=np.complex128),
        nb=nb,
        nf=nf,
        delay_free=False,
    )


def _starts(form: _Form, lag: float) -> list[tuple[float, _Form, Array, float]]:
    """Cost, form with its polynomials, vector and delay of each start for one delay."""
    out = []
    weight = 1.0 / form.lines.sd.reshape(form.lines.n_lines, -1)
    factor = form.extra * np.exp(-1j * form.lines.omega * lag)
    G = form.lines.G.reshape(form.lines.n_lines, -1) / factor[:, None]
    w = weight * np.abs(factor)[:, None]
    spread = [(damping, place) for damping in _DAMPING for place in (np.geomspace, np.linspace)]
    for how in (*spread, None):
        den = np.ones(form.lines.n_lines, dtype=np.complex128)
        if how:
            poles = _spread_poles(form.lines.omega, form.nf, form.size, form.dt, *how)
            den = np.prod(form.variable[:, None] - poles, axis=1)
        scored = _iterate(form, G, w, den, lag)
        if scored is not None:
            out.append(scored)
    return out


def _spread_poles(
    omega: Array, n_poles: int, size: float, dt: float | None, damping: float, place: Callable[..., Array]
) -> Complex:
    """Lightly damped pairs over the band, and one real pole where their number is odd."""
    positive = omega[omega > 0]
    centres = (
        place(positive[0], positive[-1], n_poles // 2 + 2)[1:-1]
        if n_poles > 3
        else [np.sqrt(positive[0] * positive[-1])]
    )
    centres = np.asarray(centres)[: n_poles // 2]
    pairs = np.stack([centres * (-damping + 1j), centres * (-damping - 1j)], axis=1).ravel()
    s = np.concatenate([pairs, [-np.sqrt(positive[0] * positive[-1])] * (n_poles % 2)]).astype(np.complex128)
    return np.asarray(s / size if dt is None else np.exp(s * dt))


def _iterate(form: _Form, G: Complex, w: Array, den: Complex, lag: float) -> tuple[float, _Form, Array, float] | None:
    """Iterated linear fits from a given denominator; the best of them, in polynomials made for it."""
    best: tuple[float, _Form, Array, float] | None = None
    before = np.inf
    for _ in range(_STARTING):
        weight = np.sqrt(np.mean(w**2, axis=1)) / np.maximum(np.abs(den), 1e-300)
        values, powers = orthogonal_polynomials(form.variable, weight / np.max(weight), form.nf)
        at = replace(form, values=values, powers=powers)
        vector = _linear(at, G, w / np.abs(den)[:, None])
        cost = float(np.sum(_residual(at, vector, lag)[0] ** 2)) / 2
        if np.isfinite(cost) and (best is None or cost < best[0]):
            best = (cost, at, vector, lag)
        if abs(cost - before) <= 1e-6 * cost:
            break
        before = cost
        den = at.values @ vector[at.places[1]]
    return best


def _linear(at: _Form, G: Complex, w: Array) -> Array:
    """Numerators, and denominator of unit norm, that make w (N - D G) smallest."""
    triangles, vector, (num, den) = [], np.zeros(at.n_vector), at.places
    for e, k in enumerate(at.nb):
        top, bottom = at.values[:, :k] * w[:, [e]], at.values * (w[:, e] * G[:, e])[:, None]
        both = np.column_stack([top, -bottom])
        triangles.append(np.asarray(np.linalg.qr(np.concatenate([both.real, both.imag]), mode="r")))
    c = np.linalg.svd(np.vstack([r[k:, k:] for r, k in zip(triangles, at.nb, strict=True)]))[2][at.nf]
    vector[den] = c
    for r, k, place in zip(triangles, at.nb, num, strict=True):
        vector[place] = np.linalg.lstsq(r[:k, :k], -r[:k, k:] @ c, rcond=None)[0]
    return vector


def _residual(at: _Form, vector: Array, lag: float, *, slope: bool = False) -> tuple[Array, Array]:
    """Whitened model - measured, and its derivative by the vector."""
    num, den = at.places
    n, ln = at.lines.n_lines, at.lines
    delay = vector[-1] * ln.dt if at.delay_free else lag
    factor = at.extra * np.exp(-1j * ln.omega * delay)
    model = np.empty((n, ln.entries), dtype=np.complex128)
    J = np.zeros((n, ln.entries, vector.size if slope else 0), dtype=np.complex128)
    D = at.values @ vector[den]
    for e, place in enumerate(num):
        own = at.values[:, : at.nb[e]]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            model[:, e] = own @ vector[place] / D * factor
            if slope:
                J[:, e, place] = own * (factor / D)[:, None]
                J[:, e, den] = -at.values * (model[:, e] / D)[:, None]
                if at.delay_free:
                    J[:, e, -1] = -1j * ln.omega * ln.dt * model[:, e]
    shape = ln.G.shape
    return ln.whitened(model.reshape(shape) - ln.G), ln.whitened(J.reshape(*shape, -1)) if slope else np.empty((0, 0))


def _search(at: _Form, vector: Array, lag: float) -> tuple[float, Array, bool]:
    """Levenberg-Marquardt; cost, vector, whether it converged."""
    return search_lines(lambda v: _residual(at, v, lag)[0], lambda v: _residual(at, v, lag, slope=True)[1], vector)


def _result(frf: FrequencyResponse, best: tuple[float, _Form, Array, float, bool], domain: str) -> BlackBoxFit:
    """Coefficients of powers, their covariance and what goes with them."""
    cost, at, vector, lag, converged = best
    J = _residual(at, vector, lag, slope=True)[1]
    covariance, condition = at.lines.covariance(J, at.n_estimated)  # the common factor carries no information
    model, M = _powers(at, vector, lag)
    delay = model.delay[0]
    spread = float(np.sqrt(covariance[-1, -1])) * at.lines.dt if at.delay_free else None
    return build_response_fit(
        "frf-ml",
        frf,
        at.lines,
        orders={"nb": compact_order(at.nb), "nf": at.nf},
        model=model,
        covariance=M @ covariance @ M.T,
        cost=cost,
        n_estimated=at.n_estimated,
        converged=converged,
        details={"domain": domain, "delay_s": delay, "delay_sd_s": spread, "condition": condition},
        warnings=[_ALIASED] if at.dt is None and at.lines.held else [],
    )


_ALIASED = (
    "the input is held over a sample: a model in s neglects the aliasing of the hold; a model in z, or the grey box, "
    "is exact"
)


def _powers(at: _Form, vector: Array, lag: float) -> tuple[TransferModel, Array]:
    """The model in powers of s or z, denominators monic, and the derivative of its coefficients by the vector."""
    num, den = at.places
    n_y, n_u = at.lines.G.shape[1:]
    n, powers = at.nf, at.size ** -np.arange(at.nf + 1.0)[:, None] * at.powers
    d = powers @ vector[den]

    def monic(values: Array, place: slice, own: Array) -> tuple[Array, Array]:
        """A polynomial over the denominator's leading coefficient, highest power first, and its derivative."""
        slope = np.zeros((values.size, vector.size))
        slope[:, place] = own / d[n]
        slope[:, den] -= np.outer(values / d[n] ** 2, powers[n])
        return values[::-1] / d[n], slope[::-1]

    bottom, by_bottom = monic(d, den, powers)
    bottom[0], by_bottom[0] = 1.0, 0.0
    rows, tops = list[Array](), list[Array]()
    for k, place in zip(at.nb, num, strict=True):
        own = powers[:k, :k]
        top, by_top = monic(own @ vector[place], place, own)
        tops.append(top)
        rows += [by_top, by_bottom]
    if not all(np.all(np.isfinite(p)) for p in (*tops, bottom)):
        raise EstimationError("frf-ml: no finite coefficients fit these lines. Lower the orders")
    delay = float(vector[-1]) * at.lines.dt if at.delay_free else lag
    if at.delay_free:
        moved = np.zeros((n_u, vector.size))
        moved[:, -1] = at.lines.dt
        rows.append(moved)
    model = TransferModel(
        num=tuple(tuple(tops[o * n_u : (o + 1) * n_u]) for o in range(n_y)),
        den=((bottom,) * n_u,) * n_y,
        dt=at.dt,
        delay=(delay,) * n_u,
        delay_estimated=at.delay_free,
    )
    return model, np.vstack(rows)
