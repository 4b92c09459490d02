"""Temporary folders of emulated benches: those of dead programs are removed; those in use and young ones are not."""

import os
import tempfile

import pytest

from ambid.acquire.devices.emulated import TemporaryFolder

OLD = (1.0, 1.0)


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def left(name, place):
    """What a program that was killed leaves."""
    folder = place / f"ambid-emulated-{name}"
    folder.mkdir()
    (folder / "in_use").touch()
    (folder / "plant.txt").write_text("m 1\n", encoding="utf-8")
    return folder


def test_what_a_dead_program_left_is_removed_by_the_next_one(place):
    dead, young, other = left("dead", place), left("young", place), place / "ambid-emulated-foreign"
    other.mkdir()  # without a lock: not known to be ours
    for folder in (dead, other):
        os.utime(folder, OLD)
    used = TemporaryFolder()
    os.utime(used.path, OLD)
    after = TemporaryFolder()
    assert sorted(place.iterdir()) == sorted([young, other, used.path, after.path])
    used.remove()
    after.remove()
    after.remove()
    assert sorted(place.iterdir()) == sorted([young, other])
