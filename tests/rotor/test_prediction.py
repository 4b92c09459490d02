"""The innovations-form predictor of a rotor: records without periods, and the same ones as period spectra see them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ambid
from ambid.estimation.colours import Colour, with_colours
from ambid.estimation.linear import one_thread
from ambid.job.data import load_bench
from ambid.physics.rotor_model import RotorModel
from ambid.record import Record
from ambid.rotor.conclusion import numbers_of
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.likelihood import Point
from ambid.rotor.prediction import predict_rotor, predictor_problem
from tests.rotor_benches import free_rig, model_of, needs_simulator, record_of, truth

pytestmark = needs_simulator
_FAR = 3.5  # standard deviations


@pytest.fixture(scope="module")
def once() -> tuple[Any, Record]:
    """One period alone, from its transient on: nothing in it comes back."""
    bench = replace(truth.BENCHES["rigid"], period=1.2, periods=1, settle=0, excitation="full")
    return bench, record_of(bench, 3)


@pytest.fixture(scope="module")
def found(once: tuple[Any, Record]) -> RotorEstimate:
    bench, record = once
    estimate = ambid.identify(record, free_rig(bench))
    assert isinstance(estimate, RotorEstimate)
    return estimate


def test_a_record_without_periods_goes_to_the_predictor_by_itself(found: RotorEstimate) -> None:
    assert found.method == "predictor"
    assert "not periodic" in found.checks["method"].detail
    assert found.status == "converged"
    assert not [name for name, check in found.checks.items() if not check.passed]


def test_the_predictor_finds_the_machine_within_its_intervals(once: tuple[Any, Record], found: RotorEstimate) -> None:
    bench, _ = once
    _, theta = model_of(bench)
    for p in found.parameters:
        assert abs(p.value - theta[p.name]) <= _FAR * p.sd, p
    assert found["m"].sd < 0.003 * found["m"].value
    assert [d.samples + d.fraction for d in found.delay.values()] == [float(bench.delay)] * 4
    assert found.noise["ax_position"] == pytest.approx(bench.position_noise, rel=0.05)
    assert found.noise["ax_current"] == pytest.approx(bench.current_noise, rel=0.05)


def test_slopes_of_the_innovations_are_exact(once: tuple[Any, Record]) -> None:
    """Every number of the vector, the delays of two inputs and the level of every noise among them, of a rotor lighter
    than 1 kg, whose logarithm is negative, and of noise with low-pass parts of a force and a position.
    """
    from ambid.estimation.likelihood import Workspace, innovations, linearise

    bench, record = once
    rig = free_rig(bench)
    assert isinstance(rig.rotor, RotorModel)
    model, theta = model_of(bench)
    model, theta = model.with_modes(1), theta | {"mode1.omega": 600.0, "mode1.zeta": 0.01}
    theta |= {"mode1.A.z": 0.2, "mode1.B.z": -0.3, "mode1.A.z_sensor": 0.25, "mode1.B.z_sensor": -0.2}
    short = load_bench(record, rig)[0.0:0.01]
    at = Point(theta=theta, delays=np.array([1.0, 1.3, 2.2, 1.7]))
    at = replace(at, theta={**at.theta, "m": 0.6})
    white = predictor_problem(short, model, rig.parameters, at, free=(1, 2))
    colours = Colour(source="ax_force", omega=300.0), Colour(source="ay_position", omega=50.0)
    problem, vector = with_colours(*white, colours, 1.0)
    work, weight = Workspace(problem), np.eye(8)
    slopes = linearise(problem, vector, weight, work)
    assert slopes is not None
    step = 1e-5 * np.random.default_rng(1).standard_normal(problem.size)
    there, back = (innovations(problem, vector + s * step) for s in (1.0, -1.0))
    assert there is not None
    assert back is not None
    along = (there - back) / 2.0
    assert np.linalg.norm(slopes.J @ step) == pytest.approx(np.linalg.norm(along), rel=1e-5)
    e = innovations(problem, vector)
    assert e is not None
    assert slopes.r @ (slopes.J @ step) == pytest.approx(float(np.sum(e * along)), rel=1e-4)


def test_coloured_forces_do_not_bend_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forces of a first-order low pass of 20 Hz, 2 N rms: white noise in their place moves k_x by 16 %. What turns with
    the rotor leaves no line.
    """
    pole, bench = 2.0 * np.pi * 20.0, replace(truth.BENCHES["rigid-spin"], period=1.2, periods=1, excitation="full")
    own = np.sqrt(np.tanh(0.5 * pole / bench.rate))  # rms of what a held noise of rms 1 is behind the low pass
    plant = truth.plant

    def slowed(b: Any) -> tuple[Any, Any, Any]:
        A, B, C = plant(b)
        push = B[:, 8:]
        A = np.block([[-pole * np.eye(4), np.zeros((4, len(A)))], [push, A]])
        B = np.vstack([np.pad(pole * np.eye(4), ((0, 0), (8, 0))), np.pad(B[:, :8], ((0, 0), (0, 4)))])
        return A, B, np.pad(C, ((0, 0), (4, 0)))

    monkeypatch.setattr(truth, "plant", slowed)
    record = record_of(replace(bench, force_noise=2.0 / own), 4)
    monkeypatch.undo()
    _, theta = model_of(bench)
    found = ambid.identify(record, free_rig(bench))
    assert isinstance(found, RotorEstimate)
    assert found.method == "predictor"
    assert found.verdict.word == "usable", found.checks
    for p in found.parameters:
        assert abs(p.value - theta[p.name]) <= _FAR * p.sd, p
    assert "noise of each force has a low-pass part" in found.checks["residuals_white"].detail
    assert found.noise["ax_force"] == pytest.approx(2.0, rel=0.4)


def test_both_estimators_agree_on_a_periodic_record() -> None:
    bench = replace(truth.BENCHES["rigid"], period=0.25, periods=4)
    record, rig = record_of(bench, 5), free_rig(bench)
    assert isinstance(rig.rotor, RotorModel)
    by_periods = ambid.identify(record, rig)
    with one_thread():
        fit = predict_rotor(load_bench(record, rig), rig.rotor, rig.parameters, speed=0.0, delays=[None] * 4)
    numbers = numbers_of(fit)
    apart = [(numbers.theta[p.name] - p.value) / p.sd for p in by_periods.parameters if p.role == "free"]
    ratio = [numbers.sd(p.name) / p.sd for p in by_periods.parameters if p.role == "free"]
    assert by_periods.method == "periods"
    assert np.sqrt(np.mean(np.square(apart))) < 0.5
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
