"""The Tab key: what is offered after a word, and that bash asks for it once it has been told to."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ambid.cli.app import run_verb


def offered(words, monkeypatch, capsys):
    monkeypatch.setenv("_AMBID_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split(" ")) - 1))
    with pytest.raises(SystemExit):
        run_verb([])
    return capsys.readouterr().out.split()


@pytest.mark.parametrize(
    ("words", "among"),
    [
        ("ambid comm", {"commission"}),
        ("ambid fit --str", {"--structure", "--strict"}),
        ("ambid identify x.csv --gaps in", {"interpolate"}),
    ],
)
def test_names_are_offered(words, among, monkeypatch, capsys):
    assert set(offered(words, monkeypatch, capsys)) >= among


@pytest.mark.parametrize(
    "words", ["ambid identify re", "ambid identify x.csv --rig b", "ambid identify x.csv --json o"]
)
def test_files_are_left_to_the_shell(words, monkeypatch, capsys):
    assert offered(words, monkeypatch, capsys) == []


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_after_the_installation(tmp_path):
    command = tmp_path / "ambid"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ambid "$@"\n', encoding="utf-8")
    command.chmod(0o755)
    words = {**os.environ, "HOME": str(tmp_path), "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    script = """
ambid --install-completion > said || exit 9
. ./.bashrc
COMP_WORDS=(ambid simul) COMP_CWORD=1
_ambid_completion ambid
echo "${COMPREPLY[@]}"
"""
    done = subprocess.run(["bash", "--norc", "-c", script], env=words, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == ["simulate"], (done, Path(tmp_path / "said").read_text(encoding="utf-8"))
