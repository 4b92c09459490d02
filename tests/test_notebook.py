"""What a person tries in the first hour of a notebook: each line as it comes to mind, and all of them work."""

from __future__ import annotations

import contextlib
import inspect
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import polars as pl
import pytest
import xarray as xr

import ambid
from ambid.physics.presets import preset
from ambid.rig import preset_text

ARX = {"structure": "arx", "input": "voltage", "output": "current", "orders": "na=2,nb=2,nk=1"}
COLUMNS = (
    ('"voltage"\ndelay = "auto"', '"u"\ndelay = 0'),
    ('"position"', '"x"\ngain = 1e-3\noffset = 2e-4'),
    ('"current"', '"i"\ngain = -0.5'),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """What a notebook holds after its first cells."""

    csv: Path  # a record in the columns of the rig, uncalibrated
    rig: Path
    raw: ambid.Record
    record: ambid.Record  # named by role, SI
    second: ambid.Record
    frame: pd.DataFrame
    arrays: dict[str, np.ndarray]
    estimate: Any
    fit: Any
    track: Any
    response: Any
    comparison: Any
    folder: Path


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Session:
    folder = tmp_path_factory.mktemp("notebook")
    text = preset_text(preset("thesis"))
    for old, new in COLUMNS:
        text = text.replace(f"column = {old}", f"column = {new}")
    rig = folder / "bench.toml"
    rig.write_text(text)
    raw = ambid.simulate(rig, duration=0.4, seed=1)
    ambid.write_record(raw, folder / "run.csv")
    record, second = (ambid.simulate("thesis", duration=0.4, seed=s) for s in (1, 2))
    return Session(
        csv=folder / "run.csv", rig=rig, raw=raw, record=record, second=second, frame=record.to_dataframe(),
        arrays={name: record[name].values for name in record}, estimate=ambid.identify(record),
        fit=ambid.fit(record, **ARX), track=ambid.track(ambid.simulate("thesis", duration=1.0, seed=1)),
        response=ambid.frf(record[0.0:0.2], input="voltage", output="current", method="random"),
        comparison=ambid.compare(record, ["arx:na=2,nb=2,nk=1", "oe:nb=2,nf=2,nk=1"], input="voltage",
                                 output="current"), folder=folder,
    )  # fmt: skip


def same(found: Any, s: Session) -> bool:
    """Whether an identification found what that of the record found, to the last digits."""
    return bool(np.isclose(found["k_i"].value, s.estimate["k_i"].value, rtol=1e-9))


def through(found: Any, s: Session) -> bool:
    """Whether an identification through the rig found its bench."""
    return bool(abs(found["k_i"].value + 310.08) < 4 * found["k_i"].sd < 4.0)


def beside(s: Session) -> dict[str, str]:
    return {c.name: c.unit for c in s.record.channels}


TRIES: dict[str, Callable[[Session], Any]] = {
    # sources
    "identify a file": lambda s: through(ambid.identify(s.csv, s.rig), s),
    "identify a file by its name": lambda s: through(ambid.identify(str(s.csv), str(s.rig)), s),
    "identify a record that was read": lambda s: through(ambid.identify(ambid.read_record(s.csv), s.rig), s),
    "identify a record without a rig": lambda s: same(ambid.identify(s.record), s),
    "identify with a rig that was loaded": lambda s: through(ambid.identify(s.raw, ambid.load_rig(s.rig)), s),
    "identify what went through the rig": lambda s: through(ambid.identify(ambid.read_bench(s.csv, s.rig), s.rig), s),
    "identify a DataFrame": lambda s: same(ambid.identify(s.frame), s),
    "identify a DataFrame through a rig": lambda s: through(ambid.identify(s.raw.to_dataframe(), s.rig), s),
    "identify what pandas reads": lambda s: through(ambid.identify(pd.read_csv(s.csv), s.rig), s),
    "identify what polars reads": lambda s: through(ambid.identify(pl.read_csv(s.csv), s.rig), s),
    "identify a Dataset": lambda s: same(ambid.identify(s.record.to_xarray()), s),
    "identify arrays": lambda s: same(ambid.identify(s.arrays, rate_hz=1e4, units=beside(s)), s),
    "identify arrays with units in their names": lambda s: same(
        ambid.identify({f"{n} [{s.record[n].unit}]": x for n, x in s.arrays.items()}, rate_hz=1e4), s
    ),
    "identify channels": lambda s: same(ambid.identify({n: s.record[n] for n in s.record}, rate_hz=1e4), s),
    "identify a part": lambda s: ambid.identify(s.record[0.1:0.3]).record["samples"] == 2000,
    "identify a part by its words": lambda s: ambid.identify(s.frame, from_s=0.1, to_s=0.3).record["samples"] == 2000,
    "validate meanwhile": lambda s: ambid.identify(s.record, validate=s.second.to_dataframe()).validation["passed"],
    "fit": lambda s: ambid.fit(s.record, **ARX).model.theta == pytest.approx(s.fit.model.theta),
    "fit a DataFrame": lambda s: ambid.fit(s.frame, **ARX).model.theta == pytest.approx(s.fit.model.theta),
    "fit with orders by name": lambda s: ambid.fit(
        s.record, structure="arx", input=["voltage"], output=["current"], orders={"na": 2, "nb": 2, "nk": 1}
    ).model.theta == pytest.approx(s.fit.model.theta),
    "fit through a rig": lambda s: ambid.fit(s.csv, structure="n4sid", orders="n=3", rig=s.rig).inputs == ("voltage",),
    "fit what it chooses itself": lambda s: ambid.fit(
        s.record[0.0:0.1], structure="arx", input="voltage", output="current"
    ).orders,
    "frf of a DataFrame": lambda s: ambid.frf(
        s.frame, input="voltage", output="current", method="random", orders="nf=3,nb=2"
    ).fit is not None,
    "compare by words": lambda s: {e.structure for e in s.comparison.entries} == {"arx", "oe"},
    "track a DataFrame": lambda s: ambid.track(
        s.frame, method="rls", input="voltage", output="current", orders="na=2,nb=2,nk=1"
    ).lines,
    "simulate a preset": lambda s: ambid.simulate("levitated-ball", duration=0.1, seed=1).n_samples == 200,
    "simulate a rig": lambda s: ambid.simulate(str(s.rig), duration=0.01).names == ("u", "x", "i"),
    "simulate an estimate": lambda s: ambid.simulate(s.estimate, duration=0.01, amplitude=1.0)["current"].std() > 0,
    "validate an estimate": lambda s: ambid.validate(s.estimate, s.second).passed,
    # records
    "a channel's values": lambda s: s.record["current"].values.shape == (4000,),
    "a channel's unit": lambda s: s.record["current"].unit == "A",
    "a channel as an array": lambda s: np.asarray(s.record["current"]).dtype == np.float64,
    "arithmetic of channels": lambda s: (s.record["voltage"] * s.record["current"] - 1.0).shape == (4000,),
    "a channel's mean": lambda s: s.record["current"].mean() == np.mean(s.record["current"]),
    "samples of a channel": lambda s: len(s.record["current"][:10]) == 10,
    "seconds of a record": lambda s: (s.record[0.1:0.3].start_s, s.record[0.1:0.3].n_samples) == (0.1, 2000),
    "the end of a record": lambda s: s.record[0.3:].n_samples == s.record[:0.1].n_samples == 1000,
    "the rate": lambda s: s.record.rate_hz == 1e4,
    "names of a record": lambda s: list(s.record) == ["voltage", "current", "position"],
    "whether a channel is there": lambda s: "current" in s.record and "gap" not in s.record,
    "length of a record": lambda s: len(s.record) == 4000,
    "a record on one line": lambda s: "4000 samples" in repr(s.record) and "\n" not in repr(s.record),
    "a record in a notebook": lambda s: "<td>current</td><td>A</td>" in s.record._repr_html_(),
    "a channel on one line": lambda s: repr(s.record["current"]) == "Channel current [A], 4000 samples",
    "a record as a DataFrame": lambda s: list(s.frame.columns) == [f"{c.name} [{c.unit}]" for c in s.record.channels],
    "a record from a DataFrame": lambda s: (
        ambid.Record.from_dataframe(s.frame)["current"] == s.arrays["current"]
    ).all(),
    "a record as a Dataset": lambda s: isinstance(s.record.to_xarray(), xr.Dataset)
    and s.record.to_xarray()["current"].attrs["units"] == "A",
    "a table with the current in mA": lambda s: ambid.read_record(
        s.frame.rename(columns={"current [A]": "current [mA]"})
    )["current"].values == pytest.approx(1e-3 * s.arrays["current"]),
    "what a record holds": lambda s: len(ambid.info(s.frame).channels) == 3,
    "what a file holds": lambda s: "current" in ambid.info(s.csv, s.rig).summary(),
    # results
    "a parameter": lambda s: s.estimate["k_i"].ci95[0] < -310.08 < s.estimate["k_i"].ci95[1],
    "its standard deviation": lambda s: s.estimate["k_i"].sd > 0,
    "the verdict": lambda s: s.estimate.verdict.word == "usable" and not s.estimate.verdict.reasons,
    "the summary": lambda s: "k_i" in s.estimate.summary(),
    "an estimate on one line": lambda s: "\n" not in repr(s.estimate) and len(repr(s.estimate)) < 400,
    "an estimate in a notebook": lambda s: "<table" in s.estimate._repr_html_(),
    "an estimate as a table": lambda s: s.estimate.to_dataframe().loc["k_i", "value"] == s.estimate["k_i"].value,
    "predictions": lambda s: set(s.estimate.predict(s.second, ahead=10)) == {"position", "current"},
    "predictions of a table": lambda s: np.nanstd(s.estimate.predict(s.second.to_dataframe())["current"]) > 0,
    "simulate with inputs": lambda s: s.estimate.simulate(s.arrays["voltage"])["current"].shape == (4000,),
    "judge on another record": lambda s: s.estimate.validate(s.second).passed,
    "python-control": lambda s: s.estimate.to_control().nstates == 3,
    "parameter on one line": lambda s: repr(s.estimate["k_i"]).startswith("<k_i = "),
    "a fit on one line": lambda s: "arx" in repr(s.fit),
    "a fit's table": lambda s: len(s.fit.to_dataframe()) >= 4,
    "a fit's summary": lambda s: "arx" in s.fit.summary(),
    "a fit predicts": lambda s: np.nanstd(s.fit.predict(s.second)["current"]) > 0,
    "a track's table": lambda s: len(s.track.to_dataframe()) == len(s.track.lines),
    "a track's summary": lambda s: "k_i" in s.track.summary(),
    "a response's table": lambda s: len(s.response.to_dataframe()) == s.response.response.frequency_hz.size,
    "a response's summary": lambda s: s.response.summary(),
    "a comparison's table": lambda s: len(s.comparison.to_dataframe()) == 2,
    # the package
    "completion": lambda s: {"identify", "fit", "frf", "track", "simulate", "compare", "load"} <= set(dir(ambid)),
    "completion of a record": lambda s: {"to_dataframe", "to_xarray", "rate_hz"} <= set(dir(s.record)),
    "parameters of simulate": lambda s: "duration" in inspect.signature(ambid.simulate).parameters,
}  # fmt: skip


@pytest.mark.parametrize("line", TRIES)
def test_what_comes_to_mind_works(line, session):
    assert TRIES[line](session)


def test_equal_seeds_give_equal_records(session):
    again = ambid.simulate("thesis", duration=0.4, seed=1)
    assert (again["current"] == session.record["current"]).all()
    assert (session.second["current"] != session.record["current"]).any()


def test_the_functions_are_not_hidden_by_rooms():
    """Importing a room makes it an attribute of the package: none may bear a function's name."""
    import ambid.acquisition
    import ambid.simulation
    import ambid.tracking
    import ambid.validation

    assert all(callable(getattr(ambid, name)) and name in ambid.__all__ for name in FUNCTIONS)


@pytest.mark.parametrize("kind", ["estimate", "fit"])
def test_results_are_saved_and_loaded(kind, session):
    result = getattr(session, kind)
    result.save(session.folder / f"{kind}.json")
    again = ambid.load(session.folder / f"{kind}.json")
    assert again.summary() == result.summary()
    assert again.verdict == result.verdict
    assert again.to_dataframe().equals(result.to_dataframe())


@pytest.mark.parametrize("kind", ["record", "estimate", "fit", "track", "response"])
def test_plot_returns_a_figure(kind, session):
    from matplotlib import pyplot
    from matplotlib.figure import Figure

    assert isinstance(getattr(session, kind).plot(), Figure)
    pyplot.close("all")


def test_a_report_is_written(session):
    session.estimate.report(session.folder / "r.html")
    assert "k_i" in (session.folder / "r.html").read_text()


FUNCTIONS = (
    "identify",
    "identify_nonlinear",
    "fit",
    "frf",
    "compare",
    "simulate",
    "track",
    "validate",
    "load",
    "acquire",
    "info",
)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_help_names_every_parameter(name):
    function = getattr(ambid, name)
    found = inspect.signature(function).parameters.values()
    assert not [p.name for p in found if p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    written = io.StringIO()
    with contextlib.redirect_stdout(written):
        help(function)
    words = written.getvalue().replace(":", " ").replace(",", " ").split()
    assert not [p.name for p in found if p.name not in words]


REFUSED: dict[str, tuple[Callable[[Session], Any], str]] = {
    "a parameter that is none": (lambda s: s.estimate["k_j"], "k_i"),
    "a channel that is none": (lambda s: s.record["curent"], "Did you mean 'current'"),
    "a number": (lambda s: s.record[3], r"\[3\].*by name.*seconds"),
    "a step": (lambda s: s.record[0.1:0.2:0.01], "0.1:0.2:0.01"),
    "text as time": (lambda s: s.record["0.1":"0.2"], "seconds"),
    "a part outside": (lambda s: s.record[0.3:9.0], "0 to 0.4 s"),
    "a part reversed": (lambda s: s.record[0.3:0.1], "from must lie before to"),
    "another bench's roles": (lambda s: ambid.identify(s.record, s.rig), "no column 'u'"),
    "columns without units": (
        lambda s: ambid.identify(s.arrays, rate_hz=1e4), r"column 'voltage' has no unit.*'voltage \[unit\]'"
    ),
    "no rate": (lambda s: ambid.identify(s.arrays, units=beside(s)), "no rate is given"),
    "two records": (lambda s: ambid.identify([s.record, s.record]), "the linear model takes one"),
    "an array": (lambda s: ambid.fit(s.arrays["current"], **ARX), "dict of arrays"),
    "orders that are none": (lambda s: ambid.fit(s.record, **{**ARX, "orders": "na=two"}), "NAME=NUMBER"),
    "a rate beside a record": (lambda s: ambid.identify(s.record, rate_hz=5e3), "10000 Hz but rate_hz"),
}  # fmt: skip


@pytest.mark.parametrize("line", REFUSED)
def test_what_cannot_be_is_refused_on_one_line(line, session):
    tried, said = REFUSED[line]
    with pytest.raises(ambid.AmbidError, match=said) as refused:
        tried(session)
    assert "\n" not in str(refused.value)


def test_a_calibration_is_applied_once(session):
    once = ambid.read_bench(session.csv, ambid.load_rig(session.rig))
    for again in (ambid.read_bench(once, ambid.load_rig(session.rig)), ambid.read_bench(once[0.1:], session.rig)):
        assert again["position"].values[-1] == once["position"].values[-1]
    lacks = replace(once, channels=tuple(c for c in once.channels if c.name != "position"))
    with pytest.raises(ambid.AmbidError, match=r"went through a rig already.*'position' is not there"):
        ambid.identify(lacks, session.rig)


def test_a_record_is_acquired_and_never_written_over(tmp_path):
    rig, told = tmp_path / "bench.toml", list[str]()
    rig.write_text(preset_text(preset("prototype")))
    played = {"seconds": 1.0, "excitation": "prbs", "amplitude": 0.5, "on_note": told.append}
    done = ambid.acquire("simulated", rig, tmp_path / "run.h5", **played)
    assert done.record["excitation"].max() == pytest.approx(0.5, rel=0.05)
    assert done.record.n_samples == 2000
    assert any(line.startswith("voltage:") for line in told)  # what the rig does not say is assumed, and told
    with pytest.raises(ambid.AmbidError, match="already exists"):
        ambid.acquire("simulated", rig, tmp_path / "run.h5", **played)
    with pytest.raises(ambid.AmbidError, match="nothing can be excited"):
        ambid.acquire("simulated", rig, tmp_path / "other.h5", **played, mode="sample")


def test_what_a_simulation_meets_is_said():
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        ambid.simulate("thesis", duration=0.02, amplitude=60.0)
    assert any("limited" in str(w.message) for w in told)
