"""Derivatives of a fit's one-step predictions along everything that was estimated, whatever the estimator was.

Residual tests project these directions out: to first order, that takes the error of the estimate out of the residuals.
Polynomial models have the five exact filters of thesis ch. 3 (theory.md, 2.5; Ljung 1999, eq. 10.54). A transfer
function is an output-error polynomial model once it is discretised. A full state space moves along every entry of A, B,
D and K; C moves nothing more where it has full row rank, because states can be exchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.polynomial_model import PolynomialModel, Polynomials
from ambid.blackbox.response import Sensitivities, run_states, stable
from ambid.blackbox.transfer_model import TransferModel
from ambid.validate.blackbox.predictor import Errors, held_transfer

Indices = NDArray[np.intp]

_BLOCK = 4096  # samples at once


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gradient:
    """Derivatives of the predictions, one array for each output."""

    rows: tuple[Array, ...]
    # place of each direction in ``model.theta``; None where directions are not coefficients
    theta: tuple[Indices, ...] | None


def gradient(fit: BlackBoxFit, data: IOData, found: Errors) -> Gradient:
    """Differentiate the one-step predictions.

    `found`: the data run through the fit. Returns started from rest: the first samples are not exact.
    """
    u, y = data.u - fit.offsets.u, data.y - fit.offsets.y
    model = fit.model
    if isinstance(model, PolynomialModel):
        free = _free(fit, model)
        rows, places, first = list[Array](), list[Indices](), 0
        for o, p in enumerate(model.outputs):
            every = polynomial_gradient(p, u, y[:, o], found.one_step[:, o])
            own = np.nonzero(free[first : first + every.shape[1]])[0]
            rows.append(every[:, own])
            places.append(own + first)
            first += every.shape[1]
        return Gradient(rows=tuple(rows), theta=tuple(places))
    if isinstance(model, TransferModel) and stable(found.plant):
        return Gradient(
            rows=tuple(_transfer_gradient(model, fit.dt, o, u, y, found) for o in range(model.n_outputs)), theta=None
        )
    return Gradient(rows=_state_space_tangent(fit, found, u, y), theta=None)


def polynomial_gradient(p: Polynomials, u: Array, y: Array, e: Array) -> Array:
    """Differentiate the predictions of one output by all of its coefficients, from rest.

    `u`: (n_samples, n_inputs), without offsets; `y`: (n_samples,), without offset; `e`: (n_samples,), one-step errors.
    Returns (n_samples, n_coefficients), in the order of ``Polynomials.parts``; leading ones included, as if they could
    move.
    """
    from scipy.signal import lfilter

    whitened = [lfilter(p.D, p.C, lfilter([1.0], f, u[:, i])) for i, f in enumerate(p.F)]  # D/(C F) u
    v = lfilter(p.A, [1.0], y) - sum(
        (lfilter(b, f, u[:, i]) for i, (b, f) in enumerate(zip(p.B, p.F, strict=True))), np.zeros_like(y)
    )
    blocks = list[Array]()
    for letter, i, c in p.parts():
        if letter == "A":
            base = -lfilter(p.D, p.C, y)
        elif letter == "B" and i is not None:
            base = whitened[i]
        elif letter == "C":
            base = lfilter([1.0], p.C, e)
        elif letter == "D":
            base = -lfilter([1.0], p.C, v)
        else:
            base = -lfilter(p.B[i or 0], p.F[i or 0], whitened[i or 0])
        blocks.append(_delayed(base, c.size))
    return np.hstack(blocks)


def _delayed(x: Array, count: int) -> Array:
    """Columns of x, x one sample later and so on."""
    out = np.zeros((x.size, count))
    for k in range(min(count, x.size)):
        out[k:, k] = x[: x.size - k]
    return out


def _free(fit: BlackBoxFit, model: PolynomialModel) -> NDArray[np.bool_]:
    """Coefficients that were estimated: those with a variance, or, where there is none, all that are not 0 or 1."""
    if fit.covariance is not None:
        return np.asarray(np.diag(fit.covariance) > 0)
    free = model.theta != 0
    for _, letter, _, place in model.blocks():
        if letter != "B":
            free[place.start] = False
    return np.asarray(free)


def _transfer_gradient(model: TransferModel, dt: float, o: int, u: Array, y: Array, found: Errors) -> Array:
    from scipy.signal import ss2tf

    B, F = list[Array](), list[Array]()
    for i in range(model.n_inputs):
        one = TransferModel(num=((model.num[o][i],),), den=((model.den[o][i],),), dt=model.dt, delay=(model.delay[i],))
        ss = one.state_space() if one.dt is not None else held_transfer(one, dt)
        num, den = ss2tf(ss.A, ss.B, ss.C, ss.D) if ss.order else (ss.D, np.ones(1))
        used = int(np.nonzero(np.abs(den) > 1e-12)[0][-1]) + 1
        B.append(np.where(np.abs(num[0]) > 1e-12 * np.max(np.abs(num[0])), num[0], 0.0))
        F.append(np.asarray(den[:used]))
    p = Polynomials(A=np.ones(1), B=tuple(B), C=np.ones(1), D=np.ones(1), F=tuple(F))
    every = polynomial_gradient(p, u, y[:, o], found.one_step[:, o])
    free, first = list[int](), 0
    for letter, _, c in p.parts():
        free += [first + k for k in range(c.size) if (k > 0 if letter == "F" else letter == "B" and c[k] != 0)]
        first += c.size
    return every[:, free]


def _state_space_tangent(fit: BlackBoxFit, found: Errors, u: Array, y: Array) -> tuple[Array, ...]:
    """Move along every entry of A and B, of K where there is noise, and of D where there is any.

    Entries that were not estimated, as those of a delay that was given, stand still: moving them would take a wrong
    delay out of the residuals.
    """
    m = found.model
    x = run_states(m.A - m.K @ m.C, np.hstack([m.B - m.K @ m.D, m.K]), np.hstack([u, y]))
    moves = {"A": True, "B": True, "C": False, "D": bool(np.any(m.D)), "K": bool(np.any(m.K))}
    free = np.concatenate([np.full(getattr(m, name).size, moves[name]) for name in "ABCDK"])
    if fit.covariance is not None and fit.covariance.shape[0] == free.size:
        free &= np.diag(fit.covariance) > 0
    along = Sensitivities(m, np.eye(free.size)[:, free])
    signals = np.hstack([x, u, found.one_step])
    blocks = [along.block(signals[k : k + _BLOCK]) for k in range(0, u.shape[0], _BLOCK)]
    return tuple(np.concatenate(blocks, axis=1))
