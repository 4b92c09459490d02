"""Any recursive estimator on a record: its numbers, its lines, and what it refuses."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ambid.cli import run
from ambid.errors import EstimationError
from ambid.job import track
from ambid.physics.presets import preset
from ambid.record import Channel, Record
from ambid.recursive.lines import Track
from ambid.simulation import simulate_scenario
from ambid.tracking.lines_file import read_track

A1, B1, N, RATE = -0.8, 0.5, 4000, 1000.0
ARX = {"na": 1, "nb": 1, "nk": 1}


def first_order(*, loop: bool = False) -> Record:
    """y(t) = 0.8 y(t-1) + 0.5 u(t-1) + noise about 3 V and 2 mA; in a loop with coloured noise and a reference."""
    rng = np.random.default_rng(1)
    u, y, r, e = np.zeros(N), np.zeros(N), rng.standard_normal(N), 0.1 * rng.standard_normal(N)
    for t in range(N):
        if t:
            y[t] = -A1 * y[t - 1] + B1 * u[t - 1] + e[t] + (0.9 * e[t - 1] if loop else 0.0)
        u[t] = r[t] - (0.6 * y[t] if loop else 0.0)
    named = {"u": ("V", u + 3.0), "y": ("A", 1e-3 * y + 2e-3), "r": ("V", r)}
    channels = tuple(Channel(name=k, unit=unit, values=x) for k, (unit, x) in named.items())
    return Record(channels=channels, rate_hz=RATE)


def last(found: Track) -> tuple[dict[str, float], dict[str, float]]:
    parameters = found.lines[-1].parameters
    return {k: p.value for k, p in parameters.items()}, {k: p.sd for k, p in parameters.items()}


@pytest.mark.parametrize(
    ("method", "more"),
    [
        ("rls", {"memory": 2.0}),
        ("lms", {"step": 0.02}),
        ("nlms", {"step": 0.05}),
        ("arx", {}),
        ("armax", {"orders": ARX | {"nc": 1}}),
    ],
)
def test_coefficients_come_in_si_with_their_deviations(method: str, more: dict[str, object]) -> None:
    settings = {"input": "u", "output": "y", "orders": ARX} | more
    found = track(first_order(), method=method, every_s=0.1, **settings)  # type: ignore[arg-type]
    value, sd = last(found)
    assert abs(value["a1"] - A1) < 4 * sd["a1"] < 0.4
    assert abs(value["b1"] - 1e-3 * B1) < 4 * sd["b1"] < 4e-4
    assert found.header.units["b1"] == "A/V"
    assert found.header.method.startswith(f"{method}, memory")
    assert len(found.lines) == 40
    assert found.lines[-1].t == pytest.approx(N / RATE)
    assert found.lines[-1].error == pytest.approx(1.0, abs=0.4)
    assert found.totals.samples + found.totals.rejected_samples == N


def test_feedback_biases_and_is_told() -> None:
    record, settings = first_order(loop=True), {"input": "u", "output": "y", "orders": ARX}
    rls = track(record, method="rls", **settings)  # type: ignore[arg-type]
    value, sd = last(rls)
    assert abs(value["a1"] - A1) > 5 * sd["a1"]
    assert "biased" in rls.header.warnings[0]


@pytest.mark.parametrize("method", ["ekf", "ukf"])
def test_joint_filters_follow_physical_parameters_from_an_identified_start(method: str) -> None:
    bench = preset("unstable-bearing")
    record = simulate_scenario("steady", bench, duration_s=1.0, seed=2).record
    found = track(record, method=method, start=0.6, memory=5.0)
    value, sd = last(found)
    for name in ("m", "k_i", "R"):
        assert abs(value[name] - bench.parameters[name]) < 5 * sd[name]
    assert found.header.start["m"].value > 0
    assert found.header.units["force_offset"] == "N"
    assert found.totals.samples == 8000


@pytest.mark.parametrize(
    ("method", "more", "match"),
    [
        ("kalman", {}, "unknown"),
        ("rls", {"orders": None}, "needs input"),
        ("rls", {"orders": {"na": 1, "nb": 1, "nk": "auto"}}, "cannot choose it"),
        ("rls", {"step": 0.1}, "no step"),
        ("lms", {"memory": 1.0}, "no memory"),
        ("armax", {"orders": None}, "needs orders"),
        ("rls", {"start": 1.0}, "no start"),
        ("ekf", {}, "no input"),
        ("rls", {"pace": "real-time"}, "no supervisor"),
        ("rls", {"output": ("y", "r")}, "one output"),
    ],
)
def test_what_a_method_would_ignore_or_lacks_is_refused(method: str, more: dict[str, object], match: str) -> None:
    settings = {"input": "u", "output": "y", "orders": ARX} | more
    with pytest.raises(EstimationError, match=match):
        track(first_order(), method=method, **settings)  # type: ignore[arg-type]


def test_the_command_writes_the_lines_of_the_contract(tmp_path) -> None:
    record, path = first_order(), tmp_path / "t.jsonl"
    rows = np.column_stack([record.time_s, *(c.values for c in record.channels)])
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",", header="time [s],u [V],y [A],r [V]", comments="", fmt="%.9g")
    words = ["track", str(tmp_path / "r.csv"), "--method", "rls", "--input", "u", "--output", "y", "--every", "0.5"]
    assert run([*words, "--orders", "na=1,nb=1,nk=1", "--open-loop", "--json", str(path)]) == 0
    first, *_, end = [json.loads(line) for line in path.read_text().splitlines()]
    assert (first["schema"], first["method"]) == ("ambid.track/1", "rls, memory auto")
    assert end["summary"]["samples"] == N - 1
    assert len(read_track(path).lines) == 8
    assert run([*words[:2], "--input", "u"]) == 2
