"""Orders that are too high: poles that cannot be told from zeros, and last coefficients that may be zero.

Too high an order puts a pole on a zero, anywhere: their difference is within its own 99.9 % region around 0 (delta
method; wide, because the likelihood is then far from a parabola). Which pairs could cancel depends on the structure: B
with F, C with D, A with C and B at once (ARMAX); in ARX a factor common to A and B is a noise model.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import PolynomialModel, StateSpaceModel, TransferModel, roots_at
from ambid.errors import counted
from ambid.estimation.estimate import Check
from ambid.estimation.uncertainty import p_text

Complex = NDArray[np.complex128]
_CHI2_999 = (10.827566170662733, 13.815510557964274)  # of one and two degrees of freedom
_P_LEAST = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Cancellation:
    """A pole and a zero that cannot be distinguished."""

    pole: complex  # in z, or rad/s for a continuous model
    zero: complex
    where: str  # which polynomials
    distance: float  # over that at the edge of the 99.9 % region: less than 1


def orders_supported(fit: BlackBoxFit) -> Check | None:
    """Check whether fewer coefficients would do; None where the fit has no covariance to judge by."""
    if fit.covariance is None or not np.any(fit.covariance):
        return None
    pairs = cancellations(fit)
    idle, p = _idle_order(fit)
    n = len(pairs)
    if pairs:
        worst = min(pairs, key=lambda c: c.distance)
        detail = (
            f"{counted(n, 'pole')} cannot be distinguished from a zero ({worst.where}: pole {_shown(worst.pole)}, "
            f"zero {_shown(worst.zero)}): the order is higher than the data support. Lower it"
        )
    elif idle and p is not None:
        detail = (
            f"the last coefficients {', '.join(idle)} may all be zero ({p_text(p)}): a lower order suffices. Lower "
            "the orders"
        )
    else:
        detail = "no pole–zero cancellation, and the last coefficients are not zero"
    return Check(passed=not pairs and not idle, p=p, values={"cancellations": float(n)}, detail=detail)


def cancellations(fit: BlackBoxFit) -> tuple[Cancellation, ...]:
    """Find pole-zero pairs that are within the 99.9 % region of their difference, one of each complex pair."""
    if fit.covariance is None:
        return ()
    pairs = list[Cancellation]()
    for where, poles, zeros in _families(fit):
        paired = set[int]()
        for k, pole in enumerate(poles[0]):
            if pole.imag < 0:
                continue
            near = [(_distance(pole, poles[1][k], z, zeros[1][j], fit.covariance), j) for j, z in enumerate(zeros[0])]
            near = [(d, j) for d, j in near if j not in paired and d < 1.0]
            if near:
                d, j = min(near)
                paired.add(j)
                pairs.append(Cancellation(pole=complex(pole), zero=complex(zeros[0][j]), where=where, distance=d))
    return tuple(pairs)


Roots = tuple[Complex, Complex]


def _distance(pole: complex, dp: Complex, zero: complex, dz: Complex, covariance: Array) -> float:
    """Distance over that at the edge of the 99.9 % region; infinite where no spread exists."""
    gap, slope = pole - zero, dp - dz
    if not np.all(np.isfinite(slope)):
        return np.inf
    real = abs(pole.imag) < 1e-12 and abs(zero.imag) < 1e-12
    parts = slope.real[None, :] if real else np.stack([slope.real, slope.imag])
    S = parts @ covariance @ parts.T
    values, vectors = np.linalg.eigh(S)
    if values[0] <= 0:
        return np.inf
    v = vectors.T @ (np.array([gap.real]) if real else np.array([gap.real, gap.imag]))
    return float(np.sqrt(np.sum(v**2 / values) / _CHI2_999[len(v) - 1]))


def _families(fit: BlackBoxFit) -> Iterator[tuple[str, Roots, Roots]]:
    """Yield (polynomials, poles, zeros) of all factors that could cancel; roots with derivatives by theta."""
    model = fit.model
    if isinstance(model, PolynomialModel):
        yield from _polynomial_families(model)
    elif isinstance(model, TransferModel):
        theta = model.theta
        parts = {(o, i, which): place for o, which, i, place in model.blocks()}
        for o, i in np.ndindex(model.n_outputs, model.n_inputs):
            den, num = (roots_at(theta, parts[o, i, which]) for which in ("den", "num"))
            yield "num and den", den, num
    elif isinstance(model, StateSpaceModel) and model.n_inputs == model.n_outputs and not np.any(model.K):
        # with a gain, a state that no input reaches may be one of the noise
        yield "of G", (model.poles(), model.pole_derivative()), (model.zeros(), model.zero_derivative())


def _polynomial_families(model: PolynomialModel) -> Iterator[tuple[str, Roots, Roots]]:
    theta, several = model.theta, model.n_outputs > 1
    places: dict[tuple[int, str, int | None], slice] = {(o, letter, i): s for o, letter, i, s in model.blocks()}
    for o, p in enumerate(model.outputs):
        name = f", output {o + 1}" if several else ""
        for i, f in enumerate(p.F):
            if f.size > 1:
                yield f"B and F{name}", roots_at(theta, places[o, "F", i]), roots_at(theta, places[o, "B", i])
        if p.D.size > 1 and p.C.size > 1:
            yield f"C and D{name}", roots_at(theta, places[o, "D", None]), roots_at(theta, places[o, "C", None])
        if p.A.size > 1 and p.C.size > 1 and p.D.size == 1:
            if not model.n_inputs:
                yield f"A and C{name}", roots_at(theta, places[o, "A", None]), roots_at(theta, places[o, "C", None])
            elif model.n_inputs == 1:
                yield from _common(theta, places, o, name)


def _common(
    theta: Array, places: dict[tuple[int, str, int | None], slice], o: int, name: str
) -> Iterator[tuple[str, Roots, Roots]]:
    """A with B, as far as C has the factor too: poles that are a root of B are compared with C."""
    A, B, C = (roots_at(theta, places[o, letter, i]) for letter, i in (("A", None), ("B", 0), ("C", None)))
    if not B[0].size or not C[0].size:
        return
    # the zero of C nearest to each pole, judged with the zero of B nearest to it: both must be there
    nearest_b = [int(np.argmin(np.abs(B[0] - pole))) for pole in A[0]]
    middle = (B[0][nearest_b], B[1][nearest_b])
    nearest_c = [int(np.argmin(np.abs(C[0] - pole))) for pole in A[0]]
    for k in range(A[0].size):
        gap_b, gap_c = abs(A[0][k] - middle[0][k]), abs(A[0][k] - C[0][nearest_c[k]])
        far = middle if gap_b > gap_c else (C[0][nearest_c], C[1][nearest_c])
        yield f"A with B and C{name}", (A[0][k : k + 1], A[1][k : k + 1]), (far[0][k : k + 1], far[1][k : k + 1])


def _idle_order(fit: BlackBoxFit) -> tuple[list[str], float | None]:
    """Wald test that the last estimated coefficients of A and all B (ARX), or of B (FIR), are zero together."""
    from scipy.special import chdtrc

    model = fit.model
    if not isinstance(model, PolynomialModel) or fit.covariance is None:
        return [], None
    last = list[int]()
    for o, letter, _, place in model.blocks():
        p = model.outputs[o]
        if p.C.size > 1 or p.D.size > 1 or any(f.size > 1 for f in p.F):
            return [], None
        if letter in "AB" and place.stop - place.start > 1 and fit.covariance[place.stop - 1, place.stop - 1] > 0:
            last.append(place.stop - 1)
    if not last:
        return [], None
    S = fit.covariance[np.ix_(last, last)]
    c = model.theta[last]
    p_value = float(chdtrc(len(last), max(float(c @ np.linalg.lstsq(S, c, rcond=1e-12)[0]), 0.0)))
    return ([] if p_value <= _P_LEAST else [model.names[k] for k in last]), p_value  # NaN shows nothing either


def _shown(root: complex) -> str:
    return f"{root.real:.4g}" if abs(root.imag) < 1e-12 else f"{root.real:.4g}{root.imag:+.4g}j"
