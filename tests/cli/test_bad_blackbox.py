"""Records, options and fit files that black-box commands have to refuse on one line, leaving nothing behind."""

import copy
import json

import numpy as np
import pytest
from scipy.signal import lfilter

HEADER = "time [s],u [V],y [A]"
N = 400
FIT = ("fit", "r.csv", "--input", "u", "--output", "y", "--structure", "arx")
ORDERS = ("--orders", "na=2,nb=2,nk=1")


def write(path, header, *columns):
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="")


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """A folder with r.csv: a plant of second order under white input and noise."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    t, u = np.arange(N) / 1000.0, rng.standard_normal(N)
    y = lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], u) + 0.1 * rng.standard_normal(N)
    write("r.csv", HEADER, t, u, y)
    write("loop.csv", "time [s],u [V],y [A],r [V]", t, u, y, u)
    write("units.csv", "time [s],u [A],y [m]", t, u, y)
    write("milli.csv", "time [ms],u [mV],y [mA]", 1e3 * t, 1e3 * u, 1e3 * y)
    write("slow.csv", HEADER, 2 * t, u, y)
    write("still.csv", HEADER, t, u, np.full(N, 3.0))
    write("twins.csv", "time [s],u [V],v [V],y [A]", t, u, u, y)
    write("tiny.csv", HEADER, t, u, 1e-300 * y)
    write("huge.csv", HEADER, t, 1e300 * u, y)
    return tmp_path


def refused(found, folder, *words):
    before = {p.name for p in folder.iterdir()}
    outcome = found(*words)
    assert outcome.code == 2, outcome
    assert outcome.out == ""
    assert outcome.err.startswith("ambid: ")
    assert outcome.err.count("\n") == 1
    assert {p.name for p in folder.iterdir()} == before
    return outcome.err


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--validate", "units.csv"), "'u' is in A in the second record, in V in the first"),
        (("--validate", "slow.csv"), "the second record is sampled at 500 Hz, the first at 1000 Hz"),
        (("--validate", "still.csv"), "'y' is constant in the second record"),
        (("--validate-from", "0.1"), "is now 'ambid validate RESULT RECORD' with --from and --to. Give that"),
        (("--criterion", "bicc"), "Did you mean 'bic'?"),
        (("--criterion", "aic"), "orders are given"),
        (("--input", "u"), "named twice"),
    ],
)
def test_options_that_contradict_the_data_or_each_other(bench, ambid, more, said):
    assert said in refused(ambid, bench, *FIT, *ORDERS, "--json", "out.json", *more)


def test_another_scale_of_the_same_unit_is_the_same_channel(bench, ambid):
    outcome = ambid(*FIT, *ORDERS, "--validate", "milli.csv", "--json", "-")
    fit = json.loads(outcome.out)
    assert fit["validation"]["one_step"]["fit"] == pytest.approx(fit["fit"]["one_step"], abs=1e-3)


@pytest.mark.parametrize("structure", ["arx", "n4sid", "pbsid", "fir"])
@pytest.mark.parametrize(
    ("record", "said"),
    [("tiny.csv", "'y' varies by only 2"), ("huge.csv", "'u' reaches 3"), ("twins.csv", "'u' and 'v'")],
)
def test_records_that_cannot_be_computed_with(bench, ambid, structure, record, said):
    more = ("--input", "v") if record == "twins.csv" else ()
    words = ("fit", record, "--input", "u", "--output", "y", "--structure", structure, *more)
    assert said in refused(ambid, bench, *words)


def edited(document, path, value):
    found = copy.deepcopy(document)
    place = found
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return found


@pytest.mark.parametrize(
    ("structure", "orders", "edits"),
    [
        (
            "arx",
            "na=2,nb=2,nk=1",
            [
                (("inputs",), "u"),
                (("offsets", "inputs", "u"), None),
                (("offsets", "outputs", "y"), 1e308),
                (("polynomials", "B"), [0.0, 1e308, 1.0]),
                (("polynomials", "B"), ["0", "1"]),
                (("noise_covariance",), [[-1.0]]),
                (("rate_hz",), "1000"),
                (("rate_hz",), True),
                (("units",), ["V"]),
                (("continuous_time",), 0),
            ],
        ),
        ("pbsid", "n=2", [(("state_space", "D"), 3.0), (("state_space", "B"), ["1", "2"])]),
    ],
)
def test_fit_files_that_were_edited(bench, ambid, structure, orders, edits):
    words = ("fit", "r.csv", "--input", "u", "--output", "y", "--structure", structure, "--orders", orders)
    assert ambid(*words, "--json", "fit.json").code == 0
    document = json.loads((bench / "fit.json").read_text())
    assert ambid("validate", "fit.json", "r.csv").code == 0
    for path, value in edits:
        (bench / "fit.json").write_text(json.dumps(edited(document, path, value)))
        assert "is not a complete fit" in refused(ambid, bench, "validate", "fit.json", "r.csv"), (path, value)


def test_a_fit_is_judged_on_its_own_units_only(bench, ambid):
    assert ambid(*FIT, *ORDERS, "--json", "fit.json").code == 0
    assert "in A in the second record" in refused(ambid, bench, "validate", "fit.json", "units.csv")
    assert "constant" in refused(ambid, bench, "validate", "fit.json", "still.csv")
    assert ambid("validate", "fit.json", "milli.csv").code == 0
