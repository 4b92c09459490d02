"""Transfer functions from a frequency response by maximum likelihood, in s or in z.

Minimises the sum of e^H C^-1 e with e = G - N/D exp(-j omega tau) by Levenberg-Marquardt with the exact Jacobian, from
iterated linear fits (Sanathanan and Koerner 1963; Pintelon and Schoukens 2012, ch. 9) that begin with D = 1 and with
poles spread over the band, as vector fitting does (Gustavsen and Semlyen 1999). N and D are searched in
polynomials that are orthogonal on the lines (Forsythe 1957; Rolain et al. 1995; Brubeck, Nakatsukasa and Trefethen
2021), with one common factor left free, so that the search is well-conditioned at any order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import Orders, check_order_names, compact_order, left_open, order_per_input, single_order
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.frequency_lines import Lines, build_response_fit, check_lines, search_lines
from ambid.blackbox.model import TransferModel
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.signals.response import FrequencyResponse

Complex = NDArray[np.complex128]


def orthogonal_polynomials(points: Complex, weight: Array, degree: int) -> tuple[Complex, Array]:
    """Return orthogonal polynomials on points and their coefficients.

    Orthonormal for Re sum_f weight_f^2 conj(a_f) b_f, which is the sum over the lines and their conjugates.

    `points`: (n_frequencies,), complex, of order one (s over a frequency of the band, or z); `weight`:
    (n_frequencies,), positive. Returns `values`: (n_frequencies, degree + 1), complex; `powers`: (degree + 1, degree +
    1), column k holds the coefficients of polynomial k, lowest power first.
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
    """Degrees, and who shares a denominator: what a vector of coefficients means."""

    lines: Lines
    variable: Complex  # the points, scaled
    size: float  # rad/s that the points are scaled by; 1 for z
    dt: float | None
    extra: Complex  # known factor of the response (hold)
    nb: tuple[int, ...]  # numerator coefficients of each entry
    nf: tuple[int, ...]  # degree of each denominator
    group: tuple[int, ...]  # denominator of each entry
    delay_free: bool
    values: tuple[Complex, ...] = ()  # polynomials of each denominator's group on the lines
    powers: tuple[Array, ...] = ()

    @property
    def places(self) -> tuple[list[slice], list[slice], int]:
        edge, num, den = 0, [], []
        for n in self.nb:
            num.append(slice(edge, edge + n))
            edge += n
        for n in self.nf:
            den.append(slice(edge, edge + n + 1))
            edge += n + 1
        return num, den, edge

    @property
    def n_vector(self) -> int:
        return self.places[2] + int(self.delay_free)

    @property
    def n_estimated(self) -> int:
        """One factor in each group is no number of the model."""
        return self.n_vector - len(self.nf)


def frf_ml(
    frf: FrequencyResponse,
    orders: Orders,
    *,
    domain: Literal["s", "z"] | None = None,
    delay: float | Literal["auto"] = 0.0,
) -> BlackBoxFit:
    """Fit transfer functions to a frequency response by maximum likelihood.

    Parameters
    ----------
    frf : FrequencyResponse
    orders : Mapping[str, int or tuple of int]
        ``nf``, degree of the denominator (a tuple, row by row, where entries have their own), and ``nb``, number of
        numerator coefficients (a tuple, row by row, where entries differ): at most nf + 1.
    domain : {"s", "z"}, optional
        Default z where the input is held over a sample, where such a model is exact, else s. With s and a held input
        the hold's own response is taken out; what it folds down from above half the rate stays, and the check sees it.
    delay : float or "auto", s
        Of all inputs; "auto" estimates it (in whole samples for z).

    Returns
    -------
    BlackBoxFit
        Structure ``frf-ml``, a TransferModel with covariance (that of an estimated delay included), the check ``cost``
        (see `Lines.verdict`), and in `details` ``cost``, ``expected_cost``, ``cost_sd``, ``delay_s``, ``delay_sd_s``
        and ``condition`` (of the scaled Jacobian).

    Raises
    ------
    EstimationError
        If orders or lines break a rule.
    """
    domain = domain or ("z" if frf.hold == "zoh" else "s")
    if domain not in ("s", "z"):
        raise EstimationError(f"domain {domain!r}; it must be 's' or 'z'. Give one of them")
    if domain == "z" and frf.hold != "zoh":
        raise EstimationError("a model in z wants an input that is held over a sample; this one is not. Use domain 's'")
    if delay != "auto" and not (np.isfinite(delay) and delay >= 0):
        raise EstimationError(f"a delay of {delay} s; it must be zero or positive, or 'auto'. Correct it")
    form = _form(frf, orders, domain)
    period = form.lines.dt
    if domain == "z" and delay != "auto" and abs(delay / period - round(delay / period)) > 1e-9:
        raise EstimationError(f"a delay of {delay} s is no whole number of samples of {period} s. Use domain 's'")
    with one_thread():
        best = _best_fit(form, delay, domain)
    return _result(frf, best, domain)


def _best_fit(
    form: _Form, delay: float | Literal["auto"], domain: Literal["s", "z"]
) -> tuple[float, _Form, Array, float, bool]:
    """Cost, form, vector, delay and whether it converged: the best of the searches from the best starts."""
    period = form.lines.dt
    lags = period * np.arange(MAX_DELAY + 1.0) if delay == "auto" else np.array([delay])
    found = sorted((start for lag in lags for start in _starts(form, float(lag))), key=lambda c: c[0])
    if not found:
        raise EstimationError("no start fits these lines; lower the orders, or check G and its covariance")
    best: tuple[float, _Form, Array, float, bool] | None = None
    for _, at, vector, lag in found[:_RACE]:
        free = replace(at, delay_free=delay == "auto" and domain == "s")
        begin = np.append(vector, lag / period) if free.delay_free else vector
        cost, end, converged = _search(free, begin, lag)
        if best is None or cost < best[0]:
            best = (cost, free, end, lag, converged)
    assert best is not None
    return best


def _form(frf: FrequencyResponse, orders: Orders, domain: Literal["s", "z"]) -> _Form:
    """Check the orders and lay the coefficients out."""
    m = int(np.prod(np.shape(frf.G)[1:]))
    who, pair = "frf-ml", "input-output pair"
    check_order_names(who, orders, ("nb", "nf"), ("nf",))
    shared = not (isinstance(orders["nf"], tuple) and len(orders["nf"]) > 1)
    group = (0,) * m if shared else tuple(range(m))
    nf = (single_order(who, orders, "nf", 0),) if shared else order_per_input(who, orders, "nf", 0, m, of=pair)
    usual = tuple(max(nf[g], 1) for g in group)
    nb = usual if left_open(orders, "nb") else order_per_input(who, orders, "nb", 1, m, of=pair)
    if any(n > nf[g] + 1 for n, g in zip(nb, group, strict=True)):
        raise EstimationError(
            f"{who}: order nb = {nb} with nf = {nf}; a numerator has at most nf + 1 coefficients. Lower nb"
        )
    checked = check_lines(frf, sum(nb) + sum(nf))
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
        group=group,
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
        dens = [np.ones(form.lines.n_lines, dtype=np.complex128) for _ in form.nf]
        for g, n in enumerate(form.nf if how else ()):
            if how and n:
                poles = _spread_poles(form.lines.omega, n, form.size, form.dt, *how)
                dens[g] = np.prod(form.variable[:, None] - poles, axis=1)
        scored = _iterate(form, G, w, dens, lag)
        if scored is not None:
            out.append(scored)
    return out


def _spread_poles(
    omega: Array, n_poles: int, size: float, dt: float | None, damping: float, place: Callable[..., Array]
) -> Complex:
    """Lightly damped pairs over the band, and one real pole where their number is odd."""
    used = omega[omega > 0]
    centres = place(used[0], used[-1], n_poles // 2 + 2)[1:-1] if n_poles > 3 else [np.sqrt(used[0] * used[-1])]
    centres = np.asarray(centres)[: n_poles // 2]
    pairs = np.stack([centres * (-damping + 1j), centres * (-damping - 1j)], axis=1).ravel()
    s = np.concatenate([pairs, [-np.sqrt(used[0] * used[-1])] * (n_poles % 2)]).astype(np.complex128)
    return np.asarray(s / size if dt is None else np.exp(s * dt))


def _iterate(
    form: _Form, G: Complex, w: Array, dens: list[Complex], lag: float
) -> tuple[float, _Form, Array, float] | None:
    """Iterated linear fits from given denominators; the best of them, in polynomials made for it."""
    best: tuple[float, _Form, Array, float] | None = None
    before = np.inf
    for _ in range(_STARTING):
        at = _with_basis(form, w, dens)
        vector = np.zeros(at.n_vector)
        num, den, _ = at.places
        for g, n in enumerate(at.nf):
            entries = [e for e, of in enumerate(at.group) if of == g]
            c, tops = _linear(at, G, w / np.abs(dens[g])[:, None], g, n, entries)
            vector[den[g]] = c
            for e, top in zip(entries, tops, strict=True):
                vector[num[e]] = top
        cost = float(np.sum(_residual(at, vector, lag)[0] ** 2)) / 2
        if np.isfinite(cost) and (best is None or cost < best[0]):
            best = (cost, at, vector, lag)
        if abs(cost - before) <= 1e-6 * cost:
            break
        before = cost
        dens = [at.values[g] @ vector[den[g]] for g in range(len(at.nf))]
    return best


def _with_basis(form: _Form, w: Array, dens: list[Complex]) -> _Form:
    values, powers = [], []
    for g, n in enumerate(form.nf):
        entries = [e for e, of in enumerate(form.group) if of == g]
        weight = np.sqrt(np.mean(w[:, entries] ** 2, axis=1)) / np.maximum(np.abs(dens[g]), 1e-300)
        v, p = orthogonal_polynomials(form.variable, weight / np.max(weight), n)
        values.append(v)
        powers.append(p)
    return replace(form, values=tuple(values), powers=tuple(powers))


def _linear(at: _Form, G: Complex, w: Array, g: int, n: int, entries: list[int]) -> tuple[Array, list[Array]]:
    """Denominator of unit norm and numerators that make w (N - D G) smallest."""
    rows, kept = [], []
    for e in entries:
        top, bottom = at.values[g][:, : at.nb[e]] * w[:, [e]], at.values[g] * (w[:, e] * G[:, e])[:, None]
        both = np.column_stack([top, -bottom])
        r = np.asarray(np.linalg.qr(np.concatenate([both.real, both.imag]), mode="r"))
        rows.append(r[at.nb[e] :, at.nb[e] :])
        kept.append(r)
    c = np.linalg.svd(np.vstack(rows))[2][n]
    tops = [
        np.linalg.lstsq(r[: at.nb[e], : at.nb[e]], -r[: at.nb[e], at.nb[e] :] @ c, rcond=None)[0]
        for e, r in zip(entries, kept, strict=True)
    ]
    return c, tops


def _residual(at: _Form, vector: Array, lag: float, *, slope: bool = False) -> tuple[Array, Array]:
    """Whitened model - measured, and its derivative by the vector."""
    num, den, _ = at.places
    n, ln = at.lines.n_lines, at.lines
    delay = vector[-1] * ln.dt if at.delay_free else lag
    factor = at.extra * np.exp(-1j * ln.omega * delay)
    model = np.empty((n, ln.entries), dtype=np.complex128)
    J = np.zeros((n, ln.entries, vector.size if slope else 0), dtype=np.complex128)
    for e, g in enumerate(at.group):
        D = at.values[g] @ vector[den[g]]
        own = at.values[g][:, : at.nb[e]]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            model[:, e] = own @ vector[num[e]] / D * factor
            if slope:
                J[:, e, num[e]] = own * (factor / D)[:, None]
                J[:, e, den[g]] = -at.values[g] * (model[:, e] / D)[:, None]
                if at.delay_free:
                    J[:, e, -1] = -1j * ln.omega * ln.dt * model[:, e]
    shape = ln.G.shape
    return ln.whitened(model.reshape(shape) - ln.G), ln.whitened(J.reshape(*shape, -1)) if slope else np.empty((0, 0))


def _search(at: _Form, vector: Array, lag: float) -> tuple[float, Array, bool]:
    """Levenberg-Marquardt; cost, vector, whether it converged."""
    return search_lines(lambda v: _residual(at, v, lag)[0], lambda v: _residual(at, v, lag, slope=True)[1], vector)


def _result(
    frf: FrequencyResponse,
    best: tuple[float, _Form, Array, float, bool],
    domain: Literal["s", "z"],
) -> BlackBoxFit:
    """Coefficients of powers, their covariance and what goes with them."""
    cost, at, vector, lag, converged = best
    J = _residual(at, vector, lag, slope=True)[1]
    covariance, condition = at.lines.covariance(J, at.n_estimated)  # the common factors carry no information
    model, M = _powers(at, vector, lag)
    delay = model.delay[0]
    spread = float(np.sqrt(covariance[-1, -1])) * at.lines.dt if at.delay_free else None
    return build_response_fit(
        "frf-ml",
        frf,
        at.lines,
        orders={"nb": compact_order(at.nb), "nf": compact_order(at.nf)},
        model=model,
        covariance=M @ covariance @ M.T,
        cost=cost,
        n_estimated=at.n_estimated,
        converged=converged,
        details={"domain": domain, "delay_s": delay, "delay_sd_s": spread, "condition": condition},
        warnings=_hold_warning(at),
    )


def _hold_warning(at: _Form) -> list[str]:
    if at.dt is not None or not at.lines.held:
        return []
    return [
        "the input is held over a sample: a model in s leaves out what the hold folds down; a model in z, or the "
        "grey box, is exact"
    ]


def _powers(at: _Form, vector: Array, lag: float) -> tuple[TransferModel, Array]:
    """The model in powers of s or z, denominators monic, and the derivative of its coefficients by the vector."""
    num, den, _ = at.places
    n_y, n_u = at.lines.G.shape[1:]
    rows, tops, bottoms = list[Array](), list[Array](), list[Array]()
    for e, g in enumerate(at.group):
        n, k = at.nf[g], at.nb[e]
        scale_den, scale_num = at.size ** -np.arange(n + 1.0), at.size ** -np.arange(float(k))
        d, a = scale_den * (at.powers[g] @ vector[den[g]]), scale_num * (at.powers[g][:k, :k] @ vector[num[e]])
        for values, place, own in (
            (a, num[e], scale_num[:, None] * at.powers[g][:k, :k]),
            (d, den[g], scale_den[:, None] * at.powers[g]),
        ):
            block = np.zeros((values.size, vector.size))
            block[:, place] = own / d[n]
            block[:, den[g]] -= np.outer(values / d[n] ** 2, scale_den[n] * at.powers[g][n])
            rows.append(block[::-1])
        rows[-1][0] = 0.0  # the leading one
        tops.append(a[::-1] / d[n])
        monic = d[::-1] / d[n]
        monic[0] = 1.0
        bottoms.append(monic)
    if not all(np.all(np.isfinite(p)) for p in (*tops, *bottoms)):
        raise EstimationError("frf-ml: no finite coefficients fit these lines. Lower the orders")
    delay = float(vector[-1]) * at.lines.dt if at.delay_free else lag
    if at.delay_free:
        moved = np.zeros((n_u, vector.size))
        moved[:, -1] = at.lines.dt
        rows.append(moved)
    model = TransferModel(
        num=tuple(tuple(tops[o * n_u : (o + 1) * n_u]) for o in range(n_y)),
        den=tuple(tuple(bottoms[o * n_u : (o + 1) * n_u]) for o in range(n_y)),
        dt=at.dt,
        delay=(delay,) * n_u,
        delay_estimated=at.delay_free,
    )
    return model, np.vstack(rows)
