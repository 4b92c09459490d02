"""A mode of vibration with its uncertainty, and how much two modes are alike.

The value that every estimator of modes gives: from a frequency response, from outputs alone, or from a rotor's physical
parameters. Likeness of shapes is the modal assurance criterion (Allemang and Brown 1982).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check, Judged
from ambid.estimation.result import NORMAL_95
from ambid.estimation.stable_poles import TrialPole, assurance

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
        cls, value: float, sd: float, *, quantile: float = NORMAL_95, size: float | None = None, shown: bool = True
    ) -> EstimatedNumber:
        """Return a number with its interval, value -+ quantile sd.

        `size`: what the standard deviation is judged against where that is not the value itself; `shown`: False where
        something else says that the data do not show it.
        """
        judged = abs(value) if size is None else size
        sound = bool(np.isfinite(sd) and np.isfinite(value))
        return cls(
            value=float(value),
            sd=float(sd),
            ci95=(float(value - quantile * sd), float(value + quantile * sd)),
            identifiable=shown and sound and sd <= _SEEN * judged,
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
    shown: bool = True,
) -> Mode:
    """Return a pole, rad/s, as a mode, its shape scaled so that the largest output is 1.

    `spreads`: covariances of real and imaginary part, (2, 2), with the quantile that makes an interval of a standard
    deviation; the widest counts; `shape`, `variance`: (n_outputs,), variance of the complex number; `shown`: False
    where something says that the data do not show the mode.
    """
    size = abs(pole)
    of_frequency = np.array([pole.real, pole.imag]) / (2 * np.pi * size)
    of_damping = np.array([-(pole.imag**2), pole.real * pole.imag]) / size**3
    wide = 4 * abs(pole.real) / (2 * np.pi)  # a frequency is known where its sd is less than half a bandwidth
    asked = (size / (2 * np.pi), of_frequency, wide), (-pole.real / size, of_damping, None)
    numbers = list[EstimatedNumber]()
    for value, slope, width in asked:
        found = [(max(float(slope @ C @ slope), 0.0) ** 0.5, q) for C, q in spreads]
        sd, half = max(s for s, _ in found), max(s * q for s, q in found)
        quantile = half / sd if sd > 0 else NORMAL_95
        numbers.append(EstimatedNumber.of(value, sd, quantile=quantile, size=width, shown=shown))
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
    """Return the oscillating modes of x' = A x, y = C x in a band, without standard deviations: those of an estimate.

    `A`, `C`: (n, n) and (n_outputs, n); `most_damped`: ratio from which a mode is none of vibration.
    """
    poles, vectors = np.linalg.eig(A)
    none, still = np.zeros((2, 2)), np.zeros(len(outputs))
    found, (low, high) = list[Mode](), (2 * np.pi * f for f in band_hz)
    for k in np.argsort(poles.imag):
        p = complex(poles[k])
        if low <= p.imag <= high and abs(p.real) <= most_damped * abs(p):
            found.append(mode_of(p, [(none, NORMAL_95)], outputs, C @ vectors[:, k], still))
    return tuple(found)


def mac(ones: Sequence[Mode], others: Sequence[Mode], outputs: Sequence[str] | None = None) -> Array:
    """Return the modal assurance criterion of each mode with each of others, on the outputs that both have.

    `outputs`: those that count; default all. Returns (n_ones, n_others), 0 to 1. EstimationError where fewer than two
    outputs have the same name: with one, all shapes are alike.
    """
    found = np.zeros((len(ones), len(others)))
    for i, a in enumerate(ones):
        for j, b in enumerate(others):
            own, other = a.complex_shape, b.complex_shape
            both = [name for name in own if name in other and (outputs is None or name in outputs)]
            if len(both) < 2:
                raise EstimationError(
                    f"two lists of modes share {len(both)} outputs ({', '.join(own)}; {', '.join(other)}); a "
                    "comparison of shapes needs two of the same name. Name the outputs alike"
                )
            found[i, j] = assurance([own[k] for k in both], [other[k] for k in both])
    return found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Modal(Judged):
    """Modes of a record, file schema ``ambid.modes/1``; in a response's file ``modes``, and the rest as ``modal``."""

    status: Literal["converged", "failed"]  # "failed" where no mode was found
    method: str
    modes: tuple[Mode, ...]  # in order of frequency
    checks: Mapping[str, Check]
    inputs: tuple[str, ...]  # none: operational modes
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
