"""What is given to others: one version everywhere, and a wheel and an sdist that work where they are installed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
from pathlib import Path

import pytest

from tests.conventions.sources import ROOT

LARGEST = 2_000_000  # bytes of the wheel


def test_one_version_everywhere():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", citation, re.MULTILINE) == [version]
    assert (ROOT / "changes" / version).is_dir()


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> dict[str, Path]:
    """The sdist of the files of this checkout, and the wheel that is built from the sdist, as an installer does it."""
    folder = tmp_path_factory.mktemp("built")
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True
    )
    if listed.returncode:
        pytest.skip("not a git checkout")
    for name in filter(None, listed.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            copy = folder / "tree" / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes((ROOT / name).read_bytes())
    sdist = folder / _hook("build_sdist", folder, folder / "tree")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    return {"sdist": sdist, "wheel": folder / _hook("build_wheel", folder, folder / sdist.name.removesuffix(".tar.gz"))}


def _hook(name: str, out: Path, tree: Path) -> str:
    code = f"from setuptools import build_meta; print(build_meta.{name}({str(out)!r}))"
    return _run([sys.executable, "-c", code], tree).splitlines()[-1]


def _run(words: list[str], folder: Path) -> str:
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_wheel_is_small_and_its_demo_runs_in_a_fresh_environment(built, tmp_path):
    """Without network: what the package depends on is lent from this environment."""
    assert built["wheel"].stat().st_size <= LARGEST
    _run([sys.executable, "-m", "venv", "fresh"], tmp_path)
    scripts = tmp_path / "fresh" / ("Scripts" if os.name == "nt" else "bin")
    python = str(scripts / "python")
    own = Path(_run([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], tmp_path).strip())
    _run([python, "-m", "pip", "install", "--no-index", "--no-deps", "--quiet", str(built["wheel"])], tmp_path)
    # as last places to look, where files of editable installations are not followed
    (own / "lent.pth").write_text("\n".join({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}) + "\n")
    where = _run([python, "-c", "import ambid; print(ambid.__file__, ambid.__version__)"], tmp_path)
    assert where.split() == [str(own / "ambid" / "__init__.py"), _version(built["wheel"])]
    said = _run([str(scripts / "ambid"), "demo"], tmp_path)
    assert said.startswith("verdict: usable\n")
    assert "5 of 5 true values" in said


def _version(wheel: Path) -> str:
    return wheel.name.split("-")[1]
