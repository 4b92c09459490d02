"""Two hundred attacks and more on a console that runs: none gets through, and nothing is changed."""

import pytest

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")

from ambid.console.runs import Runs
from tests.console.attacks import SECRET, answer, attacks, everything, lay_out, planted, through
from tests.console.pages import console, frames_of, told, until


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return lay_out(tmp_path_factory.mktemp("attacked"))


def test_none_of_the_attacks_gets_through(folder):
    over = Runs(folder).start({"job": "rig", "text": "no rig", "out": "new.toml"})
    until(over)
    with console(folder) as page:
        page.open()
        assert all(through(answer(page, raw)) for _, raw in attacks(page, over.id, ourselves=True))
        before, made = everything(folder), dict(attacks(page, over.id))
        assert len(made) >= 400
        assert [name for name, raw in made.items() if through(answer(page, raw))] == []
        assert page.state()["folder"] == "shown"
        assert everything(folder) == before


def test_a_console_to_be_read_changes_nothing(folder):
    over = Runs(folder).start({"job": "rig", "text": "no rig", "out": "new.toml"})
    until(over)
    with console(folder, "--read-only") as page:
        page.open()
        for path in ("/api/runs", "/api/stop", "/api/drive", f"/api/runs/{over.id}/say"):
            for body in ({}, {"word": "stop"}, {"job": "rig", "text": "x", "out": "new"}):
                assert page.ask("POST", path, body).status == 403


def test_what_is_planted_reads_nothing_outside(folder):
    with console(folder) as page:
        page.open()
        for name, wish in planted(page):
            begun = page.json("POST", "/api/runs", wish)
            with page.feed(begun["id"]) as feed:
                frames = frames_of(feed)
            (end,) = told(frames, "end")
            assert end["how"] == "refused", (name, end)
            assert SECRET.decode() not in str(frames), name
