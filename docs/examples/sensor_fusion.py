"""Several position sensors
========================

Three eddy-current sensors on one axis: fused, one of them slips, is found, left out and mended.

And a pair on opposite sides of the rotor whose zeros a warming housing moves by 20 um: the sum of both shows the
temperature, the position does not.

Run: ``python docs/examples/sensor_fusion.py``
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ambid.recursive.fusion import FusedSensor, SensorFusion

RATE_HZ, SECONDS = 20_000.0, 2.0
GAIN, NOISE = 4000.0, 2e-3  # V/m and V: 0.5 um
SLIP_S, SLIP = 1.0, 10e-6  # when sensor b slips, by how much, m
WARMING = 20e-6  # drift of the pair's zeros over the record, m


def vibration(n: int) -> np.ndarray:
    """Return a rotor that turns slightly out of balance at 3 000 rpm."""
    return 15e-6 * np.sin(2 * np.pi * 50.0 * np.arange(n) / RATE_HZ)


def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def three(seed: int) -> tuple[SensorFusion, dict[str, float]]:
    """Fuse three sensors through a slip of one of them; print what happens."""
    rng = np.random.default_rng(seed)
    n = int(RATE_HZ * SECONDS)
    x = vibration(n)
    values = GAIN * x[:, None] + NOISE * rng.standard_normal((n, 3))
    values[int(SLIP_S * RATE_HZ) :, 1] += GAIN * SLIP
    sensors = [FusedSensor(name=s, gain=GAIN, noise_sd=NOISE, resolution=0.0, drift_rate=2e-3) for s in "abc"]
    fusion = SensorFusion(RATE_HZ, sensors, q=1e-2)
    position, sd = fusion.update(values).T
    for event in fusion.events:
        print(f"{event.t:8.4f} s  {event.kind} {event.parameter}: {event.why}")
    found = {
        "one sensor": rms(values[:, 0] / GAIN - x),
        "mean of three": rms(values.mean(axis=1) / GAIN - x),
        "fused": rms(position - x),
        "fused, sd at the end": float(sd[-1]),
    }
    for name, value in found.items():
        print(f"{name:22} {value * 1e6:6.3f} um")
    return fusion, found


def pair(seed: int) -> dict[str, float]:
    """Fuse a differential pair while the housing warms; return errors in m and the temperature that was found in K."""
    rng = np.random.default_rng(seed)
    n = int(RATE_HZ * SECONDS)
    x, warming = vibration(n), WARMING * np.linspace(0.0, 1.0, n)
    per_kelvin = 1e-6 * GAIN  # V/K
    sensors = [
        FusedSensor(name=s, gain=g, noise_sd=NOISE, resolution=0.0, drift_rate=4e-5, warmth=per_kelvin)
        for s, g in (("upper", GAIN), ("lower", -GAIN))
    ]
    values = np.column_stack([GAIN * (x + warming), GAIN * (warming - x)]) + NOISE * rng.standard_normal((n, 2))
    fusion = SensorFusion(RATE_HZ, sensors, q=1e-2, temperature_rate=20.0)
    position, sd = fusion.update(values).T
    found = {
        "upper alone, at the end": float(np.mean(values[-2000:, 0] / GAIN - x[-2000:])),
        "fused, at the end": float(np.mean(position[-2000:] - x[-2000:])),
        "sd": float(sd[-1]),
    }
    for name, value in found.items():
        print(f"{name:25} {value * 1e6:7.3f} um")
    found["temperature"], found["temperature_sd"] = fusion.temperature
    print(f"temperature               {found['temperature']:7.2f} ± {found['temperature_sd']:.2g} K")
    return found


def main(seed: int = 1) -> tuple[SensorFusion, dict[str, float], dict[str, float]]:
    """Run both; return the fusion of three with its errors, and what the pair gave."""
    fusion, errors = three(seed)
    print()
    return fusion, errors, pair(seed)


def draw(done: tuple[SensorFusion, dict[str, float], dict[str, float]]) -> Figure:
    """Draw the rms error of one sensor, of the mean of three, and of the fusion."""
    errors = {name: 1e6 * value for name, value in done[1].items() if "sd" not in name}
    figure = Figure(figsize=(7.0, 2.2), layout="constrained")
    axes = figure.subplots()
    axes.barh(list(errors), list(errors.values()), height=0.5)
    axes.invert_yaxis()
    axes.set_xlabel("rms error of the position in um")
    return figure


if __name__ == "__main__":
    figure = draw(main())
