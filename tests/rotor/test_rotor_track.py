"""A rotor's numbers from one period to the next: quiet, through jumps of one number, and what is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ambid
from ambid.errors import AmbidError
from ambid.record import Record
from ambid.recursive.lines import Track, TrackLine
from tests.rotor_benches import free_rig, model_of, needs_simulator, record_of, stepped, truth

pytestmark = needs_simulator
_FAR = 3.8  # standard deviations, of a hundred values
_PERIOD_S = 0.25


def _bench(name: str, **changes: Any) -> Any:
    return replace(truth.BENCHES[name], period=_PERIOD_S, periods=13, **changes)


@pytest.fixture(scope="module")
def jump() -> tuple[Any, Any, Record]:
    """A force factor loses a tenth in the middle of the ninth period."""
    bench = _bench("rigid")
    aged = replace(bench, k_i=(0.9 * bench.k_i[0], *bench.k_i[1:]))
    return bench, aged, stepped(bench, {round(8.6 * _PERIOD_S * bench.rate): aged}, 2)


@pytest.fixture(scope="module")
def track(jump: tuple[Any, Any, Record]) -> Track:
    return ambid.track(jump[2], free_rig(jump[0]))


def _distances(lines: Sequence[TrackLine], bench: Any) -> list[float]:
    _, theta = model_of(bench)
    return [(v.value - theta[name]) / v.sd for line in lines for name, v in line.parameters.items()]


def test_a_jump_of_a_force_factor_is_found_named_and_followed(jump: tuple[Any, Any, Record], track: Track) -> None:
    (event,) = track.totals.changes
    assert event.parameter == "ax.k_i"
    assert event.t == pytest.approx(8 * _PERIOD_S)
    assert event.values["after"] == pytest.approx(jump[1].k_i[0], rel=0.01)
    assert [line.t for line in track.lines if line.state == "changed"] == [pytest.approx(9 * _PERIOD_S)]
    assert track.verdict.word == "usable"
    assert [e.parameter for line in track.lines for e in line.events if e.kind == "accepted"] == ["ax.k_i"]


def test_the_bands_hold_the_truth_before_and_after(jump: tuple[Any, Any, Record], track: Track) -> None:
    quiet = [line for line in track.lines if line.t < 8.1 * _PERIOD_S]
    after = [line for line in track.lines if line.t > 10.1 * _PERIOD_S]
    for lines, bench in ((quiet, jump[0]), (after, jump[1])):
        assert len(lines) >= 3
        distances = np.array(_distances(lines, bench))
        assert np.max(np.abs(distances)) < _FAR
        assert np.sqrt(np.mean(distances**2)) < 1.6
        assert all(0.8 < line.error < 1.2 for line in lines)
    assert not [e for line in quiet for e in line.events]


def test_the_track_goes_through_its_file(track: Track, tmp_path: Path) -> None:
    track.save(tmp_path / "t.json")
    found = ambid.load(tmp_path / "t.json")
    assert found.header.every_s == pytest.approx(_PERIOD_S)
    assert found.header.units["ax.k_i"] == "N/A"
    assert found["ax.k_i"].value == track["ax.k_i"].value


def test_a_mode_that_moves_farther_than_it_is_wide_is_found_again() -> None:
    bench = _bench("flexible", modes=1, zeta=(0.02,), band=(4.0, 400.0), rate=10_000.0)
    aged = replace(bench, shaft=replace(bench.shaft, E=0.97 * bench.shaft.E))
    found = ambid.track(stepped(bench, {round(7.3 * _PERIOD_S * bench.rate): aged}, 4), free_rig(bench))
    assert [e.parameter for e in found.totals.changes] == ["mode1.frequency"]
    f = found["mode1.frequency"]
    assert abs(f.value - truth.modal_of(aged).omega[2] / (2.0 * np.pi)) < _FAR * f.sd
    assert f.unit == "Hz"


def test_what_cannot_be_tracked_is_refused(jump: tuple[Any, Any, Record]) -> None:
    bench, _, record = jump
    rig, spin = free_rig(bench), _bench("rigid-spin")
    start = ambid.identify(record[0.0 : 3 * _PERIOD_S], rig)
    refused: list[tuple[dict[str, Any], str]] = [
        ({"record": record[0.0 : 1.5 * _PERIOD_S], "rig": rig}, "not periodic"),
        ({"record": record, "rig": rig, "method": "ekf"}, "for one axis"),
        ({"record": record, "rig": rig, "start": 100.0}, "13 whole periods"),
        ({"record": record, "start": start}, "estimate of a rotor"),
        ({"record": record_of(replace(spin, periods=2), 1), "rig": free_rig(spin), "start": start}, "has no Ip"),
    ]
    for words, said in refused:
        with pytest.raises(AmbidError, match=said):
            ambid.track(**words)


def test_a_track_inherits_what_stands_against_its_start_and_its_calibration(jump: tuple[Any, Any, Record]) -> None:
    record, rig = jump[2], free_rig(jump[0])
    head = ambid.identify(record[: 4 * _PERIOD_S], rig)
    known = replace(
        rig, channels=tuple(replace(c, gain_sd=0.02 if c.role == "ax_voltage" else None) for c in rig.channels)
    )
    found = ambid.track(record, known, start=replace(head, status="stalled"))
    assert found.verdict.word == "unusable"
    assert found.verdict.reasons[0].text.startswith("the start is unusable: the search did not converge")
    R, other = found["ax.R"], found["bx.R"]
    assert R.sd < 0.01 * R.value  # so that calibration is most of it; other numbers take up a little
    assert R.sd_calibrated == pytest.approx(np.hypot(R.sd, 0.02 * R.value), rel=0.01)
    assert other.sd_calibrated == pytest.approx(other.sd, rel=0.01)
