"""The documentation's pieces of code run, its rig files load, its links lead somewhere, its commands exist."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from ambid.rig import load_rig
from tests.examples.conftest import EXAMPLES
from tools.transcripts import differences, path_of, pieces, played, refreshed

ROOT = EXAMPLES.parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize(
    ("page", "printed"),
    [
        ("howto", "k_i with the mass free"),
        ("online", "k_i changed at 1.5"),
        ("from_matlab", "one_machine"),
        ("from_python_control", "the plant is unstable in open loop"),
    ],
    ids=["howto", "online", "from_matlab", "from_python_control"],
)
def test_python_pieces_of_a_page_run_in_their_order(page, printed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for number, piece in enumerate(blocks(ROOT / "docs" / f"{page}.md", "python"), start=1):
        exec(compile(piece, f"{page}.md, piece {number}", "exec"), names)
    assert printed in capsys.readouterr().out


RIGS = [(page, k, text) for page in PAGES for k, text in enumerate(blocks(page, "toml"), start=1)]


@pytest.mark.parametrize(("page", "k", "text"), RIGS, ids=[f"{page.stem}-{k}" for page, k, _ in RIGS])
def test_rig_files_on_the_pages_load(page, k, text, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(text, encoding="utf-8")
    rig = load_rig(path)
    assert rig.parameters


def test_the_bench_of_the_rig_page_is_stable_and_keeps_its_limits(tmp_path):
    from ambid.signals import multisine
    from ambid.simulation import simulate_rig

    text = next(t for t in blocks(ROOT / "docs" / "rig.md", "toml") if "[loop]" in t)
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    voltage = multisine(4000, 20_000.0, amplitude=5.0, band=(5.0, 2000.0), seed=1)
    done = simulate_rig(load_rig(tmp_path / "rig.toml"), voltage, rate_hz=20_000.0, seed=1)
    assert done.largest_pole < 1.0
    assert done.warnings == ()


def slug(heading: str) -> str:
    """Anchor of a heading, as code hosts and MyST make it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(page: Path) -> set[str]:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return {slug(h) for h in re.findall(r"^#+ (.*)$", text, re.MULTILINE)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target or target.startswith("made/"):  # outside, or made by the documentation's build
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name) if name else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert not broken


COMMANDS = [
    shlex.split(line, comments=True)[1:]
    for page in PAGES
    for piece in blocks(page, "sh")
    for line in piece.splitlines()
    if line.startswith("ambid ")
]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_commands_on_the_pages_have_known_verbs_and_options(words):
    from ambid.cli.app import parser

    top = parser()
    command = top if words[0].startswith("-") else top.commands[words[0]]
    command = getattr(command, "commands", {}).get(words[1], command) if words[1:] and command is not top else command
    known = {option for p in command.params for option in (*p.opts, *p.secondary_opts)}
    assert {word for word in words[1:] if word.startswith("-") and not re.fullmatch(r"-?[\d.]+", word)} <= known


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run a command of a page in its folder, and return what it prints."""
    from ambid.cli.app import run_verb

    monkeypatch.chdir(tmp_path)
    # dozens of figures, most of the time of such a command: tests/job/test_commission.py and tests/report look at those
    monkeypatch.setattr("ambid.job.commissioning.page", lambda found: "<html></html>")
    monkeypatch.setattr("ambid.job.presentation.page", lambda result, record: "<html></html>")

    def run_command(command: str) -> str:
        if not command.startswith("ambid "):  # the one edit that a page makes to its rig file
            assert command.startswith("sed ")
            subprocess.run(command, shell=True, check=True)
            return ""
        assert run_verb(shlex.split(command)[1:]) == 0, command
        return str(capsys.readouterr().out)

    return run_command


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 950


def test_readme_runs_as_it_stands_and_a_caution_is_explained(run, tmp_path, capsys):
    """The page on acquisition shows all of what the same commissioning prints."""
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    (commissioning,) = pieces("acquisition")
    for piece, printed in played("README", run):
        assert piece.shown is not None
        doubtful = "verdict: use with caution" in printed
        if set(commissioning.commands) <= set(piece.commands):
            assert differences(commissioning.shown, printed, scatters=True) == []
            assert differences(piece.shown, printed, scatters=True) == []
            assert doubtful
        else:
            assert differences(piece.shown, printed) == []
        after = re.sub(r"```.*?```", "", page[piece.place[1] + 3 :].split("\n## ")[0], flags=re.DOTALL)
        assert not doubtful or "caution" in after, "a command prints 'use with caution' without a word about it"
    assert {"first", "run.h5", "rotor.json", "rotor.html"} <= {p.name for p in tmp_path.iterdir()}
    for piece in blocks(ROOT / "README.md", "python"):
        exec(compile(piece, "README.md", "exec"), {})
    assert capsys.readouterr().out.endswith(" usable usable\n")


@pytest.mark.parametrize("page", ["quickstart", "online"])
def test_transcripts_of_a_page_are_what_its_commands_print(page, run, tmp_path, capsys):
    shown = 0
    for piece, printed in played(page, run):
        if piece.shown is not None:
            assert differences(piece.shown, printed) == []
            assert "verdict: usable" in printed
            shown += 1
    assert shown == 1
    if page == "quickstart":
        assert "not identifiable" not in printed
        exec(compile(blocks(path_of(page), "python")[0], "quickstart.md", "exec"), {})
        assert capsys.readouterr().out.startswith("usable\n-1.24")
    left = {"quickstart": {"mine.json", "mine.png", "mine.html"}, "online": {"change.jsonl", "change.png"}}
    assert left[page] <= {p.name for p in tmp_path.iterdir()}


@pytest.mark.parametrize(
    ("now", "complaint"),
    [
        ("verdict: usable\nm   4.012 ± 0.021 kg  identified\nother\n", ""),
        ("verdict: use with caution\nm   4.008 ± 0.020 kg  identified\n", "not printed, or not in this order: verdict"),
        ("verdict: usable\nm   4.051 ± 0.020 kg  identified\n", "4.008 ± 0.020 is 4.051 ± 0.020 now"),
        ("verdict: usable\nm   4.008 ± 0.020 kg  not identifiable\n", "not printed, or not in this order: m"),
    ],
)
def test_a_transcript_that_has_drifted_is_told_and_made_anew(now, complaint):
    shown = "verdict: usable\nm    4.008 ± 0.020 kg  identified\n"
    told = differences(shown, now)
    assert [text.startswith(complaint) for text in told] == [True] * bool(complaint)
    anew, lost = refreshed(shown, now)
    assert differences(anew, now) == []
    assert lost == []


def test_the_way_to_a_better_loop_can_be_gone(run, tmp_path, monkeypatch):
    monkeypatch.setattr("ambid.job.controller_design._JUDGES", 10)
    said = ""
    for piece, printed in played(
        "better_loop", lambda line: run(f"{line} --plants 10" if " controller " in line else line)
    ):
        assert piece.shown is None or differences(piece.shown, printed) == []
        said += printed
    assert "✓ experiment" in said
    assert (tmp_path / "better.toml").exists()


def test_the_page_on_the_ledger_runs(tmp_path, monkeypatch, capsys):
    from ambid.cli.app import run_verb

    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "ledger.md"
    for line in "".join(blocks(page, "sh")).splitlines():
        assert run_verb(shlex.split(line)[1:]) == 0, line
    assert "pump 1: 2 estimates, 2026-03-02 06:00 to 2026-03-03 06:00 UTC" in capsys.readouterr().out
    exec(compile(blocks(page, "python")[0], "ledger.md", "exec"), {})
    assert {"history.png", "history.html"} <= {p.name for p in tmp_path.iterdir()}


def test_the_page_on_fleets_runs(tmp_path, monkeypatch, capsys):
    from ambid.cli.app import run_verb

    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "fleets.md"
    for name in ("pump1", "pump2"):
        (Path("records") / name).mkdir(parents=True)
        Path("rigs").mkdir(exist_ok=True)
        assert run_verb(["init", "--preset", "thesis", "-o", f"rigs/{name}.toml"]) == 0
        assert run_verb(["simulate", "thesis", "--duration", "0.1", "-o", f"records/{name}/2026-03-01T06.h5"]) == 0
    Path("map.csv").write_text(blocks(page, "text")[0], encoding="utf-8")
    for line in "".join(blocks(page, "sh")).splitlines():
        assert run_verb(shlex.split(line)[1:]) == 0, line
    assert "2 known before" not in capsys.readouterr().out  # other settings, another job


def test_the_page_on_monitoring_runs(tmp_path, monkeypatch, capsys):
    from ambid.cli.app import run_verb
    from ambid.ledger import open_ledger
    from tests.ledger.entries import entry, parameter

    monkeypatch.chdir(tmp_path)
    page, coil = ROOT / "docs" / "monitoring.md", parameter("R", 6.0, 0.01, unit="ohm")
    with open_ledger("works.db") as ledger:
        ledger.add(
            [entry(k, "pump 1", parameters=(parameter("k_i", 80.0 - 10.0 * (k > 9), 0.2), coil)) for k in range(20)]
        )
    Path("rules.toml").write_text(blocks(page, "text")[0], encoding="utf-8")
    for line in "".join(blocks(page, "sh")).splitlines():
        if "broker.example" not in line:  # tests/ledger/test_monitor.py has a broker
            assert run_verb(shlex.split(line)[1:]) == (3 if "--strict" in line else 0), line
    capsys.readouterr()
    exec(compile(blocks(page, "python")[0], "monitoring.md", "exec"), {})
    assert "pump 1 k_i" in capsys.readouterr().out
    assert {"alarms.png", "alarms.json", "works.prom"} <= {p.name for p in tmp_path.iterdir()}


def test_the_page_on_nonlinear_models_names_every_structure():
    from ambid.nonlinear.fit import NONLINEAR_STRUCTURES

    text = (ROOT / "docs" / "nonlinear.md").read_text(encoding="utf-8")
    assert {f"| `{name}` |" for name in NONLINEAR_STRUCTURES} <= set(re.findall(r"\| `\w+` \|", text))


def test_the_page_on_nonlinear_models_runs_and_shows_what_comes_out(run, tmp_path, capsys):
    """Commands first, then the pieces of Python, which use the files that they leave."""
    page, said = path_of("nonlinear"), ""
    for piece, printed in played("nonlinear", run):
        assert piece.shown is None or differences(piece.shown, printed) == []
        said += printed
    assert {"ball.h5", "other.h5", "ball.json", "ball.png"} <= {p.name for p in tmp_path.iterdir()}
    assert "other.h5 tested with ball.json" in said
    assert "2 records: narmax" in said
    rows = re.compile(r"^(a\d\d|b3) +(-?[\d.]+) ± ([\d.]+)()$", re.MULTILINE)
    text = page.read_text(encoding="utf-8")
    truth = {"a21": 1962.0, "a23": -20.65, "a32": 10.59, "a33": -35.88, "b3": 8.544}
    for value in truth.values():
        assert str(abs(value)).removesuffix(".0") in text
    assert all(abs(float(v) - truth[name]) < 3 * float(sd) for name, v, sd, _ in rows.findall(text))
    names: dict[str, object] = {}
    for number, piece in enumerate(blocks(page, "python"), start=1):
        exec(compile(piece, f"nonlinear.md, piece {number}", "exec"), names)
    printed = capsys.readouterr().out
    assert "status converged, verdict caution" in printed
    assert [reason.check for reason in names["found"].verdict.reasons] == ["second_record"]
    assert re.search(r"^b3 = 8\.5\d* ± ", printed, re.MULTILINE)
    shares = [x for x in names["shares"] if x is not None]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_the_page_on_the_nonlinear_magnet_runs_and_shows_what_comes_out(tmp_path, monkeypatch):
    """Its records, its rig and its Python, which does what its command does."""
    from ambid.cli.app import run_verb

    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "nonlinear_bearing.md"
    (tmp_path / "bearing.toml").write_text(blocks(page, "toml")[0], encoding="utf-8")
    for line in blocks(page, "sh")[0].splitlines():
        words = shlex.split(line)
        assert words[1] != "simulate" or run_verb(words[1:]) == 0
    names: dict[str, object] = {}
    exec(compile(blocks(page, "python")[0], "nonlinear_bearing.md", "exec"), names)
    estimate, again = names["estimate"], names["again"]
    assert again.dumps() == estimate.dumps()
    assert estimate.passed
    rows = re.compile(r"^(k|s|L_leak) +([\d.]+) ± ([\d.]+) \S+", re.MULTILINE)
    shown, found = (rows.findall(text) for text in (page.read_text(encoding="utf-8"), estimate.summary()))
    assert [x[0] for x in shown] == [x[0] for x in found] == ["k", "s", "L_leak"]
    for (_, value, sd), (_, now, sd_now) in zip(shown, found, strict=True):
        assert abs(float(value) - float(now)) < 0.2 * float(sd)
        assert float(sd) == pytest.approx(float(sd_now), rel=0.2)


def test_the_page_on_exports_runs_and_its_c_and_its_fmu_agree(tmp_path, monkeypatch, capsys):
    """The FMU with its mass first changed, then as identified: what the C program prints."""
    from ambid.cli.app import run_verb

    compiler = shutil.which("cc")
    pytest.importorskip("fmpy")
    if compiler is None:
        pytest.skip("no C compiler")
    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "export.md"
    for line in blocks(page, "sh")[0].splitlines():
        assert run_verb(shlex.split(line)[1:]) == 0, line
    assert "binary for" in capsys.readouterr().out
    Path("main.c").write_text(blocks(page, "c")[0], encoding="utf-8")
    flags = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-o", "main")
    subprocess.run([compiler, *flags, "main.c", "bearing.c", "-lm"], check=True)
    in_c = subprocess.run(["./main"], capture_output=True, text=True, check=True).stdout
    piece = blocks(page, "python")[0]
    for code in (piece, piece.replace(', "m": 2.0', "")):
        exec(compile(code, "export.md", "exec"), {})
    changed, as_identified = re.findall(r"[\d.e-]+ m after 2 ms", capsys.readouterr().out)
    assert as_identified == in_c.strip() != changed
