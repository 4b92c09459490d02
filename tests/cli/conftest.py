"""A short record as that of the demo, its rig, and the command run in this process."""

import os
from dataclasses import dataclass

# As the command does for itself; it has to stand before NumPy is first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from ambid.cli import run
from ambid.cli.demo import demo_file
from tools.demo_record import demo_csv, demo_simulation

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
    """The first 0.15 s of a record as the demo's, longer and smaller: comment, header, rows."""
    lines = demo_csv(demo_simulation(0.4, 20.0)).splitlines()
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
