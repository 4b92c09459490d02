"""The hair dryer of Ljung 1999, sec. 17.3: a delay of three samples, read off the impulse response."""

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.blackbox.impulse import correlation_analysis, impulse_response, step_response
from tests.measured import ABSENT, BENCHMARKS

DRYER = BENCHMARKS / "dryer.csv"
pytestmark = pytest.mark.skipif(not DRYER.is_file(), reason=ABSENT)


def test_delay_and_gain_of_the_dryer():
    lines = [x for x in DRYER.read_text(encoding="utf-8").splitlines() if not x.startswith("#")][1:]
    table = np.array([[float(x) for x in line.split(",")[1:3]] for line in lines])
    data = IOData(
        u=table[:, :1], y=table[:, 1:], dt=0.08, inputs=("power",), outputs=("temperature",), units={}, open_loop=True
    )
    first, second = (impulse_response(data.part(a, a + 500), 60) for a in (0, 500))
    for half in (first, second):
        assert np.argmax(np.abs(half.values[:, 0, 0]) > 4.3 * half.sd[:, 0, 0]) == 3
    # both halves of the record give one gain, within the spread that they claim
    gains = [step_response(r) for r in (first, second)]
    difference = gains[0].values[-1, 0, 0] - gains[1].values[-1, 0, 0]
    assert abs(difference) < 4 * np.hypot(gains[0].sd[-1, 0, 0], gains[1].sd[-1, 0, 0])
    assert gains[0].values[-1, 0, 0] == pytest.approx(0.93, abs=0.05)
    simple = correlation_analysis(data, 30)
    assert np.all(np.abs(simple.values[31:33, 0, 0]) < 2 * simple.band[0, 0])
    assert simple.values[34, 0, 0] > 3 * simple.band[0, 0]
