"""Subspace models of measured benchmark records predict data that they were not estimated from.

A hair dryer in open loop, and a ball on a beam: unstable, held by a controller (DaISy).
"""

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.blackbox.prediction import one_step, simulation
from ambid.blackbox.subspace import cva, moesp, n4sid, pbsid
from tests.measured import ABSENT, BENCHMARKS

pytestmark = pytest.mark.skipif(not BENCHMARKS.is_dir(), reason=ABSENT)


def halves(name: str, *, open_loop: bool) -> tuple[IOData, IOData]:
    """First half to estimate from, second half to judge on."""
    table = np.loadtxt(BENCHMARKS / name, delimiter=",", skiprows=1)
    data = IOData(
        u=table[:, 1:2],
        y=table[:, 2:3],
        dt=float(table[1, 0] - table[0, 0]),
        inputs=("input",),
        outputs=("output",),
        units={"input": "1", "output": "1"},
        open_loop=open_loop,
    )
    return data.part(0, data.n_samples // 2), data.part(data.n_samples // 2, data.n_samples)


def share(y: np.ndarray, predicted: np.ndarray) -> float:
    """1 - |error| / |y - mean|."""
    return float(1 - np.linalg.norm(y - predicted) / np.linalg.norm(y - y.mean(0)))


@pytest.mark.parametrize("method", [n4sid, moesp, cva, pbsid])
def test_dryer(method):
    first, second = halves("dryer.csv", open_loop=True)
    fit = method(first, {})
    assert 2 <= fit.model.order <= 5
    assert not fit.details["feedthrough"]  # the air needs three samples through the tube
    assert share(second.y, one_step(fit.model, second.u, second.y, fit.offsets)) > 0.94
    assert share(second.y, simulation(fit.model, second.u, second.y, fit.offsets)) > 0.84
    assert not fit.warnings


def test_ball_and_beam_is_unstable_and_predicted():
    first, second = halves("ball_and_beam.csv", open_loop=False)
    fit = pbsid(first, {})
    assert fit.model.order <= 4
    # a ball rolls like a double integrator: two poles at 1, as near as the record can tell
    largest = np.sort(np.abs(fit.model.poles()))[-2:]
    np.testing.assert_allclose(largest, 1.0, atol=0.08)
    assert simulation(fit.model, second.u, second.y, fit.offsets) is None or largest[-1] < 1
    assert share(second.y, one_step(fit.model, second.u, second.y, fit.offsets)) > 0.96
    assert not fit.warnings
