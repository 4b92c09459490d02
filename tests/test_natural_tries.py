"""Eighty things and more that one types into a notebook without reading: each works, or says on one line what does.

`WORKS` are tries that give what one expects; `SAYS` are tries that cannot mean anything, with words of the advice.
"""

from __future__ import annotations

import copy
import json
import pickle
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import ambid
from ambid.physics.presets import preset
from ambid.rig import preset_text

ARX = {"input": "voltage", "output": "current", "orders": "na=2,nb=2,nk=1"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """What the notebook holds."""

    folder: Path
    record: ambid.Record  # columns voltage, current, position
    second: ambid.Record
    csv: Path
    rig: Path  # of an unstable bearing, with its loop
    text: str  # of that rig
    looped: ambid.Record  # a record of it
    estimate: Any
    other: Any  # of the second record
    changed: Any  # of a machine with another magnet
    unstable: Any  # through the rig
    fit: Any
    track: Any
    response: Any

    @property
    def frame(self) -> pd.DataFrame:
        return self.record.to_dataframe()

    @property
    def voltage(self) -> np.ndarray:
        return self.record["voltage"].values


@pytest.fixture(scope="module")
def cell(tmp_path_factory) -> Cell:
    folder = tmp_path_factory.mktemp("tries")
    record, second = (ambid.simulate("thesis", duration=0.4, seed=s) for s in (1, 2))
    ambid.write_record(record, folder / "run.csv")
    text = preset_text(preset("unstable-bearing"))
    (folder / "bench.toml").write_text(text)
    looped = ambid.simulate("unstable-bearing", duration=0.4, seed=1)
    estimate, other, unstable = (
        ambid.identify(record),
        ambid.identify(second),
        ambid.identify(looped, folder / "bench.toml"),
    )
    estimate.save(folder / "e.json")
    thesis = preset_text(preset("thesis")).replace("-310.08", "-290.0")
    (folder / "changed.toml").write_text(thesis)
    return Cell(
        folder=folder, record=record, second=second, csv=folder / "run.csv", rig=folder / "bench.toml", text=text,
        looped=looped, estimate=estimate, other=other, unstable=unstable,
        changed=ambid.identify(ambid.simulate(folder / "changed.toml", duration=0.4, seed=3)),
        fit=ambid.fit(record, structure="arx", **ARX),
        track=ambid.track(ambid.simulate("thesis", duration=1.0, seed=1)),
        response=ambid.frf(record, input="voltage", output="current", method="random"),
    )  # fmt: skip


def same(found: Any, c: Cell) -> bool:
    return bool(np.isclose(found["k_i"].value, c.unstable["k_i"].value, rtol=1e-6))


def axes() -> Any:
    from matplotlib.figure import Figure

    return Figure().subplots()


def drawn(thing: Any, **how: Any) -> bool:
    """Whether a thing draws into axes that are given, and returns their figure."""
    a = axes()
    return thing.plot(ax=a, **how) is a.figure and bool(a.lines or a.collections or a.patches or a.containers)


def several(c: Cell) -> bool:
    from matplotlib.figure import Figure

    a = Figure().subplots(2)
    return c.record.plot(ax=a) is a[0].figure and bool(a[1].lines or a[1].collections)


WORKS: dict[str, Callable[[Cell], Any]] = {
    # load, read and save
    "load(csv)": lambda c: ambid.load(c.csv)["current"].unit == "A",
    "load(str)": lambda c: ambid.load(str(c.csv)).n_samples == 4000,
    "load(json)": lambda c: ambid.load(str(c.folder / "e.json"))["k_i"].value == c.estimate["k_i"].value,
    "load(toml)": lambda c: ambid.load(c.rig).parameter("k_i").name == "k_i",
    "record.save(csv)": lambda c: (
        (c.record.save(c.folder / "s.csv"), ambid.load(c.folder / "s.csv").n_samples)[1] == 4000
    ),
    "record.save(h5)": lambda c: (
        (c.record.save(str(c.folder / "s.h5")), ambid.load(c.folder / "s.h5").names)[1] == c.record.names
    ),
    "estimate.save(str)": lambda c: (c.estimate.save(str(c.folder / "s.json")), (c.folder / "s.json").exists())[1],
    "demo()": lambda c: abs(ambid.demo()["k_i"] / preset("unstable-bearing").parameters["k_i"] - 1) < 0.01,
    # a rig in any form
    "rig as path": lambda c: same(ambid.identify(c.looped, c.rig), c),
    "rig as str": lambda c: same(ambid.identify(c.looped, rig=str(c.rig)), c),
    "rig as Rig": lambda c: same(ambid.identify(c.looped, ambid.load_rig(c.rig)), c),
    "rig as text": lambda c: same(ambid.identify(c.looped, c.text), c),
    "rig as dict": lambda c: same(ambid.identify(c.looped, tomllib.loads(c.text)), c),
    "rig as a small dict": lambda c: (
        ambid.identify(c.record, {"parameters": {"m": {"value": 100, "unit": "g", "role": "fixed"}}})["m"].role
        == "fixed"
    ),
    "rig as a text of one line": lambda c: (
        ambid.identify(c.record, 'parameters.m = {value = 100, unit = "g", role = "fixed"}')["m"].value
        == pytest.approx(0.1)
    ),
    "init(table)": lambda c: (
        ambid.identify(
            {"u": c.voltage, "i": c.record["current"], "x": c.record["position"]},
            ambid.init({"u": c.voltage, "i": c.record["current"], "x": c.record["position"]}, rate_hz=1e4),
        )["k_i"].value
        == pytest.approx(c.estimate["k_i"].value, rel=1e-6)
    ),
    "init(csv)": lambda c: 'column = "voltage"' in ambid.init(c.csv),
    "info(rig=text)": lambda c: ambid.info(c.looped, c.text).channels,
    "fit(rig=dict)": lambda c: (
        ambid.fit(c.looped, "n4sid", orders="n=3", rig=tomllib.loads(c.text)).inputs == ("voltage",)
    ),
    "simulate(text)": lambda c: ambid.simulate(c.text, duration=0.01)["voltage"].std() > 0,
    "simulate(dict)": lambda c: ambid.simulate(tomllib.loads(c.text), duration=0.01)["position"].std() > 0,
    "track(rig=text)": lambda c: ambid.track(c.looped, c.text, start=0.2).lines,
    "margins(rig=text)": lambda c: ambid.margins(c.looped, c.text).verdict,
    "validate(rig=text)": lambda c: ambid.validate(c.unstable, c.looped, c.text).checks,
    # a record
    "record.current": lambda c: c.record.current.unit == "A",
    "record[names]": lambda c: c.record[["current", "voltage"]].names == ("current", "voltage"),
    "record.keys()": lambda c: list(c.record.keys()) == ["voltage", "current", "position"],
    "dict(record)": lambda c: dict(c.record)["current"].mean() == c.record["current"].mean(),
    "record.items()": lambda c: [n for n, _ in c.record.items()] == list(c.record.names),
    "np.asarray(record)": lambda c: np.asarray(c.record).shape == (4000, 3),
    "record.to_numpy()": lambda c: c.record.to_numpy().shape == (4000, 3),
    "record.units": lambda c: c.record.units["current"] == "A",
    "record.shape": lambda c: c.record.shape == (4000, 3),
    "channel.to(unit)": lambda c: c.record["current"].to("mA").max() == pytest.approx(1e3 * c.record["current"].max()),
    "channel > 0": lambda c: c.record["current"][c.record["current"] > 0].min() > 0,
    "np.std(channel)": lambda c: np.std(c.record["current"]) > 0,
    "diff of a channel": lambda c: np.diff(c.record["position"]).size == 3999,
    "welch of a channel": lambda c: (
        __import__("scipy.signal").signal.welch(c.record["current"], fs=c.record.rate_hz)[1].any()
    ),
    "a column into a DataFrame": lambda c: pd.DataFrame({"i": c.record["current"]}).shape == (4000, 1),
    "record's DataFrame and back": lambda c: ambid.Record.from_dataframe(c.frame).n_samples == 4000,
    "copy of a record": lambda c: copy.deepcopy(c.record)["current"].values[3] == c.record["current"].values[3],
    "pickle of a record": lambda c: pickle.loads(pickle.dumps(c.record)).names == c.record.names,
    "keys that Tab offers of a record": lambda c: c.record._ipython_key_completions_() == list(c.record.names),
    "names that Tab offers of a record": lambda c: "current" in dir(c.record) and "plot" in dir(c.record),
    # plots
    "record.plot()": lambda c: c.record.plot().savefig(c.folder / "r.png") is None,
    "record.plot(ax=)": lambda c: drawn(c.record),
    "estimate.plot(ax=)": lambda c: drawn(c.estimate),
    "fit.plot(ax=)": lambda c: drawn(c.fit),
    "track.plot(ax=)": lambda c: drawn(c.track),
    "frf.plot(ax=)": lambda c: drawn(c.response),
    "plot(ax=) of several": lambda c: (
        lambda a: c.record.plot(ax=a) is a[0].figure and (a[1].lines or a[1].collections)
    )(__import__("matplotlib.figure").figure.Figure().subplots(2)),
    "plot in a notebook": lambda c: c.estimate.plot()._repr_png_()[:4] == b"\x89PNG",
    # identify, and what an estimate gives
    "identify(DataFrame)": lambda c: ambid.identify(c.frame)["k_i"].value == pytest.approx(c.estimate["k_i"].value),
    "round(estimate[...], 3)": lambda c: round(c.estimate["R"], 3) == round(c.estimate["R"].value, 3),
    "fit(record, structure, [2, 2, 1])": lambda c: (
        ambid.fit(c.record, "arx", [2, 2, 1], input="voltage", output="current").orders["na"] == 2
    ),
    "float(parameter)": lambda c: float(c.estimate["k_i"]) == c.estimate["k_i"].value,
    "arithmetic of parameters": lambda c: (
        c.estimate["k_i"] / c.estimate["m"] == c.estimate["k_i"].value / c.estimate["m"].value
    ),
    "np.sqrt of a parameter": lambda c: np.sqrt(c.estimate["m"]) == np.sqrt(c.estimate["m"].value),
    "abs and round of a parameter": lambda c: abs(c.estimate["k_i"]) > 0 and round(float(c.estimate["k_i"])) < 0,
    "a parameter in an f-string": lambda c: f"{c.estimate['k_i']:.1f}" == f"{c.estimate['k_i'].value:.1f}",
    "parameter.to(unit)": lambda c: c.estimate["m"].to("g") == pytest.approx(1e3 * c.estimate["m"].value),
    "estimate.k_i": lambda c: c.estimate.k_i is c.estimate["k_i"],
    "dict(estimate)": lambda c: dict(c.estimate)["k_i"].sd == c.estimate["k_i"].sd,
    "estimate.keys()": lambda c: list(c.estimate.keys())[:1] == ["m"],
    "estimate.items()": lambda c: {n: p.value for n, p in c.estimate.items()} == c.estimate.values,
    "'k_i' in estimate": lambda c: "k_i" in c.estimate and "q" not in c.estimate,
    "estimate.covariance by name": lambda c: (
        c.estimate.covariance.loc["k_i", "k_i"] == pytest.approx(c.estimate["k_i"].sd ** 2)
    ),
    "np.diag(estimate.covariance)": lambda c: (np.diag(c.estimate.covariance) > 0).all(),
    "estimate.correlation": lambda c: (
        c.estimate.correlation.loc["m", "k_i"] == c.estimate.correlation["k_i"]["m"]
        and c.estimate.correlation.loc["m", "m"] == pytest.approx(1.0)
    ),
    "estimate.residuals": lambda c: (
        list(c.estimate.residuals.columns) == ["position [m]", "current [A]"] and len(c.estimate.residuals) > 3900
    ),
    "estimate.residuals by name": lambda c: (
        c.estimate.residuals.iloc[:, 1].std() == pytest.approx(c.estimate.fit["current"].innovation_sd, rel=0.05)
    ),
    "estimate.poles": lambda c: len(c.estimate.poles) == 3 and np.iscomplexobj(np.asarray(c.estimate.poles)),
    "poles of an unstable plant": lambda c: np.real(c.unstable.poles).max() > 0,
    "fit.poles": lambda c: len(c.fit.poles) == 2 and (np.abs(c.fit.poles) < 1).all(),
    "fit.residuals": lambda c: c.fit.residuals["current [A]"].std() > 0,
    "fit.correlation": lambda c: c.fit.correlation.loc["a1", "a1"] == pytest.approx(1.0),
    "estimate.to_dict()": lambda c: c.estimate.to_dict()["parameters"]["k_i"]["unit"] == "N/A",
    "json of an estimate": lambda c: json.loads(json.dumps(c.estimate.to_dict()))["schema"] == "ambid.estimate/1",
    "to_dict of a fit": lambda c: c.fit.to_dict()["structure"] == "arx",
    "copy of an estimate": lambda c: copy.deepcopy(c.estimate)["k_i"] == c.estimate["k_i"],
    "pickle of an estimate": lambda c: pickle.loads(pickle.dumps(c.estimate)).summary() == c.estimate.summary(),
    "pickle of a fit": lambda c: pickle.loads(pickle.dumps(c.fit)).summary() == c.fit.summary(),
    "keys that Tab offers of an estimate": lambda c: "k_i" in c.estimate._ipython_key_completions_(),
    "names that Tab offers of an estimate": lambda c: {"k_i", "residuals", "plot"} <= set(dir(c.estimate)),
    "print(estimate)": lambda c: "k_i" in str(c.estimate),
    "a rig in a cell": lambda c: len(repr(ambid.load_rig(c.rig))) < 400,
    # predict and simulate
    "predict(record, 10)": lambda c: np.nanstd(c.estimate.predict(c.second, 10)["current"]) > 0,
    "simulate(record)": lambda c: c.estimate.simulate(c.second)["current"].shape == (4000,),
    "simulate(DataFrame)": lambda c: np.allclose(
        c.estimate.simulate(c.frame)["current"], c.estimate.simulate(c.voltage)["current"]
    ),
    "simulate(channel)": lambda c: c.estimate.simulate(c.record["voltage"])["position"].shape == (4000,),
    "simulate(dict of arrays)": lambda c: c.estimate.simulate({"voltage": c.voltage})["position"].shape == (4000,),
    "simulate(file)": lambda c: c.estimate.simulate(c.csv)["position"].shape == (4000,),
    "fit.simulate(record)": lambda c: c.fit.simulate(c.second)["current"].shape == (4000,),
    "simulate('thesis', 0.1)": lambda c: ambid.simulate("thesis", 0.1, seed=1).n_samples == 1000,
    "simulate(estimate)": lambda c: ambid.simulate(c.unstable, 0.05, amplitude=0.1)["position"].std() < 1e-3,
    "validate two files": lambda c: ambid.validate(c.folder / "e.json", str(c.csv)).verdict,
    # fit
    "fit(record, 'arx')": lambda c: ambid.fit(c.record[0:0.1], "arx", orders="na=2,nb=2,nk=1").outputs,
    "fit with orders in a list": lambda c: (
        ambid.fit(c.record, "arx", input="voltage", output="current", orders=[2, 2, 1]).model.theta
        == pytest.approx(c.fit.model.theta)
    ),
    "fit with one order": lambda c: (
        ambid.fit(c.record, "n4sid", input="voltage", output="current", orders=2).orders["n"] == 2
    ),
    "fit('ARX')": lambda c: ambid.fit(c.record, "ARX", **ARX).structure == "arx",
    "fit['a1']": lambda c: float(c.fit["a1"]) == c.fit["a1"].value,
    "fit.to_control()": lambda c: c.fit.to_control().dt == pytest.approx(1e-4),
    # compare
    "compare(a, b)": lambda c: ambid.compare(c.estimate, c.other).passed,
    "compare([a, b])": lambda c: ambid.compare([c.estimate, c.other]).to_dataframe().shape[0] >= 5,
    "compare(dict)": lambda c: "Monday" in ambid.compare({"Monday": c.estimate, "Tuesday": c.other}).summary(),
    "compare(files)": lambda c: ambid.compare(c.folder / "e.json", c.other).passed,
    "compare finds another magnet": lambda c: not ambid.compare(c.estimate, c.changed).passed,
    "compare(record, candidates)": lambda c: ambid.compare(
        c.record, ["arx:na=2,nb=2,nk=1"], input="voltage", output="current"
    ),
    "frf(record, 'voltage', 'current')": lambda c: ambid.frf(c.record, "voltage", "current", method="random").response,
    "track['k_i']": lambda c: c.track["k_i"].values[-1] == pytest.approx(-310, rel=0.05),
    "ambid.preset_names()": lambda c: "thesis" in ambid.preset_names(),
    "names that Tab offers": lambda c: {"demo", "compare", "load", "identify"} <= set(dir(ambid)) & set(ambid.__all__),
}

SAYS: dict[str, tuple[Callable[[Cell], Any], str]] = {
    "a verb with a slip": (lambda c: ambid.indentify, "Did you mean 'identify'"),
    "tfest": (lambda c: ambid.tfest, "ambid.frf"),
    "greyest": (lambda c: ambid.greyest, "ambid.identify"),
    "iddata": (lambda c: ambid.iddata, "Record"),
    "n4sid": (lambda c: ambid.n4sid, r"ambid.fit\(record, 'n4sid'\)"),
    "read_csv": (lambda c: ambid.read_csv, "read_record|ambid.load"),
    "an option of the command": (lambda c: ambid.identify(c.record, rate=1e4), "rate_hz"),
    "json=": (lambda c: ambid.identify(c.record, json="e.json"), r"save\("),
    "nonlinear=": (lambda c: ambid.identify(c.record, nonlinear=True), "ambid.identify_nonlinear"),
    "an argument with a slip": (lambda c: ambid.fit(c.record, "arx", inputs="voltage"), "Did you mean 'input'"),
    "text as time": (lambda c: ambid.identify(c.record, from_s="0.1 s"), "from_s"),
    "a role that is none": (
        lambda c: ambid.fit(c.looped, "arx", input="u", output="i", rig=c.rig),
        "^(?!.*--)input.*omit input",
    ),
    "names that are none of the roles": (
        lambda c: ambid.identify({"u [V]": c.voltage, "i [A]": c.voltage}, rate_hz=1e4),
        "Let ambid.init draft a rig",
    ),
    "columns as arguments": (lambda c: ambid.identify(voltage=c.voltage, rate_hz=1e4), r"a dict as record"),
    "fix=": (lambda c: ambid.identify(c.record, fix={"R": 4.0}), "'role': 'fixed'"),
    "model=": (lambda c: ambid.identify(c.record, model="coil"), r"rig=\{'model'"),
    "na=": (lambda c: ambid.fit(c.record, "arx", na=2, nb=2), "orders='na=2"),
    "two records": (lambda c: ambid.compare(c.record, c.second), "ambid.identify returns of each"),
    "estimate.cov": (lambda c: c.estimate.cov, "Write covariance"),
    "estimate.transfer_function": (lambda c: c.estimate.transfer_function, "to_control"),
    "record.copy()": (lambda c: c.record.copy(), "to_dataframe"),
    "ambid.version": (lambda c: ambid.version, "__version__"),
    "a file that is not there": (lambda c: ambid.load("nothing.csv"), "nothing.csv"),
    "a rig that is not there": (lambda c: ambid.identify(c.record, "nothing.toml"), "nothing.toml"),
    "a rig with a slip": (lambda c: ambid.identify(c.record, {"parameter": {}}), "Did you mean 'parameters'"),
    "a rig that is a number": (lambda c: ambid.identify(c.record, 3), "rig is 3"),
    "an array": (lambda c: ambid.identify(np.zeros((100, 3))), "dict of arrays"),
    "a structure that is none": (lambda c: ambid.fit(c.record, "n4sd"), "Did you mean 'n4sid'"),
    "fit without columns": (lambda c: ambid.fit({"u [V]": c.voltage, "i [A]": c.voltage}, "arx", rate_hz=1e4), "input"),
    "an attribute that is none": (lambda c: c.estimate.k_j, "Did you mean 'k_i'"),
    "record.fs": (lambda c: c.record.fs, "rate_hz"),
    "record.time": (lambda c: c.record.time, "time_s"),
    "record.iloc": (lambda c: c.record.iloc, "to_dataframe"),
    "seconds of a channel": (lambda c: c.record["current"][0.1:0.2], r"record\[0.1:0.2\]"),
    "a unit of another kind": (lambda c: c.record["current"].to("mm"), "mm"),
    "fit.polynomials": (lambda c: c.fit.polynomials, r"to_dict\(\)\['polynomials'\]"),
    "frequencies of a response": (lambda c: c.response.frequency_hz, "response.frequency_hz"),
    "bode of an estimate": (lambda c: c.estimate.bode(), "to_control"),
    "compare one estimate": (lambda c: ambid.compare(c.estimate), "two"),
    "compare a record and an estimate": (lambda c: ambid.compare(c.record, c.estimate), "validate"),
    "an unstable plant alone": (lambda c: ambid.identify(c.looped).simulate(c.looped["voltage"]), "unstable"),
}


@pytest.mark.parametrize("line", WORKS)
def test_what_one_types_works(line, cell):
    found = WORKS[line](cell)
    assert found is None or bool(found)


@pytest.mark.parametrize("line", SAYS)
def test_what_cannot_be_says_what_can(line, cell):
    tried, said = SAYS[line]
    with pytest.raises((ambid.AmbidError, AttributeError, TypeError), match=said) as refused:
        tried(cell)
    assert "\n" not in str(refused.value)


def test_there_are_more_than_eighty():
    assert len(WORKS) + len(SAYS) >= 130


def test_nothing_is_shown_by_itself(cell):
    """No figure is registered with pyplot, and no backend is chosen."""
    from matplotlib import pyplot

    before = pyplot.get_fignums()
    cell.estimate.plot()
    cell.record.plot()
    assert pyplot.get_fignums() == before


def test_an_unstable_plant_runs_in_its_loop(cell):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = cell.unstable.simulate(0.1 * np.sin(np.arange(2000) / 50))
    assert any("unstable" in str(w.message) and "loop" in str(w.message) for w in told)
    assert np.abs(found["position"]).max() < 1e-3
