"""The plant file of the emulated bench: what stands at the controller's pins, in its own words (firmware/bench).

A converter's count c stands for the volts in the middle of its step, (c + 1/2) 5 V / 1024, so that a calibrated reading
is right in the mean.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Literal

from ambid.acquire.devices.benches import Bench, bench_of
from ambid.acquire.scales import ADC_TOP, Scale, scale_of
from ambid.acquire.settings import has_position
from ambid.errors import DeviceError
from ambid.physics.magnet import CoEnergy, DifferentialPair
from ambid.physics.nonlinear import NonlinearPlant
from ambid.physics.power_stage import IDEAL
from ambid.physics.presets import Preset
from ambid.rig.rig import Rig

_PREFIX = "ambid-emulated-"
_LOCK = "in_use"
_YOUNG_S = 60.0  # a folder as young may be about to be locked
_VOLT_PER_COUNT = 5.0 / (ADC_TOP + 1)
_NO_POSITION = {"position_gain": 0.0, "position_offset": 2.5}
_HELD = {"m": 1.0, "k_x": 0.0, "k_i": 0.0}  # a coil alone, in the words of one axis: nothing moves, nothing moves it


class TemporaryFolder:
    """A folder of this program alone."""

    def __init__(self) -> None:
        """Make it, and remove what dead programs have left."""
        _remove_dead()
        self.path = Path(tempfile.mkdtemp(prefix=_PREFIX))
        self._lock = os.open(self.path / _LOCK, os.O_CREAT | os.O_RDWR | getattr(os, "O_CLOEXEC", 0), 0o600)
        _locked(self._lock)

    def remove(self) -> None:
        """Remove it with all that it holds; again is harmless."""
        if self._lock >= 0:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self._lock)
            self._lock = -1


def _locked(fd: int) -> bool:
    """Lock a file; whether nobody else holds it."""
    try:
        import fcntl
    except ImportError:  # not a POSIX system: there is no emulated bench either
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove_dead() -> None:
    """Remove the folders of this user that nobody holds."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError):  # of another user, or just being removed
            if folder.is_symlink() or time.time() - folder.stat().st_mtime < _YOUNG_S:
                continue
            fd = os.open(folder / _LOCK, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                if _locked(fd):
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(fd)


def write_plant_file(
    path: Path,
    rig: Rig,
    *,
    bench: Preset | Rig | None = None,
    pwm: Literal["switched", "averaged"] = "switched",
    off: Literal["diodes", "short"] = "diodes",
    start: float | None = None,
    noise: float = 1.0,
    pin_noise: float = 0.0,
    third: tuple[float, float, float] = (0.0, 0.0, 2.5),
) -> None:
    """Write the bench that stands behind a rig as a plant file.

    `path`: file to be written; `bench`: the truth; None: what daq.bench names, else the rig's own numbers; `pwm`:
    whether the coil sees each pulse, or its mean over the period; `start`: position at the beginning, m. None: where
    the rotor comes to lie without current; `noise`: factor on the bench's noise; 0 for none; `pin_noise`: more noise at
    all three analog inputs, V rms; `third`: third input: V/m, V/A and V.
    """
    truth = bench_of(rig, bench)
    body = tuple(_plant(truth))  # first: a bench that is not known is refused by its name
    current, voltage = scale_of(rig, "current"), scale_of(rig, "voltage")
    if voltage.raw.size > 2:
        raise DeviceError(
            f"rig {rig.name!r}: channels.voltage is calibrated by a table; the emulated power stage is a straight line"
            " from counts to volts. Give gain and offset"
        )
    low, high = (float(v) for v in voltage.to_si([0.0, float(voltage.top)]))
    stage = {"high_voltage": high, "low_voltage": low}
    lines = [
        f"# {truth.name}",
        *body,
        *_numbers(stage),
        *_numbers(_noise(truth, noise) | {"pin_noise": pin_noise}),
    ]
    # A rig without position leaves that input alone: it shows half of the supply.
    position = _sensor("position", scale_of(rig, "position")) if has_position(rig) else _numbers(_NO_POSITION)
    lines += [*position, *_sensor("current", current)]
    lines += _numbers(dict(zip(("third_position_gain", "third_current_gain", "third_offset"), third, strict=True)))
    lines += _numbers({"start_position": _resting_place(truth) if start is None else start})
    # A single transistor with its diode: no current the other way, and a coil that is switched off runs out slowly.
    one_way = min(low, high) >= 0.0
    lines += [f"pwm {pwm}", f"off {'short' if one_way else off}", f"current {'one-way' if one_way else 'both-ways'}"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _plant(bench: Bench) -> Iterator[str]:
    plant, point = bench.plant, bench.point
    if isinstance(plant, NonlinearPlant):
        w = plant.magnet.coenergy
        pair = isinstance(plant.magnet, DifferentialPair)
        if not isinstance(w, CoEnergy):
            raise DeviceError(
                f"bench {bench.name!r} has a magnet with another law; the emulated one knows ideal ones. Simulate it"
                " with ambid.simulate"
            )
        if (pair and (w.k_a != w.k_b or w.i0_asym != 0.0)) or plant.stage != IDEAL or math.isfinite(plant.eddy_pole):
            raise DeviceError(
                f"bench {bench.name!r} has unequal magnets, an eddy pole or a lossy stage; the emulated one knows none"
                " of them. Simulate it with ambid.simulate"
            )
        yield f"kind {'differential' if pair else 'single'}"
        yield from _numbers({"m": plant.m, "R": plant.R, "c": plant.c, "k": w.k_b, "leakage": w.leakage})
        yield from _numbers({"gravity": plant.gravity} | ({"gap": w.s_b, "bias": w.i0} if pair else {}))
    elif plant.model.name in ("one-axis", "coil"):
        yield "kind linear"
        yield from _numbers((_HELD if plant.model.name == "coil" else {}) | dict(plant.parameters))
        rest = {"position": point.position, "current": point.current, "voltage": point.voltage}
        yield from _numbers({f"rest_{name}": value for name, value in rest.items()})
    else:
        raise DeviceError(
            f"bench {bench.name!r} is of model {plant.model.name!r}; the emulated bench knows coil, one-axis and its"
            " magnets. Give a bench of those"
        )
    low, high = bench.limits.position
    floor, ceiling = (-math.inf, math.inf) if not isinstance(plant, NonlinearPlant) else plant.magnet.range
    if isinstance(plant, NonlinearPlant) and not floor < low < high < ceiling:
        raise DeviceError(
            f"bench {bench.name!r}: limits.position is {low:g} to {high:g} m; the emulated rotor needs stops inside its"
            f" air gap, {floor:g} to {ceiling:g} m. Give loop.limits.position"
        )
    yield from _numbers({k: v for k, v in (("stop_low", low), ("stop_high", high)) if math.isfinite(v)})


def _noise(bench: Bench, factor: float) -> dict[str, float]:
    n = bench.noise
    numbers = {"position_noise": n.position, "current_noise": n.current}
    return {k: factor * v for k, v in (numbers | {"force_noise": n.force, "voltage_noise": n.voltage}).items()}


def _sensor(role: str, scale: Scale) -> Iterator[str]:
    volts = (scale.raw + 0.5) * _VOLT_PER_COUNT
    if scale.raw.size > 2:
        yield from (f"{role}_point {v!r} {q!r}" for v, q in zip(volts.tolist(), scale.si.tolist(), strict=True))
        return
    gain = float((volts[1] - volts[0]) / (scale.si[1] - scale.si[0]))
    yield from _numbers({f"{role}_gain": gain, f"{role}_offset": float(volts[0]) - gain * float(scale.si[0])})


def _resting_place(bench: Bench) -> float:
    """Return where an unpowered rotor lies: on a stop if nothing brings it back, along its weight if it has one."""
    plant, stops = bench.plant, bench.limits.position
    if not isinstance(plant, NonlinearPlant) and plant.model.name == "coil":
        return 0.0
    nonlinear = isinstance(plant, NonlinearPlant)
    weight = plant.gravity if isinstance(plant, NonlinearPlant) else 0.0
    stable = not nonlinear and bench.plant.parameters["k_x"] > 0.0  # type: ignore[union-attr]
    stop = stops[1] if weight > 0.0 else stops[0]
    return bench.point.position if stable or not math.isfinite(stop) else stop


def _numbers(values: dict[str, float]) -> list[str]:
    return [f"{name} {float(value)!r}" for name, value in values.items()]
