"""``ambid frf``: exit codes, one line for bad input, JSON, figure, and nothing left behind on failure."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from ambid import load
from ambid.blackbox.fit import NO_INNOVATIONS, fit_from_json
from ambid.physics.presets import preset
from ambid.record import read_record
from tests.blackbox import sweeps
from tests.job.loops import loop_csv

TRUTH = preset("unstable-bearing").parameters
SIGNALS = ("--input", "voltage", "--output", "position", "--output", "current")
REFERENCE = ("--reference", "excitation")
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="session")
def loop_text(tmp_path_factory):
    return loop_csv(tmp_path_factory.mktemp("loop") / "loop.csv").read_text(encoding="utf-8")


@pytest.fixture
def folder(tmp_path, monkeypatch, loop_text, rig_text):
    """A folder with loop.csv (levitated, excitation recorded) and rig.toml, in which the command runs."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop.csv").write_text(loop_text, encoding="utf-8")
    (tmp_path / "rig.toml").write_text(rig_text, encoding="utf-8")
    return tmp_path


def test_the_table_fits_80_columns_and_names_what_was_measured(folder, ambid):
    found = ambid("frf", "loop.csv", *SIGNALS, *REFERENCE)
    assert (found.code, found.err) == (0, "")
    assert max(map(len, found.out.splitlines())) <= 80
    assert "\x1b" not in found.out
    assert "periodic, joint input-output with the reference, 7 periods of 4000 samples" in found.out
    for output in ("position", "current"):
        (line,) = [x for x in found.out.splitlines() if x.startswith(f"voltage → {output} ")]
        assert "%" in line
    assert "biased" not in found.out


def test_without_a_reference_the_bias_is_told_unless_the_loop_was_open(folder, ambid):
    words = ("frf", "loop.csv", "--input", "voltage", "--output", "position", "--method", "random")
    silent = ambid(*words)
    assert silent.code == 0
    assert "biased towards" in " ".join(silent.out.split())
    assert "biased towards" not in " ".join(ambid(*words, "--open-loop").out.split())


def test_json_is_the_schema_of_formats_md(folder, ambid):
    assert ambid("frf", "loop.csv", *SIGNALS, *REFERENCE, "--band", "5:500", "--json", "a.json").code == 0
    d = json.loads((folder / "a.json").read_text())
    assert d["schema"] == "ambid.frf/1"
    f = np.array(d["frequency_hz"])
    assert 5 <= f[0] < f[-1] <= 500
    for output, unit in (("position", "m"), ("current", "A")):
        G, sd = np.array(d["G"][output]["voltage"]), np.array(d["sd"][output]["voltage"])
        assert G.shape == (f.size, 2)
        assert sd.shape == (f.size,)
        assert np.all(sd > 0)
        assert d["units"][output] == unit
        assert np.array(d["noise_sd"][output]["voltage"]) == pytest.approx(sd)
    assert d["distortion_sd"] is None  # no lines were left free: noise is all that there is
    assert d["coherence"] is None
    assert np.array(d["covariance"]["matrix"]).shape == (f.size, 2, 2, 2)
    assert d["references"] == ["excitation"]
    assert d["record"]["sha256"]
    assert d["fit"] is None
    assert d["estimate"] is None
    # near 0 the levitated plant is k_i/(R k_x): the sign of an attracting magnet shows
    assert d["G"]["position"]["voltage"][0][0] == pytest.approx(TRUTH["k_i"] / TRUTH["R"] / TRUTH["k_x"], rel=0.1)


def test_the_fit_inside_is_a_fit_that_can_be_read_back(folder, ambid):
    words = ("frf", "loop.csv", *SIGNALS, *REFERENCE, "--json", "-")
    for more, structure in (
        (("--orders", "nf=3,nb=3", "--delay", "5e-5"), "frf-ml"),
        (("--state-space", "n=3", "--delay", "5e-5"), "frf-subspace"),
    ):
        found = ambid(*words, *more)
        assert found.code == 0
        document = json.loads(found.out)["fit"]
        assert (document["schema"], document["structure"]) == ("ambid.fit/1", structure)
        assert document["noise_variance"] is None
        assert document["noise_covariance"] is None
        assert document["noise"] == NO_INNOVATIONS
        fit = fit_from_json(document, "here")
        assert fit.passed
        poles = fit.model.poles() if fit.model.dt is None else np.log(fit.model.poles()) / fit.dt
        assert np.max(poles.real) == pytest.approx(113.6, rel=0.02)
        assert document["record"]["samples"] == 32_000
        assert fit.offsets.y.shape == (2,)


def test_a_state_space_says_what_the_operator_is_good_for(folder, ambid):
    out = ambid("frf", "loop.csv", *SIGNALS, *REFERENCE, "--state-space", "auto", "--delay", "5e-5").out
    text = " ".join(out.split())
    assert "n = 3" in text
    assert "Laguerre operator p = " in text
    assert "without it" in text
    assert "unstable" in text
    assert max(map(len, out.splitlines())) <= 80


def test_a_rig_gives_physical_parameters(folder, ambid):
    found = ambid("frf", "loop.csv", "--rig", "rig.toml", *REFERENCE, "--json", "a.json", "--strict")
    assert (found.code, found.err) == (0, "")
    assert max(map(len, found.out.splitlines())) <= 80
    estimate = json.loads((folder / "a.json").read_text())["estimate"]
    assert estimate["delay"]["total"] == pytest.approx(1.0, abs=0.02)
    for name in ("m", "k_x", "k_i", "R", "L"):
        p = estimate["parameters"][name]
        assert p.keys() >= {"value", "sd", "ci95", "unit", "role", "identifiable"}
        assert abs(p["value"] - TRUTH[name]) < 3.3 * p["sd"], name
        assert f"\n{name} " in found.out


def test_scales_that_the_rig_states_are_said_to_be_in_no_interval(folder, ambid):
    text = (folder / "rig.toml").read_text()
    (folder / "rig.toml").write_text(text.replace("[channels.position]", "[channels.position]\ngain_sd = 0.01", 1))
    found = ambid("frf", "loop.csv", "--rig", "rig.toml", *REFERENCE, "--json", "a.json")
    assert found.code == 0, found.err
    assert "no interval holds channels.position.gain_sd of the rig" in " ".join((folder / "a.json").read_text().split())


def test_the_figure_is_drawn_with_models_over_it(folder, ambid):
    words = ("frf", "loop.csv", "--rig", "rig.toml", *REFERENCE, "--orders", "nf=4", "--plot", "a.png")
    assert ambid(*words).code == 0
    assert (folder / "a.png").read_bytes().startswith(PNG)
    assert sorted(p.name for p in folder.iterdir()) == ["a.png", "loop.csv", "rig.toml"]


def test_strict_ends_with_3_where_the_model_does_not_fit(folder, ambid):
    words = ("frf", "loop.csv", *SIGNALS, *REFERENCE, "--orders", "nf=1,nb=1", "--json", "a.json")
    assert ambid(*words).code == 0
    strict = ambid(*words, "--strict")
    assert strict.code == 3
    assert "✗ cost" in strict.out
    assert (folder / "a.json").exists()


REFUSED = {
    "no input": (("--output", "position"), "--input"),
    "no output": (("--input", "voltage"), "--output"),
    "no such column": (("--input", "volts", "--output", "position"), "'volts'"),
    "no such reference": ((*SIGNALS, "--reference", "noise"), "'noise'"),
    "no such reference beside a rig": (("--rig", "rig.toml", "--reference", "noise"), "'noise'"),
    "no such role": (("--rig", "rig.toml", *REFERENCE, "--output", "height"), "height"),
    "both models": ((*SIGNALS, *REFERENCE, "--orders", "nf=2", "--state-space", "n=2"), "--state-space"),
    "orders without a degree": ((*SIGNALS, *REFERENCE, "--orders", "nb=2"), "nf"),
    "orders auto": ((*SIGNALS, *REFERENCE, "--orders", "auto"), "--state-space auto"),
    "orders that are none": ((*SIGNALS, *REFERENCE, "--orders", "nf:2"), "--orders"),
    "a state space of none": ((*SIGNALS, *REFERENCE, "--state-space", "0"), "at least 1"),
    "a state space in words": ((*SIGNALS, *REFERENCE, "--state-space", "three"), "--state-space"),
    "a delay in words": ((*SIGNALS, *REFERENCE, "--orders", "nf=2", "--delay", "soon"), "--delay"),
    "a negative delay": ((*SIGNALS, *REFERENCE, "--orders", "nf=2", "--delay=-1e-4"), "--delay"),
    "a delay of nothing": ((*SIGNALS, *REFERENCE, "--delay", "1e-4"), "--delay"),
    "a delay that is to be found": ((*SIGNALS, *REFERENCE, "--state-space", "3", "--delay", "auto"), "--delay"),
    "a domain of nothing": ((*SIGNALS, *REFERENCE, "--domain", "z"), "--domain"),
    "a direct path of nothing": ((*SIGNALS, *REFERENCE, "--orders", "nf=2", "--feedthrough"), "--feedthrough"),
    "half a band": ((*SIGNALS, *REFERENCE, "--band", "5"), "--band"),
    "a band upside down": ((*SIGNALS, *REFERENCE, "--band", "50:5"), "--band"),
    "a band without lines": ((*SIGNALS, *REFERENCE, "--band", "9000:9100"), "band"),
    "an unknown method": ((*SIGNALS, *REFERENCE, "--method", "welch"), "--method"),
    "a part outside": ((*SIGNALS, *REFERENCE, "--from", "100"), "100"),
    "too high an order": ((*SIGNALS, *REFERENCE, "--band", "5:20", "--orders", "nf=12"), "Lower the orders"),
    "a figure of no kind": ((*SIGNALS, *REFERENCE, "--plot", "a.txt"), "--plot"),
    "the record as figure": ((*SIGNALS, *REFERENCE, "--json", "loop.csv"), "is also an input"),
}


@pytest.mark.parametrize("words", [x[0] for x in REFUSED.values()], ids=list(REFUSED))
def test_bad_input_is_one_line_and_leaves_nothing(folder, ambid, words):
    says = next(said for w, said in REFUSED.values() if w == words)
    found = (
        ambid("frf", "loop.csv", *words, "--json", "a.json")
        if "--json" not in words
        else ambid("frf", "loop.csv", *words)
    )
    assert found.code == 2
    assert found.out == ""
    assert found.err.startswith("ambid: ")
    assert len(found.err.splitlines()) == 1
    assert says in found.err
    assert sorted(p.name for p in folder.iterdir()) == ["loop.csv", "rig.toml"]


def test_its_structures_are_not_for_fit_and_say_where_they_are(folder, ambid):
    found = ambid("fit", "loop.csv", "--input", "voltage", "--output", "position", "--structure", "frf-ml")
    assert found.code == 2
    assert "ambid frf" in found.err


def test_the_rig_s_columns_may_have_other_names(folder, ambid, loop_text, rig_text):
    (folder / "other.csv").write_text(loop_text.replace("position [", "gap [", 1), encoding="utf-8")
    (folder / "rig.toml").write_text(rig_text.replace('column = "position"', 'column = "gap"'), encoding="utf-8")
    words = ("frf", "other.csv", "--rig", "rig.toml", *REFERENCE, "--output", "gap", "--output", "current")
    found = json.loads(ambid(*words, "--json", "-").out)
    assert found["outputs"] == ["position", "current"]
    assert abs(found["estimate"]["parameters"]["m"]["value"] - TRUTH["m"]) < 0.1
    assert "excitation" in read_record(folder / "other.csv").names


def test_the_commands_of_the_page_run_one_by_one(tmp_path, monkeypatch, ambid):
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "frequency.md").read_text(encoding="utf-8")
    lines = re.search(r"^```sh\n(.*?)^```$", page, re.DOTALL | re.MULTILINE).group(1).splitlines()
    said = [ambid(*shlex.split(line)[1:]) for line in lines]
    assert [x.code for x in said] == [0] * len(lines)
    assert all("✗" not in x.out for x in said)
    assert all("biased towards" not in " ".join(x.out.split()) for x in said)
    assert sum(line.endswith(" identified") for line in said[-1].out.splitlines()) == 5
    # then the piece of Python that follows
    names: dict[str, object] = {}
    exec(re.search(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE).group(1), names)
    assert names["found"].estimate.parameter("k_i").value == pytest.approx(TRUTH["k_i"], rel=0.02)


def test_simulate_repeats_and_logs_the_excitation(tmp_path, monkeypatch, ambid):
    monkeypatch.chdir(tmp_path)
    words = (
        "simulate",
        "unstable-bearing",
        "-o",
        "a.csv",
        "--duration",
        "0.4",
        "--amplitude",
        "5",
        "--band",
        "10:1000",
    )
    assert ambid(*words, "--periods", "4", "--log-excitation").code == 0
    excitation = read_record(tmp_path / "a.csv")["excitation"].values.reshape(4, -1)
    assert np.array_equal(excitation, np.broadcast_to(excitation[0], excitation.shape))
    assert np.abs(excitation).max() == pytest.approx(5.0)
    refused = ambid(*words, "--periods", "7", "-o", "b.csv")
    assert refused.code == 2
    assert "--periods" in refused.err
    assert not (tmp_path / "b.csv").exists()
    assert ambid(*words).code == 0
    assert "excitation" not in read_record(tmp_path / "a.csv").names


# --- modes ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sweep_text():
    """Four seconds of a sweep and three accelerometers, with modes at 60 and 140 Hz."""
    rng, u = np.random.default_rng(1), sweeps.sweep(4.0)
    y, _ = sweeps.structure(((60.0, 0.01), (140.0, 0.008)), u, rng, n_outputs=3, noise=0.01)
    rows = np.column_stack([np.arange(u.size) / sweeps.RATE, u, y])
    head = "time [s],current [A],a0 [m/s^2],a1 [m/s^2],a2 [m/s^2]"
    return "\n".join([head, *(",".join(f"{x:.7g}" for x in row) for row in rows)]) + "\n"


MODES = ("--output", "a0", "--output", "a1", "--output", "a2", "--modes")


def test_modes_are_found_without_a_rig_and_stand_in_the_file(tmp_path, sweep_text, ambid, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("sweep.csv").write_text(sweep_text, encoding="utf-8")
    files = ("--json", "m.json", "--plot", "m.png")
    found = ambid("frf", "sweep.csv", "--input", "current", *MODES, "auto", "--open-loop", *files)
    assert found.code == 0
    assert "modes_fit" in found.out
    assert max(map(len, found.out.splitlines())) <= 80
    modes = json.loads(Path("m.json").read_text())["modes"]
    assert [m["frequency_hz"]["value"] for m in modes] == pytest.approx([60.0, 140.0], rel=1e-3)
    assert [m["damping"]["value"] for m in modes] == pytest.approx([0.01, 0.008], rel=0.05)
    for m in modes:
        assert set(m["shape"]) == {"a0", "a1", "a2"}
        for number in (m["frequency_hz"], m["damping"], *m["shape"].values()):
            assert number.keys() >= {"value", "sd", "ci95", "identifiable"}
    assert Path("m.png").read_bytes().startswith(PNG)
    again = load("m.json")
    assert [m.damping.value for m in again.modes] == [m["damping"]["value"] for m in modes]
    assert "frequency" in again.summary()
    assert len(again.to_dataframe()) == again.response.frequency_hz.size


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--input", "current", *MODES, "few"), "--modes is 'few'; it must be a number of modes, or auto"),
        (("--input", "current", "--output", "a0", "--estimate", "e.json"), "--estimate is for --modes"),
        ((*MODES, "auto"), "no input was named"),
        (("--input", "current", *MODES, "auto", "--band", "60:61"), "lines of the record between 60 and 61 Hz"),
    ],
)
def test_modes_that_cannot_be_sought_are_refused_on_one_line(tmp_path, sweep_text, ambid, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    Path("sweep.csv").write_text(sweep_text, encoding="utf-8")
    found = ambid("frf", "sweep.csv", *words)
    assert (found.code, found.out, found.err.count("\n")) == (2, "", 1)
    assert said in found.err
