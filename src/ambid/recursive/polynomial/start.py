"""What an off-line fit says before the first sample: coefficients, their covariance, noise, operating point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.polynomial.orders import Layout
from ambid.blackbox.polynomial_model import PolynomialModel
from ambid.blackbox.structures import any_structure as structure
from ambid.errors import EstimationError
from ambid.recursive.polynomial.state import Forgetting, State, new_state

_WORTH = 100.0  # samples, of the noise variance of a fit that does not say how many it saw
_LOOSE = 100.0  # standard deviations of noise at the output: how far the operating point may have moved since
_FIXED = 1e-9  # relative standard deviation of a coefficient that the fit holds fixed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Identity:
    """Who a fit is about: what the recursion does not change."""

    structure: str
    layout: Layout
    dt: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: dict[str, str]


def identity_of(fit: BlackBoxFit) -> Identity:
    """Return what a fit says of itself.

    `fit`: of a polynomial structure, one output.
    """
    model = fit.model
    known = structure(fit.structure).home.startswith("ambid.blackbox.polynomial:")
    if not known or not isinstance(model, PolynomialModel):
        raise EstimationError(
            f"{fit.structure} is no prediction error fit of a polynomial model; it cannot be followed. Fit armax, say"
        )
    if model.n_outputs != 1:
        raise EstimationError(
            f"the fit has {model.n_outputs} outputs; the recursion follows one. Fit and track each output by itself"
        )
    p = model.outputs[0]
    nk = tuple(int(x) for x in _per_input(fit.orders.get("nk", 0), len(p.B)))
    layout = Layout(
        na=p.A.size - 1,
        nb=tuple(b.size - k for b, k in zip(p.B, nk, strict=True)),
        nc=p.C.size - 1,
        nd=p.D.size - 1,
        nf=tuple(f.size - 1 for f in p.F),
        nk=nk,
    )
    return Identity(
        structure=fit.structure,
        layout=layout,
        dt=fit.dt,
        inputs=fit.inputs,
        outputs=fit.outputs,
        units=dict(fit.units),
    )


def state_from_fit(fit: BlackBoxFit, layout: Layout, forgetting: Forgetting, *, samples: int | None = None) -> State:
    """Return a state whose prior information is what the fit knows."""
    noise = float(fit.noise_covariance[0, 0])
    if fit.covariance is None or not noise > 0.0:
        raise EstimationError(
            f"the {fit.structure} fit has {'no covariance' if fit.covariance is None else 'no noise'}; new data cannot "
            "be weighed against it. Start from orders alone"
        )
    full, free = fit.model.theta, layout.free
    n = free.size + 1
    theta, P = np.zeros(n), np.zeros((n, n))
    theta[: free.size] = full[free]
    P[: free.size, : free.size] = fit.covariance[np.ix_(free, free)] / noise
    scale = _magnitudes(full, layout)
    floor = (_FIXED * scale) ** 2 / noise
    k = np.arange(free.size)
    P[k, k] = np.maximum(P[k, k], floor)
    limit = np.full(n, np.inf)
    limit[: free.size] = np.maximum(scale**2, noise * P[k, k])
    p = layout.polynomials(full)
    gain = float(np.clip(abs(p.C.sum()) / max(abs(p.D.sum()), 1e-3), 1e-3, 1e3))
    P[-1, -1] = gain**2 / samples if samples else (_LOOSE * gain) ** 2
    limit[-1] = 4.0 * noise * (_LOOSE * gain) ** 2
    return new_state(
        layout,
        theta=theta,
        P=P,
        limit=limit,
        noise_variance=noise,
        weight=float(samples) if samples else _WORTH,
        centre=np.concatenate([fit.offsets.y, fit.offsets.u]),
        forgetting=forgetting,
    )


def _per_input(value: int | tuple[int, ...], n: int) -> tuple[int, ...]:
    return value if isinstance(value, tuple) else (value,) * n


def _magnitudes(full: Array, layout: Layout) -> Array:
    """Size of each free coefficient: one for A, C, D and F, that of the polynomial for B."""
    out = np.ones(full.size)
    for (letter, _), place in layout.places.items():
        if letter == "B" and place.stop > place.start:
            size = float(np.max(np.abs(full[place])))
            out[place] = size if size > 0.0 else 1.0
    return np.asarray(out[layout.free])
