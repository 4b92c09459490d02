"""Records for the tests of the signals room: plain arrays as records, and the measured ones where they are present."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ambid.record import Channel, Record, read_record
from tests.measured import ABSENT, MAGLEV

_MAGLEV = MAGLEV


@pytest.fixture
def make() -> Callable[..., Record]:
    """Build a record in volts from arrays: make(1000.0, x=..., y=...)."""

    def build(rate_hz: float, **channels: np.ndarray) -> Record:
        return Record(rate_hz=rate_hz, channels=tuple(Channel(name=n, unit="V", values=v) for n, v in channels.items()))

    return build


@pytest.fixture(scope="session")
def maglev() -> Callable[[str], Record]:
    """Read a measured record by name; skips the test where the records are absent."""

    def read(name: str) -> Record:
        path = _MAGLEV / f"{name}.csv"
        if not path.exists():
            pytest.skip(ABSENT)
        return read_record(path)

    return read


@pytest.fixture(scope="session")
def duty_to_voltage() -> np.ndarray:
    """Measured table of coil voltage against duty, shape (n_points, 2)."""
    path = _MAGLEV / "duty_to_voltage.csv"
    if not path.exists():
        pytest.skip(ABSENT)
    return np.loadtxt(path, delimiter=",", skiprows=1)
