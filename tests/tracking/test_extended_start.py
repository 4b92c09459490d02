"""Tracks whose start did not hold as it was: extended by coloured noise, which goes on, or failed for good reasons."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import ambid
from ambid.estimation.colours import Colour
from ambid.physics.linear_model import model
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.record import Channel, Record
from ambid.signals import cut, multisine
from ambid.simulation import LinearPlant, simulate
from ambid.simulation.variation import Schedule, Variation
from ambid.tracking.numbers import memory_of
from tests.bearing.benches import SETTINGS
from tests.tracking.starts import BEARING, bearing

TAU_S, SECONDS = 0.01, 2.0


def walked(seed: int) -> Record:
    """The record of a bearing under a force that is forgotten in `TAU_S`, ten times the white one of its noise."""
    s, rng = SETTINGS["bearing"], np.random.default_rng(seed)
    n, keep = round(SECONDS * s.rate_hz), np.exp(-1.0 / (TAU_S * s.rate_hz))
    period = multisine(8192, s.rate_hz, amplitude=s.rms, band=s.band, seed=seed, amplitude_is="rms")
    force = 10.0 * s.noise["force"] * lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(n))
    done = simulate(
        LinearPlant(model=model(s.model), parameters=s.truth), np.resize(period, n), rate_hz=s.rate_hz, seed=seed,
        loop=s.loop, noise=Noise.held(rate_hz=s.rate_hz, **s.noise),
        variation=Variation(force=Schedule(times_s=tuple(np.arange(n) / s.rate_hz), values=tuple(force))),
    )  # fmt: skip
    kept = [c for c in done.record.channels if c.name in ("voltage", "current", "position")]
    return Record(rate_hz=s.rate_hz, channels=tuple(Channel(name=c.name, unit=c.unit, values=c.values) for c in kept))


def test_coloured_noise_of_the_start_goes_on(tmp_path):
    record, truth = walked(1), SETTINGS["bearing"].truth
    start = ambid.identify(cut(record, 0.0, 1.0))
    assert start.extended
    assert all("_force" in cause for cause in start.extended)
    start.save(tmp_path / "start.json")  # the colours are in the file
    rest = cut(record, 1.0, SECONDS)
    found = ambid.track(rest, start=tmp_path / "start.json")
    assert not found.header.warnings
    assert not {"change", "disturbed", "reverted"} & set(found.totals.counts)
    assert found.lines[-1].error == pytest.approx(1.0, abs=0.05)
    for name, value in found.lines[-1].parameters.items():
        assert abs(value.value - truth[name]) < 4.0 * value.sd
    assert start.validate(rest).verdict.word == "usable"  # a second record is judged with them, too
    white = ambid.track(rest, start=replace(start, coloured=None))
    assert white.totals.counts["disturbed"] > 5


def test_modes_of_the_noise_do_not_count_as_memory():
    plant, colour = np.array([[0.9, 0.1], [0.0, 0.8]]), Colour(source="force", omega=1.0)
    F = np.block([[plant, np.array([[0.0], [1e-4]])], [np.zeros((1, 2)), np.array([[0.9999]])]])
    assert memory_of(F, ()) == pytest.approx(1e4)
    assert memory_of(F, (colour,)) == pytest.approx(10.0)
    turned = F[::-1, ::-1]  # a plant that forgets slowly beside noise that does not
    assert memory_of(turned, (colour,)) == pytest.approx(1e4)


def test_more_data_average_out_no_bias_of_the_start():
    """A position that holds 1 % of the current: what the start's failed checks imply stays in the intervals."""
    sound, truth = bearing(40_000, 1), preset(BEARING).parameters
    current, position = sound["current"].values, sound["position"].values
    part = 0.01 * position.std() / current.std() * current
    spoilt = [replace(c, values=c.values + part) if c.name == "position" else c for c in sound.channels]
    record = replace(sound, channels=tuple(spoilt))
    start, rest = ambid.identify(cut(record, 0.0, 1.0)), cut(record, 1.0, 2.0)
    assert start.verdict.word == "caution"
    last = ambid.track(rest, start=start).lines[-1].parameters
    for name, value in last.items():
        assert abs(value.value - truth[name]) < 3.0 * value.sd
        assert value.sd > start.bias_sd[name]
    bare = ambid.track(rest, start=replace(start, bias_sd={})).lines[-1].parameters
    assert abs(bare["m"].value - truth["m"]) > 5.0 * bare["m"].sd
    assert not any(ambid.identify(cut(sound, 0.0, 1.0)).bias_sd.values())
