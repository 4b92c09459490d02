"""The main job on records of a simulator that shares no code with the project."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ambid.job import identify

TRUTH = Path(__file__).resolve().parents[2].parent / "shared" / "checks" / "truth.py"
pytestmark = pytest.mark.skipif(not TRUTH.is_file(), reason="the independent simulator is not beside this checkout")


@pytest.fixture(scope="module")
def outside():
    spec = importlib.util.spec_from_file_location("outside_truth", TRUTH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


VARIANTS = {
    "thesis, 40 dB": ("THESIS", {}, {"*": 0.005, "k_x": 0.03}),
    "thesis, 20 dB, three samples late": ("THESIS", {"snr_db": 20, "delay": 3}, {"*": 0.01, "k_x": 0.25}),
    "thesis in a loop it does not need": (
        "THESIS",
        {"feedback": True, "snr_db": None, "position_noise": 5e-7, "current_noise": 1e-4, "force_noise": 0.01},
        {"*": 0.03, "k_x": 0.25},
    ),
    "bearing": ("BEARING", {}, {"*": 0.02}),
    "bearing, two samples late": ("BEARING", {"delay": 2, "seconds": 0.5}, {"*": 0.03}),
    "bearing, noisy": (
        "BEARING",
        {"position_noise": 5e-6, "current_noise": 2e-2, "force_noise": 20.0, "seconds": 0.5},
        {"*": 0.10},
    ),
    "bearing, nearly no noise": (
        "BEARING",
        {"position_noise": 1e-9, "current_noise": 1e-5, "force_noise": 0.01, "voltage_noise": 1e-3, "seconds": 0.25},
        {"*": 0.001},
    ),
    "hobby, delay and offsets": ("HOBBY", {}, {"*": 0.20, "R": 0.01, "L": 0.01}),
    "small and fast": (
        "HOBBY",
        {"m": 1e-3, "k_x": -20.0, "k_i": 0.5, "R": 20.0, "L": 5e-3, "rate": 20_000.0, "seconds": 0.5, "volts": 1.0,
         "band": (2.0, 3000.0), "position_noise": 1e-7, "current_noise": 1e-4, "force_noise": 1e-4,
         "voltage_noise": 1e-3},
        {"*": 0.05},
    ),
    "heavy": (
        "BEARING",
        {"m": 400.0, "k_x": -5e7, "k_i": 2000.0, "R": 0.3, "L": 0.2, "volts": 200.0, "position_noise": 1e-7,
         "current_noise": 1e-2, "force_noise": 100.0, "voltage_noise": 1.0, "seconds": 0.5},
        {"*": 0.02},
    ),
}  # fmt: skip


@pytest.mark.parametrize("variant", VARIANTS)
def test_truth_comes_back_with_honest_intervals(outside, tmp_path, variant):
    base, changes, within = VARIANTS[variant]
    bench = replace(getattr(outside, base), **changes)
    estimate = identify(*outside.write(bench, tmp_path, 7))
    assert estimate.status == "converged"
    found = estimate.delay["voltage"]
    assert abs(found.samples + found.fraction - bench.delay) < (4 * found.sd if found.sd else 1e-9)
    for name, truth in bench.truth.items():
        p = estimate.parameter(name)
        assert abs(p.value - truth) < 3.5 * p.sd, (name, p.value, p.sd)
        assert p.identifiable, (name, p.sd / abs(p.value))
        assert abs(p.value / truth - 1) < within.get(name, within["*"]), (name, p.value)
    assert not [c for c in estimate.checks.values() if not c.passed]
    assert estimate.passed
    assert not estimate.warnings


def test_a_direction_that_the_data_do_not_show_is_named(outside, tmp_path):
    # 10 to 2000 Hz at 10 dB: k_x has a relative sd near 200 % at the bound
    bench = replace(outside.THESIS, band=(10.0, 2000.0), snr_db=10)
    estimate = identify(*outside.write(bench, tmp_path, 5))
    flags = {p.name: p.identifiable for p in estimate.parameters if p.role == "free"}
    assert flags == {"m": True, "k_x": False, "k_i": True, "R": True, "L": True}
    assert estimate.parameter("k_x").sd / bench.k_x == pytest.approx(2.0, rel=0.6)
    check = estimate.checks["identifiable"]
    assert not check.passed
    assert "k_x" in check.detail
    assert "low frequency" in check.detail  # the experiment that would show it
    for name in ("m", "k_i", "R", "L"):
        p = estimate.parameter(name)
        assert abs(p.value - bench.truth[name]) < 3.5 * p.sd


def test_without_excitation_nothing_is_given_confidently(outside, tmp_path):
    # the loop's own noise is the only excitation
    bench = replace(outside.BEARING, volts=1e-6)
    estimate = identify(*outside.write(bench, tmp_path, 1))
    for name, truth in bench.truth.items():
        p = estimate.parameter(name)
        assert abs(p.value - truth) < 4 * p.sd
    assert not estimate.passed
    assert not estimate.parameter("k_x").identifiable


def test_offsets_and_scale_of_the_record_change_nothing(outside, tmp_path):
    plain = replace(outside.BEARING, seconds=0.2)
    shifted = replace(plain, name="shifted", offsets=(3.0, -1.0, 0.004))
    one, other = (identify(*outside.write(b, tmp_path, 3)) for b in (plain, shifted))
    for p in one.parameters:
        assert other.parameter(p.name).value == pytest.approx(p.value, abs=0.05 * p.sd + 1e-12)
    assert other.operating_point["voltage"] - one.operating_point["voltage"] == pytest.approx(3.0, abs=1e-6)
    assert other.operating_point["position"] - one.operating_point["position"] == pytest.approx(0.004, abs=1e-9)


def test_the_discrete_plants_are_the_same(outside):
    # sign conventions of the two simulators, before any estimation
    from ambid.physics.linear_model import discretise, model

    for bench in (outside.THESIS, outside.BEARING, outside.HOBBY):
        a, b, f = outside._discrete(bench)
        ours, _ = discretise(model("one-axis").matrices({**bench.truth, "c": bench.c}), 1 / bench.rate)
        np.testing.assert_allclose(ours.A, a, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(ours.B[:, 0], b, rtol=1e-9)
        np.testing.assert_allclose(ours.E[:, 0], f, rtol=1e-9)
