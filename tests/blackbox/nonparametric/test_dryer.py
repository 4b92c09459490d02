"""The hair dryer of Ljung 1999, sec. 17.3: a delay of three samples, read off the impulse response."""

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.blackbox.impulse import correlation, rfir
from tests.blackbox.nonparametric.test_impulse import step_sd, taps
from tests.measured import ABSENT, BENCHMARKS

DRYER = BENCHMARKS / "dryer.csv"
pytestmark = pytest.mark.skipif(not DRYER.is_file(), reason=ABSENT)


def test_delay_and_gain_of_the_dryer():
    lines = [x for x in DRYER.read_text(encoding="utf-8").splitlines() if not x.startswith("#")][1:]
    table = np.array([[float(x) for x in line.split(",")[1:3]] for line in lines])
    data = IOData(
        u=table[:, :1], y=table[:, 1:], dt=0.08, inputs=("power",), outputs=("temperature",), units={}, open_loop=True
    )
    halves = [taps(rfir(data.part(a, a + 500), {"nb": 60})) for a in (0, 500)]
    for g, covariance in halves:
        assert np.argmax(np.abs(g) > 4.3 * np.sqrt(np.diag(covariance))) == 3
    # both halves of the record give one gain, within the spread that they claim
    gains, sds = [g.sum() for g, _ in halves], [step_sd(covariance)[-1] for _, covariance in halves]
    assert abs(gains[0] - gains[1]) < 4 * np.hypot(*sds)
    assert gains[0] == pytest.approx(0.93, abs=0.05)
    simple, covariance = taps(correlation(data, {"nb": 31}))
    band = 2.576 * np.sqrt(covariance[0, 0])
    assert np.all(np.abs(simple[1:3]) < 2 * band)
    assert simple[4] > 3 * band
