"""``ambid init --preset``: the rig of a bench with a controller, ready to be changed."""

import pytest

from ambid.acquisition.settings import controller_settings
from ambid.rig import load_rig


def test_the_prototypes_rig_is_written_and_its_controller_takes_it(bench, ambid):
    made = ambid("init", "--preset", "prototype", "-o", "bench.toml")
    assert (made.code, made.err) == (0, "")
    assert "ambid commission --rig bench.toml --port PORT" in made.out
    assert controller_settings(load_rig(bench / "bench.toml")).closed
    assert ambid("init", "--preset", "prototype").out == (bench / "bench.toml").read_text(encoding="utf-8")
    again = ambid("init", "--preset", "prototype", "-o", "bench.toml")
    assert again.code == 2
    assert "--force" in again.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "neither a record nor --preset was given"),
        (("record.csv", "--preset", "prototype"), "both a record and --preset were given"),
        (
            ("--preset", "prototyp"),
            "--preset 'prototyp' is unknown; known: thesis, unstable-bearing,",
        ),
        (("--preset", "prototyp"), "Did you mean 'prototype'?"),
        (("--preset", "prototype", "--rate", "100"), "--rate, --gaps and --layout are for reading a record"),
    ],
)
def test_what_makes_no_rig_is_refused_in_one_line(bench, ambid, words, said):
    refused = ambid("init", *words, "-o", "bench.toml")
    assert refused.code == 2
    assert said in refused.err
    assert refused.err.count("\n") == 1
    assert not (bench / "bench.toml").exists()
