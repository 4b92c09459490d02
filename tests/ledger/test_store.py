"""The ledger: stored once, all or nothing, and only what it is."""

import numpy as np
import pytest

from ambid.errors import AmbidError
from ambid.ledger import open_ledger
from tests.ledger.entries import entry, parameter


def test_what_is_stored_comes_back(tmp_path):
    with open_ledger(tmp_path / "l.db") as ledger:
        assert len(ledger.add([entry(k) for k in range(3)])) == 3
    with open_ledger(tmp_path / "l.db", write=False) as ledger:
        found = ledger.history("A")
        (known,) = ledger.bearings()
    assert found["k_i"].value == pytest.approx([80.0, 79.9, 79.8])
    assert (found["R"].unit, found["R"].sd[0]) == ("ohm", 0.02)
    assert (known.name, known.plant, known.estimates) == ("A", "bench A", 3)


def test_the_same_estimate_counts_once(tmp_path):
    with open_ledger(tmp_path / "l.db") as ledger:
        first = ledger.add([entry(0), entry(1), entry(1)])
        again = ledger.add([entry(1), entry(2)])
        assert first == ledger.done([entry(0).key, entry(1).key, "none"])
        assert again == {entry(2).key}
        assert ledger.history("A")["k_i"].value.size == 3


def test_what_is_not_identifiable_is_no_number(tmp_path):
    seen = [(parameter("k_i", 80.0, 0.5),), (parameter("k_i", 5.0, 90.0, seen=False),), (parameter("k_i", 3.0, 0.1),)]
    verdicts = ["usable", "caution", "unusable"]
    with open_ledger(tmp_path / "l.db") as ledger:
        ledger.add([entry(k, parameters=p, verdict=v) for k, (p, v) in enumerate(zip(seen, verdicts, strict=True))])
        found = ledger.history("A")
    assert found["k_i"].identifiable.tolist() == [True, False, True]
    assert np.isnan(found["k_i"].value).tolist() == [False, True, True]


def test_a_foreign_file_is_refused_and_left_as_it_was(tmp_path):
    import sqlite3

    other = tmp_path / "other.db"
    with sqlite3.connect(other) as c:
        c.execute("CREATE TABLE estimate (x)")
    c.close()
    (tmp_path / "text.db").write_text("no database")
    for path in (other, tmp_path / "text.db"):
        before = path.read_bytes()
        with pytest.raises(AmbidError, match="is not a ledger of ambid"):
            open_ledger(path)
        assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 2
