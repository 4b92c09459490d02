"""What a record holds, told from records whose content is known."""

import numpy as np

from ambid.job.presentation import text
from ambid.record import Channel, Record
from ambid.validation.inspection import inspect


def record_text(record, **how):
    return text(inspect(record, **how))


def record_of(**channels):
    units = {"voltage": "V", "current": "A", "position": "m"}
    return Record(
        rate_hz=1000.0,
        channels=tuple(
            Channel(name=n, unit=units.get(n, "?"), values=np.asarray(x, dtype=float)) for n, x in channels.items()
        ),
    )


def row(text, name):
    (line,) = [x for x in text.splitlines() if x.startswith(f"{name} ")]
    return line.split()


def test_levels_are_in_sensible_units_and_the_step_is_the_converter_s():
    rng = np.random.default_rng(1)
    x = np.round(rng.normal(size=5000), 1) * 1e-3
    text = record_text(record_of(position=x))
    name, unit, low, high, mean, sd, step, *_ = row(text, "position")
    assert (name, unit) == ("position", "[mm]")
    assert float(low) == 1e3 * x.min()
    assert float(high) == 1e3 * x.max()
    assert abs(float(mean) - 1e3 * x.mean()) < 1e-6
    assert abs(float(sd) - 1e3 * x.std()) < 1e-4
    assert float(step) == 0.1


def test_the_noise_is_what_the_input_does_not_explain():
    rng = np.random.default_rng(2)
    u = rng.normal(size=20_000)
    y = np.convolve(u, [0, 0.5, 0.25], mode="full")[: u.size] + 0.0559 * rng.normal(
        size=u.size
    )  # 20 dB under the signal
    told = record_text(record_of(voltage=u, current=y), inputs=("voltage",))
    untold = record_text(record_of(voltage=u, current=y))
    assert abs(float(row(told, "current")[-2]) - 20.0) < 0.3
    assert float(row(untold, "current")[-2]) < 5.0  # a lower bound, and said to be one
    assert "a lower bound" in " ".join(untold.split())
    assert "a lower bound" not in " ".join(told.split())


def test_excitation_is_told_with_its_band():
    t = np.arange(4000) / 1000.0
    text = record_text(record_of(voltage=np.sin(2 * np.pi * 50 * t) + np.sin(2 * np.pi * 120 * t)))
    assert "persistently exciting of order 4" in text
    assert "between 50 Hz and 120 Hz" in text


def test_constant_short_and_unknown_channels_are_named_not_crashed_on():
    text = record_text(record_of(voltage=np.zeros(30), current=np.arange(30.0) % 7, other=np.arange(30.0)))
    assert "voltage: constant, no excitation" in text
    assert row(text, "current")[-1] == "short"
    assert "other: unknown unit [?]" in text
