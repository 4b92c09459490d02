"""What plots show of a record: amplitudes of known sines, a line that follows a speed, limits of a rig."""

import numpy as np
import pytest

from ambid.console.envelope import window
from ambid.console.look import limits, look
from ambid.errors import AmbidError
from ambid.record import Channel, Record
from ambid.rig import load_rig
from tests.job.benches import PROTOTYPE_FILE

RATE = 2000.0


def record_of(**signals):
    units = {"position": "m", "x": "m", "y": "m", "speed": "rad/s", "voltage": "V"}
    channels = tuple(Channel(name=n, unit=units[n], values=v) for n, v in signals.items())
    return Record(rate_hz=RATE, channels=channels, start_s=1.0)


def ramp(n=20_000):
    """A speed that rises from 10 to 60 turns a second in ten seconds, and an unbalance that follows it."""
    t = np.arange(n) / RATE
    turns = 10.0 + 5.0 * t
    return record_of(position=3e-6 * np.sin(2.0 * np.pi * (10.0 * t + 2.5 * t**2)), speed=2.0 * np.pi * turns)


def test_a_window_that_is_kept_for_all_is_written_by_nobody():
    with pytest.raises(ValueError, match="read-only"):
        window(16)[0] = 1.0


@pytest.mark.parametrize(("weights", "low"), [("flat top", 0.002), ("Hann", 0.16)])
@pytest.mark.parametrize("hz", [50.0, 50.03, 123.456])
def test_a_sine_has_its_amplitude_and_frequency(weights, low, hz):
    t = np.arange(8000) / RATE
    seen = look(record_of(position=2e-6 * np.sin(2.0 * np.pi * hz * t) + 1e-4), weights=weights)["spectrum"]
    peak = int(np.argmax(seen["amplitudes"][0]))
    assert seen["hz"][peak] == pytest.approx(hz, abs=0.5 * RATE / 8000)
    assert 2e-6 * (1.0 - low) < seen["amplitudes"][0][peak] < 2e-6 * 1.001
    near = look(record_of(position=2e-6 * np.sin(2.0 * np.pi * hz * t)), from_hz=hz - 5, to_hz=hz + 5)["spectrum"]["hz"]
    assert np.allclose(np.diff(near), RATE / 8000)  # seen closer, each line stands for itself
    assert hz - 5.5 <= near[0] < near[-1] <= hz + 5.5


def test_an_envelope_holds_each_sample_and_a_short_stretch_is_shown_as_it_is():
    noise = np.random.default_rng(1).normal(size=20_000)
    seen = look(record_of(voltage=noise))
    low, high = (np.array(seen["channels"][0][k]) for k in ("low", "high"))
    assert (low.min(), high.max()) == pytest.approx((noise.min(), noise.max()), rel=1e-6)
    short = look(record_of(voltage=noise), from_s=2.0, to_s=2.1)
    assert short["each"] == 1
    assert short["t"][0] == 2.0
    assert short["t"][-1] == 2.1
    assert short["channels"][0]["low"] == pytest.approx(noise[2000:2201], rel=1e-6)


def test_the_line_of_a_waterfall_follows_the_speed():
    fall = look(ramp(), to_hz=100.0)["waterfall"]
    amplitudes, turning, hz = np.array(fall["amplitudes"]), np.array(fall["turning"]), np.array(fall["hz"])
    assert np.allclose(turning, 10.0 + 5.0 * (np.array(fall["t"]) - 1.0), atol=0.01)
    at = hz[amplitudes.argmax(axis=1)]
    assert np.abs(at - turning).max() < 2.0 * fall["resolution"]
    assert amplitudes.max() == pytest.approx(3e-6, rel=0.2)


def test_an_orbit_is_of_the_samples_themselves():
    t = np.arange(4000) / RATE
    seen = look(record_of(x=np.cos(50 * t), y=np.sin(50 * t)), orbit=("x", "y"))["orbit"]
    assert np.hypot(*np.array(seen)) == pytest.approx(np.ones(3000), rel=1e-6)


def test_limits_are_in_the_units_of_what_is_drawn():
    rig = load_rig(PROTOTYPE_FILE)
    of = {line["words"]: line["at"] for line in limits(rig)["position"] if line["at"] > 0}
    assert of == {"the rotor touches": 1e-3, "trip": 0.9e-3}
    counts = {line["words"]: line["at"] for line in limits(rig, columns=True)["position"] if line["at"] > 512}
    assert counts == pytest.approx({"the rotor touches": 921.1, "trip": 880.1}, abs=0.1)


def test_a_stretch_may_begin_or_end_at_zero():
    """A scope's time begins before its trigger."""
    t = np.arange(2000) / RATE - 0.5
    record = Record(rate_hz=RATE, channels=(Channel(name="x", unit="m", values=t),), start_s=-0.5)
    after, before = look(record, from_s=0.0), look(record, to_s=0.0)
    assert (after["t"][0], after["samples"]) == (0.0, 1000)
    assert (before["t"][0], before["samples"]) == (-0.5, 1001)


@pytest.mark.parametrize("band", [(1000.0, None), (1e8, None), (50.0, 50.0), (90.0, 10.0), (0.0, -1.0)])
def test_a_band_without_a_line_is_refused(band):
    with pytest.raises(AmbidError, match="there is no line from"):
        look(ramp(4000), from_hz=band[0], to_hz=band[1])


@pytest.mark.parametrize("band", [(999.99, None), (-1e8, 1e8), (999.0, 1000.0), (0.0, 1e-9)])
def test_the_narrowest_bands_are_drawn(band):
    assert look(ramp(4000), from_hz=band[0], to_hz=band[1])["waterfall"]["hz"]
