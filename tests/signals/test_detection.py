"""Outliers, drop-outs, saturation and resolution: found where they are, silent where they are not."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.signals import find_dropouts, find_outliers, find_saturation, resolution
from ambid.signals.excitations import prbs

RATE = 1000.0
N = 10000
T = np.arange(N) / RATE


def noise(seed: int, sd: float = 1.0) -> np.ndarray:
    return sd * np.random.default_rng(seed).standard_normal(N)


def clean_signals() -> dict[str, np.ndarray]:
    """Signals without any fault, noise-free and noisy, as they occur on a bench."""
    from scipy.signal import lfilter

    stairs = np.resize(np.repeat([0.0, 1.0, 0.0, -1.0], round(0.5 * RATE)), N)
    binary = prbs(N, RATE, amplitude=1.0, hold=10)
    lag = ([0.0, 0.1], [1.0, -0.9])
    return {
        "sine": np.sin(2 * np.pi * 3 * T),
        "fast sine": np.sin(2 * np.pi * 50 * T),
        "noisy sine": np.sin(2 * np.pi * 3 * T) + noise(1, 0.01),
        "quantised slow sine": np.round(100 * np.sin(2 * np.pi * 0.5 * T)) / 100,
        "steps": stairs,
        "noisy steps": stairs + noise(2, 0.01),
        "prbs": binary,
        "prbs every sample": prbs(N, RATE, amplitude=1.0),
        "noisy prbs": binary + noise(3, 0.01),
        "filtered steps": lfilter(*lag, stairs),
        "noisy filtered prbs": lfilter(*lag, binary) + noise(4, 0.01),
        "gaussian": noise(5),
        "quantised gaussian": np.round(noise(6)),
        "random walk": np.cumsum(noise(7)),
        "one step": np.where(T < 5, 0.0, 1.0),
        "quiet then loud": np.where(T < 5, 0.01, 1.0) * noise(8),
        "triangle": np.abs((T % 1.0) - 0.5),
    }


CLEAN = clean_signals()


@pytest.mark.parametrize("name", CLEAN)
def test_nothing_is_found_in_a_clean_signal(make, name):
    r = make(RATE, x=CLEAN[name])
    assert find_outliers(r, "x").count == 0
    assert find_dropouts(r, "x").count == 0
    assert find_saturation(r, "x").count == 0


def test_outliers_on_gaussian_noise_are_as_rare_as_said(make):
    assert sum(find_outliers(make(RATE, x=noise(100 + k)), "x").count for k in range(20)) == 0
    # At a low threshold, both predictions of white noise are its mean and each sample fails both at once: 2(1 - Φ(3))
    # = 0.0027. The local
    # scale, the widest of three blocks, makes the true threshold about a tenth higher, and a local extremum is asked
    # for.
    rate = sum(find_outliers(make(RATE, x=noise(200 + k)), "x", threshold=3.0).count for k in range(20)) / (20 * N)
    assert 0.0003 < rate < 0.0027


@pytest.mark.parametrize(
    "name", ["sine", "noisy sine", "noisy steps", "gaussian", "random walk", "noisy filtered prbs"]
)
def test_all_isolated_spikes_are_found_and_nothing_else(make, name):
    x = CLEAN[name].copy()
    at = np.array([137, 2500, 2507, 5555, 9001])
    x[at] += np.array([1.0, -1.0, 1.0, 1.0, -1.0]) * 15.0 * max(1.0, np.std(x))
    found = find_outliers(make(RATE, x=x), "x")
    np.testing.assert_array_equal(found.indices, at)
    assert found.first_s == pytest.approx(0.137)
    assert "5 outliers, the first at sample 137 (0.137 s)" in str(found)


def test_a_group_is_no_outlier(make):
    x = CLEAN["noisy sine"].copy()
    x[3000:3003] += 1.0
    assert find_outliers(make(RATE, x=x), "x").count == 0


def test_a_threshold_out_of_range_is_refused(make):
    with pytest.raises(RecordError, match="find_outliers"):
        find_outliers(make(RATE, x=CLEAN["gaussian"]), "x", threshold=1.0)


@pytest.mark.parametrize("name", ["noisy sine", "gaussian", "quantised gaussian", "quantised slow sine", "random walk"])
def test_a_stuck_sensor_is_found(make, name):
    x = CLEAN[name].copy()
    x[4000:4600] = x[4000]
    found = find_dropouts(make(RATE, x=x), "x")
    assert found.count == pytest.approx(600, abs=30)
    assert found.first_s == pytest.approx(4.0, abs=0.03)
    assert len(found.spans) == 1
    assert found.indices[0] == found.first_index


def test_single_zeros_far_from_the_signal_are_found(make):
    x = 5.0 + CLEAN["noisy sine"]
    x[[100, 700, 701]] = 0.0
    found = find_dropouts(make(RATE, x=x), "x")
    assert found.spans == ((100, 1), (700, 2))


def test_a_signal_through_zero_has_no_zero_dropouts(make):
    assert find_dropouts(make(RATE, x=np.round(noise(9), 3)), "x").count == 0


def test_a_dead_channel_is_all_dropout_and_not_saturated(make):
    r = make(RATE, x=np.zeros(N))
    assert find_dropouts(r, "x").fraction == 1.0
    assert "never changes" in str(find_dropouts(r, "x"))
    assert find_saturation(r, "x").count == 0
    assert find_outliers(r, "x").count == 0


@pytest.mark.parametrize("hz", [3.0, 3.3, 50.0, 17.7])
@pytest.mark.parametrize("amplitude", [20.0, 20.4, 20.5, 20.6, 20.99])
def test_a_quantised_sine_is_not_saturated(make, hz, amplitude):
    # Its peaks dwell: the last level holds up to 1/(√2 - 1) = 2.41 times as many samples as the one before.
    assert find_saturation(make(RATE, x=np.round(amplitude * np.sin(2 * np.pi * hz * T + 0.3))), "x").count == 0


@pytest.mark.parametrize("name", ["sine", "noisy sine", "gaussian"])
def test_clipping_is_found_on_the_side_where_it_is(make, name):
    limit = float(np.quantile(CLEAN[name], 0.9))
    found = find_saturation(make(RATE, x=np.minimum(CLEAN[name], limit)), "x")
    assert found.lower is None
    assert found.upper is not None
    assert found.upper.value == limit
    assert found.fraction == pytest.approx(0.1, abs=0.002)


@pytest.mark.parametrize("step", [0.005, 0.1, 2.0])
def test_resolution_is_the_quantum(make, step):
    found = resolution(make(RATE, x=step * np.round(20.0 * noise(11))), "x")
    assert found.quantised
    assert found.step == pytest.approx(step, rel=1e-9)
    assert found.uniform == 1.0
    assert found.noise_sd == pytest.approx(step / np.sqrt(12.0))


def test_resolution_of_a_continuous_or_dead_channel(make):
    assert not resolution(make(RATE, x=noise(12)), "x").quantised
    assert resolution(make(RATE, x=np.ones(N)), "x").step == 0.0


def test_measured_duty_in_its_limits_is_found(maglev):
    found = find_saturation(maglev("levitate_sine_e"), "duty_upper")
    assert found.lower is not None
    assert found.upper is not None
    assert (found.lower.value, found.lower.count) == (0.0, 313)
    assert (found.upper.value, found.upper.count, found.upper.longest) == (1.0, 120, 33)
    assert found.fraction == pytest.approx(433 / 15001)


def test_measured_position_at_the_end_of_its_sensor_is_found(maglev):
    for name, count in (("levitate_sine_d", 14), ("coil_steps_20mm", 130)):
        found = find_saturation(maglev(name), "position")
        assert found.upper is not None
        assert (found.upper.value, found.upper.count, found.lower) == (0.02, count, None)
    first = find_saturation(maglev("levitate_sine_d"), "position")
    assert first.first_s == 0.0


@pytest.mark.parametrize("name", ["levitate_stairs_a", "levitate_sine_d", "levitate_updown_c", "coil_steps_1"])
def test_measured_references_stairs_and_currents_are_not_saturated(maglev, name):
    r = maglev(name)
    channels = [n for n in ("reference", "current_upper", "current_lower") if n in r.names]
    if name.startswith("coil"):
        channels.append("duty_upper")
    for n in channels:
        assert find_saturation(r, n).count == 0
        assert find_dropouts(r, n).count == 0


def test_measured_current_is_quantised_and_the_unused_coil_dead(maglev):
    r = maglev("levitate_stairs_a")
    found = resolution(r, "current_upper")
    assert found.quantised
    assert found.uniform > 0.99
    assert found.step == pytest.approx(2.5306e-3, rel=1e-3)
    assert find_dropouts(r, "duty_lower").fraction == 1.0


@pytest.mark.parametrize("name", ["levitate_stairs_a", "levitate_stairs_b", "levitate_sine_e"])
def test_measured_positions_have_no_outliers(maglev, name):
    r = maglev(name)
    assert [find_outliers(r, n).count for n in ("reference", "position", "current_upper")] == [0, 0, 0]
