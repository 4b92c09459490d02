"""A column that is added to the table of parameters appears wherever parameters are shown."""

import pytest

from ambid.cli.app import run_verb
from ambid.cli.demo import truth_table
from ambid.job import presentation
from ambid.physics.presets import preset
from ambid.report import parameters
from ambid.report.document import Column, part_lines
from tests.tracking.tracks import track_of

LABEL = "variance"


@pytest.fixture(autouse=True)
def one_more(monkeypatch):
    """The one edit: a column, with its text and its number."""

    def variance(row):
        return row.parameter.sd**2

    column = Column(label=LABEL, cell=lambda row: f"{variance(row):.6e}", frame={"variance": variance})
    monkeypatch.setattr(parameters, "PARAMETERS", (*parameters.PARAMETERS, column))


def written(p):
    return f"{p.sd**2:.6e}"


def test_it_is_in_text_page_console_and_frame_of_an_estimate(unstable):
    e = unstable.estimate
    for width in (80, 110):  # a terminal; the console
        text = e.summary(width=width)
        assert LABEL in text
        assert all(written(p) in text for p in e.parameters)
    page = presentation.page(e)
    assert f"<th>{LABEL}</th>" in page
    assert all(f">{written(p)}</td>" in page for p in e.parameters)
    assert e.to_dataframe()["variance"].tolist() == [p.sd**2 for p in e.parameters]


def test_it_is_in_the_demo(unstable, capsys):
    table = truth_table(unstable.estimate, preset("unstable-bearing").parameters)
    assert any(LABEL in line for line in part_lines(table, 120))
    assert run_verb(["demo"]) == 0
    assert LABEL in capsys.readouterr().out


def test_it_is_in_a_track(tmp_path):
    track = track_of(seconds=2.0, every_s=0.05)
    assert LABEL in track.summary(width=100)
    assert all(written(v) in track.summary(width=100) for v in track.lines[-1].parameters.values())
    track.report(tmp_path / "t.html")
    assert f"<th>{LABEL}</th>" in (tmp_path / "t.html").read_text(encoding="utf-8")
