"""``ambid simulate RIG --nonlinear``: from a preset's rig to records, and from those to the numbers of the rig."""

import json

import pytest

from ambid.rig import load_rig


@pytest.mark.parametrize(
    ("name", "places", "seconds", "numbers"),
    [
        ("levitated-ball", (8e-3, 10e-3, 12e-3), 0.5, ("k", "L_leak", "R")),
        ("unstable-bearing", (-3e-5, 3e-5), 0.3, ("k", "s", "R")),
    ],
)
def test_preset_to_rig_to_records_to_numbers(tmp_path, monkeypatch, ambid, name, places, seconds, numbers) -> None:
    monkeypatch.chdir(tmp_path)
    made = ambid("init", "--preset", name, "-o", "bench.toml")
    assert made.code == 0
    assert "ambid simulate bench.toml -o RECORD --nonlinear" in made.out
    records = []
    for seed, place in enumerate(places):
        records.append(f"r{seed}.csv")
        words = ("--nonlinear", "--position", place, "--duration", seconds, "--seed", seed)
        done = ambid("simulate", "bench.toml", "-o", records[-1], *words)
        assert done.code == 0, done.err
        assert done.err == ""
        assert "truth: m " in done.out
        assert "L_leak " in done.out
        assert "truth: m " in (tmp_path / f"{records[-1]}-metadata.json").read_text(encoding="utf-8")
    found = ambid("identify", *records, "--rig", "bench.toml", "--nonlinear", "--json", "-")
    assert found.code == 0, found.err
    estimate, rig = json.loads(found.out), load_rig("bench.toml")
    truth = {p.name: p.value for p in (*rig.parameters, *rig.magnet.parameters)}
    assert estimate["status"] == "converged"
    for number in numbers:
        p = estimate["parameters"][number]
        assert abs(p["value"] - truth[number]) < max(0.01 * truth[number], 1.96 * p["sd"]), number
        assert p["sd"] < 0.03 * truth[number], number


def test_a_linear_rig_finds_its_amplitude_about_its_operating_point(tmp_path, monkeypatch, ambid) -> None:
    monkeypatch.chdir(tmp_path)
    ambid("init", "--preset", "levitated-ball", "-o", "bench.toml")  # at 10 mm, between stops at 2 and 20 mm
    peaks = [ambid("simulate", w, "-o", "r.csv", "--duration", "0.2").out for w in ("bench.toml", "levitated-ball")]
    assert [p.splitlines()[0].partition(" of ")[2] for p in peaks] == ["2.04 V, seed 0"] * 2


def test_the_prototypes_rig_simulates_in_its_counts(tmp_path, monkeypatch, ambid) -> None:
    monkeypatch.chdir(tmp_path)
    ambid("init", "--preset", "prototype", "-o", "bench.toml")
    done = ambid("simulate", "bench.toml", "-o", "r.csv", "--nonlinear", "--duration", "0.2", "--rate", "2000")
    assert done.code == 0, done.err
    header = next(x for x in (tmp_path / "r.csv").read_text(encoding="utf-8").splitlines() if not x.startswith("#"))
    assert "duty [1]" in header


@pytest.mark.parametrize(
    ("preset", "old", "new", "words", "said"),
    [
        ("levitated-ball", 'kind = "single"\n', "", ("--nonlinear",), "magnet.kind is 'auto'"),
        ("levitated-ball", "k = { value = 0.00013043767313019396, ", "k = { ", ("--nonlinear",), "no value for k;"),
        ("rmit-axis", "", "", ("--nonlinear",), "has no [magnet]"),
        ("levitated-ball", "", "", ("--nonlinear", "--position", "-0.01"), "closes an air gap"),
        ("levitated-ball", "", "", ("--position", "0.01"), "--position is for --nonlinear"),
        ("levitated-ball", "", "", ("--scenario", "none", "--position", "0.01"), "--scenario takes no --position"),
    ],
)
def test_what_cannot_be_simulated_is_refused_on_one_line(
    tmp_path, monkeypatch, ambid, preset, old, new, words, said
) -> None:
    monkeypatch.chdir(tmp_path)
    text = ambid("init", "--preset", preset).out
    assert old in text
    (tmp_path / "bench.toml").write_text(text.replace(old, new), encoding="utf-8")
    refused = ambid("simulate", "bench.toml", "-o", "r.csv", *words)
    assert refused.code == 2
    assert said in refused.err
    assert refused.err.count("\n") == 1
    assert not (tmp_path / "r.csv").exists()
