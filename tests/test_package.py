"""The package as a notebook uses it: the functions of the commands, and results by the names of their parameters."""

import pytest

import ambid
from ambid.errors import AmbidError


@pytest.fixture(scope="module")
def record():
    return ambid.simulate("thesis", duration=0.5, seed=2)


@pytest.fixture(scope="module")
def estimate(record):
    return ambid.identify(record)


def test_what_the_commands_do_stands_in_the_package():
    for name in ("identify", "fit", "frf", "compare", "simulate", "track", "load", "validate", "acquire"):
        assert callable(getattr(ambid, name)), name
        assert name in ambid.__all__
        assert ">>> " in getattr(ambid, name).__doc__ or "Parameters" in getattr(ambid, name).__doc__


def test_a_parameter_is_asked_for_by_its_name(estimate):
    k_i = estimate["k_i"]
    assert k_i.ci95[0] < -310.08 < k_i.ci95[1]
    assert k_i.sd > 0
    with pytest.raises(AmbidError, match="k_i"):
        estimate["k_j"]


def test_the_verdict_is_a_word_with_reasons(estimate):
    assert estimate.verdict.word == "usable"
    assert estimate.verdict.reasons == ()


def test_a_result_comes_back_from_its_file(estimate, tmp_path):
    path = tmp_path / "e.json"
    path.write_text(estimate.dumps())
    again = ambid.load(path)
    assert again["R"] == estimate["R"]
    assert again.verdict == estimate.verdict


def test_equal_seeds_give_equal_records(record):
    again = ambid.simulate("thesis", duration=0.5, seed=2)
    assert (again["current"] == record["current"]).all()
    assert (ambid.simulate("thesis", duration=0.5, seed=3)["current"] != record["current"]).any()


def test_the_functions_are_not_hidden_by_rooms(estimate, record):
    """Importing a room makes it an attribute of the package: none may bear a function's name."""
    import ambid.acquisition
    import ambid.simulation
    import ambid.tracking

    assert callable(ambid.simulate)
    assert callable(ambid.track)
    fit = ambid.fit(record, structure="arx", orders={"na": 2, "nb": 2, "nk": 1}, input="voltage", output="current")
    assert fit.verdict.word in ("usable", "caution", "unusable")
