"""Which column is which role: by unit and name, whether it holds a signal, and what a bearing does to it: int V = R int
i + L [i] + k [x] (weak form of thesis eq. 4.4, Shinbrot 1957) over windows; the position follows the force, and is
smoother.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError
from ambid.record.clock import even, rises
from ambid.record.record import Channel, Record
from ambid.record.words import is_set_point, quantities, unit_or_none, unit_within
from ambid.signals.spectra import cross_spectra, snr
from ambid.units import UNKNOWN

ROLES = {"voltage": "V", "current": "A", "position": "m"}
_UNNAMED = 0.3  # what unit and name say of a column without either
_CLOSE = 0.15  # scores that differ by less are left to the user
_LOOKED = 16384  # samples
_LEAST = 200  # samples from which a coil can be told
_WINDOWS = (1, 4, 16, 64)  # samples that the coil's equation is integrated over
_DELAYS = (0, 1, 2, 4)  # samples by which the voltage may act later
_CANDIDATES = 4  # of a role that are looked at, the best by name
_SHOWN = 0.2  # part of what the other terms leave that a term has to explain before its sign counts
_MOTIONS = (1, 2, 4, 8, 16, 32)  # quarters of the windows, in samples, that the motion is seen through
_LIKE = 0.8  # how much a column that neither unit nor name gives away has to do what its role does


@dataclass(frozen=True, slots=True, kw_only=True)
class Coil:
    """The coil between two columns: V = R i + L i' + k x'."""

    share: float  # part of the variance of the integrated voltage that is explained, 0 to 1
    R: float  # in units of the columns, without a sign; 0 where the record does not show it
    L: float
    reversed: bool = False  # fits with both R and L negative: one of the two has the wrong sign


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A column that may be a role, with what speaks for and against it."""

    role: str
    channel: Channel
    named: float  # by unit and name, 0 to 1
    signal: float  # part of its power that is no noise, 0 to 1; 0: constant or noise alone
    fits: float  # how much it does what its role does in a bearing, 0 to 1
    why: str

    @property
    def score(self) -> float:
        """From 0 to 1; half of it is what the column does."""
        return self.named * (1.0 + self.signal + 2.0 * self.fits) / 4.0


def rank_roles(record: Record, told: Mapping[str, str] | None = None) -> Mapping[str, Sequence[Candidate]]:
    """Rank the columns for each role of a bearing, the best first; those chosen for different roles differ.

    `record`: as read from its file, columns under their own names; `told`: columns that are known, by role. Returns
    voltage, current and position; empty where no column looks like one.
    """
    told = told or {}
    ranked = {
        role: sorted((_named(c, role, record) for c in record.channels if _name(c, role)), key=lambda c: -c.score)
        if role not in told
        else [replace(_named(record.channel(told[role]), role, record), named=1.0)]
        for role in ROLES
    }
    ranked = {
        role: [c for c in cs if c.channel.name == told.get(role) or c.channel.name not in told.values()]
        for role, cs in ranked.items()
    }
    likely = {role: [c for c in cs if c.signal > 0][:_CANDIDATES] for role, cs in ranked.items()}
    coils = _coils(record, likely)
    coherent = _coherences(record, {c.channel.name for cs in likely.values() for c in cs})
    moved = {
        (i.channel.name, x.channel.name): motion_of(i.channel.values[:_LOOKED], x.channel.values[:_LOOKED])
        for i, x in itertools.product(likely["current"], likely["position"])
        if i.channel.name != x.channel.name and max(i.named, x.named) <= _UNNAMED
    }
    coherent |= {(x, i): max(coherent.get((x, i), 0.0), part) for (i, x), part in moved.items()}
    judged = {role: [_judged(c, coils, coherent, likely, record) for c in cs] for role, cs in ranked.items()}
    kept = {
        role: sorted((c for c in cs if c.named > _UNNAMED or c.fits >= _LIKE), key=lambda c: -c.score)
        for role, cs in judged.items()
    }
    return _distinct(kept, moved)


def motion_of(i: Array, x: Array) -> float:
    """Return the part that a current explains of what a position does beyond its own stiffness and damping, 0 to 1:
    x'' = a i - b x - c x', through the smooth windows at which it explains most.
    """
    most = 0.0
    if x.size < _LEAST or not (np.ptp(i) > 0 and np.ptp(x) > 0):
        return most
    i, x = i / np.ptp(i), x / np.ptp(x)
    for quarter in _MOTIONS:
        window = np.hanning(4 * quarter + 3)[1:-1] / (2.0 * quarter + 1.0)
        slope, bend = np.convolve(window, [0.5, 0.0, -0.5]), np.convolve(window, [1.0, -2.0, 1.0])
        terms = [np.convolve(s, k, "valid") for s, k in ((x, np.pad(window, 1)), (x, slope), (i, np.pad(window, 1)))]
        seen = np.column_stack([*terms, np.convolve(x, bend, "valid")])
        R = np.asarray(np.linalg.qr(seen - seen.mean(axis=0), mode="r"))
        both = R[2, 3] ** 2 + R[3, 3] ** 2  # what position and velocity leave, of which the current leaves the latter
        most = max(most, float(R[2, 3] ** 2 / both) if both > 0 else 0.0)
    return most


def bearing_of(columns: Iterable[Array], rate_hz: float) -> float:
    """Return how much three columns are a bearing's voltage, current and position, 0 to 1: coil and motion."""
    v, i, x = (column[:_LOOKED] for column in columns)
    return min(coil_of(v, i, x, rate_hz).share, motion_of(i, x)) if x.size >= _LEAST else 1.0


def swapped(record: Record, ranked: Mapping[str, Sequence[Candidate]]) -> bool:
    """Whether current and position do what the other should, and neither what it should."""
    if not all(ranked[role] for role in ROLES):
        return False
    v, i, x = (ranked[role][0].channel.values for role in ROLES)
    return bearing_of((v, i, x), record.rate_hz) < _SHOWN and bearing_of((v, x, i), record.rate_hz) >= _LIKE


def close(ranked: Sequence[Candidate]) -> bool:
    """Whether the second is nearly as likely as the first."""
    return len(ranked) > 1 and ranked[0].score - ranked[1].score < _CLOSE * ranked[0].named


def at_rest(ranked: Mapping[str, Sequence[Candidate]]) -> bool:
    """Whether there is a coil, and a position that has nothing to do with it: the rotor is held."""
    first = [ranked[role][0].fits for role in ROLES if ranked[role]]
    return len(first) == len(ROLES) and min(first[:2]) >= _LIKE and first[2] < _SHOWN


def _name(c: Channel, role: str) -> float:
    """Rate a column by unit and name; 0: not of this role."""
    if is_set_point(c.name):
        return 0.0
    names, unit = quantities(c.name), unit_of(c)
    if not names and c.unit == UNKNOWN and rises(c.values) and even(c.values):
        return 0.0  # it counts
    if unit == ROLES[role]:
        return 1.0 if names == {role} else 0.9 if role in names else 0.8  # a sensor's voltage has two quantities
    if unit not in ("1", UNKNOWN, *(["V"] if role in names else [])):
        return 0.0
    return 0.6 if role in names else 0.0 if names else _UNNAMED


def unit_of(c: Channel) -> str:
    """Return the SI unit of a column, of one without by what its name ends in, such as ``pos_um``."""
    within = None if c.unit != UNKNOWN or c.source_unit != UNKNOWN else unit_or_none(unit_within(c.name))
    return c.unit if within is None else within.si


def _named(c: Channel, role: str, record: Record) -> Candidate:
    part = 0.0
    if np.ptp(c.values) > 0:
        try:
            ratio = snr(record, c.name)
            whole = math.hypot(ratio.signal_sd, ratio.noise_sd)
            part = (ratio.signal_sd / whole) ** 2 if whole else 0.0  # 0: the squares of its values vanish
        except AmbidError:
            part = 0.5  # too short to tell
    return Candidate(role=role, channel=c, named=_name(c, role), signal=part, fits=0.0, why="")


def _coils(record: Record, candidates: Mapping[str, Sequence[Candidate]]) -> dict[tuple[str, str], Coil]:
    """Coils between candidates for voltage and current, with the motion that suits them best."""
    if record.n_samples < _LEAST:
        return {}
    columns = {c.channel.name: c.channel.values[:_LOOKED] for cs in candidates.values() for c in cs}
    motions: list[str | None] = [c.channel.name for c in candidates["position"]]
    coils: dict[tuple[str, str], Coil] = {}
    for v, i in itertools.product(candidates["voltage"], candidates["current"]):
        pair = v.channel.name, i.channel.name
        if pair[0] != pair[1]:
            fits = [
                coil_of(columns[pair[0]], columns[pair[1]], None if x is None else columns[x], record.rate_hz)
                for x in (motions or [None])
                if x not in pair
            ]
            coils |= {pair: max(fits, key=lambda c: c.share)} if fits else {}
    return coils


def coil_of(v: Array, i: Array, x: Array | None, rate_hz: float) -> Coil:
    """Return the coil between two columns by least squares over windows; `x`: a position that moves in it.

    The window and the delay are those at which the inductance explains most of what the other terms leave.
    """
    best, coil = -1.0, Coil(share=0.0, R=0.0, L=0.0)
    for late in _DELAYS:
        n = v.size - late - 1
        after = i[late : late + n + 1]
        total = [np.concatenate([[0.0], np.cumsum(s)]) for s in (v[:n], (after[1:] + after[:-1]) / 2.0)]
        sums = np.array([total[1], after, *([] if x is None else [x[late : late + n + 1]]), total[0]])
        for length in _WINDOWS:
            starts = np.arange(0, n - length + 1, max(1, length // 2))
            terms = sums[:, starts + length] - sums[:, starts]
            terms -= terms.mean(axis=1, keepdims=True)
            terms, target = terms[:-1], terms[-1]
            size, power = np.linalg.norm(terms, axis=1), float(target @ target)
            if not (np.all(size > 0) and power > 0):
                continue
            terms /= size[:, None]
            inverse = np.linalg.pinv(terms @ terms.T)
            values = inverse @ (terms @ target)
            left = target - values @ terms
            share = 1.0 - float(left @ left) / power
            # what R and L explain that the other terms do not
            alone = values**2 / np.diag(inverse) / power
            alone /= alone + max(1.0 - share, 1e-12)
            if alone[1] > best:
                best = float(alone[1])
                signs = {bool(value > 0) for value, part in zip(values[:2], alone[:2], strict=True) if part > _SHOWN}
                coil = Coil(
                    share=share if len(signs) == 1 else 0.0, reversed=signs == {False},
                    R=abs(float(values[0] / size[0])) if alone[0] > _SHOWN else 0.0,
                    L=abs(float(values[1] / size[1])) / rate_hz,
                )  # fmt: skip
    return coil


def _coherences(record: Record, names: set[str]) -> dict[tuple[str, str], float]:
    """For each pair (a, b) the part of a's power that is a linear response to b, or the other way round."""
    own = sorted(names)
    if record.n_samples < _LEAST or len(own) < 2:
        return {}
    spectra = cross_spectra(np.column_stack([record[name][:_LOOKED] for name in own]), record.rate_hz)
    power = np.einsum("fii->fi", spectra.density).real
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.abs(spectra.density) ** 2 / (power[:, :, None] * power[:, None, :])
    chance = 1.0 / max(spectra.n_effective, 1.0 + 1e-9)  # of two signals that have nothing to do with each other
    share = np.clip((np.nan_to_num(share) - chance) / (1.0 - chance), 0.0, 1.0)
    part = np.einsum("fij,fi->ij", share[1:], power[1:]) / np.maximum(power[1:].sum(axis=0), 1e-300)[:, None]
    return {(a, b): float(part[j, k]) for j, a in enumerate(own) for k, b in enumerate(own) if j != k}


def _judged(
    c: Candidate,
    coils: Mapping[tuple[str, str], Coil],
    coherent: Mapping[tuple[str, str], float],
    candidates: Mapping[str, Sequence[Candidate]],
    record: Record,
) -> Candidate:
    """A candidate with what it does in a bearing."""
    name = c.channel.name
    if c.signal == 0.0:
        what = "never changes" if not np.ptp(c.channel.values) > 0 else "no signal, noise alone"
        return replace(c, why=f"{_unit_words(c)}; {what}")
    words, fits = [_unit_words(c)], 0.0
    if c.role == "position":
        sources = [
            x.channel.name for role in ("current", "voltage") for x in candidates[role] if x.channel.name != name
        ]
        pairs = [(coherent[name, s], s) for s in sources if (name, s) in coherent]
        if pairs:
            fits, source = max(pairs)
            words.append(f"{100.0 * fits:.0f} % of what it does follows {source}")
    else:
        own = [pair for pair in coils if name == pair[c.role == "current"]]
        best = max(own, key=lambda pair: coils[pair].share, default=None)
        if best is not None and coils[best].share > 0:
            fits, other = coils[best].share, best[c.role != "current"]
            words.append(
                f"a coil model with {other} explains {100.0 * fits:.1f} % ({_coil_words(coils[best], best, record)})"
            )
        elif best is not None:
            words.append("no coil (R, L > 0) between it and any other column")
    return replace(c, fits=fits, why="; ".join([*words, *_weak(c)]))


def _weak(c: Candidate) -> list[str]:
    return [f"only {100.0 * c.signal:.0f} % of its power is signal"] if c.signal < 0.5 else []


def _unit_words(c: Candidate) -> str:
    within = unit_within(c.channel.name) if c.channel.unit != unit_of(c.channel) else None
    words = f"its unit [{within or c.channel.source_unit}]"
    if unit_of(c.channel) == ROLES[c.role]:
        return f"{words} and name fit" if c.named >= 0.9 else f"{words} fits"
    return f"{words} instead of [{ROLES[c.role]}]" + ("" if c.named == _UNNAMED else ", but the name fits")


def _coil_words(coil: Coil, pair: tuple[str, str], record: Record) -> str:
    R, L = float(f"{coil.R:.2g}"), coil.L
    if [record.channel(name).unit for name in pair] == ["V", "A"]:
        words = f"R about {R:g} ohm, L about {L:.2g} H" if R else f"L about {L:.2g} H"
    else:
        words = f"L/R about {L / R:.2g} s" if R else "L > 0"
    return words + (", one of the two reversed" if coil.reversed else "")


def _distinct(
    ranked: Mapping[str, Sequence[Candidate]], moved: Mapping[tuple[str, str], float]
) -> Mapping[str, Sequence[Candidate]]:
    """Give a column that two roles want to the one for which all scores together are best, with how much the current
    moves the position.
    """

    def rating(choice: Sequence[Candidate | None]) -> float:
        _, i, x = ("" if c is None else c.channel.name for c in choice)
        return math.fsum(c.score for c in choice if c) + _UNNAMED * moved.get((i, x), 0.0)

    first = [[*cs[:_CANDIDATES], None] for cs in ranked.values()]
    best = max(
        (
            choice
            for choice in itertools.product(*first)
            if len({c.channel.name for c in choice if c}) == sum(c is not None for c in choice)
        ),
        key=rating,
    )
    roles = {}
    for (role, cs), top in zip(ranked.items(), best, strict=True):
        taken = {c.channel.name for c in best if c and c is not top}
        rest = [c for c in cs if c is not top and c.channel.name not in taken]
        roles[role] = (top, *rest) if top else ()
    return roles
