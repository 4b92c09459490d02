"""``--ledger`` of the verbs and ``ambid history``: each result once, told what is missing, nothing half done."""

from importlib.resources import as_file

import pytest

from ambid.cli.demo import demo_file
from ambid.ledger import open_ledger
from tests.ledger.entries import entry


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    for name in ("demo.csv.gz", "demo.toml"):
        with as_file(demo_file(name)) as path:
            (folder / name).write_bytes(path.read_bytes())
    return folder


WORDS = ("identify", "demo.csv.gz", "--rig", "demo.toml", "--ledger", "l.db", "--bearing", "pump 1")


@pytest.mark.drawn
def test_the_same_record_rig_settings_and_version_is_kept_once(demo, ambid, monkeypatch):
    monkeypatch.chdir(demo)
    first = ambid(*WORDS, "--taken-at", "2026-03-01T14:30")
    assert (first.code, first.err) == (0, "stored in l.db: pump 1, record of 2026-03-01 14:30 UTC\n")
    again = ambid(*WORDS, "--taken-at", "2026-03-01T14:30")
    assert again.out.splitlines()[0] == first.out.splitlines()[0]
    assert again.err == (
        "l.db has this already (same record, rig, settings and version): pump 1, record of 2026-03-01 14:30 UTC; "
        "nothing was added\n"
    )
    assert "stored in" in ambid(*WORDS, "--taken-at", "2026-04-01", "--from", "0.05").err  # other settings
    tracked = ambid("track", *WORDS[1:], "--taken-at", "file", "--start", "0.05")
    assert (tracked.code, "stored in" in tracked.err) == (0, True)
    with open_ledger("l.db", write=False) as ledger:
        found, every = ledger.history("pump 1"), ledger.history("pump 1", every=True)
    assert [e.job for e in found.estimates] == ["identify", "track"]
    assert [(e.job, e.superseded) for e in every.estimates] == [
        ("identify", True),
        ("identify", False),
        ("track", False),
    ]
    shown = ambid("history", "pump 1", "--ledger", "l.db", "--plot", "h.png", "--json", "-")
    assert (shown.code, shown.out.startswith('{\n "schema": "ambid.history/1"')) == (0, True)
    assert (demo / "h.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--ledger", "new.db"), "does not say when it was taken"),
        (("--ledger", "new.db", "--taken-at", "yesterday"), "must be a date and time such as 2026-03-01T14:30"),
        (("--bearing", "A"), "--bearing is for --ledger"),
        (("--taken-at", "file"), "--taken-at is for --ledger"),
        (("--ledger", "demo.toml", "--taken-at", "file"), "is not a ledger of ambid"),
        (("--ledger", ".", "--taken-at", "file"), "is no file"),
        (("--ledger", "none/new.db", "--taken-at", "file"), "there is no folder"),
        (("--ledger", "mysql://h/d", "--taken-at", "file"), "must be a file of SQLite or a URL postgresql://"),
        (("--ledger", "new.db", "--taken-at", "file", "--bearing", " "), "has to know which bearing"),
        (("--ledger", "new.db", "--taken-at", "file", "--from", "3"), "cut from 3 s"),
        (("--ledger", "new.db", "--json", "new.db", "--taken-at", "file"), "new.db"),
    ],
)
def test_what_is_missing_is_told_and_leaves_no_ledger(demo, ambid, monkeypatch, words, said):
    monkeypatch.chdir(demo)
    done = ambid("identify", "demo.csv.gz", "--rig", "demo.toml", *words)
    assert (done.code, done.out, len(done.err.splitlines())) == (2, "", 1)
    assert said in done.err
    assert not list(demo.glob("new.db*"))


def test_without_a_bearing_all_are_listed_with_what_failed(demo, ambid, monkeypatch):
    from ambid.ledger.store import Failure

    monkeypatch.chdir(demo)
    with open_ledger("list.db") as ledger:
        ledger.add([entry(k, name) for k in range(3) for name in ("A", "B")])
        poison = entry(9)
        ledger.fail(
            [
                Failure(
                    bearing="A", record="day9.h5", sha="A9", rig_sha="one", settings="{}", version="0.1.0", reason="NaN"
                )
            ]
        )
        assert ledger.failures()[poison.key].reason == "NaN"
    done = ambid("history", "--ledger", "list.db")
    assert [line.split()[0] for line in done.out.splitlines() if line] == ["bearing", "A", "B", "1", "day9.h5"]
    assert "day9.h5 (A): NaN" in done.out
    refused = ambid("history", "--ledger", "list.db", "--plot", "x.png")
    assert (refused.code, "--plot is for one bearing" in refused.err) == (2, True)
    assert ambid("history", "A", "--ledger", "none.db").code == 2
    assert not (demo / "none.db").exists()


def test_a_ledger_is_corrected_and_says_how_that_is_undone(demo, ambid, monkeypatch):
    monkeypatch.chdir(demo)
    with open_ledger("wrong.db") as ledger:
        ledger.add([entry(k, "pmup 1") for k in range(2)] + [entry(2, "pmup 1", taken_at=2.9e9)])
    of = ("--ledger", "wrong.db")
    done = ambid("history", "pmup 1", *of, "--rename", "pump 1", "--why", "misspelt", "--who", "anna")
    said = "wrong.db: 'pmup 1' became 'pump 1' (3 estimates of 3 records). "
    assert (done.code, done.out) == (0, f"{said}Undo: ambid history --ledger wrong.db --undo 1\n")
    done = ambid("history", "pump 1", *of, "--redate", "2026-01-03", "--record", "day2.h5")
    assert "day2.h5 of 2061-11-23 19:33 was taken 2026-01-03 00:00 (1 estimate" in done.out
    assert "2 estimates of 2 records of" not in ambid("history", "pump 1", *of, "--remove", "--record", "day1.h5").out
    shown = ambid("history", "pump 1", *of).out
    assert ("2 estimates, 2026-01-01" in shown, "by anna: misspelt" in " ".join(shown.split())) == (True, True)
    listing = ambid("history", *of).out.split("corrections\n")[1]
    assert [line.split()[0] for line in listing.splitlines()] == ["1", "2", "3"]
    assert ambid("history", *of, "--undo", "3").code == 0
    assert "3 estimates" in ambid("history", "pump 1", *of).out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("A", "--rename", "B", "--remove"), "--rename and --remove are 2 changes"),
        (("--rename", "B"), "--rename is for one bearing. Name it"),
        (("A", "--undo", "1"), "--undo takes a number alone"),
        (("A", "--why", "x"), "--why is for --rename, --redate, --remove, --undo"),
        (("A", "--rename", "B", "--json", "-"), "--json is not for --rename"),
        (("A", "--redate", "monday"), "--redate is 'monday'; it must be a date and time"),
        (("A", "--redate", "", "--record", "day1.h5"), "it must be a date and time"),
        (("A", "--redate", "2026-01-01", "--record", "no.h5"), "--record no.h5: 'A' has no such record"),
        (("A", "--all", "--alarms", "usual"), "--all is not for --alarms"),
    ],
)
def test_a_correction_that_is_not_clear_is_refused(demo, ambid, monkeypatch, words, said):
    monkeypatch.chdir(demo)
    with open_ledger("right.db") as ledger:
        ledger.add([entry(0), entry(1)])
    done = ambid("history", *words, "--ledger", "right.db")
    assert (done.code, done.out, len(done.err.splitlines())) == (2, "", 1)
    assert said in done.err
    assert ambid("history", "A", "--ledger", "none.db", "--remove").code == 2
    assert not (demo / "none.db").exists()


def test_a_silent_bearing_ends_in_three_until_somebody_takes_note(demo, ambid, monkeypatch):
    monkeypatch.chdir(demo)
    with open_ledger("silent.db") as ledger:
        ledger.add([entry(k, day=k - 400) for k in range(30)])  # to 2024-12-26
    words = ("history", "--ledger", "silent.db", "--alarms", "usual", "--strict")
    silent = ambid(*words)
    assert (silent.code, "records (alarm stale), raised 2024-12-30" in silent.out) == (3, True)
    note = ("--acknowledge", "stale", "--why", "dismounted")
    for more, said in (
        (note, "needs the name of the BEARING, and --why"),
        (("A", *note[:2]), "needs the name of the BEARING, and --why"),
        (("A", "--until", "2027-01-01"), "--until needs --acknowledge"),
        (("A", *note, "--until", "soon"), "--until is 'soon'"),
        (("A", *note, "--until", "2020-01-01"), "--until 2020-01-01 is over already"),
        (("A", "--acknowledge", "", "--why", "x"), "no alarm '' stands"),
        (("A", "--acknowledge", "k_i", "--why", "x"), "no alarm 'k_i' stands; those that stand: stale."),
    ):
        refused = ambid(words[0], *more, *words[1:])
        assert (refused.code, said in refused.err) == (2, True), refused.err
    noted = ambid("history", "A", *words[1:], *note, "--who", "A. Smith")
    assert (noted.code, "by A. Smith: dismounted" in noted.out) == (0, True)
    assert ambid(*words).code == 0
