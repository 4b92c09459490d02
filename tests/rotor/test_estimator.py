"""The estimator on period spectra: the whole machine from one record, its noise, and what it says of a wrong model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ambid
from ambid.physics.linear_model import Parameter
from ambid.record import Record
from ambid.rig import Rig
from ambid.rig.rotor import RigModes
from ambid.rotor import RotorEstimate
from ambid.rotor.likelihood import Experiment, Point, rough_weight
from ambid.rotor.modes import scan
from ambid.rotor.spectra import find_excitation, period_spectra
from tests.rotor_benches import free_rig, model_of, needs_simulator, record_of, stepped, truth

pytestmark = needs_simulator
_FAR = 3.8  # standard deviations


def _bench(name: str, **changes: Any) -> Any:
    return replace(truth.BENCHES[name], **{"period": 0.25, "periods": 4, **changes})


def _flexible(**changes: Any) -> Any:
    return _bench("flexible", modes=2, zeta=(0.01, 0.01), band=(4.0, 700.0), rate=10_000.0, **changes)


def _far(found: RotorEstimate, bench: Any) -> list[str]:
    _, theta = model_of(bench)
    return [p.name for p in found.parameters if abs(p.value - theta[p.name]) > _FAR * p.sd and p.role != "fixed"]


@pytest.fixture(scope="module")
def rigid() -> tuple[Any, Record, Rig, RotorEstimate]:
    bench = _bench("rigid")
    record, rig = record_of(bench, 1), free_rig(bench)
    return bench, record, rig, ambid.identify(record, rig)


@pytest.fixture(scope="module")
def flexible() -> tuple[Any, Record, Rig, RotorEstimate]:
    bench = _flexible()
    record, rig = record_of(bench, 2), free_rig(bench)
    return bench, record, rig, ambid.identify(record, rig)


def test_a_rigid_rotor_comes_out_within_its_standard_deviations(rigid: tuple[Any, Record, Rig, RotorEstimate]) -> None:
    bench, _, _, found = rigid
    assert found.verdict.word == "usable", found.verdict.reasons
    assert not _far(found, bench)
    assert not found.modes
    assert {d.samples + d.fraction for d in found.delay.values()} == {1.0}
    assert found["m"].sd < 0.003 * found["m"].value


def test_its_noise_is_that_of_the_bench(rigid: tuple[Any, Record, Rig, RotorEstimate]) -> None:
    bench, _, _, found = rigid
    wanted = {"ax_position": bench.position_noise, "by_current": bench.current_noise, "bx_force": bench.force_noise}
    for name, level in {**wanted, "ay_voltage": bench.voltage_noise}.items():
        assert found.noise[name] == pytest.approx(level, rel=0.2), name


def test_modes_are_found_unaided_with_their_damping(flexible: tuple[Any, Record, Rig, RotorEstimate]) -> None:
    bench, _, _, found = flexible
    modal = truth.modal_of(bench)
    assert found.verdict.word == "usable", found.verdict.reasons
    assert not _far(found, bench)
    assert len(found.modes) == 2
    for mode, omega, zeta in zip(found.modes, modal.omega[2:], modal.zeta[2:], strict=True):
        assert abs(mode.frequency_hz.value - omega / (2.0 * np.pi)) < _FAR * mode.frequency_hz.sd
        assert abs(mode.damping.value - zeta) < _FAR * mode.damping.sd
        assert mode.frequency_hz.sd < 1e-3 * mode.frequency_hz.value
    shape = np.array([found.modes[0].shape[place].value for place in ("A.z", "B.z", "A.z_sensor", "B.z_sensor")])
    wanted = np.concatenate([modal.bearing[:, 2], modal.sensor[:, 2]])
    assert abs(shape @ wanted) / np.linalg.norm(shape) / np.linalg.norm(wanted) > 0.9999


def test_fewer_modes_than_there_are_is_told(flexible: tuple[Any, Record, Rig, RotorEstimate]) -> None:
    _, record, rig, _ = flexible
    found = ambid.identify(record, replace(rig, modes=RigModes(count=1)))
    assert len(found.modes) <= 1
    assert not found.checks["residuals_white"].passed
    assert found.verdict.word != "usable"


def test_a_hint_where_a_mode_is_changes_nothing_but_where_it_is_sought(
    flexible: tuple[Any, Record, Rig, RotorEstimate],
) -> None:
    _, record, rig, alone = flexible
    found = ambid.identify(record, replace(rig, modes=RigModes(frequency_hz=(146.0, 505.0))))
    ours, theirs = ([m.frequency_hz.value for m in e.modes] for e in (found, alone))
    assert ours == pytest.approx(theirs, rel=1e-5)


def test_without_voltages_and_mass_no_force_is_claimed(rigid: tuple[Any, Record, Rig, RotorEstimate]) -> None:
    bench, record, rig, _ = rigid
    assert rig.rotor is not None
    model = replace(rig.rotor, drives=("current",) * 4)
    channels = tuple(
        replace(c, delay=0) for c in rig.channels if not c.role.endswith("_voltage")
    )  # the currents are inputs now, and not delayed
    known = {p.name: p for p in rig.parameters}
    bare = replace(rig, rotor=model, channels=channels, parameters=tuple(known[p.name] for p in model.parameters))
    found = ambid.identify(record, bare)
    assert not any(found[name].identifiable for name in ("m", "Id", "ax.k_i", "ax.k_x"))
    assert "log the coil voltages" in found.checks["identifiable"].detail
    _, theta = model_of(bench)
    ratio = found["ax.k_i"].value / found["m"].value
    assert ratio == pytest.approx(theta["ax.k_i"] / theta["m"], rel=0.01)
    weighed = tuple(
        Parameter(name="m", unit="kg", role="fixed", value=bench.m) if p.name == "m" else p for p in bare.parameters
    )
    fixed = ambid.identify(record, replace(bare, parameters=weighed))
    assert not [n for n in ("Id", "z_cg", "ax.k_i", "bx.k_x") if abs(fixed[n].value - theta[n]) > _FAR * fixed[n].sd]
    guess = Parameter(name="m", unit="kg", role="prior", value=bench.m, sd=0.1)
    guessed = ambid.identify(record, replace(bare, parameters=tuple(guess if p.name == "m" else p for p in weighed)))
    assert guessed["m"].sd == pytest.approx(0.1, rel=0.01)
    assert guessed["m"].data_share == pytest.approx(0.0, abs=0.02)  # it is what was put in


def test_a_plane_that_is_wrong_is_named(rigid: tuple[Any, Record, Rig, RotorEstimate]) -> None:
    _, record, rig, _ = rigid
    moved = tuple(
        replace(p, value=p.value + 4e-3) if p.name == "A.z_sensor" and p.value is not None else p
        for p in rig.parameters
    )
    found = ambid.identify(record, replace(rig, parameters=moved))
    check = found.checks["fixed_agree"]
    assert not check.passed
    assert check.detail.split(":")[0].removeprefix("the record contradicts ") in ("A.z_sensor", "A.z")
    assert found.verdict.word != "usable"


def test_a_plane_at_the_datum_can_be_wrong_too(rigid: tuple[Any, Record, Rig, RotorEstimate]) -> None:
    bench, record, rig, _ = rigid
    model, _ = model_of(bench)
    true = next(b.z for b in model.bearings if b.name == "A")
    assert true is not None
    moved = tuple(
        p if p.role != "fixed" or p.value is None else replace(p, value=p.value - true + 4e-3 * (p.name != "A.z"))
        for p in rig.parameters
    )
    assert next(p.value for p in moved if p.name == "A.z") == 0.0
    check = ambid.identify(record, replace(rig, parameters=moved)).checks["fixed_agree"]
    assert {check.cause, *check.alternatives} == {"A.z", "A.z_sensor"}  # their distance is wrong
    assert "A.z: +4" in check.detail or "A.z (+4" in check.detail


def test_a_delay_that_is_not_whole_is_not_held_at_a_whole_sample() -> None:
    bench = _bench("rigid", amplitude=0.3)
    found = ambid.identify(stepped(bench, {}, 3, fraction=0.0013), free_rig(bench))
    assert not _far(found, bench)
    for d in found.delay.values():
        assert d.sd is not None
        assert abs(d.samples + d.fraction - 1.0013) < _FAR * d.sd
        assert d.sd < 5e-4


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_mode_of_a_turning_rotor_is_seen_whichever_way_it_turns(sign: float) -> None:
    bench = _bench("utrc", rpm=12_000.0, unbalance=0.0, runout=0.0)
    model, theta = model_of(bench)
    record, W = record_of(bench, 1), sign * bench.rpm * np.pi / 30.0
    if sign < 0.0:  # seen from the other end, where x and y change places
        other = {"x": "y", "y": "x"}
        record = replace(
            record, channels=tuple(replace(c, name=f"{c.name[0]}{other[c.name[1]]}{c.name[2:]}") if "_" in c.name else c
                                   for c in record.channels),
        )  # fmt: skip
        theta = {**theta, **{f"{b}{x}.{q}": theta[f"{b}{y}.{q}"] for b in "ab" for x, y in other.items()
                             for q in ("k_i", "k_x", "R", "L")}}  # fmt: skip
    less = replace(model, n_modes=0, speed=W)
    excitation = find_excitation(record, less)
    assert excitation is not None
    e = Experiment(spectra=period_spectra(record, less, excitation), speed=W)
    at = Point(theta=theta, delays=np.full(4, float(bench.delay)))
    mode = scan(e, less, at, rough_weight(e, less, at, 0.03), (50.0, 300.0))
    assert mode is not None
    assert mode.gyro == pytest.approx(theta["gyro.11"], rel=0.1)


def test_a_sensor_at_fault_is_named_and_no_mode_stands_in_for_it(rigid: tuple[Any, Record, Rig, RotorEstimate]) -> None:
    _, record, rig, _ = rigid
    x, y = record["ax_position"].values, record["ay_position"].values
    faulty = tuple(replace(c, values=x + 0.05 * y) if c.name == "ax_position" else c for c in record.channels)
    found = ambid.identify(replace(record, channels=faulty), rig)
    assert "ax_position holds" in found.checks["sensors_agree"].detail
    assert not found.modes


def test_an_estimate_comes_back_from_its_file(flexible: tuple[Any, Record, Rig, RotorEstimate], tmp_path: Any) -> None:
    *_, found = flexible
    found.save(tmp_path / "e.json")
    again = ambid.load(tmp_path / "e.json")
    assert again.values == found.values
    assert [m.frequency_hz for m in again.modes] == [m.frequency_hz for m in found.modes]
    np.testing.assert_array_equal(again.covariance, found.covariance)
