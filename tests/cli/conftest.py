"""A short record and its rig, from the embedded demo, and the command run in this process."""

import gzip
import os
from dataclasses import dataclass

# As the command does for itself; it has to stand before NumPy is first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from ambid.cli import run
from ambid.cli.demo import demo_file

ROWS = 3000


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str


@pytest.fixture
def ambid(capsys):
    """Run the command in this process."""

    def call(*words):
        capsys.readouterr()
        code = run([str(word) for word in words])
        said = capsys.readouterr()
        return Outcome(code=code, out=said.out, err=said.err)

    return call


@pytest.fixture(scope="session")
def record_text():
    """The first 0.15 s of the demo's record: comment, header, rows."""
    lines = gzip.decompress(demo_file("demo.csv.gz").read_bytes()).decode().splitlines()
    return "\n".join(lines[: ROWS + 2]) + "\n"


@pytest.fixture(scope="session")
def rig_text():
    return demo_file("demo.toml").read_text(encoding="utf-8")


@pytest.fixture
def bench(tmp_path, monkeypatch, record_text, rig_text):
    """A folder with record.csv and rig.toml, in which the command runs."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "record.csv").write_text(record_text, encoding="utf-8")
    (tmp_path / "rig.toml").write_text(rig_text, encoding="utf-8")
    return tmp_path
