"""The command as a whole: exit codes, one line of error, files that are whole or absent, a light start, Ctrl-C."""

import os
import signal
import subprocess
import sys
import time

import pytest

from ambid.cli import info
from ambid.cli.app import _FORMER
from ambid.cli.output import Outputs
from ambid.cli.terminal import plain_where_needed
from ambid.errors import AmbidError
from ambid.settings.jobs import JOBS

AMBID = [sys.executable, "-c", "from ambid.cli import main; main()"]

USAGE = {
    "unknown verb": (["identfy", "x"], "No such command 'identfy'. Did you mean 'identify'? See 'ambid --help'"),
    "unknown option": (["models", "--all"], "No such option: --all. See 'ambid models --help'"),
    "missing argument": (["identify"], "Missing argument 'RECORD...'. See 'ambid identify --help'"),
    "too many arguments": (["models", "x"], "(x)"),
    "no number": (["identify", "record.csv", "--from", "soon"], "Invalid value for '--from'"),
    "missing output": (["simulate", "thesis"], "Missing option '--out'"),
    "unknown preset": (["simulate", "thesos", "-o", "x.csv"], "Did you mean 'thesis'?"),
    "unknown excitation": (
        ["simulate", "thesis", "-o", "x.csv", "--excitation", "sinus"],
        "excitation 'sinus' is unknown",
    ),
    "band that is none": (["simulate", "thesis", "-o", "x.csv", "--band", "5"], "two frequencies in Hz with a colon"),
    "no duration": (["simulate", "thesis", "-o", "x.csv", "--duration", "0"], "must be a positive number"),
    "nonlinear rig": (
        ["simulate", "rig.toml", "-o", "x.csv", "--rate", "1e4", "--nonlinear"],
        "has no [magnet]; a nonlinear simulation needs one",
    ),
    "a verb of a release before": (["fleet", "simulate", "--help"], "Give records of 'ambid simulate' to 'ambid fleet"),
    "metrics without alarms": (["history", "--ledger", "x.db", "--publish", "a.prom"], "--publish needs --alarms"),
    "rig without rate": (["simulate", "rig.toml", "-o", "x.csv"], "Give --rate HZ"),
    "rig without values": (["simulate", "rig.toml", "-o", "x.csv", "--rate", "1e4", "--amplitude", "1"], "no value"),
}


@pytest.mark.parametrize(("words", "said"), USAGE.values(), ids=USAGE.keys())
def test_wrong_usage_is_one_line_and_exit_code_2(bench, ambid, words, said):
    found = ambid(*words)
    assert found.code == 2
    assert found.out == ""
    assert len(found.err.splitlines()) == 1
    assert found.err.startswith("ambid: ")
    assert said in found.err


OUTPUTS = {
    "no folder": (["--json", "no/found.json"], "there is no folder no"),
    "a folder": (["--json", "."], "is a folder"),
    "in a file": (["--json", "rig.toml/found.json"], "there is no folder rig.toml"),
    "the record": (["--json", "record.csv"], "is also an input"),
    "the rig by another path": (["--json", "../{name}/rig.toml"], "is also an input"),
    "the second record": (["--json", "second.csv", "--validate", "second.csv"], "is also an input"),
    "twice": (["--plot", "a.png", "--report", "a.html", "--json", "./a.png"], "two options"),
    "no picture": (["--plot", "a.jpeg"], "must end in .png or .svg or .pdf"),
    "no page": (["--report", "a.png"], "must end in .html or .htm or .pdf"),
}


@pytest.mark.parametrize(("words", "said"), OUTPUTS.values(), ids=OUTPUTS.keys())
def test_outputs_are_refused_before_any_work(bench, ambid, words, said):
    before = sorted(p.name for p in bench.iterdir())
    found = ambid("identify", "record.csv", "--rig", "rig.toml", *(w.format(name=bench.name) for w in words))
    assert found.code == 2
    assert said in found.err
    assert len(found.err.splitlines()) == 1
    assert sorted(p.name for p in bench.iterdir()) == before


@pytest.mark.parametrize(("job", "word"), [(job, word) for job, words in _FORMER.items() for word in words])
def test_a_word_of_a_release_before_is_refused_with_what_it_is_now(ambid, job, word):
    new = _FORMER[job][word]
    now = f"now {new}. Give that" if new else "gone. Omit it"
    for found in (ambid(*job.split(), f"--{word}", "1"), ambid(*job.split(), f"--{word}=1")):
        assert found.code == 2
        assert found.err == f"ambid: --{word} of 'ambid {job}' is {now}\n"
    if new.startswith("--"):
        assert new.split()[0] in {s.flag for s in JOBS[job].settings}


def test_files_are_put_in_place_together_or_not_at_all(tmp_path):
    old, new = tmp_path / "old.txt", tmp_path / "new.txt"
    old.write_text("before")

    def fails(path):
        path.write_text("half")
        raise OSError(28, "No space left on device")

    def write_both():
        with Outputs() as outputs:
            outputs.stage_text(old, "after")
            outputs.stage(new, fails)

    with pytest.raises(AmbidError, match=r"new\.txt cannot be written: No space left"):
        write_both()
    assert old.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["old.txt"]
    with Outputs() as outputs:
        outputs.stage_text(old, "after")
        assert old.read_text() == "before"
    assert old.read_text() == "after"
    assert [p.name for p in tmp_path.iterdir()] == ["old.txt"]


def test_a_folder_that_may_not_be_written_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    with pytest.raises(AmbidError, match="may not be written"), Outputs() as outputs:
        outputs.claim(tmp_path / "a.json", "--json")


def broken():
    raise ZeroDivisionError("float division\nby zero")


def test_a_defect_is_one_line_and_exit_code_1(ambid, monkeypatch):
    monkeypatch.setattr(info.models, "__code__", broken.__code__)
    found = ambid("models")
    assert found.code == 1
    assert (
        found.err
        == "ambid: a defect of ambid: ZeroDivisionError: float division by zero. Run with --traceback, and report it\n"
    )
    traced = ambid("models", "--traceback")
    assert traced.code == 1
    assert "Traceback" in traced.err
    assert "in broken" in traced.err or "ZeroDivisionError" in traced.err


def test_help_and_version(ambid):
    for words in ([], ["--help"], ["identify", "--help"]):
        found = ambid(*words)
        assert (found.code, found.err) == (0, "")
        assert "Usage: ambid" in found.out
    assert ambid("--version").out.startswith("ambid 1.")


LIGHT = """
import sys
from ambid.cli import run
for words in (["--help"], *([verb, "--help"] for verb in {verbs})):
    assert run(words) == 0
heavy = [m for m in ("numpy", "scipy", "numba", "matplotlib", "h5py", "jinja2", "rich") if m in sys.modules]
assert not heavy, heavy
"""


def test_help_of_every_verb_imports_nothing_heavy():
    verbs = ["demo", "identify", "init", "simulate", "validate", "info", "models"]
    done = subprocess.run([sys.executable, "-c", LIGHT.format(verbs=verbs)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_linear_algebra_gets_one_thread_unless_told_otherwise():
    code = "import os; from ambid.cli import main\ntry: main(['--version'])\nexcept SystemExit: print(os.environ['{}'])"
    for name, given, expected in (("OPENBLAS_NUM_THREADS", None, "1"), ("OMP_NUM_THREADS", "2", "2")):
        environment = {k: v for k, v in os.environ.items() if k != name} | ({name: given} if given else {})
        done = subprocess.run(
            [sys.executable, "-c", code.format(name)], capture_output=True, text=True, env=environment
        )
        assert done.stdout.splitlines()[-1] == expected


@pytest.mark.skipif(sys.platform == "win32", reason="signals as POSIX has them")
@pytest.mark.parametrize("usual", [signal.SIG_DFL, signal.SIG_IGN], ids=["foreground", "nohup"])
def test_ctrl_c_ends_cleanly(bench, ambid, usual):
    # long enough that the interrupt comes in the middle of the work
    assert ambid("simulate", "unstable-bearing", "-o", "long.csv", "--duration", "10", "--amplitude", "20").code == 0
    before = sorted(p.name for p in bench.iterdir())
    words = ["identify", "long.csv", "--json", "found.json", "--plot", "found.png"]
    job = subprocess.Popen(
        [*AMBID, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, usual),
    )
    time.sleep(1.2)
    job.send_signal(signal.SIGINT)
    out, err = job.communicate(timeout=60)
    assert (job.returncode, out, err) == (130, "", "ambid: interrupted; nothing was written\n")
    assert sorted(p.name for p in bench.iterdir()) == before


@pytest.mark.skipif(sys.platform == "win32", reason="pipes as POSIX has them")
def test_a_reader_who_leaves_is_no_error():
    done = subprocess.run(
        f'"{sys.executable}" -c "from ambid.cli import main; main()" models | head -n 1',
        shell=True,
        capture_output=True,
        text=True,
    )
    assert (done.stdout, done.stderr) == ("one-axis\n", "")


def test_letters_that_a_terminal_lacks_are_replaced(tmp_path):
    path = tmp_path / "out.txt"
    with path.open("w", encoding="latin-1") as stream:
        plain_where_needed(stream)
        stream.write("R ± 1 … ✓ ✗ →")
    assert path.read_text(encoding="latin-1") == "R ± 1 .. ok FAILED ->"
