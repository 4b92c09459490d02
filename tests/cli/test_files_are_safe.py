"""No verb writes over a file that cannot be made again; what it does replace, it names."""

import pytest

from ambid.acquisition.recorder import Recorder
from ambid.cli import run
from ambid.ledger import open_ledger
from tests.acquisition.recorder.signals import block, header
from tests.ledger.entries import entry

MEASURED = "time [s],voltage [V],current [A],position [m]\n0,1,2,3\n"
RECORD = ("simulate", "thesis", "--duration", "0.3", "-o")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a simulated record, its estimate and a rig of the acquisition's bench."""
    folder = tmp_path_factory.mktemp("made")
    for words in (
        ("simulate", "thesis", "--duration", "0.3", "-o", folder / "r.csv"),
        ("identify", folder / "r.csv", "--json", folder / "e.json"),
        ("init", "--preset", "prototype", "-o", folder / "rig.toml"),
    ):
        assert run([str(word) for word in words]) == 0
    for name in ("l.db", "l2.db"):
        with open_ledger(folder / name) as ledger:
            ledger.add([entry()])
    return folder


VERBS = {
    "simulate": ("simulate", "thesis", "--duration", "0.1", "-o"),
    "init": ("init", "r.csv", "-o"),
    "identify": ("identify", "r.csv", "--json"),
    "validate": ("validate", "e.json", "r.csv", "--json"),
    "fleet run": ("fleet", "run", "r.csv", "--ledger", "fleet.db", "--workers", "1", "--job", "info", "--taken-at",
                  "file", "--json"),
    "history": ("history", "A", "--ledger", "l.db", "--json"),
    "ledger backup": ("ledger", "backup", "l.db", "-o"),
    "ledger restore": ("ledger", "restore", "l.db", "l2.db", "-o"),
    "accept": ("accept", "r.csv", "--rig", "rig.toml", "--json"),
    "margins": ("margins", "r.csv", "--rig", "rig.toml", "--estimate", "e.json", "--json"),
    "design experiment": ("design", "experiment", "e.json", "--rig", "rig.toml", "--seconds", "0.3", "--json"),
    "design controller": ("design", "controller", "e.json", "--rig", "rig.toml", "--out"),
    "export": ("export", "e.json", "-o"),
    "fit": ("fit", "r.csv", "--input", "voltage", "--output", "current", "--structure", "arx", "--orders",
            "na=1,nb=1,nk=1", "--json"),
    "compare": ("compare", "r.csv", "arx:na=1,nb=1,nk=1", "--input", "voltage", "--output", "current", "--json"),
    "frf": ("frf", "r.csv", "--input", "voltage", "--output", "current", "--json"),
    "track": ("track", "r.csv", "--start", "e.json", "--json"),
    "acquire": ("acquire", "--port", "simulated", "--rig", "rig.toml", "--seconds", "1", "-o"),
}  # fmt: skip


@pytest.mark.parametrize("verb", VERBS)
def test_a_measured_record_is_not_written_over(made, ambid, monkeypatch, verb):
    target = made / ("measured.mat" if verb == "export" else "measured.csv")
    content = "MATLAB 5.0 MAT-file of a Simulink run" if verb == "export" else MEASURED
    target.write_text(content)
    monkeypatch.chdir(made)
    done = ambid(*VERBS[verb], target.name)
    assert done.code == 2, done.out
    assert len(done.err.splitlines()) == 1
    assert f"{target.name} exists" in done.err
    assert target.read_text() == content


@pytest.mark.parametrize("words", [("--plot", "a.png"), ("--report", "a.html"), ("--report", "a.pdf")])
def test_a_record_behind_a_link_or_under_another_name_is_not_drawn_over(made, ambid, monkeypatch, words):
    monkeypatch.chdir(made)
    target, name = made / "measured.csv", made / words[1]
    target.write_text(MEASURED)
    for place in (lambda: name.symlink_to(target), lambda: name.write_text(MEASURED)):
        place()
        done = ambid("info", "r.csv", *words)
        assert (done.code, len(done.err.splitlines())) == (2, 1)
        assert "exists, and is not a result of ambid" in done.err
        assert target.read_text() == name.read_text() == MEASURED
        name.unlink()


@pytest.mark.drawn
def test_a_figure_behind_a_link_of_another_ending_is_drawn_again(made, ambid, monkeypatch):
    monkeypatch.chdir(made)
    (made / "old").write_bytes(b"\x89PNG of a moment ago")
    (made / "new.png").symlink_to("old")
    assert ambid("info", "r.csv", "--plot", "new.png").code == 0
    assert (made / "old").stat().st_size > 10_000


def test_commission_writes_into_no_folder_of_a_record(made, ambid, monkeypatch):
    monkeypatch.chdir(made)
    (made / "bench").mkdir()
    (made / "bench" / "record.h5").write_text(MEASURED)
    done = ambid("commission", "--port", "simulated", "--rig", "rig.toml", "-o", "bench")
    assert done.code == 2
    assert "bench holds record.h5 of an earlier commissioning" in done.err
    assert {path.name: path.read_text() for path in (made / "bench").iterdir()} == {"record.h5": MEASURED}


def test_recover_writes_over_no_other_record(made, ambid, monkeypatch):
    monkeypatch.chdir(made)
    with Recorder(made / "cut.csv", header()) as recorder:
        recorder.append(block(0))
        assert recorder.flush()
        (made / "kept.csv.journal").write_bytes(recorder.journal.read_bytes())
    (made / "measured.csv").write_text(MEASURED)
    done = ambid("recover", "kept.csv.journal", "-o", "measured.csv")
    assert (done.code, done.out) == (2, "")
    assert "measured.csv already exists" in done.err
    assert (made / "measured.csv").read_text() == MEASURED
    assert ambid("recover", "kept.csv.journal", "-o", "new.csv").code == 0


def test_every_verb_that_writes_stands_here():
    from ambid.cli.app import parser

    reads_only = {"info", "models", "demo"}
    verbs = parser().commands
    groups = {name for name, verb in verbs.items() if hasattr(verb, "commands")}
    others = set(verbs) - groups - reads_only - {"commission", "recover", "console"}
    others |= {f"{group} {verb}" for group in groups for verb in verbs[group].commands}
    into_ledgers = {"ledger check", "ledger merge", "ledger retain"}  # which refuse what is none
    assert others - into_ledgers == set(VERBS)


def test_what_was_simulated_is_replaced_and_named(made, ambid, monkeypatch):
    monkeypatch.chdir(made)
    for name in ("s.csv", "s.csv.gz", "s.h5"):
        assert ambid(*RECORD, name).err == ""
        done = ambid(*RECORD, name)
        assert done.code == 0
        assert done.err == f"{name} is replaced\n"
    done = ambid("identify", "r.csv", "--json", "e.json")
    assert done.code == 0
    assert done.err == "e.json is replaced\n"


def test_force_writes_over_it(made, ambid, monkeypatch):
    monkeypatch.chdir(made)
    (made / "m.csv").write_text(MEASURED)
    done = ambid(*RECORD, "m.csv", "--force")
    assert done.code == 0
    assert "m.csv is replaced" in done.err


def test_what_stands_where_notes_would_is_kept(ambid, tmp_path):
    beside, out = tmp_path / "r.csv-metadata.json", tmp_path / "r.csv"
    beside.write_text('{"tableSchema": "mine"}', encoding="utf-8")
    words = ("simulate", "thesis", "--duration", "0.1", "-o", str(out))
    found = ambid(*words)
    assert (found.code, beside.read_text(encoding="utf-8")) == (2, '{"tableSchema": "mine"}')
    assert "would hold the notes of r.csv" in found.err
    assert not out.exists()
    beside.unlink()
    assert [ambid(*words).code for _ in range(2)] == [0, 0]  # notes of its own are replaced
