"""The documentation's pieces of code run, its rig files load, its links lead somewhere, its commands exist."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from math import hypot
from pathlib import Path

import pytest

from ambid.rig import load_rig
from ambid.units import parse_unit
from tests.examples.conftest import EXAMPLES

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


def test_the_readme_shows_what_the_demo_prints():
    """Numbers may differ in the last digit from machine to machine, by far less than their standard deviations."""
    from importlib.resources import as_file

    from ambid.cli.demo import demo_file
    from ambid.job import identify

    with as_file(demo_file("demo.csv.gz")) as record, as_file(demo_file("demo.toml")) as rig:
        estimate = identify(record, rig)
    rows = re.findall(
        r"^(\w+) +(-?[\d.]+) ± ([\d.]+) (\S+) .*identified$", blocks(ROOT / "README.md", "")[1], re.MULTILINE
    )
    assert [row[0] for row in rows] == ["m", "k_x", "k_i", "R", "L"]
    for name, value, sd, unit in rows:
        found, scale = estimate.parameter(name), parse_unit(unit).scale
        assert abs(float(value) * scale - found.value) < 0.1 * found.sd, name
        assert float(sd) * scale == pytest.approx(found.sd, rel=0.1), name


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


def test_the_commands_of_the_readme_run_one_by_one(tmp_path, monkeypatch, capsys):
    from ambid.cli.app import run_verb

    monkeypatch.chdir(tmp_path)
    # thirty figures, three quarters of the time of a commissioning: tests/job/test_commission.py looks at that page
    monkeypatch.setattr("ambid.job.commissioning.page", lambda found: "<html></html>")
    said: dict[str, str] = {}  # by command
    for piece in blocks(ROOT / "README.md", "sh"):
        for line in piece.splitlines():
            words = shlex.split(line, comments=True)
            if words[0] == "ambid":
                assert run_verb(words[1:]) == 0, line
                said[" ".join(words[1:3])] = capsys.readouterr().out
            elif words[0] == "sed":  # the one edit that the page makes to the rig file
                old, new = re.fullmatch(r"s/(.*?)/(.*)/", words[2]).groups()
                rig = Path(words[3])
                rig.write_text(re.sub(old, new, rig.read_text(encoding="utf-8"), flags=re.MULTILINE), encoding="utf-8")
            else:
                assert words[0] in (".", "cd"), f"unforeseen command: {line}"
    assert re.search(r"^m    60 g .* fixed$", said["identify mine.csv"], re.MULTILINE)  # the edit took
    assert "not identifiable" not in "".join(said.values())
    left = {"mine.json", "mine.png", "mine.html", "track.jsonl", "track.png", "first", "run.h5"}
    assert left <= {p.name for p in tmp_path.iterdir()}
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    tracked = re.compile(r"^(m|k_x|k_i|R|L) +(-?[\d.]+) ± ([\d.]+) (\S+) .* tracked$", re.MULTILINE)
    same_values(tracked, page, said["track change.csv"])
    commissioned = said["commission --port"]
    same_values(COMMISSIONED, page, commissioned)
    fenced = (ROOT / "docs" / "acquisition.md").read_text(encoding="utf-8").split("```")
    page = next(piece for piece in fenced if piece.startswith("\n✓ 1/9 self-test"))
    same_values(COMMISSIONED, page, commissioned)
    assert without_numbers(page) <= without_numbers(commissioned)


def test_the_way_to_a_better_loop_can_be_gone(tmp_path, monkeypatch, capsys):
    from ambid.cli.app import run_verb

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ambid.job.controller_design._JUDGES", 10)
    said: dict[str, str] = {}
    page = ROOT / "docs" / "better_loop.md"
    for piece in blocks(page, "sh"):
        for line in piece.splitlines():
            words = shlex.split(line)
            if words[1:3] == ["design", "controller"]:  # what it finds its own tests say
                words = [*(w for w in words if w not in ("--report", "design.html")), "--plants", "10"]
            assert run_verb(words[1:]) == 0, line
            said[" ".join(words[1:3])] = capsys.readouterr().out
    assert "✓ experiment" in said["identify second.h5"]
    assert "peak of sensitivity" in said["design controller"]
    assert (tmp_path / "better.toml").exists()


def test_the_page_on_the_ledger_runs(tmp_path, monkeypatch, capsys):
    from ambid.cli.app import run_verb

    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "ledger.md"
    for line in "".join(blocks(page, "sh")).splitlines():
        assert run_verb(shlex.split(line)[1:]) == 0, line
    assert "pump 1: 2 estimates, 2026-03-02 06:00 to 2026-03-03 06:00 UTC" in capsys.readouterr().out
    exec(compile(blocks(page, "python")[0], "ledger.md", "exec"), {})
    assert {"history.png", "history.html", "tables"} <= {p.name for p in tmp_path.iterdir()}


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


def test_the_quickstart_has_commands_of_the_readme_and_its_python_runs(tmp_path, monkeypatch, capsys):
    import ambid

    monkeypatch.chdir(tmp_path)
    page = ROOT / "docs" / "quickstart.md"
    quick, tested = (
        {line for piece in blocks(p, "sh") for line in piece.splitlines()} for p in (page, ROOT / "README.md")
    )
    assert quick <= tested
    for name, duration, seed in (("mine", 10.0, 1), ("second", 5.0, 2)):
        record = ambid.simulate("levitated-ball", duration=duration, band=(0.2, 200.0), seed=seed)
        ambid.write_record(record, f"{name}.csv")
    (tmp_path / "bench.toml").write_text(blocks(page, "toml")[0], encoding="utf-8")
    exec(compile(blocks(page, "python")[0], "quickstart.md", "exec"), {})
    assert capsys.readouterr().out.startswith("usable\n-1.24")
    assert ambid.load("mine.json").verdict.word == "usable"


def test_the_page_on_nonlinear_models_names_every_structure():
    from ambid.nonlinear.fit import NONLINEAR_STRUCTURES

    text = (ROOT / "docs" / "nonlinear.md").read_text(encoding="utf-8")
    assert {f"| `{name}` |" for name in NONLINEAR_STRUCTURES} <= set(re.findall(r"\| `\w+` \|", text))


def test_the_page_on_nonlinear_models_runs_and_shows_what_comes_out(tmp_path, monkeypatch, capsys):
    """Commands first, then the pieces of Python, which use the files that they leave."""
    from ambid.cli.app import run_verb

    monkeypatch.chdir(tmp_path)
    page, said = ROOT / "docs" / "nonlinear.md", {}
    for piece in blocks(page, "sh"):
        for line in piece.splitlines():
            words = shlex.split(line, comments=True)
            assert run_verb(words[1:]) == 0, line
            said[words[words.index("--structure") + 1] if "fit" in words else words[1]] = capsys.readouterr().out
    assert {"ball.h5", "other.h5", "ball.json", "ball.png"} <= {p.name for p in tmp_path.iterdir()}
    assert "other.h5 tested with ball.json" in said["validate"]
    assert "2 records: narmax" in said["narmax"]
    rows = re.compile(r"^(a\d\d|b3) +(-?[\d.]+) ± ([\d.]+)()$", re.MULTILINE)
    text = page.read_text(encoding="utf-8")
    same_values(rows, text, said["nn"])
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


COMMISSIONED = re.compile(r"^  (m|k_x|k_i|R|L) = (-?[\d.]+) ± ([\d.]+) (\S+) \(95 %", re.MULTILINE)


def same_values(rows: re.Pattern[str], page: str, printed: str) -> None:
    """What the page shows is what comes out, but for what rounding on another machine makes of a levitating rotor."""
    shown, found = rows.findall(page), rows.findall(printed)
    assert [(name, unit) for name, _, _, unit in shown] == [(name, unit) for name, _, _, unit in found]
    assert len(shown) == 5
    for (name, value, sd, _), (_, now, sd_now, _) in zip(shown, found, strict=True):
        # another rounding is another run: both scatter
        assert abs(float(value) - float(now)) < 3.0 * hypot(float(sd), float(sd_now)), name
        assert float(sd) == pytest.approx(float(sd_now), rel=0.2), name


def without_numbers(text: str) -> set[str]:
    """The lines of a text; a number of any size with its prefix is the same to it."""
    return {
        re.sub(r"-?[\d.]+(e[+-]\d+)?( [num]?(?=[mAV]\b))?", "#", line.strip()) for line in text.strip().splitlines()
    }
