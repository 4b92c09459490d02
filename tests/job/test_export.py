"""An identified plant as C source and FMU, in the same closed loop as `ambid.simulate`; and as scripts and matrices."""

import re
import runpy
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

import ambid
from ambid.bearing.magnet_problem import UNITS
from ambid.errors import AmbidError, EstimationError
from ambid.estimation.estimate import Delay, EstimatedParameter
from ambid.job.exchange import _operating_point
from ambid.job.plant_source import binaries
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.presets import preset
from ambid.rig import rig_from_text
from ambid.rig.draft import preset_text
from tests.bearing.magnet.estimates import by_hand, seen
from tests.job.exported import CC, FLAGS, InC, InFmpy, assert_agree, needs_compiler, runs_of_exports
from tests.tiers import sample

PROTOTYPE = Path(ambid.__file__).parent / "data" / "prototype.toml"


def rig_text(name):
    return re.sub(r"\[noise\][^\[]*", "", preset_text(preset(name)))


@pytest.fixture(scope="module")
def axis():
    text = rig_text("unstable-bearing")
    return ambid.identify(ambid.simulate("unstable-bearing", duration=0.3, seed=1), rig_from_text(text, "rig.toml"))


@pytest.fixture(scope="module")
def ball():
    found = by_hand({"ball.csv": seen(1)})
    return replace(found, rig={"name": "ball", "text": rig_text("levitated-ball"), "folder": ""})


def magnet(ball, bench, law, eddy=False, **values):
    """A nonlinear estimate with other numbers."""
    known = preset(bench)
    values = {"m": known.parameters["m"], "R": known.parameters["R"], "c": 0.0, "L_leak": 0.0, "g": 0.0, **values}
    return replace(
        ball, law=law, eddy=eddy, rig={"name": bench, "text": rig_text(bench), "folder": ""},
        records=({**ball.records[0], "rate_hz": known.rate_hz},),
        delay={f"{known.rate_hz:g} Hz": Delay(samples=1, fraction=0.25, sd=None, how="given")},
        parameters=tuple(EstimatedParameter(name=n, unit=UNITS[n], value=x, sd=0.0, ci95=(x, x), role="fixed",
                                            identifiable=True) for n, x in values.items()),
        operating_point=dict(known.operating_point._asdict()),
    )  # fmt: skip


def plants(axis, ball):
    unequal = MagnetLaw(pair=True, saturation=True, rise=True, asymmetric=True)
    numbers = {"k": 5.2e-6, "s": 0.432e-3, "L_leak": 2e-3, "i0": 1.0}
    return {
        "linear": axis,
        "late": replace(axis, delay={"voltage": Delay(samples=0, fraction=0.4, sd=None, how="given")}),
        "ball": ball,
        "pair": magnet(ball, "unstable-bearing", unequal, eddy=True, **numbers, sigma=0.05, L_rise=1e-3, i_knee=0.2,
                       k_asym=0.03, i0_asym=-0.02, a=2e4, x_offset=2e-6, i_offset=0.01, v_offset=0.02, v_drop=0.05,
                       i_drop=0.05),
        "exponential": magnet(ball, "levitated-ball", MagnetLaw(gap="exponential"), L_g=0.03, zeta=0.009, L_leak=0.1,
                              g=9.81),
    }  # fmt: skip


NAMES = ("linear", "late", "ball", "pair", "exponential")


def simulated(estimate, seconds=0.05):
    """What the simulator makes of an estimate in the loop of its rig, without noise: its record, and the loop."""
    nonlinear = hasattr(estimate, "law")
    amplitude = 0.02 if nonlinear and estimate.law.gap == "exponential" else 0.2
    record = ambid.simulate(
        estimate, duration=seconds, amplitude=amplitude, seed=1, nonlinear=nonlinear, closed=True, log_excitation=True
    )
    rig = rig_from_text(estimate.rig["text"], "rig.toml")
    return record, rig.loop.as_law(record.rate_hz)


def in_loop(plant, record, law):
    """Run a plant in the loop of a simulated record, which begins at rest; return position, current and voltage."""
    e, z, rows = record["excitation"].values, np.zeros(law.order), []
    rest = [record["position"].values[0], record["current"].values[0], record["voltage"].values[0] - e[0]]
    for k in range(record.n_samples):
        y = np.array(plant.outputs()[:2])
        u = e[k] + float((law.C @ z + law.D @ y)[0])
        z = law.A @ z + law.B @ y
        rows.append((*y, u))
        assert plant.step(u, 1.0 / record.rate_hz) == 0
    return np.array(rows) + rest


def assert_the_same(plant, estimate):
    record, law = simulated(estimate)
    found = in_loop(plant, record, law)
    for j, name in enumerate(("position", "current", "voltage")):
        wanted = record[name].values
        assert np.ptp(wanted) > 0.0
        assert np.max(np.abs(found[:, j] - wanted)) < 1e-6 * np.ptp(wanted), name


@needs_compiler
@pytest.mark.parametrize("name", NAMES)
def test_c_source_is_the_simulated_plant(axis, ball, tmp_path, name):
    estimate = plants(axis, ball)[name]
    assert_the_same(InC(estimate, tmp_path), estimate)


@needs_compiler
@pytest.mark.parametrize("name", NAMES)
def test_the_fmu_is_valid_and_is_the_simulated_plant(axis, ball, tmp_path, name):
    pytest.importorskip("fmpy")
    from fmpy.validation import validate_fmu

    estimate = plants(axis, ball)[name]
    estimate.export(tmp_path / "plant.fmu")
    assert validate_fmu(str(tmp_path / "plant.fmu")) == []
    assert_the_same(InFmpy(tmp_path / "plant.fmu", tmp_path / "open"), estimate)


@needs_compiler
@pytest.mark.filterwarnings("ignore:the loop is unstable")
@pytest.mark.parametrize("name", ["linear", "ball"])
def test_a_rotor_that_falls_stops_and_lies_as_in_the_simulator(axis, ball, tmp_path, name):
    estimate = plants(axis, ball)[name]
    nonlinear = name == "ball"
    with pytest.warns(UserWarning, match="touched a stop"):
        record = ambid.simulate(
            estimate,
            duration=0.4 if nonlinear else 0.1,
            amplitude=0.2,
            seed=2,
            nonlinear=nonlinear,
            closed=False,
            force=True,
        )
    rest = _operating_point(estimate)
    plant, told, found = InC(estimate, tmp_path), [], []
    for u in record["voltage"].values:
        found.append(np.add(plant.outputs()[:2], (rest["position"], rest["current"])))
        told.append(plant.step(u - rest["voltage"], 1.0 / record.rate_hz))
    assert (told[0], told[-1]) == (0, 1)
    for j, role in enumerate(("position", "current")):
        wanted = record[role].values
        assert np.max(np.abs(np.array(found)[:, j] - wanted)) < 1e-6 * np.ptp(wanted)


@needs_compiler
def test_steps_of_any_length_give_the_same_and_wrong_ones_are_refused(axis, tmp_path):
    plant = InC(replace(axis, delay={"voltage": Delay(samples=1, fraction=0.3, sd=None, how="given")}), tmp_path)
    period = 1.0 / float(axis.record["rate_hz"])

    def run(parts):
        plant.made.begin()
        for u in (0.1, -0.2, 0.3, 0.0, 0.0):
            assert [plant.step(u, length * period, force=1.0) for length in parts] == [0] * len(parts)
        return plant.outputs()

    np.testing.assert_allclose(run([0.1, 0.25, 0.65]), run([1.0]), rtol=1e-10)
    for length in (0.0, -period, np.nan, 1e9):
        assert plant.step(0.0, length) == -2
    assert [plant.step(float(k), 1e-3 * period) for k in range(200)][-1] == -2  # more changes than are remembered
    assert plant.step(np.nan, 5 * period) == -2
    plant.made.begin()
    assert plant.step(np.nan, 5 * period) == -1


@needs_compiler
def test_an_fmu_is_several_plants_that_are_set_kept_and_begun_again(axis, tmp_path):
    axis.export(tmp_path / "a.fmu")
    first = (tmp_path / "a.fmu").read_bytes()
    axis.export(tmp_path / "a.fmu")
    assert (tmp_path / "a.fmu").read_bytes() == first
    period = 1.0 / float(axis.record["rate_hz"])
    one, two = (InFmpy(tmp_path / "a.fmu", tmp_path / name, name) for name in ("one", "two"))
    begin = one.outputs()

    def run(plant, n=20, u=1.0):
        for _ in range(n):
            plant.step(u, period)
        return plant.outputs()

    for name in ("m", "L", "delay"):
        assert float({v.name: v.min for v in one.told.modelVariables}[name]) >= 0.0
        with pytest.raises(Exception, match="SetReal failed"):
            one.set(k_i=0.0, **{name: -1e-9})
    moved = run(one)
    assert two.outputs() == begin != moved
    kept = one.fmu.getFMUstate()
    data = one.fmu.serializeFMUstate(kept)
    further = run(one)
    one.fmu.setFMUstate(kept)
    assert run(one) == further
    one.fmu.setFMUstate(one.fmu.deSerializeFMUstate(data))
    assert run(one) == further
    one.set(m=2.0 * axis["m"].value)  # while it runs
    assert run(one) != further
    one.fmu.terminate()
    with pytest.raises(Exception, match="DoStep failed"):
        one.step(0.0, period)
    one.fmu.reset()
    one.begin()
    assert run(one) == moved
    two.fmu.reset()
    two.begin(L=0.5 * axis["L"].value, position_start=1e-5)
    assert two.outputs()[0] == 1e-5
    two.fmu.reset()
    two.begin(L=0.5 * axis["L"].value)
    heavier = replace(axis, parameters=tuple(
        replace(p, value=0.5 * p.value) if p.name == "L" else p for p in axis.parameters
    ))  # fmt: skip
    np.testing.assert_allclose(run(two)[1:], run_in_c(heavier, tmp_path, [1.0] * 20, period)[1:], rtol=1e-9)


def run_in_c(estimate, folder, voltages, period):
    plant = InC(estimate, folder)
    for u in voltages:
        assert plant.step(u, period) == 0
    return plant.outputs()[:3]


def test_matrices_and_script_hold_the_plant_continuous_and_sampled(axis, tmp_path):
    pytest.importorskip("control")
    late = replace(axis, delay={"voltage": Delay(samples=2, fraction=0.3, sd=None, how="given")})
    for ending in (".mat", ".py"):
        late.export(tmp_path / f"a{ending}")
    read = loadmat(tmp_path / "a.mat", squeeze_me=True, simplify_cells=True)
    np.testing.assert_array_equal(read["A"], axis.continuous.A)
    np.testing.assert_array_equal(read["covariance"], axis.covariance)
    assert list(read["covariance_names"]) == list(axis.covariance_names)
    assert dict(zip(read["parameters"], read["value"], strict=True)) == axis.values
    assert (list(read["output_units"]), read["input_units"], read["delay_samples"]) == (["m", "A"], "V", 2.3)
    assert read["operating_point"] == dict(axis.operating_point)
    script = runpy.run_path(str(tmp_path / "a.py"))
    plant, sampled = script["plant"](), script["sampled"]()
    np.testing.assert_array_equal(plant.A, axis.continuous.A)
    assert (plant.input_labels, plant.state_labels) == (["voltage"], list(axis.continuous.states))
    for name in "ABCD":
        np.testing.assert_array_equal(np.asarray(read["sampled"][name]).reshape(getattr(sampled, name).shape),
                                      getattr(sampled, name))  # fmt: skip
    assert sampled.dt == read["sampled"]["sample_time_s"] == 1.0 / axis.record["rate_hz"]
    u = np.random.default_rng(1).standard_normal(30)
    x, found = np.zeros(sampled.nstates), []
    for value in u:
        found.append(sampled.C @ x)
        x = sampled.A @ x + sampled.B[:, 0] * value
    wanted = late.simulate(u + axis.operating_point["voltage"])
    for j, role in enumerate(("position", "current")):
        np.testing.assert_allclose(np.array(found)[:, j] + axis.operating_point[role], wanted[role], rtol=1e-9)


def test_a_fit_is_matrices_and_a_script_alone(tmp_path):
    pytest.importorskip("control")
    fit = ambid.fit(ambid.simulate("thesis", duration=0.2, seed=1), structure="arx", input="voltage",
                    output="current", orders="na=1,nb=1,nk=1")  # fmt: skip
    fit.export(tmp_path / "f.py")
    made = runpy.run_path(str(tmp_path / "f.py"))["plant"]()
    wanted = fit.to_control()
    np.testing.assert_allclose(made(np.exp(0.3j)), wanted(np.exp(0.3j)), rtol=1e-10)
    with pytest.raises(EstimationError, match="no physical parameters"):
        fit.export(tmp_path / "f.fmu")
    assert not (tmp_path / "f.fmu").exists()


def doubtful(estimate, kind):
    if kind == "unusable":
        return replace(estimate, status="stalled")
    unseen = tuple(replace(p, identifiable=p.name != "k_i") for p in estimate.parameters)
    return replace(estimate, parameters=unseen)


@pytest.mark.parametrize(("kind", "said"), [("unusable", "did not converge"), ("unseen", "does not show k_i")])
@pytest.mark.parametrize("ending", [".mat", ".py", ".c", ".h", ".fmu"])
def test_a_plant_that_should_not_be_relied_on_is_exported_on_request_and_says_so(axis, tmp_path, kind, said, ending):
    estimate, path = doubtful(axis, kind), tmp_path / f"a{ending}"
    with pytest.raises(EstimationError, match=said):
        estimate.export(path)
    assert not path.exists()
    estimate.export(path, anyway=True)
    if ending == ".fmu":
        fmpy = pytest.importorskip("fmpy")
        text = fmpy.read_model_description(str(path)).description
    else:
        text = str(loadmat(path)["about"]) if ending == ".mat" else path.read_text(encoding="utf-8")
    assert re.search(rf"NOT TO BE RELIED ON: [^.]*{said}", text)


HOSTILE = '*/ int x; /* ??/ "\\"""\nimport os\x00 <&> ]]> \u202e {0} %s \' $(x)'


@needs_compiler
def test_names_that_a_user_gave_end_no_comment_string_or_tag(axis, tmp_path):
    pytest.importorskip("control")
    estimate = replace(axis, rig={**axis.rig, "name": HOSTILE}, record={**axis.record, "file": HOSTILE})
    for ending in (".c", ".h", ".py", ".fmu"):
        estimate.export(tmp_path / f"9 int; ü--x{ending}")
    runpy.run_path(str(tmp_path / "9 int; ü--x.py"))["plant"]()
    (tmp_path / "two.c").write_text(f'#include "9 int; ü--x.h"\n#include "{tmp_path}/b.c"\n')
    axis.export(tmp_path / "b.c")
    subprocess.run([CC, *FLAGS, "two.c", "9 int; ü--x.c", "-o", "two.so", "-lm"], cwd=tmp_path, check=True)
    validation = pytest.importorskip("fmpy.validation")
    assert validation.validate_fmu(str(tmp_path / "9 int; ü--x.fmu")) == []
    assert InFmpy(tmp_path / "9 int; ü--x.fmu", tmp_path / "open").told.modelName == "9 int; ü--x"


def test_what_no_export_is_stays_and_odd_words_are_refused(axis, tmp_path):
    for ending in (".mat", ".py", ".c", ".fmu"):
        kept = tmp_path / f"a{ending}"
        kept.write_bytes(b"PK\x03\x04 of another program" if ending == ".fmu" else b'"""A script of mine."""')
        before = kept.read_bytes()
        with pytest.raises(AmbidError, match="exists, and is not a result of ambid"):
            axis.export(kept)
        assert kept.read_bytes() == before
    for words in ({"to": "matlab"}, {"to": 3}, {"to": "ross"}, {"anyway": "yes"}):
        with pytest.raises(AmbidError):
            axis.export(tmp_path / "b.py", **words)
    for path in (None, 3, "", tmp_path, tmp_path / "b", tmp_path / "b.mat.txt", tmp_path / "no" / "b.mat",
                 tmp_path / "b\0.mat"):  # fmt: skip
        with pytest.raises(AmbidError):
            axis.export(path)
    with pytest.raises(AmbidError, match="for scripts, files ending in"):
        axis.export(tmp_path / "b.mat", to="control")
    assert {p.name for p in tmp_path.iterdir()} == {f"a{ending}" for ending in (".mat", ".py", ".c", ".fmu")}


def test_without_a_compiler_an_fmu_holds_its_source(axis, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    axis.export(tmp_path / "a.fmu")
    assert binaries(tmp_path / "a.fmu") == ()


@needs_compiler
@pytest.mark.parametrize(("model", "roles"), [("coil", ("voltage", "current")), ("rotor", ("current", "position"))])
def test_the_other_linear_models_are_stepped_by_their_matrices(tmp_path, model, roles):
    fixed = 'm = { value = 4.0, unit = "kg", role = "fixed" }' if model == "rotor" else ""
    channels = "\n".join(f'[channels.{role}]\ncolumn = "{role}"' for role in roles)
    rig = rig_from_text(
        f'schema = "ambid.rig/1"\nname = "{model}"\nmodel = "{model}"\n{channels}\n[parameters]\n{fixed}\n', "rig.toml"
    )
    bench = "unstable-bearing" if model == "rotor" else "thesis"
    estimate = ambid.identify(ambid.simulate(bench, duration=0.1, seed=1), rig)
    plant, period = InC(estimate, tmp_path, anyway=True), 1.0 / float(estimate.record["rate_hz"])
    estimate.export(tmp_path / "a.mat", anyway=True)
    read = loadmat(tmp_path / "a.mat", simplify_cells=True)["sampled"]
    A, B, C = (np.asarray(read[x]) for x in "ABC")
    A, x = np.atleast_2d(A), np.zeros(np.atleast_2d(A).shape[0])
    for u in np.random.default_rng(1).standard_normal(20):
        found = plant.outputs()[0]
        wanted = (np.atleast_2d(C.reshape(1, -1)) @ x)[0]
        assert found == pytest.approx(wanted, rel=1e-9)
        assert plant.step(u, period) == 0
        x = A @ x + B.reshape(x.size) * u


@needs_compiler
@pytest.mark.parametrize("bench", sample(["thesis", "unstable-bearing", "rmit-axis", "levitated-ball", "prototype"], 1))
def test_all_exports_of_a_bench_agree(tmp_path, bench):
    rig = PROTOTYPE if bench == "prototype" else rig_from_text(preset_text(preset(bench)), "rig.toml")
    found = ambid.identify(ambid.simulate(bench, duration=0.2, seed=1), rig)
    rest = {**found.operating_point, "voltage": 0.2e-3}
    late = {"voltage": Delay(samples=1, fraction=0.4, sd=None, how="given")}
    estimate = replace(found, operating_point=rest, delay=late)
    n = int(0.02 * float(estimate.record["rate_hz"]))
    assert_agree(runs_of_exports(estimate, tmp_path, 0.01 * np.random.default_rng(1).standard_normal((n, 1))))
    for ending in ("mat", "py", "c"):
        text = (tmp_path / f"plant.{ending}").read_text(encoding="latin-1")
        assert "count from the operating point: " in text
        assert all(f"{name} {value!r} " in text for name, value in rest.items())
    assert loadmat(tmp_path / "plant.mat", simplify_cells=True)["operating_point"] == rest


@needs_compiler
@pytest.mark.parametrize("name", ["ball", "pair"])
def test_a_nonlinear_plant_is_its_matrices_where_it_hardly_moves(axis, ball, tmp_path, name):
    u = 1e-5 * np.random.default_rng(1).standard_normal((40, 1))
    runs = runs_of_exports(plants(axis, ball)[name], tmp_path, u)
    assert_agree({".mat": runs[".c"], ".fmu": runs[".fmu"]})
    assert_agree(runs, within=1e-4)


@needs_compiler
@pytest.mark.parametrize("stem", ["double", "linux", "class", "While"])
def test_a_keyword_as_a_name_compiles(axis, tmp_path, stem):
    axis.export(tmp_path / f"{stem}.c")
    axis.export(tmp_path / f"{stem}.h")
    subprocess.run([CC, "-Wall", "-Wextra", "-Werror", "-c", f"{stem}.c"], cwd=tmp_path, check=True)
    assert f"void plant_{stem.lower()}_reset(" in (tmp_path / f"{stem}.h").read_text(encoding="utf-8")
