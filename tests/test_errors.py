"""The word that a message suggests is the one that was meant."""

import pytest

from ambid.errors import nearest


@pytest.mark.parametrize(
    ("word", "known", "meant"),
    [
        ("rate", ["gate", "date_s", "rate_hz"], "rate_hz"),  # the unit was left out
        ("kd", ["ki", "kp", "kd_hz"], "kd_hz"),
        ("ab", ["axb", "abx"], "abx"),  # equally close
        ("narx", ["arx", "nrax", "narmax"], "nrax"),  # two letters exchanged
        ("naxr", ["narmax", "narx"], "narx"),
    ],
)
def test_the_nearest_word_is_the_one_meant(word, known, meant):
    assert nearest(word, known) == f" Did you mean {meant!r}?"


def test_nothing_is_suggested_where_nothing_is_alike():
    assert nearest("xyz", ["rate_hz", "tick"]) == ""
    assert nearest("rate", []) == ""
