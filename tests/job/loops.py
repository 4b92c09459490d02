"""Records of a levitated bearing with the outer excitation in them, as a bench with a logged reference gives them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ambid.physics.presets import preset
from ambid.record import Channel, Record, write_record
from ambid.signals import multisine
from ambid.simulation import simulate_preset


def loop_record(
    name: str = "unstable-bearing", *, period: int = 4000, periods: int = 8, rms: float = 3.0, seed: int = 4
) -> Record:
    """The preset in its own loop and noise, excited by a periodic multisine that adds to the controller's voltage."""
    bench = preset(name)
    excitation = multisine(
        period * periods, bench.rate_hz, amplitude=rms, amplitude_is="rms", band=(5.0, 2000.0), periods=periods,
        phases="schroeder", shape="pink",
    )  # fmt: skip
    return with_excitation(excitation, name, seed)


def odd_record(*, nonlinear: bool, rms: float = 6.0, period: int = 4000, periods: int = 8) -> Record:
    """As `loop_record`, with odd lines, of which one in four is left out to show distortion."""
    rate, rng = preset("unstable-bearing").rate_hz, np.random.default_rng(3)
    odd = np.arange(1, 2 * 196, 2).reshape(-1, 4)
    lines = odd[np.arange(4) != rng.integers(4, size=(odd.shape[0], 1))]
    spectrum = np.zeros(period // 2 + 1, dtype=np.complex128)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size)) / np.sqrt(lines)
    x = np.fft.irfft(spectrum, period)
    assert rate > 0
    return with_excitation(np.tile(rms * x / x.std(), periods), "unstable-bearing", 2, nonlinear=nonlinear)


def with_excitation(excitation: np.ndarray, name: str, seed: int, **settings: bool) -> Record:
    done = simulate_preset(preset(name), excitation, seed=seed, **settings)
    assert not done.warnings
    logged = Channel(name="excitation", unit="V", values=excitation)
    return replace(done.record, channels=(*done.record.channels, logged))


def loop_csv(path: Path) -> Path:
    write_record(loop_record(), path)
    return path
