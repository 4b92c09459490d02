"""A preset or a rig as the scenarios take it, and the excitation that suits it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array
from ambid.errors import ModelError, RigError
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.models import model
from ambid.physics.nonlinear import OperatingPoint
from ambid.physics.presets import Preset
from ambid.signals import multisine
from ambid.simulate.bench import Simulation, simulate
from ambid.simulate.levels import largest_amplitude
from ambid.simulate.plant import LinearPlant
from ambid.simulate.rig_bench import parts_of_rig

if TYPE_CHECKING:  # the rig room reads files; a simulation needs its values only
    from ambid.rig.rig import Rig


_PERIOD = 20_000  # samples in which the excitation repeats
_FLATTEN = 40  # iterations that lower the peaks of an excitation
_FRACTION = 0.4  # of the limits that an amplitude chosen here uses: a bench that changes needs room


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """Plant, loop and what stands around them; `rig` is where the columns of a record are named, if there is one."""

    name: str
    plant: LinearPlant
    loop: Loop
    limits: Limits
    noise: Noise
    point: OperatingPoint
    rate_hz: float
    rig: Rig | None

    @classmethod
    def of(cls, bench: Preset | Rig, rate_hz: float | None, closed: bool | None) -> Bench:
        """Return the linear bench: a preset with its loop closed, a rig as its records are taken."""
        if isinstance(bench, Preset):
            loop = bench.loop if closed is not False else bench.loop.opened()
            return cls(
                name=bench.name,
                plant=LinearPlant(model=model(bench.model), parameters=bench.parameters),
                loop=loop,
                limits=bench.limits,
                noise=bench.noise,
                point=bench.operating_point,
                rate_hz=bench.rate_hz if rate_hz is None else rate_hz,
                rig=None,
            )
        plant, found, point = parts_of_rig(bench, closed)
        rate = bench.record.rate_hz if rate_hz is None else rate_hz
        if rate is None:
            raise RigError(
                f"rig {bench.name!r} names no rate; a simulation needs one. Give the rate, or record.rate_hz"
            )
        return cls(
            name=bench.name,
            plant=plant,
            loop=found or Loop(),
            limits=bench.limits or Limits(),
            noise=bench.noise or Noise(),
            point=point,
            rate_hz=rate,
            rig=bench,
        )

    @property
    def input_room(self) -> float:
        """From the operating point to the nearer limit of the input; infinite where it has none."""
        name = self.plant.model.inputs[0]
        rest = float(getattr(self.point, name))
        low, high = getattr(self.limits, name)
        return float(min(abs(low - rest), abs(high - rest)))

    @property
    def current_room(self) -> float:
        """From the operating point to the nearer limit of the current in A; infinite where it has none."""
        return min(abs(end - self.point.current) for end in self.limits.current)

    def persistent(self, seed: int) -> Array:
        """Return one period of a multisine of peak one from 1/4000 to 1/20 of the rate, shape (n_samples,).

        There the rotor and the coil both answer: 5 Hz to 1 kHz at 20 kHz.
        """
        band = (self.rate_hz / 4000.0, self.rate_hz / 20.0)
        return multisine(_PERIOD, self.rate_hz, amplitude=1.0, band=band, seed=seed, crest_iterations=_FLATTEN)

    def fast(self, seed: int) -> Array:
        """Return one period of a multisine of peak one that the rotor hardly follows, shape (n_samples,)."""
        band = (self.rate_hz / 40.0, self.rate_hz / 5.0)
        return multisine(_PERIOD, self.rate_hz, amplitude=1.0, band=band, seed=seed, crest_iterations=_FLATTEN)

    def largest(self, shape: Array, seed: int) -> float:
        """Return the amplitude that uses 0.4 of the limits, to three digits."""
        if not any(math.isfinite(e) for pair in (self.limits.voltage, self.limits.current) for e in pair):
            raise ModelError(
                f"bench {self.name!r} limits neither voltage nor current; no amplitude can be chosen. Give one"
            )

        def respond(u: Array) -> Simulation:
            return simulate(
                self.plant, u, rate_hz=self.rate_hz, seed=seed, loop=self.loop, limits=self.limits, noise=self.noise,
                operating_point=self.point,
            )  # fmt: skip

        found = largest_amplitude(
            respond, np.tile(shape, 2), limits=self.limits, operating_point=self.point, fraction=_FRACTION
        )
        return float(f"{found:.3g}")
