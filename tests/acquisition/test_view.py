"""What a device samples, seen through its rig: roles, SI, order, and what does not fit."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.acquisition.device import Column
from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.acquisition.settings import BenchView, as_record
from ambid.errors import AmbidError
from ambid.record.calibration import Calibration
from ambid.rig import rig_from_text
from ambid.tracking.blocks import Block
from tests.job.benches import PLAIN, prototype


@pytest.fixture(scope="module")
def info():
    return SimulatedDevice(prototype()).info


def test_counts_become_units_in_the_order_of_the_roles(info):
    view = BenchView(info, prototype(), ("voltage", "position", "current"))
    counts = np.array([[511.5, 511.5, 400.0, 0.0, 511.5][: len(info.columns)]])
    seen = view.block(Block(first=7, time_s=0.25, values=counts))
    assert (seen.first, seen.time_s) == (7, 0.25)
    np.testing.assert_allclose(seen.values, [[0.0, 0.0, 0.0]], atol=1e-12)
    counts[0, 0] += 1.0  # position
    np.testing.assert_allclose(view.block(Block(first=0, time_s=0.0, values=counts)).values[0, 1], 2.44140625e-6)
    assert view.units == {"voltage": "V", "position": "m", "current": "A"}
    assert view.rate_hz == 2000.0


def of_position(rig, **what):
    return replace(rig, channels=tuple(replace(c, **what) if c.role == "position" else c for c in rig.channels))


TABLE = Calibration(unit_in="1", unit_out="m", raw=np.array([0.0, 50.0, 1023.0]), out=np.array([0.0, 1e-4, 1e-3]))
RIGS = {
    "gains": (prototype(), {}),
    "a table": (prototype(), {"calibration": TABLE}),
    "a declared unit": (rig_from_text(PLAIN, "plain.toml"), {"unit": "mm"}),
}


@pytest.mark.parametrize(("rig", "what"), RIGS.values(), ids=RIGS)
def test_a_block_looks_the_same_as_the_record_that_is_read(rig, what):
    info = SimulatedDevice(rig).info
    view = BenchView(info, of_position(rig, **what), ("voltage", "position", "current"))
    counts = np.arange(20.0 * len(info.columns)).reshape(20, -1)
    record = view.record(counts, start_s=2.0)
    assert record.start_s == 2.0
    seen = view.block(Block(first=0, time_s=0.0, values=counts)).values
    np.testing.assert_array_equal(seen, np.column_stack([record[r] for r in ("voltage", "position", "current")]))


def test_si_columns_pass_as_they_are():
    rig = rig_from_text(PLAIN, "plain.toml")
    info = SimulatedDevice(rig).info
    values = np.array([[1e-4, 0.2, -3.0, 0.5]])
    seen = BenchView(info, rig, ("voltage", "position", "current")).block(Block(first=0, time_s=0.0, values=values))
    np.testing.assert_array_equal(seen.values, [[-3.0, 1e-4, 0.2]])


def test_a_column_that_is_missing_is_told_at_once(info):
    others = replace(info, columns=tuple(c for c in info.columns if c.role != "current"))
    with pytest.raises(AmbidError, match="current"):
        BenchView(others, prototype(), ("voltage", "position", "current"))


def test_a_unit_that_does_not_fit_is_told_at_once():
    rig = rig_from_text(PLAIN, "plain.toml")
    info = SimulatedDevice(rig).info
    wrong = tuple(replace(c, unit="A") if c.role == "position" else c for c in info.columns)
    with pytest.raises(AmbidError, match="position"):
        BenchView(replace(info, columns=wrong), rig, ("voltage", "position", "current"))


def test_samples_become_a_record_of_the_devices_columns():
    columns = (Column(name="a", role="extra", unit="1"), Column(name="b", role="extra", unit="V"))
    record = as_record(np.array([[1.0, 2.0], [3.0, 4.0]]), columns, 100.0)
    assert [(c.name, c.unit, c.values.tolist()) for c in record.channels] == [("a", "1", [1, 3]), ("b", "V", [2, 4])]
