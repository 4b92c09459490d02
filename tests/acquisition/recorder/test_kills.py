"""A recorder under full load is killed at random moments: what it had acknowledged is there, and the file opens."""

from tests.acquisition.recorder.kills import killed
from tests.tiers import ALL

CASES = 100 if ALL else 12


def test_nothing_acknowledged_is_lost_by_a_kill(tmp_path):
    found = list(killed(tmp_path, CASES, seed=4))
    assert [k for k in found if k.fault] == []
    assert len(found) == CASES
    assert sum(k.acknowledged > 0 for k in found) > CASES / 2  # most were killed under load
    assert sum(k.acknowledged for k in found) > 300 * CASES
    assert sum(k.when == "while recording" for k in found) > CASES / 2
    if ALL:  # of a dozen kills on a quiet machine often none comes between a write and its acknowledgement
        assert any(k.recovered > k.acknowledged for k in found)  # a kill takes less than a power cut
