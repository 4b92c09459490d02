"""A mode of vibration with its uncertainty, as every estimator of modes gives it, and the likeness of two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check, Judged
from ambid.estimation.result import NORMAL_95


def assurance(one: Sequence[complex], other: Sequence[complex]) -> float:
    """Return the modal assurance criterion |a* b|^2 / (a* a b* b) of two mode shapes (Allemang and Brown 1982): 1 for
    equal shapes, whatever their size; 0 for orthogonal ones.
    """
    a, b = np.asarray(one, dtype=np.complex128), np.asarray(other, dtype=np.complex128)
    size = float(np.vdot(a, a).real * np.vdot(b, b).real)
    return float(abs(np.vdot(a, b)) ** 2 / size) if size > 0 else 0.0


class OfPole:
    """What follows from a pole in continuous time."""

    __slots__ = ()
    pole: complex

    @property
    def frequency_hz(self) -> float:
        """Natural frequency, |pole|/(2 pi)."""
        return abs(self.pole) / (2 * np.pi)

    @property
    def damping(self) -> float:
        """-Re(pole)/|pole|; negative for an unstable pole."""
        return -self.pole.real / abs(self.pole) if self.pole else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PoleCluster(OfPole):
    """A cluster of stable poles: a mode of the plant."""

    pole: complex  # in continuous time, log(z)/dt; of a complex pair the one above the real axis; median of a cluster
    orders: tuple[int, ...]  # models that show it


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialPole(PoleCluster):
    """One pole of one model."""

    shape: tuple[complex, ...]  # mode shape: the outputs that go with the pole, largest 1
    stable_frequency: bool = False  # whether the next lower order has a pole that agrees in that
    stable: bool = False  # whether it agrees in frequency, damping and shape

    @property
    def order(self) -> int:
        """Order of the model."""
        return self.orders[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerance:
    """How near poles of neighbouring orders are to each other to count as one."""

    frequency: float = 0.01  # relative
    damping: float = 0.05  # relative to the damping, or to `least` where that is larger
    least: float = 0.1
    shape: float = 0.98  # assurance
    share: float = 0.4  # part of the orders, from a cluster's first one on, that must show it


def trial_poles(order: int, poles: Complex, shapes: Complex) -> list[TrialPole]:
    """Return poles of one model (n,), rad/s, with shapes (n, n_outputs), by their angle; those below the real axis are
    left out.
    """
    out = list[TrialPole]()
    for p, v in sorted(zip(poles, shapes, strict=True), key=lambda x: abs(x[0].imag)):
        if p.imag < 0:
            continue
        largest = v[np.argmax(np.abs(v))]
        shape = tuple(complex(x) for x in (v / largest if abs(largest) > 0 else v))
        out.append(TrialPole(orders=(order,), pole=complex(p), shape=shape))
    return out


def followed(rows: Sequence[Sequence[TrialPole]], near: Tolerance) -> list[TrialPole]:
    """Return the poles of all models, lowest order first, each compared with those of the order below."""
    marked = list(rows[0])
    for before, after in pairwise(rows):
        marked += [_mark(p, before, near) for p in after]
    return marked


def _mark(p: TrialPole, before: Sequence[TrialPole], near: Tolerance) -> TrialPole:
    """Compare a pole with the nearest one of the order below that is of its kind."""
    same = [q for q in before if (q.pole.imag > 0) == (p.pole.imag > 0)]
    if not same:
        return p
    next_to = min(same, key=lambda q: abs(q.pole - p.pole))
    f, g, c, d = p.frequency_hz, next_to.frequency_hz, p.damping, next_to.damping
    same_frequency = abs(f - g) <= near.frequency * max(f, g, 1e-300)
    same_damping = abs(c - d) <= near.damping * max(abs(c), abs(d), near.least)
    stable = same_frequency and same_damping and assurance(p.shape, next_to.shape) >= near.shape
    return replace(p, stable_frequency=same_frequency, stable=stable)


def clusters(poles: Sequence[TrialPole], models: Sequence[int], near: Tolerance) -> tuple[PoleCluster, ...]:
    """Gather stable poles of models of these orders: from the highest order down, each joins the cluster it is near to,
    or begins one. Returns those that enough orders share, lowest frequency first.
    """
    gathered = list[list[TrialPole]]()
    for p in sorted((p for p in poles if p.stable), key=lambda p: -p.order):
        fitting = [c for c in gathered if _belongs(p, c, near)]
        if fitting:
            min(fitting, key=lambda c: abs(_centre(c) - p.pole)).append(p)
        else:
            gathered.append([p])
    out = list[PoleCluster]()
    for c in gathered:
        orders = sorted({p.order for p in c})
        if len(orders) < max(3, near.share * sum(n >= orders[0] for n in models)):
            continue
        out.append(PoleCluster(pole=_centre(c), orders=tuple(orders)))
    return tuple(sorted(out, key=lambda m: m.frequency_hz))


def _belongs(p: TrialPole, cluster: Sequence[TrialPole], near: Tolerance) -> bool:
    centre = _centre(cluster)
    size = max(abs(centre), abs(p.pole))
    same = (p.pole.imag > 0) == (cluster[0].pole.imag > 0) and all(q.order != p.order for q in cluster)
    reach = 2 * size * (near.frequency + near.damping * max(abs(p.damping), near.least))
    return same and abs(p.pole - centre) <= reach


def _centre(cluster: Sequence[TrialPole]) -> complex:
    values = np.array([p.pole for p in cluster])
    return complex(np.median(values.real), np.median(values.imag))


_SEEN = 0.25  # relative standard deviation up to which data show a number, as for parameters


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatedNumber:
    """A number as estimated."""

    value: float
    sd: float
    ci95: tuple[float, float]
    identifiable: bool  # whether the data show it

    @classmethod
    def of(
        cls, value: float, sd: float, *, quantile: float = NORMAL_95, size: float | None = None, visible: bool = True
    ) -> EstimatedNumber:
        """Return a number with its interval, value -+ quantile sd. `size`: what the sd is judged against where not the
        value; `visible`: False where something else says that the data do not show it.
        """
        judged = abs(value) if size is None else size
        sound = bool(np.isfinite(sd) and np.isfinite(value))
        return cls(
            value=float(value),
            sd=float(sd),
            ci95=(float(value - quantile * sd), float(value + quantile * sd)),
            identifiable=visible and sound and sd <= _SEEN * judged,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """A mode: natural frequency |pole|/(2 pi), damping -Re(pole)/|pole|, and its shape over outputs or planes."""

    frequency_hz: EstimatedNumber
    damping: EstimatedNumber  # ratio
    shape: Mapping[str, EstimatedNumber]  # by name; as the estimator scales it: largest 1, or modal mass 1 kg
    # part of the shape a quarter of a period later, where outputs do not move in step; none of a real shape
    shape_quadrature: Mapping[str, EstimatedNumber] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def complex_shape(self) -> dict[str, complex]:
        """The shape as complex numbers, by name."""
        late = self.shape_quadrature
        return {k: complex(x.value, late[k].value if k in late else 0.0) for k, x in self.shape.items()}

    @property
    def identifiable(self) -> bool:
        """Whether the data show both frequency and damping."""
        return self.frequency_hz.identifiable and self.damping.identifiable


def mode_of(
    pole: complex,
    spreads: Sequence[tuple[Array, float]],
    outputs: Sequence[str],
    shape: Complex,
    variance: Array,
    *,
    visible: bool = True,
) -> Mode:
    """Return a pole, rad/s, as a mode, its shape (n_outputs,) scaled so that the largest output is 1. `spreads`:
    covariances (2, 2) of real and imaginary part, each with its interval's quantile, the widest counts; `variance`: of
    the complex shape; `visible`: as `EstimatedNumber.of`.
    """
    size = abs(pole)
    of_frequency = np.array([pole.real, pole.imag]) / (2 * np.pi * size)
    of_damping = np.array([-(pole.imag**2), pole.real * pole.imag]) / size**3
    wide = 4 * abs(pole.real) / (2 * np.pi)  # a frequency is known where its sd is less than half a bandwidth
    quantities = (size / (2 * np.pi), of_frequency, wide), (-pole.real / size, of_damping, None)
    numbers = list[EstimatedNumber]()
    for value, slope, width in quantities:
        spreads_of_one = [(max(float(slope @ C @ slope), 0.0) ** 0.5, q) for C, q in spreads]
        sd, half = max(s for s, _ in spreads_of_one), max(s * q for s, q in spreads_of_one)
        quantile = half / sd if sd > 0 else NORMAL_95
        numbers.append(EstimatedNumber.of(value, sd, quantile=quantile, size=width, visible=visible))
    largest = int(np.argmax(np.abs(shape)))
    scaled = shape / shape[largest]
    spread = np.sqrt((variance + np.abs(scaled) ** 2 * variance[largest]) / 2) / abs(shape[largest])
    spread[largest] = 0.0
    in_step, late = (
        {o: EstimatedNumber.of(float(x), float(sd), size=1.0) for o, x, sd in zip(outputs, part, spread, strict=True)}
        for part in (scaled.real, scaled.imag)
    )
    return Mode(frequency_hz=numbers[0], damping=numbers[1], shape=in_step, shape_quadrature=late)


def modes_checks(
    modes: Sequence[Mode], count: int | Literal["auto"], band_hz: tuple[float, float], remedy: str
) -> dict[str, Check]:
    """Return whether as many modes were found as were wanted, and whether the data show their numbers."""
    least = 1 if count == "auto" else count
    detail = f"{len(modes)} found between {band_hz[0]:.4g} and {band_hz[1]:.4g} Hz"
    if len(modes) < least:
        detail += f", at least {least} wanted. {remedy}"
    hidden = ", ".join(f"{m.frequency_hz.value:.4g} Hz" for m in modes if not m.identifiable)
    shown = f"frequency or damping of {hidden} has a standard deviation over a quarter of its size. {remedy}"
    return {
        "modes_found": Check(passed=len(modes) >= least, detail=detail),
        "identifiable": Check(passed=not hidden, detail=shown if hidden else "the data show every mode"),
    }


def student(freedom: int) -> float:
    """Return Student's quantile for 95 % intervals."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.975))


def plant_modes(
    A: Array, C: Array, outputs: Sequence[str], band_hz: tuple[float, float], most_damped: float
) -> tuple[Mode, ...]:
    """Return the oscillating modes of x' = A x, y = C x in a band, of less than `most_damped`, without standard
    deviations.
    """
    poles, vectors = np.linalg.eig(A)
    none, still = np.zeros((2, 2)), np.zeros(len(outputs))
    modes, (low, high) = list[Mode](), (2 * np.pi * f for f in band_hz)
    for k in np.argsort(poles.imag):
        p = complex(poles[k])
        if low <= p.imag <= high and abs(p.real) <= most_damped * abs(p):
            modes.append(mode_of(p, [(none, NORMAL_95)], outputs, C @ vectors[:, k], still))
    return tuple(modes)


def mac(ones: Sequence[Mode], others: Sequence[Mode], outputs: Sequence[str] | None = None) -> Array:
    """Return the modal assurance criterion of each mode with each of others, (n_ones, n_others), on `outputs`, default
    those that both have. EstimationError where they share fewer than two: with one, all shapes are alike.
    """
    criteria = np.zeros((len(ones), len(others)))
    for i, a in enumerate(ones):
        for j, b in enumerate(others):
            own, other = a.complex_shape, b.complex_shape
            both = [name for name in own if name in other and (outputs is None or name in outputs)]
            if len(both) < 2:
                raise EstimationError(
                    f"two lists of modes share {len(both)} outputs ({', '.join(own)}; {', '.join(other)}); a "
                    "comparison of shapes needs two of the same name. Name the outputs alike"
                )
            criteria[i, j] = assurance([own[k] for k in both], [other[k] for k in both])
    return criteria


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Modal(Judged):
    """Modes of a record; in a response's file ``modes``, and the rest as ``modal``."""

    status: Literal["converged", "failed"]  # "failed" where no mode was found
    method: str
    modes: tuple[Mode, ...]  # in order of frequency
    checks: Mapping[str, Check]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    band_hz: tuple[float, float]  # that was searched
    poles: tuple[TrialPole, ...] = ()  # of all models that the search began from: the stabilisation diagram
    record: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    warnings: tuple[str, ...] = ()
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    # by mode, in the same order: ``energy_share``, ``misfit``, ``residual_correlation``, ``gain``
    details: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    against: tuple[Mode, ...] = ()  # modes of an estimate that was given beside the record
    mac: Array | None = None  # (n_modes, n_against), modal assurance criterion

    def beside(self, others: Sequence[Mode]) -> Modal:
        """Return it with modes of an estimate beside its own, compared on outputs of the first one's unit."""
        alike = [o for o in self.outputs if self.units.get(o) == self.units.get(self.outputs[0])]
        return replace(self, against=tuple(others), mac=mac(self.modes, others, alike))
