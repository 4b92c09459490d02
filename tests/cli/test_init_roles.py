"""``ambid init`` from a record: why each column was taken, on standard error; asked where two are nearly as likely."""

import re

import numpy as np
import pytest

from ambid.cli import init
from ambid.rig import load_rig


@pytest.fixture
def doubled(bench, record_text):
    """The record with a second position that is nearly the first."""
    lines = record_text.splitlines()
    header, values = lines[1], np.loadtxt(lines[2:], delimiter=",")
    rows = [",".join(f"{x:.6g}" for x in [*row, 1.01 * row[3]]) for row in values]
    (bench / "two.csv").write_text("\n".join([f"{header},gap [um]", *rows]) + "\n")


def test_it_says_why(bench, ambid, doubled):
    made = ambid("init", "two.csv", "-o", "new.toml", "--yes")
    assert made.code == 0
    assert "voltage: voltage, because its unit [V] and name fit; a coil model with current explains" in made.err
    assert re.search("position: (position|gap), because its unit", made.err)
    assert re.search("CHECK; or (position|gap)", (bench / "new.toml").read_text(encoding="utf-8"))


def test_on_a_terminal_it_asks_where_two_are_as_likely(bench, ambid, doubled, monkeypatch):
    asked, second = [], {"position": "gap", "gap": "position"}

    def answer(question, default, **_):
        asked.append(default)
        assert question.startswith("Which column is the position")
        return "nothing" if len(asked) == 1 else second[default]

    monkeypatch.setattr(init.typer, "prompt", answer)
    monkeypatch.setattr(init, "_on_terminal", lambda: True)
    assert ambid("init", "two.csv", "-o", "new.toml").code == 0
    assert len(asked) == 2
    assert load_rig(bench / "new.toml").channel("position").column == second[asked[0]]
