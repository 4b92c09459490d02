"""The figure of a record: extremes, faults, spectra with noise and rounding, at the record's own time."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.record import Channel, Record
from ambid.report.record import record_figure

STEP, NOISE, RATE = 0.01, 0.02, 1000.0


@pytest.fixture(scope="module")
def record() -> Record:
    rng = np.random.default_rng(4)
    t = np.arange(6000) / RATE
    x = np.round((np.sin(2 * np.pi * 5 * t) + NOISE * rng.standard_normal(t.size)) / STEP) * STEP
    y = np.clip(2.0 * np.sin(2 * np.pi * 3 * t + 1) + 0.01 * rng.standard_normal(t.size), -1.5, 1.5)
    channels = tuple(Channel(name=n, unit=u, values=v, source_unit=u) for n, u, v in (("x", "m", x), ("volts", "V", y)))
    return Record(channels=channels, rate_hz=RATE, start_s=12.0)


def test_each_channel_has_its_time_its_close_view_and_its_spectrum(record: Record) -> None:
    axes = record_figure(record, "a record").axes
    assert len(axes) == 6
    whole, close, spectrum = axes[:3]
    edges = np.concatenate([c.get_paths()[0].vertices for c in whole.collections])
    x = record.channel("x").values
    assert (edges[:, 1].min(), edges[:, 1].max()) == (pytest.approx(x.min()), pytest.approx(x.max()))
    assert edges[:, 0].min() == pytest.approx(12.0)
    assert "steps of 10 mm" in close.get_title(loc="left")
    levels = {line.get_label(): float(line.get_ydata()[0]) for line in spectrum.lines if len(line.get_ydata()) == 2}
    scale = 1e3 if "[mm" in spectrum.get_ylabel() else 1.0
    assert levels["rounding to steps"] == pytest.approx(scale * STEP / np.sqrt(12) * np.sqrt(2 / RATE))
    assert levels["noise, unpredictable part"] == pytest.approx(
        scale * NOISE * np.sqrt(2 / RATE), rel=0.2
    )  # 20 lags predict a little less


def test_saturation_is_seen(record: Record) -> None:
    whole = record_figure(record, "a record").axes[3]
    title = whole.get_title(loc="left")
    assert title.startswith("✗ volts: ")
    assert "% saturated" in title
    limits = sorted(float(line.get_ydata()[0]) for line in whole.lines if line.get_label() == "saturated here")
    assert limits == [-1.5, 1.5]
