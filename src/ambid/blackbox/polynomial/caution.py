"""What a reader of a polynomial fit has to be warned of: cancelling roots, roots at the border, an unstable plant."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.polynomial.orders import Layout
from ambid.blackbox.polynomial.predictor import predictor
from ambid.blackbox.polynomial.scaled import Scaled
from ambid.blackbox.polynomial.search import BLIND, Fitted, searched
from ambid.blackbox.polynomial.starts import starts
from ambid.blackbox.polynomial_model import PolynomialModel
from ambid.blackbox.roots import root_derivative, roots_at, roots_of

Complex = NDArray[np.complex128]

_SDS = 2.0  # two roots nearer than so many standard deviations of their distance are not told apart
_NEAR = 0.5  # roots farther apart do not cancel, however vague
_OUTER = 0.9  # roots inside are not at the border, however vague


def cautions(model: PolynomialModel, covariance: Array, fits: Sequence[Fitted]) -> list[str]:
    """Return warnings that follow from the roots and their spread.

    `covariance`: (n_theta, n_theta); `fits`: one for each output.
    """
    found = []
    for o, fit in enumerate(fits):
        where = f"output {o}: " if len(fits) > 1 else ""
        roots = _roots(model, o)
        found += [where + x for x in _blind(model, o, fit)]
        found += [where + x for x in _cancelling(roots, covariance)]
        found += [where + x for x in _at_border(roots, covariance, fit)]
    return found


def unstable_plant(layouts: Sequence[Layout], scaled: Scaled) -> list[str]:
    """Return a warning where the plant looks unstable, which a predictor with F cannot be."""
    found = []
    for o, x in enumerate(layouts):
        n = max(x.nf)
        armax = Layout(na=n, nb=x.nb, nc=n, nd=0, nf=(0,) * x.n_inputs, nk=x.nk, at_rest=x.at_rest)
        fit = searched(predictor(armax), scaled.y[o], scaled.u, next(starts(armax, scaled.y[o], scaled.u)), most=20)
        theta = fit.theta[armax.places["A", None]]
        if not n or not np.all(np.isfinite(theta)):
            continue
        roots = roots_of(theta)
        k = int(np.argmax(np.abs(roots)))
        scale = np.maximum(np.linalg.norm(fit.triangle, axis=0), 1e-150)
        row = np.zeros(armax.n_theta, dtype=np.complex128)
        row[armax.places["A", None]] = root_derivative(theta, roots[k : k + 1])[0]
        slope = np.real(row * np.conj(roots[k]))[armax.free] / abs(roots[k])
        variance = fit.cost / max(fit.n_rows - fit.nuisance.size - armax.free.size, 1)
        sd = np.sqrt(variance) * np.linalg.norm(np.linalg.lstsq((fit.triangle / scale).T, slope / scale, rcond=None)[0])
        if abs(roots[k]) > 1.0 + _SDS * sd:
            found.append(
                f"output {o}: the plant looks unstable (armax finds a pole of magnitude {abs(roots[k]):.4g}, "
                f"sd {sd:.1g}), which this structure cannot hold: its "
                "predictor would be unstable too. Use armax, arx or ararmax"
            )
    return found


def _roots(model: PolynomialModel, o: int) -> dict[str, tuple[Complex, Complex]]:
    """Roots of those polynomials of one output that have a partner or a border, with derivatives by all coefficients.

    B is looked at beside F or A and C, A and D beside C alone; there may be hundreds of roots that need no look.
    """
    p, several, out = model.outputs[o], model.n_inputs > 1, {}
    if p.C.size == 1 and all(f.size == 1 for f in p.F):
        return {}
    theta, noisy = model.theta, p.C.size > 1
    for output, letter, i, place in model.blocks():
        if output != o or not np.any(theta[place]):
            continue
        if letter in "AD" and not noisy:
            continue
        if letter == "B" and not (p.F[i or 0].size > 1 or (noisy and p.A.size > 1)):
            continue
        out[letter + (f".{i}" if several and i is not None else "")] = roots_at(theta, place)
    return out


def _blind(model: PolynomialModel, o: int, fit: Fitted) -> Iterator[str]:
    _, s, Vt, _ = fit.directions
    if not s.size or s[-1] * BLIND >= s[0]:
        return
    names = [name for name, place in _free_names(model, o, fit)]
    large = np.abs(Vt[-1]) > 0.3 * np.max(np.abs(Vt[-1]))
    which = ", ".join(x for x, big in zip(names, large, strict=True) if big)
    yield (
        f"the data do not tell {which} apart (condition number {s[0] / max(s[-1], 1e-300):.1e}): their values are "
        "arbitrary along one direction. Lower the orders, or excite more"
    )


def _free_names(model: PolynomialModel, o: int, fit: Fitted) -> Iterator[tuple[str, int]]:
    places = [k for output, _, _, place in model.blocks() if output == o for k in range(place.start, place.stop)]
    for k in fit.free:
        yield model.names[places[int(k)]], places[int(k)]


def _cancelling(roots: dict[str, tuple[Complex, Complex]], covariance: Array) -> Iterator[str]:
    """Name roots that numerator and denominator share within their uncertainty."""
    if not roots:
        return
    nothing = (np.empty(0, dtype=np.complex128), np.empty((0, covariance.shape[0]), dtype=np.complex128))
    numerators = [x for x in roots if x.startswith("B")]
    for b in numerators:
        f = b.replace("B", "F")
        for r in _common(roots[b], roots.get(f, nothing), covariance):
            yield f"a zero of {b} and a pole of {f} near {_shown(r)} cancel within their uncertainty. Lower nb and nf"
    for r in _common(roots["C"], roots.get("D", nothing), covariance):
        yield f"roots of C and D near {_shown(r)} cancel within their uncertainty. Lower nc and nd"
    if roots["C"][0].size and roots["A"][0].size:
        shared = [_common(roots["A"], roots[x], covariance) for x in ("C", *numerators)]
        for r in shared[0]:
            if all(r in x for x in shared[1:]):
                which = ", ".join(("A", *numerators, "C"))
                yield f"roots of {which} near {_shown(r)} cancel within their uncertainty. Lower the orders"


def _common(p: tuple[Complex, Complex], q: tuple[Complex, Complex], covariance: Array) -> list[complex]:
    """Roots of p (one of each conjugate pair) that are not told apart from some root of q."""
    found = []
    for r, dr in zip(*p, strict=True):
        if r.imag < 0:
            continue
        for s, ds in zip(*q, strict=True):
            d = dr - ds
            if np.all(np.isfinite(d)):
                variance = float(np.real(d @ covariance @ np.conj(d)))
                if abs(r - s) <= _NEAR and abs(r - s) ** 2 <= _SDS**2 * max(variance, 1e-24):
                    found.append(complex(r))
                    break
    return found


def _at_border(roots: dict[str, tuple[Complex, Complex]], covariance: Array, fit: Fitted) -> Iterator[str]:
    for name, (values, rows) in roots.items():
        if name[0] not in "CF" or not values.size:
            continue
        k = int(np.argmax(np.abs(values)))
        r = values[k]
        slope = np.real(rows[k] * np.conj(r)) / max(abs(r), 1e-300)
        sd = np.sqrt(max(float(slope @ covariance @ slope), 0.0)) if np.all(np.isfinite(slope)) else 0.0
        if (abs(r) > _OUTER and abs(r) + _SDS * sd >= 1.0) or (fit.at_border and abs(r) > 0.999):
            yield (
                f"a root of {name} of magnitude {abs(r):.6g} (sd {sd:.1g}) is at the border of stability: its standard "
                "deviation is not to be trusted. "
                + ("Lower nc" if name[0] == "C" else "If the plant integrates or is unstable, use armax or arx")
            )


def _shown(r: complex) -> str:
    return f"{r.real:.3g}" if not r.imag else f"{r.real:.3g} ± {abs(r.imag):.3g}j"
