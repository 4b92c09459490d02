"""``ambid design controller``: from a record to a rig with a better loop; what is asked for wrongly is refused."""

import json

import pytest

import ambid as package
from ambid.cli import run
from ambid.rig import load_rig

FEW = ("--plants", "8")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with the rig of the unstable bearing, and an estimate from its record."""
    folder = tmp_path_factory.mktemp("design")
    for words in (
        ("init", "--preset", "unstable-bearing", "-o", folder / "rig.toml"),
        ("simulate", "unstable-bearing", "--duration", "0.5", "--seed", "1", "-o", folder / "r.csv"),
        ("identify", folder / "r.csv", "--rig", folder / "rig.toml", "--json", folder / "e.json"),
    ):
        assert run([str(word) for word in words]) == 0
    return folder


@pytest.fixture(scope="module")
def designed(made):
    """The files of a design, and its result."""
    words = ("-o", made / "new.toml", "--json", made / "d.json", "--plot", made / "d.png", "--report", made / "d.html")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ambid.job.controller_design._JUDGES", 12)
        assert run(["design", "controller", str(made / "e.json"), *FEW, *map(str, words)]) == 0
    return package.load(made / "d.json")


def test_the_loop_becomes_better_and_is_written(made, designed):
    assert designed.verdict.word == "usable"
    assert designed.after.worst.peak_db < designed.before.worst.peak_db - 2.0
    new, old = load_rig(made / "new.toml"), load_rig(made / "rig.toml")
    assert new.loop == designed.loop != old.loop
    assert new.loop.delay == old.loop.delay
    assert new.parameters == old.parameters
    assert json.loads((made / "d.json").read_text())["schema"] == "ambid.design/1"


def test_the_new_loop_is_measured_better_too(made, designed):
    """The margins of the new rig, on the same estimate, are those that the design predicts."""
    found = package.margins(made / "e.json", made / "new.toml")
    assert found.sensitivity["x"].peak_db.value == pytest.approx(
        designed.after.sensitivity["x"].peak_db.value, abs=0.01
    )


def test_the_summary_shows_both_loops_and_names_the_worst_plant(designed):
    text = designed.summary()
    assert "12 of 12" in text
    assert f"draw\n  {designed.worst_plant.number}" in text or f"draw {designed.worst_plant.number}" in text
    assert all(len(line) <= 80 for line in text.splitlines())


def test_the_loop_becomes_an_object_of_python_control(designed):
    pytest.importorskip("control")
    law = designed.to_control()
    assert law.dt == pytest.approx(1.0 / designed.rate_hz)
    assert law.D[0, 0] < 0.0  # the sign is included


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--goal", "peek"), "figure 'peek' of a design is unknown"),
        (("--limit", "noise=high"), "--limit noise=high has no number"),
        (("--limit", "noise=1m"), "noise is in V, not in m"),
        (("--limit", "peak=nan"), "limit peak is nan; it must be a finite number"),
        (("--limit", "peak=-3dB"), "no loop is that good"),
        (("--spread", "delay=x"), "--spread delay=x has no number"),
        (("--spread", "dealy=1"), "source 'dealy' of spread is unknown"),
        (("--spread", "warm_k=0.1"), "it must be two numbers"),
        (("--form", "pod"), "form 'pod' of gains is unknown"),
    ],
)
def test_what_is_asked_for_wrongly_is_refused_on_one_line(made, ambid, words, said):
    done = ambid("design", "controller", str(made / "e.json"), *words)
    assert done.code == 2
    assert len(done.err.splitlines()) == 1
    assert said in done.err


def test_a_rig_that_exists_is_kept(made, ambid, designed):
    before = (made / "new.toml").read_text()
    done = ambid("design", "controller", str(made / "e.json"), "-o", str(made / "new.toml"))
    assert done.code == 2
    assert "new.toml exists" in done.err
    assert (made / "new.toml").read_text() == before
    assert designed.loop is not None


def test_both_loops_are_tried_on_the_nonlinear_simulator(designed):
    before, after = designed.trials["before"], designed.trials["after"]
    assert [v.plant for v in before] == [v.plant for v in after]
    assert before[0].plant == "the estimate"
    assert len(before) > 1
    pushed = [[v.of_kind("force step")[0] for v in found] for found in (before, after)]
    assert len({case.size for cases in pushed for case in cases}) == 1  # the same force on all plants
    assert all(b.peak < a.peak for a, b in zip(*pushed, strict=True))
    assert designed.checks["lift_off"].passed
    assert "force step of" in designed.summary()
