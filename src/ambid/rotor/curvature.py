"""What the curvature of magnets does to a rotor's numbers: force and flux of a co-energy of fourth degree in position
and current, as a pair of magnets has beside its linear terms, tested in the residuals with their sizes unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array, Complex
from ambid.estimation.estimate import Check
from ambid.estimation.linear import directions, triangle_of
from ambid.estimation.uncertainty import chi_squared_tail
from ambid.rotor.likelihood import Experiment, Likelihood, Point, Weight, sampled

_DEGREE = 4
_SAME = 1e-5  # part of a column outside the Jacobian's space, squared, below which the data do not tell it from J
_CHANCE = 1e-4  # probability below which curvature counts as seen
_HARMLESS, _BENT = 1.5, 8.0  # standard deviations that it may move a number by, to be silent, and to be held


@dataclass(frozen=True, slots=True, kw_only=True)
class Bent:
    """Curvature as the residuals show it."""

    gain: float  # by how much it would lower the sum of squares
    p: float  # probability of that by chance
    shift: Mapping[str, float]  # of each number, SI
    # covariance that numbers by the names of `shift` have beside that of the record: what the shift is, not taken out,
    # and how far it is known
    more: Array

    @classmethod
    def none(cls) -> Bent:
        """Return that nothing shows."""
        return cls(gain=0.0, p=1.0, shift={}, more=np.zeros((0, 0)))


def curvature(problem: Likelihood, v: Array) -> Bent:
    """Return what curvature has done to the numbers; nothing where it does not show, or an axis has no coil."""
    model = problem.unknowns.model
    if len(model.coils) < len(model.axes):
        return Bent.none()
    rows, at = np.concatenate(problem.rows(v, corrected=True)), problem.point(v)
    pairs = zip(problem.experiments, problem.weights, strict=True)
    C = np.concatenate([_columns(problem, e, w, at) for e, w in pairs])
    C /= np.linalg.norm(C, axis=0)
    J, r = rows[:, :-1], rows[:, -1]
    moved = directions(triangle_of([J])).inverse(1e-9) @ (J.T @ C)
    outside = C - J @ moved
    values, axes = np.linalg.eigh(outside.T @ outside)
    axes, values = axes[:, values > _SAME], values[values > _SAME]
    along = axes.T @ (outside.T @ r)
    gain = float(np.sum(along**2 / values))
    p = chi_squared_tail(max(values.size, 1), gain / max(1.0, float(r @ r) / r.size))
    if p > _CHANCE:
        return Bent(gain=gain, p=p, shift={}, more=np.zeros((0, 0)))
    names, chain = problem.unknowns.chain(v)
    of_sizes = chain[: len(names)] @ moved @ axes
    shift = of_sizes @ (along / values)
    more = np.outer(shift, shift) + (of_sizes / values) @ of_sizes.T
    return Bent(gain=gain, p=p, shift=dict(zip(names, shift.tolist(), strict=True)), more=np.asarray(more))


def _columns(problem: Likelihood, e: Experiment, w: Weight, at: Point) -> Array:
    """Return what each term of each axis adds to the whitened outputs, (n_real, n_axes (degree + 1))."""
    model, spectra = problem.unknowns.model, e.spectra
    of, turned = sampled(e, model, at), model.at_speed(e.speed)
    x, n = of.states(spectra.mean_u), len(turned.coordinates)
    bins = np.round(spectra.frequency_hz * spectra.period / spectra.rate_hz).astype(int)
    places, states, D = x[:, :n] @ turned.rows(at.theta)[0].T, list(turned.states), of.disturbed()
    columns = []
    for j, axis in enumerate(model.axes):
        courses = (_course(q, bins, spectra.period) for q in (places[:, j], x[:, states.index(f"{axis}_current")]))
        (px, sx), (pi, si) = (_powers(s) for s in courses)
        for a in range(_DEGREE + 1):
            b = _DEGREE - a
            force = a / sx * px[max(a - 1, 0)] * pi[b]
            flux = b / si * px[a] * pi[max(b - 1, 0)]
            F, L = (np.fft.rfft(q)[bins] / spectra.period for q in (force, flux))
            rate = -1j * spectra.omega * L
            added = D[:, :, j] * F[:, None] + D[:, :, len(model.axes) + model.coils.index(j)] * rate[:, None]
            columns.append((w.whiten @ added[:, :, None])[:, :, 0].ravel())
    block = np.sqrt(2.0) * np.array(columns).T
    return np.concatenate([block.real, block.imag])


def _course(spectrum: Complex, bins: Array, period: int) -> Array:
    """Return a signal over one period by its lines."""
    whole = np.zeros(period // 2 + 1, dtype=complex)
    whole[bins] = spectrum * period
    return np.fft.irfft(whole, period)


def _powers(s: Array) -> tuple[list[Array], float]:
    """Return powers of a signal over its rms, and that."""
    size = max(float(s.std()), 1e-300)
    return [(s / size) ** k for k in range(_DEGREE + 1)], size


def curvature_check(bent: Bent, sd: Mapping[str, float]) -> Check:
    """Judge what curvature has done against the standard deviations of the record."""
    worst = max(bent.shift, key=lambda x: abs(bent.shift[x]) / (sd.get(x) or np.inf), default="")
    z = abs(bent.shift[worst]) / (sd.get(worst) or np.inf) if worst else 0.0
    if z <= _HARMLESS:
        return Check(passed=True, p=bent.p, detail="no curvature of the magnets shows that moves a number")
    held = z <= _BENT
    text = f"curvature of the magnets shows, and moves {worst} by {z:.2g} sd of the record: the intervals hold it"
    if held:
        return Check(passed=True, p=bent.p, values={"z": z}, detail=text)
    return Check(
        passed=False, p=bent.p, values={"z": z}, detail=f"{text} to first order. Excite less", cause="curvature"
    )
