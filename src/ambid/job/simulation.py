"""A record from the physics, of a preset or of a rig."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError
from ambid.estimation.estimate import Estimate
from ambid.job.results import read_linear_estimate, rig_of
from ambid.physics.loop import Loop
from ambid.physics.presets import Preset, preset, preset_names
from ambid.record import Channel, Record
from ambid.rig import Rig, load_rig
from ambid.signals import excitation as make_excitation
from ambid.simulation.bench import Simulation
from ambid.simulation.rig_bench import Bench

BenchSource = str | Path | Rig | Preset | Estimate
"""Who has the numbers of a bench: a preset by name, a rig, a linear estimate, or a file of one of these."""

_FRACTION = 0.5  # of the limits that an amplitude chosen by the program uses


@dataclass(frozen=True, slots=True, kw_only=True)
class Excited:
    """The excitation of a simulated record."""

    kind: str
    peak: float  # V; rms of a gaussian


def simulate(
    source: BenchSource,
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
) -> Record:
    """Simulate a bench and return the record that it would log; equal seeds give equal records.

    Parameters
    ----------
    source : str, Path, Rig, Preset or Estimate
        A preset by its name; a rig or its file; a linear estimate or its file: its rig, with the estimated values.
    duration : float, optional
        Length in s.
    rate_hz : float, optional
        Sampling rate in Hz; default the bench's.
    excitation : str, optional
        One of `ambid.signals.EXCITATIONS`.
    amplitude : float, optional
        Peak in V (rms for ``gaussian``); default: what half of the limits allows.
    band : (float, float), optional
        Band of the excitation in Hz; default: one period over the record to a fifth of the rate.
    periods : int, optional
        Number of repetitions of the excitation.
    seed : int, optional
        Seed of excitation and noise.
    closed : bool, optional
        With or without the controller; default: as the bench usually works.
    nonlinear : bool, optional
        Simulate the nonlinear magnet instead of its linearisation.
    position : float, optional
        With `nonlinear`: position at which the loop holds the rotor, m.
    log_excitation : bool, optional
        Add a channel ``excitation``, the reference for `ambid.frf`.
    force : bool, optional
        Simulate a loop that is predicted unstable too.

    Returns
    -------
    Record
        Columns are named as in the rig; those of a preset by role.

    Raises
    ------
    AmbidError
        If a setting breaks a rule, the rig lacks a value, or the loop is predicted unstable.

    Examples
    --------
    >>> import ambid
    >>> record = ambid.simulate("thesis", duration=0.1, seed=1)
    >>> record.n_samples, record.names
    (1000, ('voltage', 'current', 'position'))
    """
    done, _ = simulate_used(
        source, duration=duration, rate_hz=rate_hz, excitation=excitation, amplitude=amplitude, band=band,
        periods=periods, seed=seed, closed=closed, nonlinear=nonlinear, position=position,
        log_excitation=log_excitation, force=force,
    )  # fmt: skip
    for line in done.warnings:
        warnings.warn(line, stacklevel=2)
    return done.record


def simulate_used(
    source: BenchSource,
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
        raise AmbidError(
            "no amplitude was given, and the rig has no limits to derive one from. Give --amplitude A in V"
        )
    peak = bench.largest(shape, seed, _FRACTION) if amplitude is None else amplitude
    done = bench.simulate(peak * shape, seed=seed)
    if log_excitation:
        logged = Channel(name="excitation", unit="V", values=peak * shape)
        done = replace(done, record=replace(done.record, channels=(*done.record.channels, logged)))
    return done, Excited(kind=excitation, peak=peak)


def bench_of_source(source: BenchSource) -> Rig | Preset:
    """Return the preset or rig that a name, a file or an estimate stands for."""
    if isinstance(source, str) and source in preset_names():
        return preset(source)
    if isinstance(source, (str, Path)) and str(source).lower().endswith(".json"):
        source = read_linear_estimate(source, f"{source} is no linear estimate; a simulation needs one. Give a rig")
    if isinstance(source, Estimate):
        return _rig_of_estimate(source)
    return source if isinstance(source, (Rig, Preset)) else load_rig(Path(source))


def _bench(
    given: BenchSource, rate: float | None, closed: bool | None, nonlinear: bool, position: float | None
) -> Bench:
    """Return the bench of a preset or a rig, its rotor held at a position where one is given."""
    source = bench_of_source(given)
    if isinstance(source, Preset):
        if position is not None and source.plant is not None:
            source = replace(source, operating_point=source.plant.equilibrium(position))
        return Bench.of(source, rate, source.usually_closed if closed is None else closed, nonlinear=nonlinear)
    if position is not None:
        source = replace(source, operating_point={**source.operating_point, "position": position})
    if rate is None and source.record.rate_hz is None:
        raise AmbidError(
            f"rig {source.source or source.name} gives no rate; a simulation needs one. Give --rate HZ, or "
            "record.rate_hz"
        )
    return Bench.of(source, rate, closed, nonlinear=nonlinear)


def _rig_of_estimate(estimate: Estimate) -> Rig:
    """Return the rig that an estimate remembers, with the numbers that it found."""
    rig = rig_of(estimate, "the estimate")
    known = tuple(replace(p, role="fixed", value=estimate[p.name].value, sd=None) for p in rig.parameters)
    late = next(iter(estimate.delay.values()))
    loop = replace(rig.loop or Loop(), delay=late.samples + late.fraction)
    rate = rig.record.rate_hz or float(str(estimate.record["rate_hz"]))
    return replace(
        rig, parameters=known, loop=loop, operating_point=dict(estimate.operating_point),
        record=replace(rig.record, rate_hz=rate),
    )  # fmt: skip


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
        raise AmbidError(
            f"--periods {periods}: {n} samples do not divide into that many periods. Change --duration or --periods"
        )
    return np.tile(make(n // periods), periods)
