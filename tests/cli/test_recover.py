"""``ambid recover``: what a recording that could not finish has left becomes a record, and what is missing is said."""

import gzip
from pathlib import Path

import h5py
import numpy as np
import pytest

from ambid.acquisition.recorder import Recorded, Recorder, journal_path
from ambid.acquisition.recorder.convert import Damage, Survey
from ambid.job import load
from ambid.record import read_record
from tests.acquisition.recorder.signals import ROWS, block, header, same_bits, values_at

BLOCKS = 30


@pytest.fixture
def left(tmp_path, monkeypatch):
    """A folder with what a killed recording of 30 blocks leaves: run.h5.journal; the command runs there."""
    monkeypatch.chdir(tmp_path)
    with Recorder(tmp_path / "run.h5", header()) as recorder:
        for k in range(BLOCKS):
            recorder.append(block(k))
        assert recorder.flush()
        data = recorder.journal.read_bytes()
    (tmp_path / "run.h5").unlink()
    journal_path(tmp_path / "run.h5").write_bytes(data)
    return tmp_path


def damaged(folder):
    path = folder / "run.h5.journal"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def values_of(path, gaps="error"):
    return np.column_stack([c.values for c in read_record(path, gaps=gaps).channels])


def test_what_was_acknowledged_comes_back(left, ambid):
    found = ambid("recover", "run.h5.journal", "--strict")
    assert (found.code, found.err) == (0, "")
    assert found.out.splitlines() == [
        "verdict: usable",
        "",
        "run.h5: 30 blocks, 600 samples, 0.3 s; cut off while recording",
        "run.h5 written. run.h5.journal is kept; --delete removes it",
    ]
    assert same_bits(values_of("run.h5"), values_at(0, BLOCKS * ROWS))
    assert (left / "run.h5.journal").exists()
    assert ambid("identify", "run.h5").code == 2  # a record like any other: its columns are no bearing


@pytest.mark.drawn
def test_figure_page_and_json_are_of_the_record_and_the_json_reads_back(left, ambid):
    damaged(left)
    words = ("--plot", "run.png", "--report", "run.html", "--json", "run.json", "--strict")
    assert ambid("recover", "run.h5.journal", *words).code == 3
    assert (left / "run.png").stat().st_size > 10_000
    assert "use with caution" in (left / "run.html").read_text()
    again = load(left / "run.json")
    assert (again.verdict.word, again.survey.gap_samples) == ("caution", 20)


def test_delete_removes_the_journal(left, ambid):
    found = ambid("recover", "run.h5.journal", "--delete")
    assert found.code == 0
    assert "run.h5.journal removed" in found.out
    assert [p.name for p in left.iterdir()] == ["run.h5"]


def test_a_complete_journal_says_so_and_an_incomplete_end_too(left, ambid):
    data = (left / "run.h5.journal").read_bytes()
    (left / "cut.h5.journal").write_bytes(data[:-30] + bytes(100))
    found = ambid("recover", "run.h5.journal", "cut.h5.journal", "--strict")
    assert found.code == 0  # what was being written at the end was not acknowledged
    assert found.out.count("verdict: usable\n\n") == 2
    said = " ".join(found.out.partition("cut.h5: ")[2].split())
    assert "29 blocks" in said
    assert "at the end of the journal are not a whole block" in said
    assert same_bits(values_of("cut.h5"), values_at(0, 29 * ROWS))


def test_a_damaged_block_is_counted_and_becomes_rows_without_values(left, ambid):
    damaged(left)
    found = ambid("recover", "run.h5.journal", "--delete")
    assert found.code == 0
    assert found.out.startswith("verdict: use with caution\n  ✗ journal: 1 block damaged, in 1 place.")
    assert "✗ samples: 20 samples missing in 1 place. Read the record with --gaps" in found.out
    assert "is kept: the record does not hold all of it" in found.out
    assert (left / "run.h5.journal").exists()
    refused = ambid("identify", "run.h5")
    assert refused.code == 2
    assert "--gaps interpolate or --gaps cut" in refused.err
    assert ambid("recover", "run.h5.journal", "--force", "--strict").code == 3


def test_a_record_that_exists_is_written_over_only_with_force(left, ambid):
    (left / "run.h5").write_text("precious")
    found = ambid("recover", "run.h5.journal")
    assert found.code == 2
    assert "run.h5 already exists" in found.err
    assert (left / "run.h5").read_text() == "precious"
    assert ambid("recover", "run.h5.journal", "--force").code == 0
    assert len(values_of("run.h5")) == BLOCKS * ROWS


@pytest.mark.parametrize("name", ["run.h5", "run.csv", "run.csv.gz"])
def test_a_record_that_holds_the_journal_is_said_to_and_the_journal_goes(left, ambid, name):
    """As after a power cut between the two: the record has its name, the journal is not removed yet."""
    ambid("recover", "run.h5.journal", "-o", name)
    before = (left / name).read_bytes()
    found = ambid("recover", "run.h5.journal", "-o", name)
    assert (found.code, found.err) == (0, "")
    said = f"{name} holds that already: nothing to do. run.h5.journal"
    assert found.out.splitlines()[-1] == f"{said} is kept; --delete removes it"
    found = ambid("recover", "run.h5.journal", "-o", name, "--delete")
    assert (found.code, found.err) == (0, "")
    assert found.out.splitlines()[-1] == f"{said} removed"
    assert [p.name for p in left.iterdir()] == [name]
    assert (left / name).read_bytes() == before


def changed_value(path):
    with h5py.File(path, "r+") as file:
        file["channels/1"][7] += 1.0


def changed_name(path):
    with h5py.File(path, "r+") as file:
        file["channels/1"].attrs["name"] = "other"


def changed_start(path):
    with h5py.File(path, "r+") as file:
        file.attrs["start_s"] = 1.0


def changed_rate(path):
    with h5py.File(path, "r+") as file:
        file.attrs["rate_hz"] = 1.0


def changed_events(path):
    with h5py.File(path, "r+") as file:
        text = file["acquisition"].asstr()[()]
        del file["acquisition"]
        file["acquisition"] = text.replace('"events": [', '"events": [1')


def a_column_more(path):
    with h5py.File(path, "r+") as file:
        n = len(file["channels"])
        file.copy("channels/0", file["channels"], str(n))


def cut_off(path):
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize(
    "change", [changed_value, changed_name, changed_start, changed_rate, changed_events, a_column_more, cut_off]
)
def test_a_record_that_holds_anything_else_keeps_the_journal(left, ambid, change):
    ambid("recover", "run.h5.journal")
    change(left / "run.h5")
    before = (left / "run.h5").read_bytes()
    found = ambid("recover", "run.h5.journal", "--delete")
    assert (found.code, found.out) == (2, "")
    assert "run.h5 already exists" in found.err
    assert (left / "run.h5.journal").exists()
    assert (left / "run.h5").read_bytes() == before


@pytest.mark.parametrize("name", ["run.csv", "run.csv.gz"])
def test_a_text_with_another_digit_keeps_the_journal(left, ambid, name):
    ambid("recover", "run.h5.journal", "-o", "run.csv")
    text = (left / "run.csv").read_text()
    other = text[:-3] + ("1" if text[-3] != "1" else "2") + text[-2:]
    (left / name).write_bytes(gzip.compress(other.encode()) if name.endswith(".gz") else other.encode())
    assert ambid("recover", "run.h5.journal", "-o", name, "--delete").code == 2
    assert (left / "run.h5.journal").exists()


def test_a_damaged_journal_stays_although_the_record_holds_what_is_left_of_it(left, ambid):
    damaged(left)
    ambid("recover", "run.h5.journal")
    found = ambid("recover", "run.h5.journal", "--delete")
    assert found.code == 0
    assert "✗ journal: 1 block damaged" in found.out
    assert "run.h5 holds that already" in found.out
    assert "is kept: the record does not hold all of it" in found.out
    assert (left / "run.h5.journal").exists()


def test_another_name_and_another_format(left, ambid):
    assert ambid("recover", "run.h5.journal", "-o", "other.csv").code == 0
    assert same_bits(values_of("other.csv"), values_at(0, BLOCKS * ROWS))
    assert not (left / "run.h5").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["none.journal"], "No such file"),
        (["text.csv"], "is not a journal"),
        (["empty.journal"], "is empty"),
        (["run.h5.journal", "-o", "run.mat"], "is written as"),
        (["run.h5.journal", "-o", "none/run.h5"], "there is no folder"),
        (["run.h5.journal", "-o", "run.h5.journal"], "is also an input"),
        (["run.h5.journal", "run.h5.journal", "-o", "a.h5"], "one by one"),
        (["run.h5.journal", "run.h5.journal", "--plot", "a.png"], "one by one"),
        (["run.h5.journal", "--json", "text.csv"], "is not a result"),
        ([], "Missing argument"),
    ],
)
def test_what_cannot_be_recovered_is_refused_on_one_line(left, ambid, words, says):
    (left / "text.csv").write_text("time [s],x [m]\n")
    (left / "empty.journal").write_bytes(b"")
    before = sorted(p.name for p in left.iterdir())
    found = ambid("recover", *words)
    assert (found.code, found.out) == (2, "")
    assert len(found.err.splitlines()) == 1
    assert says in found.err
    assert sorted(p.name for p in left.iterdir()) == before


def test_a_journal_without_a_block_is_refused(left, ambid):
    with Recorder(left / "none.h5", header()) as recorder:
        data = recorder.journal.read_bytes()
    (left / "none.h5.journal").write_bytes(data)
    found = ambid("recover", "none.h5.journal")
    assert found.code == 2
    assert "no intact block" in found.err


def test_a_recording_that_goes_on_is_left_alone(left, ambid):
    with Recorder(left / "live.h5", header()) as recorder:
        recorder.append(block(0))
        found = ambid("recover", "live.h5.journal", "--delete", "--force")
        assert found.code == 2
        assert "is being written by a recorder" in found.err
    assert same_bits(values_of("live.h5"), values_at(0, ROWS))


def test_one_that_is_refused_does_not_keep_the_others_back(left, ambid):
    found = ambid("recover", "none.journal", "run.h5.journal", "nor.journal")
    assert found.code == 2
    assert [line.split()[2] for line in found.err.splitlines()] == ["nor.journal", "none.journal"]
    assert len(values_of("run.h5")) == BLOCKS * ROWS


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (Damage(places=1), "bytes damaged in 1 place"),
        (Damage(frames=1, places=1), "1 entry damaged, in 1 place"),
        (Damage(blocks=2, frames=3, places=1), "2 blocks and 1 other entry damaged, in 1 place"),
    ],
)
def test_only_what_is_damaged_is_counted(damage, words):
    made = Recorded(path=Path("a.h5"), rate_hz=2000.0, survey=Survey(damage=damage))
    assert [r.text for r in made.reasons] == [f"{words}. Keep it, and look at the disk"]
