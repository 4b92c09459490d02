"""A simulated bench that behaves like the controller: its modes, its law in whole numbers, its limits and trips. Of the
line nothing is simulated: no frame is lost, and the host is never silent. For that, emulate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.acquisition.device import AxesProgram, DeviceEvent, DeviceInfo, Mode, Program, SelfTest
from ambid.acquisition.devices.benches import bench_of, instruments
from ambid.acquisition.devices.played import Pace, PlayedDevice
from ambid.acquisition.law_words import BEGIN, WATCH_MS
from ambid.acquisition.program import counts_of, of_one_axis
from ambid.acquisition.protocol import table
from ambid.acquisition.scales import ADC_TOP, LAG_S, LIFTED_MS, PWM_TOP, TABLE_LENGTH, Scale, output_rates
from ambid.acquisition.settings import (
    ControllerSettings,
    carried,
    columns,
    controller_settings,
    in_si,
    is_made_up,
    with_default_daq,
)
from ambid.arrays import Array
from ambid.errors import DeviceError
from ambid.physics.presets import Preset
from ambid.rig.rig import Rig
from ambid.simulation.plant import Equations, Standing
from ambid.simulation.rig_bench import Bench
from ambid.tracking.blocks import Block

Integers = NDArray[np.int64]

_SETTLE_S = 0.5  # before a start: a rotor without current falls to where it lies
_SUBSTEPS = 8  # Runge-Kutta steps in each part of a sample
_ROLES = ("position", "current", "voltage", "excitation", "reference")  # in the order of a tick's counts
_PLACES = (  # of the settings that are passed on as they are, in the order of the compiled loop
    *("kp", "ki", "kd", "pole", "kc", "setpoint", "current_rest", "duty_bias"),
    *("position_low", "position_high", "current_low", "current_high", "duty_low", "duty_high", "duty_off"),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Plant:
    """What the compiled loop is given of the plant, all SI."""

    centre: Array
    centre_input: float
    equations: Equations
    stops: tuple[float, float]
    noise_size: Array
    roles: tuple[int, int]


class SimulatedDevice(PlayedDevice):
    """A bench in this process: equal seeds and equal commands between equal samples give equal samples.

    `bench`: the truth, by default daq.bench, else the rig's own numbers; `block_samples`: at most, by default of 10 ms.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        bench: Preset | Rig | None = None,
        pace: Pace = "fastest",
        seed: int = 0,
        block_samples: int | None = None,
    ) -> None:
        self._bench = bench_of(rig, bench)
        self._rig = with_default_daq(rig)
        self._si = is_made_up(rig, self._rig)
        self._settings = controller_settings(self._rig)
        self._instruments = instruments(self._rig, bench)
        super().__init__(self._settings.rate_hz, pace, block_samples)
        self._info = DeviceInfo(
            kind="simulated",
            port=self._bench.name,
            rate_hz=self._settings.rate_hz,
            columns=columns(self._rig, self._settings, si=self._si),
            plant=self._bench.parameters,
            real=pace == "real",
        )
        self._seed = seed

    def _opened(self) -> None:
        from ambid.acquisition.devices import _kernels as k

        self._rng = np.random.default_rng(self._seed)
        self._plant, whole = _plant_of(self._bench, self._settings)
        self._maps = _maps_of(self._instruments)
        self._numbers = _numbers_of(self._settings)
        self._table = np.zeros(TABLE_LENGTH, dtype=np.int64)
        law = self._settings.law
        self._words = np.array(law.words if law else (), dtype=np.int64)
        self._z = np.full(law.order if law else 0, BEGIN, dtype=np.int64)
        self._memory = np.zeros(k.N_MEMORY, dtype=np.int64)
        self._x, self._room_x = self._plant.centre.copy(), np.empty(self._plant.centre.size)
        self._line = np.zeros(whole + 2)
        self._base = self._current = 0
        self._rest()

    def _begin(self, mode: Mode) -> None:
        from ambid.acquisition.devices import _kernels as k

        if mode == "levitate" and not self._settings.closed:
            raise DeviceError(
                f"{self._where} refuses mode 'levitate'; the rig has no loop with a gain. Give the rig a [loop]"
            )
        if mode != "sample" and not self._settings.drives:
            raise DeviceError(
                f"{self._where} refuses mode {mode!r}; at {self._rate:g} Hz the controller only samples, its output"
                f" is on at {output_rates()}. Give daq.rate_hz such a rate"
            )
        memory = self._memory
        if self._state == "idle":
            self._rest()
            self._base = self._next
            memory[k.TICK] = 0
        memory[k.STATE] = table().value("state", {"sample": "sampling", "drive": "driving"}.get(mode, "levitating"))
        memory[k.CAUSE] = memory[k.INTEGRAL] = memory[k.DERIVATIVE] = memory[k.PLAYING] = 0
        self._z[:] = BEGIN
        law = mode == "levitate" and self._settings.law is not None
        memory[k.WATCHING] = math.ceil(WATCH_MS * 1e-3 * self._rate) if law else 0
        lifts = memory[k.TICK] + (memory[k.WATCHING] if self._settings.lift_ms else 0)
        memory[k.FRESH], memory[k.LIFTED], memory[k.INSIDE] = 1, lifts, 0

    def _rest(self) -> None:
        """Let time pass with the output off, unseen."""
        self._memory[:] = 0
        self._advance(round(_SETTLE_S * self._rate))
        self._memory[:] = 0

    def _clears(self) -> None:
        # Time passes while nothing is sampled, and the current goes.
        if self._flowing and not self._settings.current_low <= self._current <= self._settings.current_high:
            self._refuse("clear", "the current is still outside its limits. Wait until it is gone")

    def _play(self, program: Program | AxesProgram | None) -> None:
        from ambid.acquisition.devices import _kernels as k

        self._memory[k.PLAYING] = 0
        if program is None:
            return
        program = of_one_axis(program)
        fields = counts_of(program, self._rig, self._settings)
        self._table[: len(program.table)] = program.table
        for place, name in enumerate(("kind", "amplitude", "hold", "length", "cycles")):
            self._numbers[k.KIND + place] = fields[name]
        self._memory[[k.ELEMENT, k.HELD, k.PLAYED]] = 0
        self._memory[k.SHIFT] = fields["seed"] & (1 << fields["length"]) - 1
        self._memory[k.PLAYING] = int(program.kind != "none")

    def _tested(self) -> SelfTest:
        self._memory[:] = 0
        state = self._x.copy()
        counts = self._advance(16)
        self._x[:] = state
        self._memory[:] = 0
        numbers = {"position": float(counts[:, 0].mean()), "current": float(counts[:, 1].mean()), "supply_mv": 5000.0}
        about = {e.name: e.about for e in table().bits["failed"]}
        failed = []
        if self._plant.roles[0] >= 0 and not 0.0 < numbers["position"] < ADC_TOP:
            failed.append(about["position"])
        if not self._settings.current_low <= numbers["current"] <= self._settings.current_high:
            failed.append(about["current"])
        return SelfTest(failed=tuple(failed), numbers=numbers)

    def _made(self, room: int) -> Block | None:
        from ambid.acquisition.devices import _kernels as k

        faulty = self._memory[k.STATE] == k.FAULT
        counts = self._advance(room)
        if self._memory[k.STATE] == k.FAULT and not faulty:
            at, cause = self._base + int(self._memory[k.FAULT_TICK]), int(self._memory[k.CAUSE])
            self._state = "fault"
            self._events.append(DeviceEvent(kind="fault", sample=at, what=table().name("cause", cause)))
        wanted = [_ROLES.index(r) for r in carried(self._settings) if r in _ROLES]
        values = np.zeros((room, len(self._info.columns)))
        places = [j for j, r in enumerate(carried(self._settings)) if r in _ROLES]
        values[:, places] = counts[:, wanted]
        if self._si:
            values = in_si(self._rig, self._settings, values)
        return Block(first=self._next, time_s=self._next / self._rate, values=values)

    def _advance(self, n: int) -> Integers:
        """Carry bench and controller over n ticks; returns what was sampled, shape (n, 6), counts."""
        from ambid.acquisition.devices._kernels import tick_on

        plant = self._plant
        counts = np.empty((n, len(_ROLES) + 1), dtype=np.int64)
        lost = tick_on(
            counts,
            self._rng.standard_normal((n, plant.noise_size.size)),
            plant.noise_size,
            self._numbers,
            self._memory,
            self._table,
            self._words,
            self._z,
            self._x,
            self._line,
            plant.roles,
            self._maps,
            plant.centre,
            plant.centre_input,
            plant.equations,
            plant.stops,
            self._room_x,
        )
        if lost >= 0:
            raise DeviceError(
                f"{self._where}: the simulation leaves the finite numbers; a bench without stops falls without end."
                " Give the bench loop.limits.position"
            )
        self._current = int(counts[-1, 1]) if n else self._current
        return counts


def _plant_of(bench: Bench, settings: ControllerSettings) -> tuple[_Plant, int]:
    """Return the plant for the compiled loop, and the whole samples of its delay."""
    standing = Standing.of(bench.plant, bench.point)
    plant_model, period = standing.model, 1.0 / settings.rate_hz
    delay = LAG_S * settings.rate_hz  # the controller's own, whatever delay a loop was designed for
    whole = math.floor(delay)
    force, voltage = bench.noise.held_rms(settings.rate_hz)
    size = {"force": force, "voltage": voltage}
    inside = standing.gap
    low, high = bench.limits.position
    # Short of the pole faces, where the equations end.
    stops = (max(low, inside[0] + 1e-3 * abs(inside[0])), min(high, inside[1] - 1e-3 * abs(inside[1])))
    with np.errstate(all="ignore"):  # of a plant beyond all numbers, which is told when it runs
        equations = standing.equations(period, delay - whole, _SUBSTEPS)
    plant = _Plant(
        centre=standing.centre,
        centre_input=standing.centre_input,
        equations=equations,
        stops=stops,
        noise_size=np.array([bench.noise.position, bench.noise.current, *(size[d] for d in plant_model.disturbances)]),
        roles=(_place(plant_model.states, "position"), _place(plant_model.states, "current")),
    )
    return plant, whole


def _maps_of(scales: Mapping[str, Scale]) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Return x and y of position to counts, current to counts, and pulse width to volts."""
    flat = np.array([0.0, 1.0])
    position = _inverse(scales["position"]) if "position" in scales else (flat, flat)
    voltage = scales["voltage"]
    return (*position, *_inverse(scales["current"]), voltage.raw, voltage.si)


def _inverse(scale: Scale) -> tuple[Array, Array]:
    order = slice(None) if scale.si[-1] > scale.si[0] else slice(None, None, -1)
    return np.ascontiguousarray(scale.si[order]), np.ascontiguousarray(scale.raw[order])


def _numbers_of(settings: ControllerSettings) -> Integers:
    from ambid.acquisition.devices import _kernels as k

    numbers = np.zeros(k.N_SETTINGS, dtype=np.int64)
    numbers[: len(_PLACES)] = [getattr(settings, name) for name in _PLACES]
    numbers[k.LIFT] = math.ceil(settings.lift_ms * 1e-3 * settings.rate_hz)
    numbers[k.SETTLED] = math.ceil(LIFTED_MS * 1e-3 * settings.rate_hz)
    numbers[k.HOLD], numbers[k.TOP], numbers[k.TOP_DUTY] = 1, ADC_TOP, PWM_TOP
    return numbers


def _place(names: tuple[str, ...], name: str) -> int:
    return names.index(name) if name in names else -1
