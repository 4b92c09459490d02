"""The demo: its record is what its recipe gives, and its estimate lies beside the truth."""

import gzip

import numpy as np

from ambid.cli.demo import PRESET, demo_file
from ambid.physics.presets import preset
from ambid.rig import load_rig, read_bench
from tools.demo_record import demo_csv, demo_simulation


def numbers(text):
    return np.loadtxt(text.splitlines()[2:], delimiter=",")


def test_the_embedded_record_is_what_its_recipe_gives():
    content = demo_file("demo.csv.gz").read_bytes()
    assert len(content) < 300_000
    stored, made = gzip.decompress(content).decode(), demo_csv(demo_simulation())
    assert stored.splitlines()[:2] == made.splitlines()[:2]
    # one unit of the last printed digit: another processor may round a halfway case the other way
    assert np.all(np.abs(numbers(stored) - numbers(made)) <= [1e-9, 1.001e-2, 1.001e-1, 1.001e-2])


def test_the_embedded_record_is_sound():
    assert demo_simulation().warnings == ()
    with gzip.open(str(demo_file("demo.csv.gz")), "rt") as file:
        assert len(file.readlines()) == 2002


def test_the_rig_of_the_demo_knows_nothing(tmp_path):
    (tmp_path / "demo.toml").write_bytes(demo_file("demo.toml").read_bytes())
    (tmp_path / "demo.csv.gz").write_bytes(demo_file("demo.csv.gz").read_bytes())
    rig = load_rig(tmp_path / "demo.toml")
    assert all(p.value is None for p in rig.parameters if p.name != "c")
    record = read_bench(tmp_path / "demo.csv.gz", rig)
    assert record.rate_hz == preset(PRESET).rate_hz


def test_the_demo_prints_estimate_and_truth(ambid):
    found = ambid("demo")
    assert (found.code, found.err) == (0, "")
    assert found.out.startswith("verdict: usable\n\n")
    assert "✓ 5 of 5 true values lie in their 99.9 % intervals" in found.out
    assert "✗" not in found.out
    assert max(map(len, found.out.splitlines())) <= 80
    for name in ("m", "k_x", "k_i", "R", "L"):
        (line,) = [x for x in found.out.splitlines() if x.startswith(f"{name} ") and "±" in x]
        error = float(line.split(" %")[0].split()[-1])
        assert abs(error) < 2.0
