"""A rotor for other programs: python-control, MATLAB, and a script for ROSS that is run against a stand-in of it."""

from __future__ import annotations

import json
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.io import loadmat

import ambid
from ambid.errors import AmbidError, EstimationError
from ambid.rotor.estimate import RotorEstimate
from tests.job.exported import assert_agree, needs_compiler, runs_of_exports
from tests.rotor_benches import free_rig, needs_simulator, record_of, truth

pytestmark = needs_simulator


@pytest.fixture(scope="module")
def bench() -> Any:
    return replace(truth.BENCHES["rigid-spin"], period=0.25, periods=4)


@pytest.fixture(scope="module")
def estimate(bench: Any) -> RotorEstimate:
    found = ambid.identify(record_of(bench, 5), free_rig(bench))
    assert isinstance(found, RotorEstimate)
    return found


def _built(
    path: Path, monkeypatch: pytest.MonkeyPatch, version: str = "2.3.0"
) -> tuple[dict[str, Any], dict[str, list[dict[str, Any]]]]:
    """Run a script with a stand-in for a version of ROSS; return its names, and what it made of each kind."""
    made: dict[str, list[dict[str, Any]]] = {
        "Material": [],
        "ShaftElement": [],
        "DiskElement": [],
        "BearingElement": [],
    }
    parts = {kind: lambda kind=kind, **words: made[kind].append(words) or words for kind in made}
    ross = SimpleNamespace(**parts, Rotor=lambda *parts: parts, __version__=version)
    monkeypatch.setitem(sys.modules, "ross", ross)  # type: ignore[arg-type]
    names: dict[str, Any] = {"__name__": "script"}
    exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), names)
    names["rotor"]()
    return names, made


def test_the_script_for_ross_holds_the_rotor_with_synchronous_bearings(
    bench: Any, estimate: RotorEstimate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimate.export(tmp_path / "r.py")
    names, made = _built(tmp_path / "r.py", monkeypatch)
    assert "synchronous" in names["__doc__"]
    (disc,) = made["DiskElement"]
    assert (disc["m"], disc["Id"], disc["Ip"]) == (estimate["m"].value, estimate["Id"].value, estimate["Ip"].value)
    span = estimate.numbers["B.z_sensor"] - estimate.numbers["A.z_sensor"]
    assert sum(e["L"] for e in made["ShaftElement"]) == pytest.approx(span)
    f = np.array([bench.rpm / 60.0])
    for one, stiffness in zip(made["BearingElement"], _stiffness(bench, f), strict=True):
        for plane, wanted in zip("xy", stiffness, strict=True):
            assert one[f"k{plane}{plane}"] == pytest.approx(wanted[0].real, rel=0.03)
            assert one[f"c{plane}{plane}"] == pytest.approx(wanted[0].imag / (2.0 * np.pi * f[0]), rel=0.03)
    A, B, C = names["state_space"]()
    np.testing.assert_array_equal(A, estimate.continuous.A)
    assert B.shape[1] == len(names["INPUTS"])
    assert C.shape[0] == len(names["OUTPUTS"])


def _stiffness(bench: Any, f: Any) -> Any:
    """-force over motion of each axis of two bearings at frequencies in Hz, by the numbers of the bench, (2, 2, n)."""
    s, late = 2j * np.pi * f, np.exp(-2j * np.pi * f * (bench.delay + 0.5) / bench.rate)
    back = bench.kc * truth.controller_frf(bench, f) * late
    found = [
        bench.k_x[j]
        + bench.k_i[j] * (back + bench.k_i[j] * s) / (bench.R[j] + bench.L[j] * s + bench.kc * late)
        for j in range(4)
    ]  # fmt: skip
    return np.array(found).reshape(2, 2, -1)


def test_the_bearings_for_ross_3_are_tables_over_whirl_frequency_and_speed(
    bench: Any, estimate: RotorEstimate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimate.export(tmp_path / "r.py")
    _, made = _built(tmp_path / "r.py", monkeypatch, "3.1.0")
    f = np.array([15.0, 40.0, 110.0, 300.0, 900.0])  # ROSS 3 interpolates monotonically between what the table holds
    for one, stiffness in zip(made["BearingElement"], _stiffness(bench, f), strict=True):
        assert "speed" not in one
        for plane, wanted in zip("xy", stiffness, strict=True):
            k, c = (PchipInterpolator(one["frequency"], one[f"{x}{plane}{plane}"])(2.0 * np.pi * f) for x in "kc")
            np.testing.assert_allclose(k + 2j * np.pi * f * c, wanted, rtol=0.03)
    assert estimate.used is not None
    slower = {**estimate.records[0], "speed": 900.0}
    replace(estimate, records=(*estimate.records, slower), used=estimate.used * 2).export(tmp_path / "r.py")
    names, made = _built(tmp_path / "r.py", monkeypatch, "3.1.0")
    one = made["BearingElement"][0]
    assert one["speed"] == names["SPEEDS"] == [900.0, estimate.speed]
    assert np.shape(one["kxx"]) == np.shape(one["cyy"]) == (2, len(one["frequency"]))
    kept = names["WHIRL"].index(estimate.speed)
    assert _built(tmp_path / "r.py", monkeypatch)[1]["BearingElement"][0]["kxx"] == one["kxx"][1][kept]


def test_an_estimate_without_its_record_knows_no_controller(
    estimate: RotorEstimate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimate.save(tmp_path / "e.json")
    ambid.load(tmp_path / "e.json").export(tmp_path / "r.py")
    names, made = _built(tmp_path / "r.py", monkeypatch)
    assert "the magnets alone" in names["__doc__"]
    assert made["BearingElement"][0]["kxx"] == pytest.approx(estimate["ax.k_x"].value)
    assert made["BearingElement"][0]["cxx"] == 0.0


def test_matlab_reads_the_plant_and_the_numbers(estimate: RotorEstimate, tmp_path: Path) -> None:
    estimate.export(tmp_path / "r.mat")
    found = loadmat(tmp_path / "r.mat", squeeze_me=True)
    np.testing.assert_array_equal(found["A"], estimate.continuous.A)
    assert list(found["inputs"]) == list(estimate.plant.inputs)
    at = list(found["parameters"]).index("ax.k_i")
    assert (found["value"][at], found["sd"][at]) == (estimate["ax.k_i"].value, estimate["ax.k_i"].sd)
    assert list(found["delay_samples"]) == [1.0] * 4


def test_python_control_gets_named_signals(estimate: RotorEstimate) -> None:
    pytest.importorskip("control")
    plant = estimate.to_control()
    assert plant.input_labels == list(estimate.plant.inputs)
    assert plant.output_labels == list(estimate.plant.outputs)


@needs_compiler
def test_all_exports_of_a_rotor_agree(estimate: RotorEstimate, tmp_path: Path) -> None:
    late = replace(estimate.delay["by_voltage"], samples=2, fraction=0.3)
    estimate = replace(estimate, delay={**estimate.delay, "by_voltage": late})
    u = np.random.default_rng(1).standard_normal((40, 4))
    assert_agree(runs_of_exports(estimate, tmp_path, u))


def test_a_rotor_is_an_fmu_and_a_script_for_python_control(estimate: RotorEstimate, tmp_path: Path) -> None:
    fmpy = pytest.importorskip("fmpy")
    pytest.importorskip("control")
    estimate.export(tmp_path / "r.fmu")
    validation = pytest.importorskip("fmpy.validation")
    assert validation.validate_fmu(str(tmp_path / "r.fmu")) == []
    told = fmpy.read_model_description(str(tmp_path / "r.fmu"))
    assert [v.name for v in told.modelVariables if v.causality == "output"] == list(estimate.plant.outputs)
    assert f"{estimate.speed:.6g} rad/s" in told.description
    estimate.export(tmp_path / "r.py", to="control")
    system = runpy.run_path(str(tmp_path / "r.py"))["plant"]()
    np.testing.assert_array_equal(system.A, estimate.continuous.A)
    assert system.input_labels == list(estimate.plant.inputs)


def test_other_endings_and_results_are_refused(estimate: RotorEstimate, tmp_path: Path) -> None:
    with pytest.raises(AmbidError, match=r"\.mat or \.py"):
        estimate.export(tmp_path / "r.txt")
    axis = ambid.identify(ambid.simulate("thesis", duration=0.5, seed=1))
    with pytest.raises(EstimationError, match="holds a rotor"):
        axis.export(tmp_path / "r.py", to="ross")
    axis.export(tmp_path / "r.mat")


@pytest.mark.parametrize(("value", "said"), [(None, "numbers.m is missing"), (-6.2, "numbers.m is not positive")])
def test_a_file_without_a_number_of_the_rotor_is_refused(
    estimate: RotorEstimate, tmp_path: Path, value: float | None, said: str
) -> None:
    document = json.loads(estimate.dumps())
    document["numbers"] = {n: x for n, x in document["numbers"].items() if n != "m"} | ({"m": value} if value else {})
    (tmp_path / "e.json").write_text(json.dumps(document))
    with pytest.raises(AmbidError, match=said):
        ambid.load(tmp_path / "e.json")
