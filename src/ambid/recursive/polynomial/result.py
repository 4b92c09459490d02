"""What a recursion says at any moment, in the form of an off-line result: model, operating point, spread, warnings."""

from __future__ import annotations

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.polynomial.orders import shown_orders
from ambid.blackbox.polynomial_model import PolynomialModel
from ambid.blackbox.response import Offsets
from ambid.blackbox.structures import structure
from ambid.recursive.polynomial.start import Identity
from ambid.recursive.polynomial.state import Forgetting, State, noise_variance_of

_WORSE = 1.5  # growth, or fall to one over it, of the innovations' standard deviation that is told
_FEW = 20  # samples of memory for each coefficient, below which gradients of C, D and F mislead
_INTEGRATES = 1e-6  # A(1) over sum |A|, below which a constant cannot be an offset of the output


def model_of(who: Identity, full: Array) -> PolynomialModel:
    """Return all coefficients as a model.

    `full`: (n_theta,).
    """
    return PolynomialModel(outputs=(who.layout.polynomials(full),), dt=who.dt)


def offsets_of(model: PolynomialModel, state: State) -> Offsets:
    """Turn the constant of A y = (B/F) u + constant into an operating point.

    It is the output's, unless A sums to zero: an integrating plant has any level, and the constant stands for an offset
    of its inputs.
    """
    centre, constant, p = state.levels.copy(), float(state.at[-1]), model.outputs[0]
    level = float(p.A.sum())
    gain = np.array([b.sum() / f.sum() if f.sum() else np.inf for b, f in zip(p.B, p.F, strict=True)])
    if abs(level) > _INTEGRATES * float(np.abs(p.A).sum()):
        centre[0] += constant / level
    elif gain.size and np.all(np.isfinite(gain)) and np.any(gain):
        centre[1:] -= constant * gain / float(gain @ gain)
    return Offsets(u=centre[1:], y=centre[:1])


def warnings_of(
    who: Identity, state: State | None, forgetting: Forgetting, *, open_loop: bool, doubtful: bool
) -> tuple[str, ...]:
    """Return what a reader of the estimate has to know.

    `state`: none where there is no estimate yet; `open_loop`: whether the user says that no feedback is at work;
    `doubtful`: whether the fit with which it began did not converge.
    """
    name, found = who.structure, []
    if state is None:
        found.append(f"{name}: the first window is not full: there is no estimate yet")
    if doubtful:
        found.append(
            f"{name}: the search for the first estimate did not converge: coefficients may be wrong by as much as "
            "they are large, and standard deviations say so. "
            "Lower the orders, or begin with a fit that did"
        )
    x, least = who.layout, _FEW * (who.layout.free.size + 1)
    memory = forgetting.memory
    if memory < least and (x.nc or x.nd or any(x.nf)):
        found.append(
            f"{name}: a memory of {memory:.3g} samples is short for {x.free.size} coefficients and a constant: the "
            "estimate may lock at the border after a standstill, and standard deviations are too small. Remember "
            f"{least} samples or more, or use arx"
        )
    if structure(name).feedback == "biased" and not open_loop:
        found.append(
            f"{name} is biased where a controller is at work, and nothing says that this loop is open: use bj or "
            "armax, or say open_loop if there is no feedback"
        )
    if state is None:
        return tuple(found)
    if state.at_border:
        found.append(
            f"{name}: the data ask, or often asked, for an unstable C or F; stable coefficients are shown and their "
            "standard deviations are not to be trusted. If the plant integrates or is unstable, use armax or arx"
        )
    if state.worse > _WORSE:
        found.append(
            f"{name}: errors of prediction are {state.worse:.2g} times those at the start: the noise has grown, or the "
            "structure does not hold what the data show. Raise the orders, or forget faster"
        )
    if state.worse < 1.0 / _WORSE:
        found.append(
            f"{name}: errors of prediction are {state.worse:.2g} times those at the start: the noise has fallen, or "
            "the signals stand still and tell nothing; without forgetting, standard deviations are too small then. "
            "Look at the signals"
        )
    if state.waits:
        found.append(f"{name}: nothing is learnt at present: the filters wait for history after the start or a gap")
    return tuple(found)


def fit_of(
    who: Identity,
    model: PolynomialModel,
    state: State,
    spread: Array,
    *,
    samples: int,
    warnings: tuple[str, ...],
) -> BlackBoxFit:
    """Return the present estimate as a fit.

    `spread`: (n_free, n_free), covariance of the free coefficients; `samples`: taken in so far.
    """
    covariance, free = np.zeros((model.theta.size,) * 2), who.layout.free
    covariance[np.ix_(free, free)] = spread
    return BlackBoxFit(
        structure=who.structure,
        orders=shown_orders(who.structure, who.layout),
        model=model,
        covariance=covariance,
        n_estimated=free.size,
        offsets=offsets_of(model, state),
        noise_covariance=np.array([[noise_variance_of(state)]]),
        inputs=who.inputs,
        outputs=who.outputs,
        units=dict(who.units),
        dt=who.dt,
        record={"samples": samples, "rate_hz": 1.0 / who.dt},
        warnings=warnings,
        details={"recursive": True, **state.counts()},
    )
