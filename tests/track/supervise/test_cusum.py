import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.track.supervise.cusum import Cusum, run_length, threshold_for

# Montgomery, Introduction to Statistical Quality Control, table 9.3: two-sided, drift 0.5, shift in sd, h = 4 and h = 5
PUBLISHED = [(0.0, 168, 465), (0.25, 74.2, 139), (0.5, 26.6, 38.0), (1.0, 8.38, 10.4), (2.0, 3.34, 4.01)]


@pytest.mark.parametrize(("shift", "at_4", "at_5"), PUBLISHED)
def test_run_lengths_are_those_of_the_tables(shift, at_4, at_5):
    assert run_length(4.0, 0.5, shift) == pytest.approx(at_4, rel=0.06)
    assert run_length(5.0, 0.5, shift) == pytest.approx(at_5, rel=0.06)


def test_run_lengths_of_the_class_agree_with_the_formula():
    rng = np.random.default_rng(1)
    lengths = []
    for _ in range(300):
        sums = Cusum(drift=0.5, threshold=3.0)
        while not sums.update(rng.normal()):
            pass
        lengths.append(sums.n)
    # run lengths are nearly geometric: the standard deviation of their mean is mean / sqrt(300), 6 %
    assert np.mean(lengths) == pytest.approx(run_length(3.0, 0.5), rel=0.2)


def test_run_length_without_slope_is_the_limit():
    assert run_length(5.0, 0.0, two_sided=False) == pytest.approx((5.0 + 1.166) ** 2)
    assert run_length(5.0, 1e-7, two_sided=False) == pytest.approx(run_length(5.0, 1e-4, two_sided=False), rel=2e-3)


@pytest.mark.parametrize("length", [10.0, 1e3, 1e8, 1e15])
def test_threshold_gives_the_wanted_run_length(length):
    assert run_length(threshold_for(length, 0.5), 0.5) == pytest.approx(length, rel=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_shift_is_called_with_its_sign_and_its_onset(sign):
    rng = np.random.default_rng(2)
    onsets = []
    for _ in range(50):
        sums = Cusum(drift=1.0, threshold=12.0, mean=5.0, sd=0.1)
        for k in range(400):
            called = sums.update(5.0 + 0.1 * (rng.normal() + 2.0 * sign * (k >= 200)))
            if called:
                break
        assert called == sign
        assert 203 <= sums.n <= 240
        onsets.append(sums.onset)
    assert np.median(onsets) == pytest.approx(200, abs=2)


def test_reset_forgets_and_what_is_not_finite_is_not_used():
    sums = Cusum(drift=0.5, threshold=4.0)
    for _ in range(10):
        sums.update(3.0)
    assert sums.update(float("nan")) == 0
    assert sums.n == 10
    sums.reset()
    assert (sums.high, sums.low, sums.n, sums.onset) == (0.0, 0.0, 0, 0)
    assert sums.update(0.1) == 0


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(EstimationError):
        Cusum(sd=0.0)
    with pytest.raises(EstimationError):
        threshold_for(1.0, 0.5)
