"""Two-stage method for a plant in a loop (Van den Hof and Schrama 1993).

First the input is split: a long finite impulse response from the reference gives the part of it that no noise reaches.
Then that part and the output are an open-loop record, from which B/F follows as output error. The plant has to be
stable, because it is simulated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.instrumental.cliv import cliv
from ambid.blackbox.instrumental.iv4 import centred
from ambid.blackbox.instrumental.noise import autoregression
from ambid.blackbox.instrumental.reference import reference_part, wants_reference
from ambid.blackbox.instrumental.solve import Solution, solve, span, weak
from ambid.blackbox.made import made
from ambid.blackbox.orders import Orders, known_orders, long_enough, per_input
from ambid.blackbox.polynomial_model import PolynomialModel, Polynomials
from ambid.blackbox.response import Offsets
from ambid.blackbox.roots import stable
from ambid.blackbox.spread import pole_covariance
from ambid.errors import EstimationError
from ambid.estimation.threads import one_thread

_COLUMNS = 400  # of the finite impulse response, all references together
_CERTAIN = 2.0  # standard deviations by which a pole is outside before the plant is called unstable
_NOISE_ORDER = 20
_ROUNDS = 30
_SETTLED = 1e-6  # change of the output by a step, relative to the noise


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Refined:
    """One output after the refined steps."""

    polynomials: Polynomials
    noise: Array  # (n_samples,), y - G u, free responses and constant taken off
    constant: float
    step: Solution  # the last one
    settled: bool


def two_stage(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate G = B/F of a stable plant in a loop from its reference; every output by itself.

    Errors of the first stage reach the second and make it several times less sharp than it has to be. So its G is only
    the start of refined instrumental variable steps (Gilson and Van den Hof 2005): Z' (y - G u) = 0 with the measured
    input, Z from the clean one. They leave the noise of the plant alone, and their covariance is known.

    Parameters
    ----------
    data : IOData
        With a reference that the noise does not reach.
    orders : Mapping[str, int or tuple of int]
        ``nb``, ``nf`` and ``nk`` (default 1), one or one for each input.

    Returns
    -------
    BlackBoxFit
        PolynomialModel with B and F.

    Raises
    ------
    EstimationError
        If there is no reference, the plant is unstable, an order breaks a rule, or the record is too short.
    """
    from ambid.blackbox.polynomial import oe

    who = "two-stage"
    wants_reference(who, data)
    known_orders(who, orders, ("nb", "nf", "nk"), ("nb", "nf"))
    n_u = data.n_inputs
    nb, nf = per_input(who, orders, "nb", 1, n_u), per_input(who, orders, "nf", 0, n_u)
    nk = per_input(who, {"nk": 1, **orders}, "nk", 0, n_u)
    unknowns = sum(nb) + sum(nf)
    long_enough(who, data, data.n_samples - max(nf), unknowns + 1)
    with one_thread():
        _refuse_unstable(data, nb, nf, nk)
        clean, lags, warnings = _first_stage(who, data)
        rest = data.part(lags, data.n_samples)
        second = oe(replace(rest, u=clean), {"nb": nb, "nf": nf, "nk": nk})
        assert isinstance(second.model, PolynomialModel)
        if not all(stable(f) for p in second.model.outputs for f in p.F):
            raise EstimationError(_UNSTABLE.format(poles="the second stage found poles outside the unit circle"))
        mean = rest.u.mean(axis=0)
        found = [
            _refined(p, clean - mean, rest.u - mean, rest.y[:, o] - second.offsets.y[o], nk)
            for o, p in enumerate(second.model.outputs)
        ]
        blocks = [_covariance(f, nk) for f in found]
    noise = np.stack([f.noise for f in found], axis=1)
    return made(
        who,
        data,
        orders={"nb": nb, "nf": nf, "nk": nk},
        model=PolynomialModel(outputs=tuple(f.polynomials for f in found), dt=data.dt),
        covariance=block_diag(*blocks),
        n_estimated=data.n_outputs * unknowns,
        offsets=Offsets(u=mean, y=second.offsets.y + np.array([f.constant for f in found])),
        noise_covariance=noise.T @ noise / max(noise.shape[0] - unknowns - 1, 1),
        status="converged" if all(f.settled for f in found) else "stalled",
        warnings=(*warnings, *weak([f.step for f in found], data.outputs)),
        details={
            "first_stage_lags": lags,
            "condition": [f.step.condition for f in found],
            "instrument_strength": [f.step.strength() for f in found],
        },
    )


_UNSTABLE = (
    "two-stage: {poles}; the second stage simulates the plant from its input, which is bounded only for a stable one. "
    "Use cliv or clsrivc, which need no simulation, or bj and armax on the loop's own signals"
)


def _refuse_unstable(data: IOData, nb: tuple[int, ...], nf: tuple[int, ...], nk: tuple[int, ...]) -> None:
    """Ask cliv, which stands unstable plants, where the poles are."""
    if not max(nf):
        return
    try:
        plain = cliv(data, {"na": max(nf), "nb": nb, "nk": nk})
    except EstimationError:
        return
    poles = plain.model.poles()
    size = np.abs(poles)
    if plain.covariance is None or not size.size:
        return
    direction = np.stack([poles.real, poles.imag], axis=1) / np.maximum(size, 1e-12)[:, None]
    spread = np.einsum("pi,pij,pj->p", direction, pole_covariance(plain.model, plain.covariance), direction)
    outside = size - _CERTAIN * np.sqrt(np.maximum(spread, 0)) > 1
    if np.any(outside):
        worst = float(size[outside].max())
        raise EstimationError(_UNSTABLE.format(poles=f"the plant is unstable (a pole at |z| = {worst:.6g})"))


def _first_stage(who: str, data: IOData) -> tuple[Array, int, tuple[str, ...]]:
    """Part of the input that the reference makes, from sample `lags` on; `lags`; warnings."""
    memory = reference_part(who, centred(data)[0]).memory
    n, n_r = data.reference.shape
    lags = int(min(memory, _COLUMNS // n_r, n // (6 * n_r)))
    r = data.reference - data.reference.mean(axis=0)
    rows = np.hstack([np.ones((n - lags, 1)), *[r[lags - k : n - k] for k in range(lags + 1)]])
    mean = data.u.mean(axis=0)
    basis = span(rows)
    u = data.u[lags:] - mean
    warnings = (
        ()
        if lags >= memory
        else (
            f"the loop remembers its reference for {memory} samples, and the record allows a first stage of {lags}: "
            "what is left out counts as noise. Take a longer record, or cliv",
        )
    )
    return basis @ (basis.T @ u) + mean, lags, warnings


def _refined(p: Polynomials, clean: Array, u: Array, y: Array, nk: tuple[int, ...]) -> _Refined:
    """Solve Z' (y - G u) = 0 with the measured input, Z the gradient by the clean one, from G of the second stage."""
    settled = False
    for _ in range(_ROUNDS):
        pulses = _pulses(p, y.size)
        basis = span(pulses)
        raw = y - sum(lfilter(b, f, u[:, i]) for i, (b, f) in enumerate(zip(p.B, p.F, strict=True)))
        noise = raw - basis @ (basis.T @ raw)
        instruments, rows = _gradient(p, clean, 0.0, nk), _gradient(p, u, noise, nk)
        instruments -= basis @ (basis.T @ instruments)
        rows -= basis @ (basis.T @ rows)
        step = solve(instruments, rows, noise, who="two-stage")
        size = np.linalg.norm(pulses, axis=0)
        constant = float(np.linalg.lstsq(pulses / size, raw, rcond=1e-8)[0][0] / size[0])
        here = _Refined(polynomials=p, noise=noise, constant=constant, step=step, settled=settled)
        if settled:
            return here
        moved = _moved(p, step.theta, nk)
        if not all(stable(f) for f in moved.F):
            return here
        settled = bool(np.linalg.norm(instruments @ step.theta) <= _SETTLED * np.linalg.norm(noise))
        p = moved
    return here


def _gradient(p: Polynomials, u: Array, error: Array | float, nk: tuple[int, ...]) -> Array:
    """Derivatives of B/F u by the free b of each input, then the free f of each; `error` is added to B/F u."""
    by_b, by_f = [], []
    for i, (b, f) in enumerate(zip(p.B, p.F, strict=True)):
        smooth = lfilter([1.0], f, u[:, i])
        out = -lfilter([1.0], f, lfilter(b, f, u[:, i]) + error)
        by_b += [_later(smooth, k) for k in range(nk[i], b.size)]
        by_f += [_later(out, k) for k in range(1, f.size)]
    return np.stack(by_b + by_f, axis=1)


def _pulses(p: Polynomials, n: int) -> Array:
    """A constant, and what initial states make of the output."""
    pulse = np.zeros(n)
    pulse[0] = 1.0
    return np.stack(
        [np.ones(n), *(_later(lfilter([1.0], f, pulse), k) for f in p.F for k in range(f.size - 1))], axis=1
    )


def _moved(p: Polynomials, change: Array, nk: tuple[int, ...]) -> Polynomials:
    B, F, first = list[Array](), list[Array](), 0
    for b, k in zip(p.B, nk, strict=True):
        B.append(np.concatenate([b[:k], b[k:] + change[first : first + b.size - k]]))
        first += b.size - k
    for f in p.F:
        F.append(np.concatenate([f[:1], f[1:] + change[first : first + f.size - 1]]))
        first += f.size - 1
    return replace(p, B=tuple(B), F=tuple(F))


def _covariance(found: _Refined, nk: tuple[int, ...]) -> Array:
    """Covariance of all coefficients of one output, for noise of any colour."""
    p, n = found.polynomials, found.noise.size
    starts = np.cumsum([p.A.size, *(b.size for b in p.B), p.C.size, p.D.size, *(f.size for f in p.F)])
    b_starts, f_starts = starts[: len(p.B)], starts[len(p.B) + 2 : -1]
    places = [int(s) + k for s, b, d in zip(b_starts, p.B, nk, strict=True) for k in range(d, b.size)]
    places += [int(s) + k for s, f in zip(f_starts, p.F, strict=True) for k in range(1, f.size)]
    out = np.zeros((int(starts[-1]),) * 2)
    inner = found.step.covariance(autoregression(found.noise, _NOISE_ORDER))
    out[np.ix_(places, places)] = inner * (n / max(n - len(places) - 1, 1))
    return out


def _later(x: Array, k: int) -> Array:
    return np.concatenate([np.zeros(k), x[: x.size - k]]) if k else x
