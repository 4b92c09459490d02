"""What is estimated from what: records, magnet law, numbers, and the layout of the vector that the search moves.

The vector: free and prior numbers (the logarithm where physics needs them positive, else over their magnitudes), a free
delay for each sampling rate, each record's log noise levels (position, current, force, voltage, drift; of a held rotor
current and voltage), and zeros of the position that are a record's own. Each touch of a stop hits the predictor with a
force hundreds of times the noise: position and current are measured on, force and back-EMF are unknown; where the rotor
lies on a stop, the record is cut. Any stretch without touches shows whether one magnet carries the weight: the mean of
f/(m g) is (v_end - v_begin)/(g T) - 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.predictor import noise_floor
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.loop import Interval

BODY = ("m", "R", "c", "g", "a", "x_offset", "i_offset", "v_offset", "v_drop", "i_drop", "tau")
"""Numbers after those of the magnet, in the order of the kernels."""

SIGNED = frozenset({"g", "x_offset", "i_offset", "v_offset", "v_drop", "k_asym", "i0_asym"})
"""Numbers that may have either sign with any law; the others are positive, or zero where they are fixed."""

UNITS: Mapping[str, str] = {
    "k": "N m^2/A^2", "s": "m", "L_g": "H", "zeta": "m", "sigma": "1/A^2", "L_leak": "H", "L_rise": "H", "i_knee": "A",
    "i0": "A", "m": "kg", "R": "ohm", "c": "N s/m", "g": "m/s^2", "a": "rad/s", "x_offset": "m", "i_offset": "A",
    "v_offset": "V", "v_drop": "V", "i_drop": "A", "tau": "s", "k_asym": "1", "i0_asym": "A",
}  # fmt: skip
"""SI unit of every number."""

LEVELS = ("position", "current", "force", "voltage", "drift", "voltage_drift")
"""Noise levels in the order of the kernels: rms of one sample, the last four held over it."""

EDDY_STEPS = 8
"""Steps in a sample where there is an eddy pole; it may be as fast as one of them."""

FORGETS = 20.0
"""Time constants of a drifting force that a record holds at least, so that its mean is small beside its size."""

NOISE_PRIOR_SD = 5.0
"""Of a log noise level: keeps a level that the data do not see from running to minus infinity."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingRecord:
    """One record as the predictor sees it."""

    name: str
    rate_hz: float
    u: Array  # (n_samples,), V, voltage, held over a sample
    # (n_samples,), V, standard deviation of what is not known of the voltage; zero where it is what was logged
    loose: Array
    y: Array  # (n_samples, 2), position in m and current in A
    # (n_samples, 2), bool, which of them are measured; the predictor runs on through the others
    valid: NDArray[np.bool_]
    held: bool = False  # the rotor is held at rest at the mean position: only the coil moves
    # (n_samples,), m/s^2, or None, standard deviation of an acceleration of unknown origin during each sample, such as
    # at a stop (see `touching`); None: of none
    knock: Array | None = None
    # (n_samples,), bool, or None, samples that are left out, such as those of a rotor that lies on a stop; the
    # predictor begins anew after them. None: none.
    cut: NDArray[np.bool_] | None = None
    zero: float | None = None  # of the position, m, taken out and searched beside the numbers; None: that of the rest
    later: bool = False  # whether a voltage that drifts has walked before it
    push: Array | None = None  # (n_samples,), m/s^2, or None, acceleration by a known force during each sample

    @property
    def parts(self) -> tuple[tuple[int, int], ...]:
        """First sample, and that after the last, of each stretch that is used."""
        if self.cut is None:
            return ((0, self.u.size),)
        edges = np.flatnonzero(np.diff(np.concatenate([[True], self.cut, [True]])))
        return tuple(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))

    @property
    def kept(self) -> Array:
        """Position and current of the samples that are used, in shape (n_kept, 2)."""
        return self.y if self.cut is None else self.y[~self.cut]

    def first(self, count: int) -> BearingRecord:
        """Return the beginning of the record, `count` used samples."""
        n = count if self.cut is None else int(np.searchsorted(np.cumsum(~self.cut), count)) + 1
        return self.part(slice(0, n))

    def part(self, samples: slice) -> BearingRecord:
        """Return some samples in a row of the record."""
        names = [n for n in ("u", "loose", "y", "valid", "knock", "cut", "push") if getattr(self, n) is not None]
        return replace(self, **{name: getattr(self, name)[samples] for name in names})


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    """One number of the model, in SI units."""

    name: str
    value: float  # start, fixed value, or mean of the prior
    estimated: bool
    prior_sd: float = np.inf  # infinite without a prior
    # whether it may have either sign (`SIGNED`, and the s of one magnet, which is that of a position); else it is
    # positive, and the vector holds its logarithm
    signed: bool = False
    magnitude: float = 1.0  # scale of a signed number


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingProblem:
    """Records, law and what is estimated."""

    law: MagnetLaw
    records: tuple[BearingRecord, ...]
    numbers: tuple[Number, ...]  # one for each name of the law and of `BODY`, in that order
    delays: Mapping[float, float]  # by sampling rate: delay of the voltage in samples (start where free)
    free_delay: frozenset[float]  # rates at which it is estimated
    eddy: bool  # whether the force has a pole a/(s + a), and whether force and voltage drift
    drift: bool
    noise_center: Array  # (n_records, 6), centres of the weak prior on log noise levels
    skip: int = 8  # samples left out at the start of each record
    substeps: int = 1  # runge-Kutta steps in a sample, at least; a power of two

    @property
    def estimated(self) -> tuple[Number, ...]:
        """Numbers in the vector."""
        return tuple(n for n in self.numbers if n.estimated)

    @property
    def rates(self) -> tuple[float, ...]:
        """Sampling rates whose delay is in the vector."""
        return tuple(r for r in self.delays if r in self.free_delay)

    @property
    def settled(self) -> tuple[float, ...]:
        """The other sampling rates."""
        return tuple(r for r in self.delays if r not in self.free_delay)

    def levels(self, r: int) -> tuple[int, ...]:
        """Return which noise levels record `r` has, as places in `LEVELS`."""
        if self.records[r].held:
            return (1, 3)
        return (0, 1, 2, 3, 4, 5) if self.drift else (0, 1, 2, 3)

    @property
    def noise_slices(self) -> tuple[slice, ...]:
        """Places of each record's noise levels in the vector."""
        slices, first = [], len(self.estimated) + len(self.rates)
        for r in range(len(self.records)):
            slices.append(slice(first, first + len(self.levels(r))))
            first = slices[-1].stop
        return tuple(slices)

    @property
    def size(self) -> int:
        """Length of the vector."""
        return int(self.noise_slices[-1].stop) + sum(r.zero is not None for r in self.records)

    def zero(self, r: int) -> int | None:
        """Return the place in the vector of what is left of record `r`'s own zero, over `zero_scale`."""
        own = [k for k, x in enumerate(self.records) if x.zero is not None]
        return self.noise_slices[-1].stop + own.index(r) if r in own else None

    @property
    def zero_scale(self) -> float:
        """Scale of the zeros in the vector, m."""
        return float(np.std(np.concatenate([r.kept[:, 0] for r in self.records if not r.held])))

    @property
    def n_used(self) -> int:
        """Measured values that enter the fit."""
        return int(sum(np.count_nonzero(r.valid[self.skip :, 1 if r.held else 0 :]) for r in self.records))

    def start(self) -> Array:
        """Return the vector at the numbers' own values and the centres of the noise, in shape (size,)."""
        vector = np.zeros(self.size)
        for j, n in enumerate(self.estimated):
            vector[j] = n.value / n.magnitude if n.signed else np.log(n.value)
        first = len(self.estimated)
        vector[first : first + len(self.rates)] = [self.delays[r] for r in self.rates]
        for r, place in enumerate(self.noise_slices):
            vector[place] = self.noise_center[r, list(self.levels(r))]
        return vector

    def upper(self) -> Array:
        """Return the largest values of the vector, in shape (size,): an eddy pole faster than a step cannot be seen,
        nor a force that drifts more slowly than `FORGETS` be told from one of the law.
        """
        free = [r for r in self.records if not r.held]
        most = {
            "a": EDDY_STEPS * min(r.rate_hz for r in free),
            "tau": min(r.u.size / r.rate_hz for r in free) / FORGETS,
        }
        bounds = np.full(self.size, np.inf)
        said = [np.inf if np.isfinite(n.prior_sd) else most.get(n.name, np.inf) for n in self.estimated]
        bounds[: len(said)] = np.log(said)
        return bounds

    def values(self, vector: Array) -> dict[str, float]:
        """Return all numbers at a vector, SI."""
        values = {n.name: n.value for n in self.numbers}
        for n, v in zip(self.estimated, vector.tolist(), strict=False):
            values[n.name] = v * n.magnitude if n.signed else float(np.exp(v))
        return values

    def chain(self, vector: Array) -> Array:
        """Return d(number)/d(vector) of the estimated numbers, (n_estimated,)."""
        values = self.values(vector)
        return np.array([n.magnitude if n.signed else values[n.name] for n in self.estimated])

    def delay_at(self, vector: Array, rate_hz: float) -> float:
        """Return the delay in samples at a rate."""
        if rate_hz in self.free_delay:
            return float(vector[len(self.estimated) + self.rates.index(rate_hz)])
        return self.delays[rate_hz]

    def theta(self, vector: Array, rate_hz: float) -> tuple[Array, int]:
        """Return the kernels' numbers (21,) at a vector, and the whole samples of delay at a rate."""
        values, delay = self.values(vector), self.delay_at(vector, rate_hz)
        whole = int(np.floor(delay))
        body = [values[name] for name in BODY]
        return np.concatenate([self.law.vector(values), body, [delay - whole]]), whole

    def flags(self, r: int) -> NDArray[np.bool_]:
        """Return (exponential, pair, eddy, drift, held) of record `r`, in shape (5,)."""
        held = self.records[r].held
        drift, eddy = self.drift and not held, self.eddy and not held
        return np.array([self.law.gap == "exponential", self.law.pair, eddy, drift, held])

    def noise2(self, vector: Array, r: int) -> Array:
        """Return the squared noise levels (6,) of record number `r`."""
        squares = np.zeros(len(LEVELS))
        squares[list(self.levels(r))] = np.exp(2.0 * vector[self.noise_slices[r]])
        return squares


_NEAR = 6.0  # standard deviations of the sensor from a stop within which the rotor may lie at it
_LOCAL, _REST = 3, 3.0  # samples over which the speed is looked for, and its floor in the sensor's deviations a sample
_AROUND = 1  # samples before and after: it comes and goes between them
_LASTING = 5  # samples at a stop from which it is more than a touch
_FREE = 40  # samples between two such stretches that are not worth a new beginning
_SPEED = 8  # samples over which a speed is taken
_LEAST = 50  # samples of a stretch that counts


def touching(record: BearingRecord, stops: Interval) -> BearingRecord:
    """Take the force of a free rotor's record as unknown (`knock`) while the rotor touches a stop, and `cut` out where
    it lies on one. A touch's acceleration has the standard deviation of stopping within a sample from the speed about
    it.
    """
    x, noise = record.y[:, 0], float(noise_floor(record.y)[0])
    at = (x <= stops[0] + _NEAR * noise) | (x >= stops[1] - _NEAR * noise)
    at &= record.valid[:, 0]
    if record.held:
        return record
    cut = _lasting(at)
    # between two samples it may have come and gone
    reach = _NEAR * noise + np.abs(np.diff(x, append=x[-1]))
    at |= record.valid[:, 0] & ((x - stops[0] <= reach) | (stops[1] - x <= reach))
    if not at.any():
        return record
    for _ in range(_AROUND):
        at[:-1] |= at[1:]
        at[1:] |= at[:-1]
    step = np.abs(np.diff(x, prepend=x[0]))
    near = np.max([np.roll(step, k) for k in range(-_LOCAL, _LOCAL + 1)], axis=0) + _REST * noise
    knock = np.where(at, near * record.rate_hz**2, 0.0)
    if record.knock is not None:
        knock = np.hypot(knock, record.knock)
    if not cut.any():
        return replace(record, knock=knock)
    knock[cut] = 0.0
    if record.cut is not None:
        cut |= record.cut
    return replace(record, knock=knock, cut=cut, valid=record.valid & ~cut[:, None])


def _lasting(at: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which samples belong to lying: long stays with what is about them, and what is too short between two of them."""
    cut = np.zeros(at.size, dtype=np.bool_)
    for first, end in _runs(at):
        if end - first >= _LASTING:
            cut[max(first - _AROUND - 1, 0) : end + _AROUND + 1] = True
    if cut.any():
        for first, end in _runs(~cut):
            if end - first < _FREE:
                cut[first:end] = True
    return cut


def _runs(on: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def weight_carried(law: MagnetLaw, values: Mapping[str, float], record: BearingRecord) -> float | None:
    """Return the mean force of one magnet's `law` over what a free rotor needs, 1 where it carries the weight; None
    where no stretch is long enough to tell. `values`: SI, m and g among them.
    """
    free = np.ones(record.u.size, dtype=np.bool_) if record.cut is None else ~record.cut
    if record.knock is not None:
        free &= record.knock == 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]])))
    force, wanted = 0.0, 0.0
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if end - first < _LEAST:
            continue
        part = record.y[first + _SPEED // 2 : end - _SPEED // 2]
        ends = record.y[first : first + _SPEED + 1, 0], record.y[end - _SPEED - 1 : end, 0]
        before, after = ((x[-1] - x[0]) * record.rate_hz / _SPEED for x in ends)
        x, i = part[:, 0] - values.get("x_offset", 0.0), part[:, 1] - values.get("i_offset", 0.0)
        rubbed = values.get("c", 0.0) * float(part[-1, 0] - part[0, 0]) * record.rate_hz
        force += float(np.sum(law.force(x, i, values))) - rubbed
        wanted += values["m"] * ((after - before) * record.rate_hz - values["g"] * part.shape[0])
    return float(force / wanted) if wanted else None
