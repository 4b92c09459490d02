"""A record from the physics, of a preset or of a rig."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError
from ambid.physics.presets import Preset, preset, preset_names
from ambid.record import Channel, Record
from ambid.rig import Rig, load_rig
from ambid.signals import excitation as make_excitation
from ambid.simulation.bench import Simulation
from ambid.simulation.rig_bench import Bench

_FRACTION = 0.5  # of the limits that an amplitude chosen by the program uses


class Words(TypedDict, total=False):
    """How a bench is simulated."""

    duration: float  # s, 1 by default
    rate_hz: float | None  # the bench's by default
    excitation: str  # "multisine" by default
    amplitude: float | None  # peak in V, rms of a gaussian; what half of the limits allows by default
    band: tuple[float, float] | None  # Hz; one period to a fifth of the rate by default
    periods: int  # how often the excitation repeats
    seed: int  # of excitation and noise
    closed: bool | None  # with or without the controller; as the bench usually works by default
    nonlinear: bool  # the nonlinear magnet instead of its linearisation
    position: float | None  # nonlinear: where the loop holds the rotor, m
    log_excitation: bool  # a channel of it too
    force: bool  # a loop that is predicted unstable too


@dataclass(frozen=True, slots=True, kw_only=True)
class Excited:
    """The excitation of a simulated record."""

    kind: str
    peak: float  # V; rms of a gaussian


def simulate(source: str | Path | Rig | Preset, **words: Unpack[Words]) -> Record:
    """Simulate a bench and return the record that it would log; equal seeds give equal records.

    Parameters
    ----------
    source : str, Path, Rig or Preset
        A preset by its name, or a rig or its file.
    **words
        ``duration``, ``rate_hz``, ``excitation``, ``amplitude``, ``band``, ``periods``, ``seed``, ``closed``,
        ``nonlinear``, ``position``, ``log_excitation`` and ``force``, see `Words`.

    Returns
    -------
    Record
        Columns named as the rig names them, of a preset by role.

    Raises
    ------
    AmbidError
        If a word breaks a rule, the rig lacks a value, or the loop is predicted unstable.

    Examples
    --------
    >>> import ambid
    >>> record = ambid.simulate("thesis", duration=0.1, seed=1)
    >>> record.n_samples, record.names
    (1000, ('voltage', 'current', 'position'))
    """
    return simulate_used(source, **words)[0].record


def simulate_used(
    source: str | Path | Rig | Preset,
    *,
    duration: float = 1.0,
    rate_hz: float | None = None,
    excitation: str = "multisine",
    amplitude: float | None = None,
    band: tuple[float, float] | None = None,
    periods: int = 1,
    seed: int = 0,
    closed: bool | None = None,
    nonlinear: bool = False,
    position: float | None = None,
    log_excitation: bool = False,
    force: bool = False,
) -> tuple[Simulation, Excited]:
    """Return what `simulate` does with what happened, and the excitation."""
    bench = _bench(source, rate_hz, closed, nonlinear, position)
    n = _samples(duration, bench.rate_hz)
    if not force:
        bench.refuse_unstable()
    shape = _repeat(
        lambda part: make_excitation(excitation, part, bench.rate_hz, amplitude=1.0, band=band, seed=seed), n, periods
    )
    if amplitude is None and bench.rig is not None and bench.rig.limits is None:
        raise AmbidError("no amplitude is given, and the rig has no limits to find one from. Give --amplitude A in V")
    peak = bench.largest(shape, seed, _FRACTION) if amplitude is None else amplitude
    done = bench.simulate(peak * shape, seed=seed)
    if log_excitation:
        logged = Channel(name="excitation", unit="V", values=peak * shape)
        done = replace(done, record=replace(done.record, channels=(*done.record.channels, logged)))
    return done, Excited(kind=excitation, peak=peak)


def _bench(
    source: str | Path | Rig | Preset, rate: float | None, closed: bool | None, nonlinear: bool, position: float | None
) -> Bench:
    """Return the bench of a preset or a rig, its rotor held at a position where one is given."""
    if isinstance(source, str) and source in preset_names():
        source = preset(source)
    if isinstance(source, Preset):
        if position is not None and source.plant is not None:
            source = replace(source, operating_point=source.plant.equilibrium(position))
        return Bench.of(source, rate, source.usually_closed if closed is None else closed, nonlinear=nonlinear)
    found = source if isinstance(source, Rig) else load_rig(Path(source))
    if position is not None:
        found = replace(found, operating_point={**found.operating_point, "position": position})
    if rate is None and found.record.rate_hz is None:
        raise AmbidError(
            f"rig {found.source or found.name} names no rate; a simulation needs one. Give --rate HZ, or record.rate_hz"
        )
    return Bench.of(found, rate, closed, nonlinear=nonlinear)


def _samples(duration: float, rate_hz: float) -> int:
    count = duration * rate_hz
    if not 1 <= count <= 1e8:
        raise AmbidError(
            f"--duration {duration:g} s at {rate_hz:g} Hz is {count:g} samples; it must be 1 to 1e8. Correct one"
        )
    return round(count)


def _repeat(make: Callable[[int], Array], n: int, periods: int) -> Array:
    """Lay equal periods one behind the other."""
    if n % periods:
        raise AmbidError(f"--periods {periods}: {n} samples are no whole number each. Change --duration or --periods")
    return np.tile(make(n // periods), periods)
