"""A black-box fit judged: fit, criteria, checks, and its errors on a second record.

Residuals of an output-error model may be coloured; its covariance is then (J'J)^-1 J' R J (J'J)^-1 with R the
covariance of the noise (Soederstrom and Stoica 1989, sec. 7.5; Ljung 1999, sec. 9.4), not the (J'J)^-1 var(v) of white
noise, which may be many times too small for slow noise, or too large.

A model of too high an order puts a pole and a zero on top of each other, anywhere: their difference is then within its
own 99.9 % region around 0 (delta method; wide, because where an order is too high the likelihood is far from a
parabola), and their place means nothing. Which pairs could cancel depends on the structure: B with F, C with D, A with
C and B at once (ARMAX); in ARX a factor common to A and B is a noise model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import StateSpaceModel
from ambid.blackbox.polynomial_model import PolynomialModel
from ambid.blackbox.roots import roots_at
from ambid.blackbox.structures import structure
from ambid.blackbox.transfer_model import TransferModel
from ambid.estimation.criteria import criteria, skipped
from ambid.estimation.linear import triangle_of
from ambid.estimation.parts import Check
from ambid.validate.blackbox_predictor import Errors, Gradient, errors, errors_elsewhere, gradient
from ambid.validate.residuals import (
    LEAST,
    MOST,
    Residuals,
    ResidualTests,
    Sizes,
    Subject,
    autoregression,
    describe_feedback,
    error_sizes,
    filter_backwards,
    output_fits,
    power_gain,
    refuse_constant,
    residual_checks,
    residual_tests,
)

Complex = NDArray[np.complex128]

_ASSUME_WHITE = ("fir", "oe")  # covariance of white noise; the instrumental structures allow for the colour
_CHI2_999 = (10.827566170662733, 13.815510557964274)  # of one and two degrees of freedom
_P_LEAST = 0.05


def judge(fit: BlackBoxFit, data: IOData, *, second: IOData | None = None) -> BlackBoxFit:
    """Judge a fit on the data that it was estimated from and, where given, on a second record.

    Returns it with `fit`, `criteria`, `checks` and, for a second record, `validation`. An output-error model whose
    residuals are coloured gets the covariance that holds for coloured noise, and says so in its warnings.
    """
    found = errors(fit, data)
    sound = bool(np.all(np.isfinite(found.one_step)))
    checks = {"stable_predictor": _check_predictor(found)}
    covariance, more = fit.covariance, list[str]()
    if sound and checks["stable_predictor"].passed and data.n_samples >= LEAST:
        part, tail = _last(data, found)
        slopes = gradient(fit, part, tail)
        residuals = residuals_of(fit, part, tail, slopes)
        tests = residual_tests(residuals, open_loop=data.open_loop)
        colours = [np.ones(1) if c is None else c for c in residuals.colours]
        if any(c.size > 1 for c in colours) and fit.structure in _ASSUME_WHITE:
            whole = slopes if part is data else None
            again = None if whole is None else coloured_covariance(fit, found.one_step, whole, colours)
            covariance = fit.covariance if again is None else again
            more += _coloured_warning(fit, adjusted=again is not None)
        biased = structure(fit.structure).feedback == "biased"
        subject = Subject(name=fit.structure, coloured=not found.claims_noise, biased=biased)
        checks |= residual_checks(tests, subject)
        more += _feedback_warning(subject, tests, open_loop=data.open_loop)
    fit = replace(fit, covariance=covariance)
    supported = orders_supported(fit)
    if supported is not None:
        checks["orders_supported"] = supported
    return replace(
        fit,
        fit=output_fits(fit.outputs, *_sizes(found, data), fit.noise_covariance),
        criteria=criteria(found.one_step, data.y, fit.n_estimated) if sound else {},
        checks=checks,
        validation=None if second is None else validation(fit, second),
        warnings=(*fit.warnings, *more),
    )


def validation(fit: BlackBoxFit, second: IOData) -> dict[str, object]:
    """Judge a fit on data that were not used in the estimation.

    Returns by output: ``one_step`` and ``simulation`` (None where unstable, or without inputs), each with ``fit`` (1 -
    |e|/|y - mean|) and ``rmse`` (SI). The model is kept; initial state and a constant error are fitted, because a
    record's operating point is not a property of the model.
    """
    refuse_constant(second)
    one, free = _sizes(errors_elsewhere(fit, second), second)
    return {
        name: {"one_step": one[j], "simulation": None if free is None else free[j]}
        for j, name in enumerate(fit.outputs)
    }


def _sizes(found: Errors, data: IOData) -> tuple[Sizes, Sizes | None]:
    free = None if found.simulation is None else error_sizes([found.simulation], [data.y])
    return error_sizes([found.one_step], [data.y]), free


def _last(data: IOData, found: Errors) -> tuple[IOData, Errors]:
    """Return the last part of a long record: as much as the derivatives of a large model leave room for."""
    m = found.model
    width = (m.order + 1) * (m.order + m.n_inputs + m.n_outputs)
    first = data.n_samples - int(MOST / width)
    if first <= 0:
        return data, found
    return data.part(first, data.n_samples), replace(found, one_step=found.one_step[first:], simulation=None)


def residuals_of(fit: BlackBoxFit, data: IOData, found: Errors, slopes: Gradient) -> Residuals:
    """Prepare what the residual tests look at: the data run through the fit, and derivatives of its predictions.

    In a loop, a model without noise is tested against the reference, where there is one: inputs hold the noise.
    """
    first = skipped(data.n_samples)
    loop = not found.claims_noise and structure(fit.structure).feedback == "consistent" and bool(data.references)
    u = data.u - data.u.mean(axis=0)
    return Residuals(
        e=[found.one_step - found.one_step.mean(axis=0)],
        u=[u],
        J=[[rows] for rows in slopes.rows],
        first=first,
        colours=[None if found.claims_noise else autoregression(e[first:]) for e in found.one_step.T],
        source=[data.reference - data.reference.mean(axis=0)] if loop else [u],
        instrumental=loop,
        nonlinear=False,
        outputs=data.outputs if data.n_outputs > 1 else (),
        inputs=data.inputs,
    )


def _check_predictor(found: Errors) -> Check:
    """Check that the one-step errors do not grow by themselves."""
    m = found.model
    radius = float(np.max(np.abs(np.linalg.eigvals(m.A - m.K @ m.C)), initial=0.0)) if m.order else 0.0
    ok = radius < 1.0
    return Check(
        passed=ok,
        values={"radius": radius},
        detail=f"the predictor's poles are within {radius:.4g} of zero"
        + ("" if ok else ": its errors grow without bound. Take a structure with a noise model, or other orders"),
    )


def _feedback_warning(subject: Subject, tests: ResidualTests, *, open_loop: bool) -> list[str]:
    """Warn where the data show feedback that the user or the structure excludes."""
    if tests.feedback is None or tests.feedback.passed:
        return []
    evidence = f"{describe_feedback(tests.feedback)} (p = {tests.feedback.p:.2g})"
    if subject.biased:
        if tests.explained_by_inputs:
            return [f"{evidence}: feedback, by which {subject.name} is biased, or what the model misses"]
        return [f"there is feedback in this record: {evidence}; {subject.name} is biased by it. Use bj, armax or pbsid"]
    if open_loop and not tests.explained_by_inputs:
        return [f"the record is said to be open loop, but {evidence}: leave --open-loop out"]
    return []


def _coloured_warning(fit: BlackBoxFit, *, adjusted: bool) -> list[str]:
    """Say how far the standard deviations of an output-error model hold under coloured noise."""
    if adjusted:
        return [
            f"the noise is coloured, which {fit.structure} does not describe: standard deviations allow for it; "
            "a noise model (bj) would make them smaller"
        ]
    if fit.covariance is None:
        return []
    return [
        f"the noise is coloured, which {fit.structure} does not describe; its standard deviations are those of "
        "white noise: they may be too small. Use a structure with a noise model"
    ]


def coloured_covariance(fit: BlackBoxFit, e: Array, slopes: Gradient, colours: Sequence[Array]) -> Array | None:
    """Return the covariance (n_theta, n_theta) of an output-error model's coefficients under coloured noise.

    `e`: (n_samples, n_outputs), simulation errors; `slopes`: derivatives of the simulation; `colours`: autoregression
    of the errors of each output, which are taken to be independent of each other. None where directions are not
    coefficients, or not independent.
    """
    if slopes.theta is None or fit.covariance is None:
        return None
    out = np.zeros_like(fit.covariance)
    for o, (J, place) in enumerate(zip(slopes.rows, slopes.theta, strict=True)):
        if not place.size:
            continue
        size = np.linalg.norm(J, axis=0)
        if not np.all(size > 0):
            return None
        wide = np.hstack([J / size, np.full((J.shape[0], 1), 1 / np.sqrt(J.shape[0]))])  # the constant is estimated too
        Q, R = np.linalg.qr(wide)
        if np.min(np.abs(np.diag(R))) < 1e-10:
            return None
        noise = float(np.mean((e[:, o] - e[:, o].mean()) ** 2)) * J.shape[0] / max(J.shape[0] - wide.shape[1], 1)
        half = triangle_of([filter_backwards(Q, colours[o])]) @ np.linalg.inv(R).T
        inner = half.T @ half * noise / power_gain(colours[o])
        out[np.ix_(place, place)] = inner[:-1, :-1] / np.outer(size, size)
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Cancellation:
    """A pole and a zero that cannot be told apart."""

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
            f"{n} pole{'s' if n > 1 else ''} cannot be told from a zero ({worst.where}: pole {_shown(worst.pole)}, "
            f"zero {_shown(worst.zero)}): the order is higher than the data support. Lower it"
        )
    elif idle:
        detail = (
            f"the last coefficients {', '.join(idle)} may all be zero (p = {p:.2g}): fewer would do. Lower the orders"
        )
    else:
        detail = "no pole meets a zero, and the last coefficients are not zero"
    return Check(passed=not pairs and not idle, p=p, values={"cancellations": float(n)}, detail=detail)


def cancellations(fit: BlackBoxFit) -> tuple[Cancellation, ...]:
    """Find pole-zero pairs that are within the 99.9 % region of their difference, one of each complex pair."""
    if fit.covariance is None:
        return ()
    found = list[Cancellation]()
    for where, poles, zeros in _families(fit):
        used = set[int]()
        for k, pole in enumerate(poles[0]):
            if pole.imag < 0:
                continue
            near = [(_distance(pole, poles[1][k], z, zeros[1][j], fit.covariance), j) for j, z in enumerate(zeros[0])]
            near = [(d, j) for d, j in near if j not in used and d < 1.0]
            if near:
                d, j = min(near)
                used.add(j)
                found.append(Cancellation(pole=complex(pole), zero=complex(zeros[0][j]), where=where, distance=d))
    return tuple(found)


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
        parts = {(o, i, which): place for o, i, which, _, place in model.parts()}
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
    p_value = float(chdtrc(len(last), float(c @ np.linalg.lstsq(S, c, rcond=1e-12)[0])))
    return ([model.names[k] for k in last] if p_value > _P_LEAST else []), p_value


def _shown(root: complex) -> str:
    return f"{root.real:.4g}" if abs(root.imag) < 1e-12 else f"{root.real:.4g}{root.imag:+.4g}j"
