"""Several records give one rotor: at rest and at speed, one bearing excited at a time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ambid
from ambid.errors import AmbidError, EstimationError
from ambid.record import Record
from tests.rotor_benches import free_rig, model_of, needs_simulator, record_of, truth

pytestmark = needs_simulator
_FAR = 3.5  # standard deviations


def _bench(name: str, **changes: Any) -> Any:
    return replace(truth.BENCHES[name], period=0.25, periods=4, **changes)


@pytest.fixture(scope="module")
def apart() -> tuple[Any, Record, Record]:
    """Bearing A is excited at rest, bearing B at speed, with other noise."""
    still = record_of(_bench("rigid", excited=(0, 1)), 1)
    turning = _bench("rigid-spin", excited=(2, 3), position_noise=0.6e-6)
    return turning, still, record_of(turning, 2)


def test_records_each_of_which_shows_a_part_give_the_whole_machine(apart: tuple[Any, Record, Record]) -> None:
    bench, still, turning = apart
    found = ambid.identify([still, turning], free_rig(bench))
    assert [round(float(r["speed"])) for r in found.records] == [0, round(2.0 * np.pi * 300.0)]
    assert "taken to be at rest" in found.warnings[0]
    assert found.status == "converged"
    assert not [name for name, check in found.checks.items() if not check.passed]
    _, theta = model_of(bench)
    for p in found.parameters:
        assert abs(p.value - theta[p.name]) <= _FAR * p.sd, p
    assert found["Ip"].sd < 0.005 * found["Ip"].value


def test_a_rotor_that_bends_shows_its_gyroscopic_terms_beside_a_record_at_rest() -> None:
    bench = _bench("utrc", modes=1, zeta=(0.01,), band=(4.0, 400.0), rate=10_000.0, eddy_pole_hz=np.inf)
    records = [record_of(replace(bench, rpm=0.0), 3), record_of(bench, 4)]
    still = free_rig(replace(bench, rpm=0.0))  # says nothing of Ip
    found = ambid.identify(records, still, speed_rpm=[0.0, bench.rpm])
    _, theta = model_of(bench)
    assert found.n_modes == 1
    assert not found.warnings
    for name in ("Ip", "gyro.11", "mode1.omega", "mode1.zeta"):
        sd = float(np.sqrt(found.covariance_of((name,))[0, 0]))
        assert abs(found.numbers[name] - theta[name]) <= _FAR * sd, name
    assert found.numbers["gyro.11"] == pytest.approx(theta["gyro.11"], rel=0.01)


def test_what_cannot_be_one_machine_is_refused(apart: tuple[Any, Record, Record]) -> None:
    bench, still, turning = apart
    rig = free_rig(bench)
    refused = [
        ({"record": [turning, turning]}, "count twice"),
        ({"record": [still]}, "no column 'angle'"),
        ({"record": [still, turning], "speed_rpm": 0.0}, "2 records and 1 speed"),
        ({"record": still, "speed_rpm": [float("nan")]}, "speed_rpm is nan; it must be a number"),
        ({"record": [still, replace(turning, rate_hz=5000.0)]}, "5000 Hz"),
    ]
    for words, said in refused:
        with pytest.raises(AmbidError, match=said):
            ambid.identify(rig=rig, **words)


def test_an_estimate_without_a_finite_response_leaves_unbalance_out_and_says_so(
    apart: tuple[Any, Record, Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_args: object, **_more: object) -> None:
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr("ambid.rotor.balance.balance_rotor", fails)
    bench, still, turning = apart
    found = ambid.identify([still, turning], free_rig(bench))
    assert not found.synchronous
    assert any("unbalance was not worked out" in line for line in found.warnings)


def test_axes_that_nothing_moves_are_refused_by_name() -> None:
    bench = _bench("rigid", excited=(0, 2))
    with pytest.raises(EstimationError, match="ay, by move no more than their noise"):
        ambid.identify(record_of(bench, 1), free_rig(bench))


def test_periods_that_are_exactly_alike_are_not_usable_and_raise_no_warning() -> None:
    bench = _bench("rigid")
    record = record_of(bench, 1)
    period = round(bench.period * record.rate_hz)
    alike = [replace(c, values=np.resize(c.values[:period], record.n_samples)) for c in record.channels]
    assert ambid.identify(replace(record, channels=tuple(alike)), free_rig(bench)).verdict.word == "unusable"
