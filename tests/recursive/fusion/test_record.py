"""A record gets its position: new channel, history, nothing else touched, no dynamics of a filter in it."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import EstimationError, RecordError
from ambid.record.record import Channel, Record
from ambid.recursive.fusion.motion import free_motion
from ambid.recursive.fusion.record import fuse_record
from tests.recursive.fusion.benches import NOISE, RATE, SIGMA, Q, readings, sensors, vibration

MOTION = free_motion(RATE, q=Q)


def record(y, start_s=3.0):
    return Record(
        rate_hz=RATE,
        start_s=start_s,
        channels=tuple(Channel(name=n, unit="V", values=v) for n, v in zip("abc", y.T, strict=True)),
    )


def test_the_record_gets_a_position_and_a_line_of_history():
    y = readings(vibration(4000))
    y[2000:, 1] += 20 * NOISE
    given = record(y)
    done = fuse_record(given, sensors(), motion=MOTION)
    assert given.names == ("a", "b", "c")
    assert done.record.names == ("a", "b", "c", "position")
    (step,) = done.record.history
    assert step.name == "fuse"
    assert step.settings["missing_samples"] == 0
    assert "excluded b" in step.settings["events"][0]
    assert done.events[0].t == pytest.approx(3.1, abs=1e-3)
    error = (done.record["position"] - vibration(4000)) / done.sd
    assert 0.9 < np.mean(np.abs(error[100:]) < 1.96) < 0.98


def test_the_instant_position_has_no_dynamics_and_the_filtered_one_has():
    """Motion far faster than the filter's: the amplitude of one stays, that of the other does not."""
    x = vibration(8000, amplitude=10e-6, hz=3000.0)
    y = readings(x)
    ratio = {
        give: fuse_record(record(y), sensors(), motion=MOTION, give=give).record["position"] @ x / (x @ x)
        for give in ("instant", "filtered")
    }
    assert ratio["instant"] == pytest.approx(1.0, abs=0.01)
    assert ratio["filtered"] < 0.5


def test_where_no_sensor_can_be_used_the_instant_position_is_missing():
    y = readings(vibration(1000))
    y[500:505] = np.nan
    done = fuse_record(record(y), sensors(), motion=MOTION)
    assert np.flatnonzero(np.isnan(done.record["position"])).tolist() == [500, 501, 502, 503, 504]
    assert done.record.history[-1].settings["missing_samples"] == 5
    assert done.sd[499] == pytest.approx(SIGMA / np.sqrt(3.0), rel=0.01)


def test_nothing_is_overwritten_or_made_up():
    y = readings(vibration(100))
    with pytest.raises(EstimationError, match="nothing is overwritten"):
        fuse_record(record(y), sensors(), motion=MOTION, name="a")
    with pytest.raises(RecordError, match="no channel 'd'"):
        fuse_record(record(y), sensors(4), motion=MOTION)
