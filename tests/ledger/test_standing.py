"""How a bearing stands now, by its estimates alone."""

import pytest

pytest.importorskip("sqlalchemy", reason="the extra [fleet] is not installed")

from ambid.ledger import open_ledger
from ambid.ledger.standing import STATES, standing_of
from tests.ledger.entries import BEGIN, DAY, entry, parameter


def standing(tmp_path, entries):
    with open_ledger(tmp_path / "works.db") as ledger:
        ledger.add(entries)
        return standing_of(ledger.history("A"), now=max(e.taken_at for e in entries))


def test_a_bearing_that_is_looked_at_every_day_is_stale_after_four_and_a_half(tmp_path):
    found = standing(tmp_path, [entry(k) for k in range(10)])
    last = BEGIN + 9 * DAY
    assert (found.estimates, found.stale_after_s) == (10, 4.5 * DAY)
    assert found.age_s(last + 3600.0) == 3600.0
    assert found.state(last + 4 * DAY) == "good"
    assert found.state(last + 5 * DAY) == "stale"


def test_a_single_estimate_is_stale_after_three_months(tmp_path):
    found = standing(tmp_path, [entry()])
    assert found.state(BEGIN + 91 * DAY) == "good"
    assert found.state(BEGIN + 93 * DAY) == "stale"


@pytest.mark.parametrize(
    ("verdicts", "state", "usable"),
    [
        (("usable", "caution"), "caution", 1),
        (("caution", "unusable"), "unusable", 0),
        (("unusable",), "unusable", None),
    ],
)
def test_the_last_estimate_counts_and_the_age_is_that_of_a_usable_one(tmp_path, verdicts, state, usable):
    found = standing(tmp_path, [entry(k, verdict=v) for k, v in enumerate(verdicts)])
    now = BEGIN + len(verdicts) * DAY
    assert found.state(now) == state
    assert found.age_s(now) == (None if usable is None else now - BEGIN - usable * DAY)


def test_an_alarm_that_stands_is_the_gravest(tmp_path):
    def k_i(k):
        return parameter("k_i", 80.0 - 8.0 * (k > 14) + 0.05 * (-1) ** k, 0.3)

    found = standing(tmp_path, [entry(k, parameters=(k_i(k),)) for k in range(30)])
    assert [a.parameter for a in found.alarms] == ["k_i"]
    assert found.state(BEGIN + 300 * DAY) == STATES[0]
