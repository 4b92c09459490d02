"""A simulated rotor in its bearings as a device: all axes in the loop of the rig, at its speed, with unbalance and
run-out. It begins at the centre; where it touches a stop, or a current leaves its limits, the output goes off for good.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambid.acquisition.device import AxesProgram, Column, DeviceEvent, DeviceInfo, Mode, Program, SelfTest
from ambid.acquisition.devices.played import Pace, PlayedDevice
from ambid.arrays import Array
from ambid.errors import DeviceError
from ambid.physics.loop import Loop
from ambid.physics.presets import Preset
from ambid.record import Channel
from ambid.rig.draft import rig_of_preset
from ambid.rig.rig import Rig
from ambid.simulation.rig_bench import column_channels
from ambid.simulation.rotor_bench import Motion, RotorBench
from ambid.tracking.blocks import Block

_LIFT_S = 0.5  # after a start out of sampling, in which the rotor may still touch its stops


class RotorDevice(PlayedDevice):
    """A rotor in this process, in SI by the rig's columns; equal seeds and equal commands between equal samples give
    equal samples. `bench`: the truth, by default the rig's own numbers; the loop is the rig's.
    """

    def __init__(self, rig: Rig, *, bench: Preset | Rig | None = None, pace: Pace = "fastest", seed: int = 0) -> None:
        assert rig.rotor is not None
        truth = rig if bench is None else rig_of_preset(bench) if isinstance(bench, Preset) else bench
        if truth.rotor is None or truth.rotor.axes != rig.rotor.axes:
            raise DeviceError(
                f"the bench {truth.name!r} is not a rotor with axes {', '.join(rig.rotor.axes)}; that is what the rig "
                "sees. Give another"
            )
        whole = replace(truth, loop=rig.loop, channels=rig.channels, open_loop=False)
        self._loop, rate_hz = rig.loop, rig.rate_for(None)
        self._levitated = RotorBench.of(whole, rate_hz, None)
        self._off = replace(self._levitated, loop=(rig.loop or Loop()).opened())
        super().__init__(rate_hz, pace)
        self._limits, self._seed = self._levitated.limits, seed
        roles = {c.column: c.role for c in rig.channels}
        none = np.zeros((1, len(rig.rotor.axes)))
        shown = self._logged(self._off.advance(self._off.begun(), none, np.random.default_rng(0)), none)
        self._info = DeviceInfo(
            kind="simulated", port=truth.name or "rig", rate_hz=rate_hz, plant=self._levitated.plant.parameters,
            real=pace == "real",
            columns=tuple(Column(name=c.name, role=roles.get(c.name, c.name), unit=c.unit) for c in shown),
        )  # fmt: skip

    def _logged(self, moved: Motion, u: Array) -> tuple[Channel, ...]:
        return column_channels(self._off.channels(moved, u), self._off.rig, len(u))

    def _opened(self) -> None:
        self._rng = np.random.default_rng(self._seed)
        self._at, self._bench = self._off.begun(), self._off
        self._program: AxesProgram | None = None
        self._played = self._free_from = 0

    def _begin(self, mode: Mode) -> None:
        if mode == "levitate" and (self._loop is None or not self._loop.closed):
            raise DeviceError(
                f"{self._where} refuses mode 'levitate'; the rig has no loop with a gain. Give the rig a [loop]"
            )
        lies = self._state == "sampling"
        self._bench = self._levitated if mode == "levitate" else self._off
        begun = self._bench.begun()
        if lies:  # it goes on from where it is
            begun.x[:], begun.angle = self._at.x, self._at.angle
        self._at, self._program = begun, None
        self._free_from = self._next + (round(_LIFT_S * self._rate) if lies else 0)

    def _play(self, program: Program | AxesProgram | None) -> None:
        if isinstance(program, Program):
            self._refuse("excite", "a program of one axis does not say which axis. Give an AxesProgram")
        if program is not None and program.wave.shape[1] != len(self._off.model.axes):
            self._refuse("excite", f"it has {len(self._off.model.axes)} axes, the program {program.wave.shape[1]}")
        self._program, self._played = program, 0

    def _tested(self) -> SelfTest:
        return SelfTest(failed=(), numbers={"largest_pole": self._levitated.largest_pole})

    def _made(self, room: int) -> Block | None:
        u = np.zeros((room, len(self._off.model.axes)))
        if self._program is not None:
            wave = self._program.wave
            u = wave[(self._played + np.arange(room)) % len(wave)]
            self._played += room
        moved = self._bench.advance(self._at, u, self._rng)
        if moved.lost >= 0:
            raise DeviceError(
                f"{self._where}: the simulation leaves the finite numbers; a bench without stops falls without end."
                " Give the bench loop.limits.position"
            )
        if self._state == "levitating":
            self._watch(moved)
        values = np.column_stack([c.values for c in self._logged(moved, u)])
        return Block(first=self._next, time_s=self._next / self._rate, values=values)

    def _watch(self, moved: Motion) -> None:
        """Go to the safe state where the rotor touches down, or a current leaves its limits."""
        n, skip = len(self._off.model.axes), max(0, self._free_from - self._next)
        (low, high), (least, most) = self._limits.position, self._limits.current
        positions, currents = moved.truth[skip:, :n], moved.truth[skip:, n:]
        if not currents.size or (
            low < positions.min() <= positions.max() < high and least <= currents.min() <= currents.max() <= most
        ):
            return
        out = np.any((positions <= low) | (positions >= high), axis=1)
        over = np.any((currents < least) | (currents > most), axis=1)
        trips = np.flatnonzero(out | over)
        if not trips.size:
            return
        at = int(trips[0])
        self._state = "fault"
        self._events.append(
            DeviceEvent(
                kind="fault", sample=self._next + skip + at, what="out_of_gap" if bool(out[at]) else "over_current"
            )
        )
        running, self._bench, self._program = self._at, self._off, None
        self._at = self._off.begun()
        self._at.x[:], self._at.angle = running.x, running.angle
