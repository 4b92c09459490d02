"""The three blocks on-line: as off-line where nothing moves, following where something does, the same however fed."""

import numpy as np
import pytest
from scipy.signal import lfilter

from ambid.bearing.blocks import three_blocks
from ambid.errors import EstimationError
from ambid.recursive.blocks import OnlineThreeBlocks
from ambid.recursive.streaming import PassiveLowpass, ScalarKalman
from tests.bearing.benches import run
from tests.bearing.block_benches import NOISE, RATE, TRUTH, coefficients, record
from tests.reference.test_three_blocks import PRINTED


def fed(columns, rate=RATE, **how):
    online = OnlineThreeBlocks(rate, **how)
    online.update(*columns)
    return online


@pytest.fixture(scope="module")
def still():
    return record(0, 40_000)[:3]


def test_the_off_line_estimate_is_reached(still):
    for columns in (still, record(5, 40_000)[:3]):
        off = three_blocks(*columns, RATE, open_loop=True)
        found = fed(columns, open_loop=True).result()
        (on, on_sd), (wanted, sd) = coefficients(found), coefficients(off)
        np.testing.assert_array_less(np.abs(on - wanted), 1.5 * sd)
        assert np.all((on_sd < 1.7 * sd) & (on_sd > 0.6 * sd))
        np.testing.assert_array_less(np.abs(on - TRUTH), 4 * on_sd)
        assert found.status == "converged"
        assert not found.warnings
        assert min(found.fit.values()) > 0.98
        for name, p in found.parameters.items():
            assert abs(p.value - off.parameters[name].value) < 1.5 * off.parameters[name].sd


def test_intervals_hold():
    scores = []
    for seed in range(12):
        value, sd = coefficients(fed(record(seed + 20, 14_000)[:3], open_loop=True).result())
        scores.append((value - TRUTH) / sd)
    scores = np.array(scores)
    assert 0.85 < np.mean(np.abs(scores) < 1.96) < 1.0
    assert np.all(np.abs(scores.mean(axis=0)) < 4 / np.sqrt(12))


def test_numbers_of_table_5_1():
    # R = 1.842 ohm, L = 1.530 mH, k_i = -1.913, k_x = 0.00886 follow from eq. 5.4-5.6 (theory.md sec. 6)
    columns = record(1, 160_000, truth=PRINTED, rate=2000.0, noise=[1e-5, 1e-5])[:3]
    found = fed(columns, 2000.0, open_loop=True, warm_up=20_000).result()
    p = found.parameters
    assert p["R"].value == pytest.approx(1.842, rel=1e-3)
    assert p["L"].value == pytest.approx(1.530e-3, rel=1e-3)
    assert p["k_i"].value == pytest.approx(-1.913, abs=4 * p["k_i"].sd)
    assert p["k_x"].value == pytest.approx(0.00886, abs=4 * p["k_x"].sd)
    assert p["k_i"].sd < 0.2


def test_a_drift_of_the_resistance_is_followed():
    n = 120_000
    v, i, x, _ = record(2, n, slope=0.2)
    online = OnlineThreeBlocks(RATE, open_loop=True, memory_s=0.2)
    error, others, scores = [], [], []
    for k in range(0, n, 4000):
        online.update(v[k : k + 4000], i[k : k + 4000], x[k : k + 4000])
        if k < 16_000:
            continue
        found = online.result()
        truth = TRUTH[1] * (1 + 0.2 * (k + 4000) / n) / TRUTH[0]
        error.append(found.parameters["R"].value / truth - 1)
        value, sd = coefficients(found)
        others.append((value - TRUTH)[[4, 5]] / sd[[4, 5]])
        scores.append(found.parameters["L"].value * TRUTH[0] - 1)
    assert np.max(np.abs(error)) < 0.01
    assert np.max(np.abs(scores)) < 0.01  # the inductance stays
    assert np.mean(np.abs(others) < 2.5) > 0.85
    assert online.result().parameters["R"].value > 1.15 * TRUTH[1] / TRUTH[0]


def test_splitting_a_stream_changes_no_number():
    columns = np.array(record(3, 12_000)[:3])
    columns[1, 9000] = np.nan
    columns[2, 1000] = np.inf
    whole, parts = OnlineThreeBlocks(RATE, open_loop=True), OnlineThreeBlocks(RATE, open_loop=True)
    wanted = whole.update(*columns)
    found, k, rng = [], 0, np.random.default_rng(0)
    while k < 12_000:
        n = int(rng.choice([1, 1, 1, 7, 300, 2000]))
        part = columns[:, k : k + n]
        found.append(np.atleast_2d(parts.update(*(part if n > 1 else part[:, 0].tolist()))))
        k += n
    np.testing.assert_array_equal(np.vstack(found), wanted)
    np.testing.assert_array_equal(parts.result().covariance, whole.result().covariance)
    assert (whole.n_used, whole.n_rejected) == (parts.n_used, parts.n_rejected) == (11_998, 2)
    assert np.isnan(wanted[9000]).all()
    # the first coefficients come from noisy samples: errors are those of the noise soon after
    assert np.nanstd(wanted[:, 0]) < 2 * NOISE[0]


def test_a_copy_goes_its_own_way(still):
    online = fed([c[:20_000] for c in still], open_loop=True)
    other, kept = online.copy(), online.result().covariance
    found = other.update(*(c[20_000:] for c in still))
    np.testing.assert_array_equal(online.result().covariance, kept)
    np.testing.assert_array_equal(online.update(*(c[20_000:] for c in still)), found)
    np.testing.assert_array_equal(online.result().covariance, other.result().covariance)


def test_quiet_neither_winds_up_nor_moves_the_blocks():
    columns = np.array(record(6, 160_000, until=40_000)[:3])
    online = fed(columns[:, :40_000], open_loop=True, memory_s=0.3)
    sd = coefficients(online.result())[1]
    online.update(*columns[:, 40_000:])
    found = online.result()
    after, wide = coefficients(found)
    np.testing.assert_array_less(np.abs(after - TRUTH), 4 * wide)
    assert np.all(wide < 20 * sd)  # forgetting stops at four; what the noise is, is remembered longer
    assert any("hardly excited" in w for w in found.warnings)


def test_a_loop_wants_its_reference():
    scores = []
    for seed in range(5):
        *columns, r = record(seed, 20_000, gain=60.0, noise=2 * NOISE)
        found = fed((*columns, r), with_reference=True).result()
        assert not any("controller" in w for w in found.warnings)
        value, sd = coefficients(found)
        scores.append((value - TRUTH) / sd)
    assert np.mean(np.abs(np.array(scores)) < 2.2) > 0.8
    assert any("--reference" in w for w in fed(columns).result().warnings)


def test_least_squares_is_biased_by_slow_noise_and_says_so():
    apart = []
    for seed in (4, 5, 6):
        columns = record(seed, 20_000)[:3]
        slow = lfilter([1.0], [1.0, -0.998], np.random.default_rng(seed).standard_normal(20_000))
        columns[2][:] += 0.2 * np.std(columns[2]) * slow / slow.std()
        least = fed(columns, open_loop=True, instruments=False).result()
        proper = fed(columns, open_loop=True).result()
        assert any("least squares" in w for w in least.warnings)
        assert not any("least squares" in w for w in proper.warnings)
        apart.append(least.blocks["c"].pole - proper.blocks["c"].pole)
    assert max(apart) < -0.02 * TRUTH[5]  # noise in the position makes the pole of TFc look slower


def test_the_prefilter_cancels(still):
    # at one corner the Kalman-Bucy filter with A = 0 is the passive one; a low corner takes what tells the coil
    corner = 3 * 1204.0
    default = coefficients(fed(still, open_loop=True).result())
    kalman = ScalarKalman(RATE, q=corner**2, r=1.0)
    passive = PassiveLowpass(RATE, corner_hz=corner / (2 * np.pi))
    one = coefficients(fed(still, open_loop=True, prefilter=kalman).result())
    other = coefficients(fed(still, open_loop=True, prefilter=passive).result())
    np.testing.assert_allclose(other[0], one[0], rtol=1e-6)
    np.testing.assert_array_less(np.abs(one[0] - default[0]), 0.2 * default[1])
    low = coefficients(fed(still, open_loop=True, prefilter=ScalarKalman(RATE, q=60.0**2, r=1.0)).result())
    np.testing.assert_array_less(np.abs(low[0] - TRUTH), 4.5 * low[1])
    assert low[1][1] > 2 * default[1][1]


def test_a_start_from_off_line_is_taken(still):
    start = three_blocks(*(c[:6000] for c in still), RATE, open_loop=True)
    value, sd = coefficients(fed(still, open_loop=True, start=start, warm_up=400).result())
    np.testing.assert_array_less(np.abs(value - TRUTH), 4 * sd)


def test_a_bearing_is_not_of_first_order_and_the_result_says_so():
    bench = run("thesis", 20_000, 1)
    columns = dict(zip(bench.model.outputs, bench.signals.y.T, strict=True))
    signals = bench.signals.u[:, 0], columns["current"], columns["position"]
    found = fed(signals, bench.signals.rate_hz, open_loop=True).result()
    assert any("first order" in w for w in found.warnings)
    assert any("explain little of the position" in w for w in found.warnings)
    assert "mass is normalised" in str(found)


def test_refusals(still):
    online = OnlineThreeBlocks(RATE, open_loop=True)
    with pytest.raises(EstimationError, match="no estimate after 0"):
        online.result()
    with pytest.raises(EstimationError, match="lengths"):
        online.update(np.ones(3), np.ones(3), np.ones(2))
    with pytest.raises(EstimationError, match="reference"):
        online.update(1.0, 1.0, 1.0, 1.0)
    online.update(np.ones(5000), np.ones(5000), np.ones(5000))
    with pytest.raises(EstimationError, match="constant"):
        online.result()
    online.update(*still)  # goes on when something moves
    assert online.result().status == "converged"
    for wrong in ({"memory_s": 1e-3}, {"warm_up": 10}):
        with pytest.raises(EstimationError):
            OnlineThreeBlocks(RATE, **wrong)
