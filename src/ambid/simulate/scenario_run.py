"""Scenarios carried out: as one record, or as a stream of blocks that takes the same memory however long it is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import ModelError
from ambid.physics.presets import Preset
from ambid.record.record import Channel, Record, Step
from ambid.simulate.bench import TRUE, Simulation, Stretch, VaryingLoop, join
from ambid.simulate.lost_samples import losses
from ambid.simulate.rig_bench import Bench, as_columns
from ambid.simulate.scenarios import Scenario, amplitude_for, input_room, one_period, scenario

if TYPE_CHECKING:  # the rig room reads files; a simulation needs its values only
    from ambid.rig.rig import Rig


_CHUNK = 16384  # samples that are simulated at once
_LARGEST = 10**8  # samples of one record: it has to fit into memory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScenarioBlock:
    """Consecutive samples of a scenario.

    Attributes
    ----------
    first : int
        Number of the first sample.
    time_s : ndarray, shape (n_samples,)
        Sampling instants in s.
    signals : Mapping[str, ndarray of shape (n_samples,)]
        As logged, SI, by role: input, outputs, ``excitation``, and ``speed`` and ``angle`` where the rotor turns. Lost
        samples of the scenario ``dropped`` are NaN.
    truth : Mapping[str, ndarray of shape (n_samples,)]
        What varies, SI, by name: parameters, ``gain_<output>``, ``force``, ``unbalance``, ``unbalance_phase``.
    """

    first: int
    time_s: Array
    signals: Mapping[str, Array]
    truth: Mapping[str, Array]


def simulate_scenario(
    name: str | Scenario,
    bench: Preset | Rig,
    *,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    seed: int = 0,
    amplitude: float | None = None,
    at_s: float | None = None,
    size: float | None = None,
    closed: bool | None = None,
    log_excitation: bool = False,
) -> Simulation:
    """Simulate a scenario on the linear model of a bench.

    Parameters
    ----------
    name : str or Scenario
        One of `scenario_names`.
    bench : Preset or Rig
        With a loop that holds it, also after the change.
    duration_s : float, optional
        Length in s; default the scenario's.
    rate_hz : float, optional
        Sampling rate in Hz; default the bench's.
    seed : int
        Of excitation and noise.
    amplitude : float, optional
        Peak of the persistent excitation in the unit of the input; default what 0.4 of the limits allows before
        anything changes.
    at_s : float, optional
        When it begins, in s; default the scenario's part of the duration.
    size : float, optional
        How much, as `Scenario.size_is` says; default the scenario's.
    closed : bool, optional
        Closed or open loop; default closed, unless the rig says ``open_loop``.
    log_excitation : bool
        Add a column ``excitation``.

    Returns
    -------
    Simulation
        Its record (a rig's has the rig's columns, uncalibrated) has a column ``true_<name>`` for all that varies,
        e.g. ``true_k_i``, ``true_gain_position``, ``true_force``, ``true_unbalance`` and ``true_unbalance_phase``, and
        ``speed`` and ``angle`` where the rotor turns; `Simulation.truth` are the parameters at the beginning. That of
        ``dropped`` is whole: `ambid.simulate.damage` writes the damaged file.

    Raises
    ------
    ModelError
        If a number is out of range, there is no such scenario, or the bench does not survive it.
    RigError
        If a rig lacks what a simulation needs.
    """
    run = _Run(name, bench, duration_s, rate_hz, seed, amplitude, at_s, size, closed)
    if run.n_samples > _LARGEST:
        raise ModelError(
            f"{run.duration_s:g} s at {run.bench.rate_hz:g} Hz is {run.n_samples:g} samples; one record takes"
            f" {_LARGEST:g}. Make it shorter"
        )
    stretches, excitations = [], []
    for first in range(0, run.n_samples, _CHUNK):
        u = run.excitation(first, min(_CHUNK, run.n_samples - first))
        stretches.append(run.running.advance(u))
        excitations.append(u)
    done = join(run.running, stretches, seed)
    record = done.record.with_step(Step(name="scenario", settings=MappingProxyType(run.settings())))
    if log_excitation:
        unit = run.bench.linear.model.units[run.bench.linear.model.inputs[0]]
        logged = Channel(name="excitation", unit=unit, values=np.concatenate(excitations))
        record = replace(record, channels=(*record.channels, logged))
    if run.bench.rig is not None:
        record = as_columns(record, run.bench.rig, np.full(record.n_samples, run.bench.point.position))
    return replace(done, record=record)


def scenario_blocks(
    name: str | Scenario,
    bench: Preset | Rig,
    *,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    seed: int = 0,
    amplitude: float | None = None,
    at_s: float | None = None,
    size: float | None = None,
    closed: bool | None = None,
    block: int = 1000,
) -> Iterator[ScenarioBlock]:
    """Simulate a scenario block by block; the numbers are those of `simulate_scenario`, whatever the block's size.

    Memory is that of some blocks: an hour at 20 kHz costs no more than a second.

    Parameters
    ----------
    name, bench, duration_s, rate_hz, seed, amplitude, at_s, size, closed
        As in `simulate_scenario`.
    block : int
        Samples of a block; the last one may be shorter.

    Yields
    ------
    ScenarioBlock
        In order. Its arrays are views that nobody else writes to.

    Raises
    ------
    ModelError
        As `simulate_scenario`, at once; the bench may also fail on the way.
    """
    if block < 1:
        raise ModelError(f"a block of {block} samples; it has at least one. Give another size")
    return _blocks(_Run(name, bench, duration_s, rate_hz, seed, amplitude, at_s, size, closed), block)


def truth_columns(record: Record) -> Mapping[str, Channel]:
    """Return the true values that a simulated record holds.

    Parameters
    ----------
    record : Record
        As simulated or read from a file, before a rig has selected its columns.

    Returns
    -------
    Mapping[str, Channel]
        The channels whose names begin with ``true_``, by what follows: ``k_i`` for ``true_k_i``. Empty for a record
        without truth.
    """
    found = {c.name.removeprefix(TRUE): c for c in record.channels if c.name.startswith(TRUE)}
    return MappingProxyType(found)


class _Run:
    """A scenario with all its numbers settled, ready to go."""

    def __init__(
        self,
        name: str | Scenario,
        bench: Preset | Rig,
        duration_s: float | None,
        rate_hz: float | None,
        seed: int,
        amplitude: float | None,
        at_s: float | None,
        size: float | None,
        closed: bool | None,
    ) -> None:
        self.scenario = scenario(name) if isinstance(name, str) else name
        always = closed is None and isinstance(bench, Preset)
        self.bench = b = Bench.of(bench, rate_hz, True if always else closed)
        self.seed, self.duration_s = seed, self.scenario.duration_s if duration_s is None else duration_s
        if not (math.isfinite(b.rate_hz) and b.rate_hz > 0.0):
            raise ModelError(f"rate_hz is {b.rate_hz}; it must be positive. Correct it")
        count = self.duration_s * b.rate_hz
        if not (math.isfinite(count) and count >= 1.0):
            raise ModelError(
                f"{self.duration_s:g} s at {b.rate_hz:g} Hz is {count:g} samples; it must be at least one. Correct one"
            )
        self.n_samples = round(count)
        if at_s is not None and not self.scenario.size_is:
            raise ModelError(f"scenario {self.scenario.name!r} has no beginning: nothing changes. Leave the time out")
        self.at_s = self.scenario.begins * self.duration_s if at_s is None else at_s
        if not 0.0 <= self.at_s < self.duration_s:
            raise ModelError(
                f"scenario {self.scenario.name!r} begins at {self.at_s:g} s; the record runs from 0 to"
                f" {self.duration_s:g} s. Give a time in it"
            )
        if amplitude is not None and not (math.isfinite(amplitude) and amplitude >= 0.0):
            raise ModelError(f"amplitude is {amplitude}; it must be zero or positive. Correct it")
        if amplitude and not self.scenario.excited:
            raise ModelError(f"scenario {self.scenario.name!r} has no excitation. Leave the amplitude out")
        self.size = self.scenario.size_for(b, size)
        self.amplitude, self._period, self._extra = 0.0, np.zeros(1), np.zeros(1)
        self._prepare_excitation(amplitude)
        self.running = VaryingLoop(
            b.plant, self.scenario.vary(b, self.at_s, self.size, self.duration_s), rate_hz=b.rate_hz, seed=seed,
            loop=b.loop, limits=b.limits, noise=b.noise, operating_point=b.point,
        )  # fmt: skip

    def _prepare_excitation(self, amplitude: float | None) -> None:
        b = self.bench
        if self.scenario.excited:
            shape = one_period(b, self.seed)
            self.amplitude = amplitude_for(b, shape, self.seed) if amplitude is None else amplitude
            self._period = self.amplitude * shape
        if self.scenario.driven:
            room = input_room(b)
            if not math.isfinite(room):
                raise ModelError(
                    f"bench {b.name!r} does not limit its {b.linear.model.inputs[0]}; nothing can saturate. Set"
                    " loop.limits, or choose another scenario"
                )
            self._extra = self.size * room * one_period(b, self.seed + 1, fast=True)

    @property
    def first_sample(self) -> int:
        """The sample at which it begins."""
        return round(self.at_s * self.bench.rate_hz)

    def excitation(self, first: int, n: int) -> Array:
        """Return the excitation of n samples."""
        k = first + np.arange(n)
        u = self._period[k % self._period.size]
        if self.scenario.driven:
            u += np.where(k >= self.first_sample, self._extra[k % self._extra.size], 0.0)
        return u

    def settings(self) -> dict[str, object]:
        """Return what the history says."""
        found: dict[str, object] = {"name": self.scenario.name, "seed": self.seed, "amplitude": self.amplitude}
        if self.scenario.size_is:
            found |= {"from_s": self.at_s, "size": self.size, "size_is": self.scenario.size_is}
        return found


def _blocks(run: _Run, block: int) -> Iterator[ScenarioBlock]:
    lost = _lost(run)
    chunk = block * math.ceil(_CHUNK / block)
    for first in range(0, run.n_samples, chunk):
        u = run.excitation(first, min(chunk, run.n_samples - first))
        stretch = run.running.advance(u)
        signals = _signals(run, stretch, u)
        if lost.size:
            _lose(signals, lost, first)
        time = (first + np.arange(u.size)) / run.bench.rate_hz
        for k in range(0, u.size, block):
            part = slice(k, min(k + block, u.size))
            yield ScenarioBlock(
                first=first + k,
                time_s=time[part],
                signals=MappingProxyType({name: x[part] for name, x in signals.items()}),
                truth=MappingProxyType({name: x[part] for name, x in stretch.truth.items()}),
            )


def _signals(run: _Run, stretch: Stretch, excitation: Array) -> dict[str, Array]:
    of = run.bench.linear.model
    found = {of.inputs[0]: stretch.command}
    found.update({o: np.ascontiguousarray(stretch.measured[:, j]) for j, o in enumerate(of.outputs)})
    found["excitation"] = excitation
    if stretch.speed is not None and stretch.angle is not None:
        found |= {"speed": stretch.speed, "angle": stretch.angle}
    return found


def _lost(run: _Run) -> NDArray[np.int64]:
    """Return first, stop and column (-1: all) of what is lost, shape (n_losses, 3)."""
    if not run.scenario.dropped:
        return np.zeros((0, 3), dtype=np.int64)
    found = losses(run.n_samples, run.size, run.seed, first=run.first_sample)
    return np.array([(x.first, x.stop, x.column if x.kind == "cells" else -1) for x in found], dtype=np.int64)


def _lose(signals: dict[str, Array], lost: NDArray[np.int64], first: int) -> None:
    columns = list(signals.values())
    stop = first + columns[0].size
    for a, b, column in lost[(lost[:, 1] > first) & (lost[:, 0] < stop)].tolist():
        part = slice(max(a - first, 0), min(b, stop) - first)
        for values in columns if column < 0 else [columns[column % len(columns)]]:
            values[part] = np.nan
