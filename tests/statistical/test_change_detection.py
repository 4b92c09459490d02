"""False alarms of the change detector on quiet Gaussian evidence, tracked by an exact filter."""

import numpy as np
import pytest

from ambid.tracking.monitors import ChangeDetector
from tests.tiers import ALL
from tests.tracking.evidences import BLOCK_S, Filter, evidence, triangle

N = 12_000 if ALL else 4_000  # blocks: a minute of record, or a third of one
SECONDS = N * BLOCK_S
P7 = tuple(f"q{i}" for i in range(7))


def alarms(detector, J, seed, n=N):
    """Times at which an alarm began after at least a longest window without one, and the kinds."""
    rng, walk, truth = np.random.default_rng(seed), 1e-9, np.zeros(7)
    P = np.linalg.inv(200 * J.T @ J)
    f = Filter(np.linalg.cholesky(P) @ rng.normal(size=7), P, walk=walk)
    begun, last, kinds = 0, -1000, []
    for k in range(n):
        e = evidence(J, truth, k, rng)
        alarm = detector.update(e, f.q, f.P)
        if alarm is not None:
            begun += k - last > 100
            last = k
            kinds.append(alarm.kind)
        f.update(e)
        truth = truth + np.sqrt(walk) * rng.normal(size=7)
    return begun, kinds


@pytest.mark.parametrize(("condition", "scale"), [(1.0, 1.0), (1e6, 1.0), (1e2, 1e-3)])
def test_false_alarms_come_no_oftener_than_allowed(condition, scale):
    """Allowed one a second; they may be fewer, as the allowance holds for the worst case."""
    J = triangle(7, 1, condition=condition) * scale
    detector = ChangeDetector(P7, block_s=BLOCK_S, false_alarms_per_hour=3600.0)
    detector.drift[:] = 1e-9
    begun, kinds = alarms(detector, J, 2)
    assert SECONDS / 12 <= begun <= SECONDS + 3 * np.sqrt(SECONDS)
    assert set(kinds) == {"moved", "unexplained"}


def test_quiet_running_gives_no_alarm():
    """At the default of one in twenty hours a minute of quiet running gives one in a thousand cases."""
    for seed, condition in ((3, 1.0), (4, 1e6)):
        detector = ChangeDetector(P7, block_s=BLOCK_S)
        detector.drift[:] = 1e-9
        assert alarms(detector, triangle(7, seed, condition=condition), seed)[0] == 0
        assert detector.noise == pytest.approx(1.0, abs=0.02 * np.sqrt(60 / SECONDS))
        assert np.median(detector.overdispersion) < 1.1
