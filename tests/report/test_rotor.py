"""What is shown of a rotor: tables by bearing, figures, page; and that it comes back from its file."""

from dataclasses import replace
from pathlib import Path

import ambid
from tests.report.rotor_record import estimate


def test_a_rotor_has_one_table_for_itself_and_one_for_each_bearing() -> None:
    e = estimate()
    lines = e.summary().splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) < 50
    assert "record: rotor on 4 axes, 3 periods of 0.5 s at 10000 Hz, at rest" in lines
    heads = [line.split() for line in lines if line.startswith(("rotor ", "bearing "))]
    assert [h[:4] for h in heads] == [["rotor", "value", "±", "sd"], ["bearing", "A", "ax", "ay"],
                                      ["bearing", "B", "bx", "by"]]  # fmt: skip
    (k_x, _) = (line for line in lines if line.startswith("k_x"))
    assert [float(x) for x in k_x.split()[1:7:3][:1]] == [round(e["ax.k_x"].value / 1e3, 1)]
    assert any(line.split() == ["sensor", "plane", "45", "mm,", "fixed"] for line in lines)
    narrow = e.summary(width=60).splitlines()
    assert sum(line.startswith("bearing A") for line in narrow) == 2  # an axis each


def test_what_the_data_do_not_show_is_marked_in_its_cell() -> None:
    e = estimate()
    unseen = [replace(p, identifiable=p.name != "by.R") for p in e.parameters]
    said = replace(e, parameters=tuple(unseen)).summary()
    (line,) = (x for x in said.splitlines() if x.startswith("R ") and "✗" in x)
    assert line.rindex("✗") > line.index("±")  # the second axis
    assert "✗ not identifiable from these data" in said
    assert "✗" not in e.summary()


def test_an_estimate_of_a_rotor_comes_back_from_its_file(tmp_path: Path) -> None:
    e = estimate()
    e.save(tmp_path / "e.json")
    again = ambid.load(tmp_path / "e.json")
    assert again.plant == e.plant
    assert again.dumps() == e.dumps()
    assert again.summary() == e.summary()
