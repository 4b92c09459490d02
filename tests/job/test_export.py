"""An identified plant as C source and FMU, in the same closed loop as `ambid.simulate`; and as scripts and matrices."""

import re
from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.bearing.magnet_problem import UNITS
from ambid.estimation.estimate import Delay, EstimatedParameter
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.presets import preset
from ambid.rig import rig_from_text
from ambid.rig.preset_rig import preset_text
from tests.bearing.magnet.estimates import by_hand, seen
from tests.job.exported import InC, InFmpy, needs_compiler


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
    """Run a plant in the loop of a simulated record, and return position, current and voltage."""
    first = {name: float(record[name].values[0]) for name in ("position", "current")}
    e, z, rows = record["excitation"].values, np.zeros(law.order), []
    rest = float(record["voltage"].values[0] - e[0])
    for k in range(record.n_samples):
        position, current = plant.outputs()[:2]
        seen_by_law = np.array([position - first["position"], current - first["current"]])
        u = rest + e[k] + float((law.C @ z + law.D @ seen_by_law)[0])
        z = law.A @ z + law.B @ seen_by_law
        rows.append((position, current, u))
        assert plant.step(u, 1.0 / record.rate_hz) == 0
    return np.array(rows)


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
