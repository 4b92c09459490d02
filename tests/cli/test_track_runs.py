"""``ambid track`` end to end: a simulated record, its track as the contract has it, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

STATES = {"tracking", "frozen", "changed", "hold"}


def numbers_only(value):
    """No NaN, no infinity, anywhere."""
    if isinstance(value, dict):
        return all(numbers_only(v) for v in value.values())
    if isinstance(value, list):
        return all(numbers_only(v) for v in value)
    return not isinstance(value, float) or np.isfinite(value)


def lines_of(path):
    def refuse(constant):
        raise AssertionError(f"{constant} is not a JSON number")

    return [json.loads(line, parse_constant=refuse) for line in path.read_text().splitlines()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A record in which k_i changes at 1.6 s, its first second alone, and estimates and fits of it."""
    from ambid.cli import run

    here = tmp_path_factory.mktemp("track")
    words = ["simulate", "unstable-bearing", "--scenario", "change@1.6", "--duration", "2.2", "--seed", "2"]
    assert run([*words, "-o", str(here / "change.csv")]) == 0
    assert run(["identify", str(here / "change.csv"), "--to", "1.0", "--json", str(here / "e.json")]) == 0
    return here


@pytest.fixture
def here(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder


def test_the_track_of_a_change_obeys_the_contract(here, ambid):
    found = ambid("track", "change.csv", "--json", "t.jsonl", "--plot", "t.png", "--strict", "--start", "1")
    assert (found.code, found.err) == (0, "")
    assert (here / "t.png").stat().st_size > 10_000
    first, *lines, last = lines_of(here / "t.jsonl")
    assert first["schema"] == "ambid.track/1"
    assert first["rate_hz"] == 20_000.0
    assert first["limit"] == 1.5
    assert isinstance(first["method"], str)
    assert len(lines) == 120
    assert np.diff([line["t"] for line in lines]) == pytest.approx(0.01, abs=1e-6)
    for line in lines:
        assert {"t", "parameters", "error", "state", "event"} <= line.keys()
        assert line["state"] in STATES
        assert line["parameters"].keys() == {"m", "k_x", "k_i", "R", "L"}
        assert all(v["sd"] > 0 for v in line["parameters"].values())
        assert numbers_only(line)
    changes = [x["event"] for x in lines if x["event"] and x["event"]["kind"] == "change"]
    change = changes[-1]  # a first name that the data have mended is that of the same change
    assert {(x["t"], x.get("named", x["parameter"])) for x in changes[1:]} <= {(changes[0]["t"], "k_i")}
    assert change["parameter"] == "k_i"
    assert change["t"] == pytest.approx(1.6, abs=0.01)
    told = next(x["t"] for x in lines if x["event"] and x["event"]["kind"] == "change")
    assert told - 1.6 <= 0.0201
    good = 0.85 * 55.73352
    assert all(x["parameters"]["k_i"]["value"] == pytest.approx(good, rel=0.02) for x in lines if x["t"] > 1.85)
    summary = last["summary"]
    assert {"samples", "seconds_of_record", "computing_s", "updates", "rejected_samples", "changes"} <= summary.keys()
    assert (summary["samples"], summary["rejected_samples"]) == (24_000, 0)
    assert summary["seconds_of_record"] == pytest.approx(1.2)
    assert summary["update_s"] > 0.0
    (in_summary,) = summary["changes"]
    assert (in_summary["parameter"], in_summary["t"]) == ("k_i", pytest.approx(change["t"]))


def test_samples_that_were_lost_are_events_of_their_kind(here, ambid):
    rows = (here / "change.csv").read_text().splitlines()
    at = next(k for k, row in enumerate(rows) if row.startswith("1.2"))
    (here / "gap.csv").write_text("\n".join(rows[:at] + rows[at + 37 :]) + "\n")
    assert ambid("track", "gap.csv", "--json", "g.jsonl", "--start", "1", "--to", "1.5").code == 0
    _, *lines, last = lines_of(here / "g.jsonl")
    (event,) = [x["event"] for x in lines if x["event"]]
    assert (event["kind"], event["samples"], last["summary"]["rejected_samples"]) == ("rejected", 37, 37)
    assert isinstance(event["why"], str)
    assert np.diff([line["t"] for line in lines]) == pytest.approx(0.01, abs=1e-6)


def test_starts_that_do_not_fit_are_refused_on_one_line(here, ambid):
    whole = json.loads((here / "e.json").read_text())
    (here / "coil.json").write_text(json.dumps({**whole, "model": "coil"}))
    assert ambid("fit", "change.csv", "--structure", "arx", "--input", "voltage", "--output", "current", "--to", "0.5",
                 "--orders", "na=2,nb=2,nk=1", "--json", "fit.json").code == 0  # fmt: skip
    cases = (
        (("--start", "coil.json"), ""),
        (("--start", "fit.json"), "starts from linear physical parameters"),
        (("--start", "none.json"), "none.json"),
        (("--to", "0.001"), ""),
        (("--start", "9"), "leaves nothing"),
    )
    for words, said in cases:
        found = ambid("track", "change.csv", *words)
        assert (found.code, len(found.err.splitlines())) == (2, 1), words
        assert said in found.err


def test_a_start_of_another_rate_is_refused(here, ambid):
    whole = json.loads((here / "e.json").read_text())
    whole["record"]["rate_hz"] = 10_000.0
    (here / "slow.json").write_text(json.dumps(whole))
    found = ambid("track", "change.csv", "--start", "slow.json")
    assert (found.code, len(found.err.splitlines())) == (2, 1)
    assert "they must agree" in found.err
