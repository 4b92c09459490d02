"""Odd use of ``ambid track`` and of scenarios: each is refused on one line, or done and said; nothing older is lost."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.cli.test_bad_input import columns, with_columns

OLDER = '{"schema": "ambid.track/1"}\n'


@pytest.fixture
def start(bench, ambid):
    """An estimate to begin with."""
    assert ambid("identify", "record.csv", "--rig", "rig.toml", "--json", "start.json").code == 0
    return ("--rig", "rig.toml", "--start", "start.json")


def refused(found, *parts):
    assert (found.code, found.out, len(found.err.splitlines())) == (2, "", 1)
    assert found.err.startswith("ambid: ")
    for part in parts:
        assert part in found.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--every", "9"), "ends before the first reporting interval"),
        (("--every", "1e-9"), "shorter than one sample at 20000 Hz"),
        (("--memory", "1e300"), "--memory is 1e+300 s; it must be"),
        (("--memory", "1e-9"), "--memory is 1e-09 s; it must be"),
    ],
)
def test_a_refusal_leaves_an_older_track_as_it_was(ambid, bench, start, words, said):
    (bench / "track.jsonl").write_text(OLDER, encoding="utf-8")
    refused(ambid("track", "record.csv", *start, "--json", "track.jsonl", *words), said)
    assert (bench / "track.jsonl").read_text(encoding="utf-8") == OLDER


def test_a_record_without_one_sound_sample_is_no_success(ambid, bench, start, record_text):
    values = columns(record_text)
    values[:, 2] = np.nan
    (bench / "none.csv").write_text(with_columns(values), encoding="utf-8")
    found = ambid("track", "none.csv", *start, "--strict")
    assert found.code == 3
    assert "no sample of the record was used" in " ".join(found.out.split())


def test_time_printed_too_coarsely_does_not_halve_the_rate(ambid, bench, record_text):
    values = columns(record_text)
    values[:, 0] = np.round(values[:, 0], 1)  # ms; two samples in each step
    (bench / "coarse.csv").write_text(with_columns(values), encoding="utf-8")
    refused(ambid("track", "coarse.csv", "--rig", "rig.toml"), "time stamp of the row before", "more digits")


@pytest.mark.parametrize("name", ["steady", "quiet"])
def test_a_scenario_in_which_nothing_begins_takes_no_time(ambid, bench, name):
    refused(ambid("simulate", "rmit-axis", "--scenario", f"{name}@0.1", "-o", "s.csv"), "has no beginning")
    assert not (bench / "s.csv").exists()


def test_a_scenario_that_no_memory_holds_is_refused_at_once(ambid, bench):
    found = ambid("simulate", "rmit-axis", "--scenario", "change", "--duration", "1e9", "-o", "s.csv")
    refused(found, "2e+13 samples")
    assert not (bench / "s.csv").exists()


def test_a_track_of_strange_samples_is_json_without_nan(ambid, bench, start, record_text):
    values = columns(record_text)
    values[500:520, 3] = 1e14
    values[900:1000, 1:] = np.inf
    (bench / "odd.csv").write_text(with_columns(values), encoding="utf-8")
    assert ambid("track", "odd.csv", *start, "--json", "track.jsonl").code == 0

    def never(word):
        raise AssertionError(word)

    lines = (bench / "track.jsonl").read_text(encoding="utf-8").splitlines()
    last = [json.loads(line, parse_constant=never) for line in lines][-1]
    assert last["summary"]["rejected_samples"] == 120


def test_a_closed_output_ends_as_a_pipe_that_nobody_reads(bench, start, monkeypatch):
    from ambid.cli import BROKEN_PIPE, run

    monkeypatch.setattr("sys.stdout", None)
    assert run(["track", "record.csv", *start, "--json", "track.jsonl"]) == BROKEN_PIPE
    assert '"summary"' in (bench / "track.jsonl").read_text(encoding="utf-8").splitlines()[-1]
    monkeypatch.setattr("sys.stdout", None)
    assert run(["--version"]) == BROKEN_PIPE


def test_an_edited_start_and_a_record_without_a_sound_row_are_refused(ambid, bench, start, record_text):
    known = json.loads((bench / "start.json").read_text(encoding="utf-8"))
    (bench / "e0.json").write_text(json.dumps({**known, "operating_point": None}), encoding="utf-8")
    refused(ambid("track", "record.csv", "--rig", "rig.toml", "--start", "e0.json"), "operating_point")
    known["parameters"]["m"]["value"] = 1e6
    (bench / "e1.json").write_text(json.dumps(known), encoding="utf-8")
    refused(
        ambid("track", "record.csv", "--rig", "rig.toml", "--start", "e1.json"), "does not follow from the parameters"
    )
    values = columns(record_text)
    values[:, 1:] = np.nan
    (bench / "nan.csv").write_text(with_columns(values), encoding="utf-8")
    refused(ambid("track", "nan.csv", "--rig", "rig.toml"), "finite")
