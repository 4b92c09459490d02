import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.tracking.monitors import ExcitationMonitor
from tests.tracking.evidences import BLOCK_S, GAINS, NAMES, OFFSETS, PHYSICAL, bearing, evidence, triangle

P5 = tuple(f"q{i}" for i in range(5))


def block(J, k=0):
    return evidence(J, np.zeros(len(J)), k, np.random.default_rng(k))


def fed(monitor, J, n, t=0.0):
    events = []
    for _ in range(n):
        t += BLOCK_S
        events += monitor.update(block(J), t)
    return events, t


def monitor_of(J, **settings):
    """References as of one second of blocks like `J`, for the first three of five numbers."""
    sd = np.sqrt(np.diag(np.linalg.inv(200 * J.T @ J)))
    reference = {P5[i]: 1.0 / sd[i] ** 2 for i in range(3)}
    return ExcitationMonitor(P5, reference_rate=reference, block_s=BLOCK_S, **{"enough": 1e-9, **settings})


@pytest.mark.parametrize("condition", [1.0, 1e4, 1e8])
def test_the_window_gives_the_marginal_standard_deviations(condition):
    J = triangle(5, 1, condition=condition)
    monitor = monitor_of(J)
    n = 700
    fed(monitor, J, n)
    weight = np.exp(-BLOCK_S * np.arange(n)).sum()
    R = np.linalg.qr(J * np.sqrt(weight), mode="r")
    expected = np.linalg.norm(np.linalg.inv(R), axis=1)
    assert monitor.sd[:3] == pytest.approx(expected[:3], rel=1e-4)
    # at a steady rate the information per second is that at identification
    sd = np.sqrt(np.diag(np.linalg.inv(J.T @ J)) / 200)
    assert 1 / (monitor.sd[:3] ** 2 * monitor.duration_s) == pytest.approx(1 / sd[:3] ** 2, rel=1e-4)
    assert all(monitor.fresh.values())


def test_without_information_everything_freezes_once_and_thaws_once():
    J = triangle(5, 2)
    monitor = monitor_of(J)
    events, t = fed(monitor, J, 1600)
    assert events == []
    frozen, t = fed(monitor, np.zeros((5, 5)), 2000, t)
    assert sorted(e.parameter for e in frozen) == list(P5[:3])
    assert {e.kind for e in frozen} == {"frozen"}
    # information decays with the window's time constant: 2 % are left after ln 50 s
    assert [e.t - 8.0 for e in frozen] == pytest.approx([np.log(50)] * 3, abs=0.05)
    assert not any(monitor.fresh.values())
    assert all("%" in e.why and e.values["rate"] < 0.02 * e.values["reference_rate"] for e in frozen)
    thawed, _ = fed(monitor, J, 400, t)
    assert sorted(e.parameter for e in thawed) == list(P5[:3])
    assert {e.kind for e in thawed} == {"thawed"}
    assert all(monitor.fresh.values())


def test_hours_without_information_are_endured():
    monitor = monitor_of(triangle(5, 3), window_s=0.05)
    fed(monitor, triangle(5, 3), 10)
    fed(monitor, np.zeros((5, 5)), 6000)  # 600 time constants: all numbers have underflowed
    assert monitor.sd == pytest.approx(np.full(5, 1000.0))
    events, _ = fed(monitor, triangle(5, 3), 400)
    assert len(events) == 3
    assert all(monitor.fresh.values())


def test_from_the_start_without_information():
    monitor = monitor_of(triangle(5, 4))
    events, _ = fed(monitor, np.zeros((5, 5)), 300)
    assert len(events) == 3
    assert all("no information" in e.why for e in events)
    assert 0.5 < events[0].t < 1.0  # not before half of the window is filled


def test_a_direction_that_is_missing_freezes_what_lies_in_it_alone():
    """Information of q0 - q3 and q1, q2, q4: q3 is unknown, so q0 is, although its own column is full."""
    J = np.diag([50.0] * 5)
    full = monitor_of(J)
    fed(full, J, 300)
    rows = np.zeros((5, 5))
    rows[0, 0], rows[0, 3] = 50.0, -50.0
    rows[1, 1] = rows[2, 2] = rows[4, 4] = 50.0
    events, _ = fed(full, rows, 2000)
    assert [e.parameter for e in events] == ["q0"]
    assert full.fresh == {"q0": False, "q1": True, "q2": True}


def test_between_the_limits_nothing_changes():
    J = triangle(5, 5)
    monitor = monitor_of(J)
    fed(monitor, J, 400)
    events, t = fed(monitor, J * np.sqrt(0.035), 3000)
    assert events == []
    assert all(monitor.fresh.values())
    _, t = fed(monitor, J * np.sqrt(0.01), 3000, t)
    assert not any(monitor.fresh.values())
    events, _ = fed(monitor, J * np.sqrt(0.035), 3000, t)
    assert events == []


def test_what_is_known_well_enough_stays_fresh_with_hysteresis():
    J = triangle(5, 6)
    sd = np.linalg.norm(np.linalg.inv(J), axis=1)[:3].max() / np.sqrt(200)
    monitor = monitor_of(J, enough=50 * sd)
    fed(monitor, J, 400)
    assert fed(monitor, J / 30, 3000)[0] == []  # a thousandth of the information, 30 times the standard deviation
    assert fed(monitor, J / 60, 3000)[0] == []  # worse than enough, not by half
    assert len(fed(monitor, J / 300, 3000)[0]) == 3
    assert len(fed(monitor, J / 60, 3000)[0]) < 3
    fed(monitor, J / 30, 3000)
    assert all(monitor.fresh.values())


def test_a_bearing_that_is_shaken_stays_fresh_and_one_that_is_not_freezes():
    blocks = bearing("none", 1.0, at=6000, n=8000, seed=1)
    reference = dict.fromkeys(PHYSICAL, 0.0)
    first = ExcitationMonitor(NAMES, reference_rate=reference, held=GAINS, block_s=BLOCK_S, window_s=0.2)
    for k, e in enumerate(blocks):
        first.update(e, k * BLOCK_S)
    assert max(first.sd[: len(PHYSICAL)]) < 0.02
    unheld = ExcitationMonitor(NAMES, reference_rate=reference, block_s=BLOCK_S, window_s=0.2)
    for k, e in enumerate(blocks):
        unheld.update(e, k * BLOCK_S)
    assert unheld.sd[0] > 10 * first.sd[0]  # a free gain of a sensor takes nearly all that is known of the mass
    rates = dict(zip(PHYSICAL, 1 / (first.sd**2 * first.duration_s), strict=False))
    monitor = ExcitationMonitor(NAMES, reference_rate=rates, held=GAINS, block_s=BLOCK_S, window_s=0.2, enough=1e-4)
    assert [event for k, e in enumerate(blocks) for event in monitor.update(e, k * BLOCK_S)] == []
    quiet = block(np.diag([1e-2] * (len(NAMES) - len(OFFSETS)) + [1.0] * len(OFFSETS)))
    events = [event for k in range(2000) for event in monitor.update(quiet, k * BLOCK_S)]
    assert {e.parameter for e in events} == set(PHYSICAL)


def test_a_block_that_makes_no_sense_is_refused():
    monitor = monitor_of(triangle(5, 7))
    fed(monitor, triangle(5, 7), 50)
    before = monitor.sd.copy()
    with pytest.raises(EstimationError, match="not finite"):
        monitor.update(block(np.full((5, 5), np.nan)), 1.0)
    with pytest.raises(EstimationError, match="other parameters"):
        monitor.update(block(np.eye(4)), 1.0)
    assert np.array_equal(monitor.sd, before)
