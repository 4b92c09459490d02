"""The zone of a sensitivity: which peak counts, and how surely it is in one."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from ambid.control import margins
from ambid.control.zones import Zone, zone_of
from ambid.estimation.modes import EstimatedNumber

LIMITS = [20.0 * math.log10(ratio) for ratio in (3.0, 4.0, 5.0)]


def zone(peak, sd=0.0):
    return Zone.of((peak, sd))


@pytest.mark.parametrize(
    ("peak", "sd", "letters", "worst"),
    [
        (9.466, 0.037, "A", "A"),
        (9.496, 0.080, "A or B", "B"),
        (11.0, 0.2, "B", "B"),
        (11.9, 0.1, "B or C", "C"),
        (12.0, 2.5, "A to D", "D"),
        (19.0, 0.5, "D", "D"),
        (9.5, 0.0, "A", "A"),
        (9.5, math.inf, "A to D", "D"),
        (9.5, math.nan, "A to D", "D"),
    ],
)
def test_a_zone_is_a_letter_or_two_where_the_interval_holds_a_limit(peak, sd, letters, worst):
    found = zone(peak, sd)
    assert (found.letters, found.worst) == (letters, worst)


def test_the_probability_is_that_of_a_normal_peak():
    found = zone(9.466, 0.037)
    assert found.probability["A"] == pytest.approx(norm.cdf(LIMITS[0], 9.466, 0.037), rel=1e-9)
    assert sum(zone(12.0, 1.3).probability.values()) == pytest.approx(1.0)
    between = norm.cdf(LIMITS[1], 12.0, 1.3) - norm.cdf(LIMITS[0], 12.0, 1.3)
    assert zone(12.0, 1.3).probability["B"] == pytest.approx(between, rel=1e-9)
    assert zone(9.5).probability is None  # nothing says how well the peak is known


def test_of_draws_of_a_peak_as_many_lie_in_a_zone_as_it_says():
    draws = 12.2 + 0.4 * np.random.default_rng(1).standard_normal(4000)
    share = np.mean([zone_of(x) == "C" for x in draws])
    p = zone(12.2, 0.4).probability["C"]
    assert abs(share - p) < 4.0 * math.sqrt(p * (1.0 - p) / draws.size)


def test_the_words_are_a_letter_with_its_probability_or_two_letters():
    assert zone(9.466, 0.037).words == "A (98 %)"
    assert zone(5.0, 0.1).words == "A (> 99 %)"
    assert zone(9.496, 0.080).words == "A or B"
    assert zone(9.5).words == "A"


@pytest.mark.parametrize(
    ("predicted", "measured", "source", "worst"),
    [
        ((8.0, 0.05), None, "predicted", "A"),
        ((8.0, 0.05), (12.5, 0.3), "measured", "C"),
        ((13.0, 3.0), (8.0, 0.1), "measured", "A"),  # a weak prediction does not contradict it
        ((13.0, 0.3), (8.0, 0.1), "predicted", "C"),  # where nothing was excited nothing was measured
        ((13.0, 0.3), (8.0, 0.0), "predicted", "C"),  # how well it was measured is not known
        ((8.0, 0.3), (13.0, 0.0), "measured", "C"),
    ],
)
def test_the_measured_peak_counts_unless_the_predicted_one_is_surely_higher(predicted, measured, source, worst):
    found = Zone.of(predicted, measured)
    assert (found.source, found.worst) == (source, worst)


def test_a_sensitivity_of_a_file_is_judged_as_a_new_one_also_of_an_earlier_version():
    entry = {"peak_db": {"value": 9.466, "sd": 0.037}, "zone": "A", "measured_peak_db": 9.496, "measured_sd_db": 0.08}
    assert Zone.read(entry) == Zone.of((9.466, 0.037), (9.496, 0.08))
    assert Zone.read({"peak_db": {"value": 9.466, "sd": None}, "measured_peak_db": None}).letters == "A to D"


@pytest.mark.parametrize(
    ("peak", "sd", "passed", "text"),
    [
        (11.0, 0.2, True, "zone B (> 99 %) of ISO 14839-3"),
        (11.9, 0.2, False, "too little margin for unrestricted operation is not ruled out. Add"),
        (13.0, 0.2, False, "too little margin for unrestricted operation. Add"),
    ],
)
def test_the_check_says_how_sure_a_lack_of_margin_is(peak, sd, passed, text):
    number = EstimatedNumber.of(peak, sd, size=1.0)
    axis = margins.AxisSensitivity(
        peak_db=number, frequency_hz=40.0, zone=zone(peak, sd).letters, measured_peak_db=None
    )
    check = margins._zone({"x": axis})
    assert check.passed == passed
    assert text in check.detail
