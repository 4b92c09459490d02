"""The on-line job from record to track: scenarios with known truth, damaged files, starts, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import AmbidError
from ambid.estimation.estimate import estimate_to_json
from ambid.job import identify, track
from ambid.physics.presets import preset
from ambid.record import Record, write_record
from ambid.recursive.lines import TrackedValue, TrackHeader
from ambid.rig import default_rig
from ambid.signals import multisine
from ambid.simulation import simulate_preset, simulate_scenario, truth_columns
from tests.tracking.runs import RATE, START_S, TRUE, simulated, start, step

BENCH = preset("unstable-bearing")
ROLES = ("voltage", "current", "position")


def scenario(name, seconds, **settings):
    """A record in roles, and the truth at its end."""
    made = simulate_scenario(name, BENCH, duration_s=seconds, seed=2, **settings)
    record = made.record
    roles = (*ROLES, *(n for n in ("speed", "angle") if n in record.names))
    truth = {**made.truth, **{n: c.values[-1] for n, c in truth_columns(record).items()}}
    return replace(record, channels=tuple(record.channel(c) for c in roles)), truth


def far(found, truth):
    """Numbers of the last line that are more than four standard deviations off."""
    last = {**found.lines[-1].parameters, **found.lines[-1].extra}
    return {n: (v.value, truth[n]) for n, v in last.items() if n in truth and abs(v.value - truth[n]) > 4.0 * v.sd}


def kinds(found):
    return [e.kind for line in found.lines for e in line.events if e.kind != "refused"]


@pytest.mark.parametrize(
    ("name", "moved"), [("change", "k_i"), ("added-mass", "m"), ("sensor-gain", "gain_position"), ("offset", None)]
)
def test_a_scenario_is_told_as_it_was(name, moved):
    record, truth = scenario(name, 2.4, at_s=1.6)
    found = track(record)
    assert [e.parameter for e in found.totals.changes] == ([moved] if moved else [])
    assert all(e.t == pytest.approx(1.6, abs=0.02) for e in found.totals.changes)
    assert far(found, truth) == {}
    assert found.lines[-1].state == "tracking"


@pytest.mark.parametrize("pushed", [False, True])
def test_nothing_is_told_where_nothing_changes(pushed):
    record, truth = scenario("steady", 2.5)
    if pushed:  # a fast excitation that meets the limits of the voltage, from half of the time on
        u = simulate_scenario("steady", BENCH, duration_s=2.5, seed=2, log_excitation=True).record["excitation"].copy()
        low, high = BENCH.limits.voltage
        fast = multisine(20_000, RATE, amplitude=0.75 * (high - low), band=(RATE / 40, RATE / 5), seed=3)
        u[25_000:] += np.resize(fast, 25_000)
        done = simulate_preset(BENCH, u, seed=2)
        assert done.n_saturated > 0
        record = done.record
    found = track(record)
    assert kinds(found) == []
    assert found.totals.update_s == 0.0
    assert {line.state for line in found.lines} == {"tracking"}
    assert far(found, truth) == {}


def test_a_coil_that_warms_is_followed_without_an_alarm():
    record, truth = scenario("drift", 5.0)
    found = track(record)
    assert found.totals.changes == ()
    assert found.lines[-1].parameters["R"].value == pytest.approx(truth["R"], rel=0.01)
    assert far(found, {n: v for n, v in truth.items() if n != "R"}) == {}


def test_a_spin_up_gives_the_unbalance_without_a_rig(tmp_path):
    record, truth = scenario("spin-up", 3.0, at_s=1.2)
    write_record(record, tmp_path / "spin.csv")
    found = track(tmp_path / "spin.csv")
    assert far(found, truth) == {}
    last = found.lines[-1].extra
    assert last["unbalance"].value == pytest.approx(truth["unbalance"], rel=0.05)
    assert last["unbalance_phase"].value == pytest.approx(truth["unbalance_phase"], abs=0.05)
    assert found.totals.changes == ()


def test_columns_of_other_units_are_no_rotation(tmp_path):
    record, _ = scenario("spin-up", 1.5, at_s=0.2)
    wrong = [replace(c, unit="m/s", source_unit="m/s") if c.name == "speed" else c for c in record.channels]
    write_record(replace(record, channels=tuple(c for c in wrong if c.name != "angle")), tmp_path / "other.csv")
    assert "unbalance" not in track(tmp_path / "other.csv").lines[-1].extra


def test_a_quiet_rotor_after_a_start_from_an_estimate_is_frozen_and_thaws():
    loud, quiet = simulated(seconds=1.5), simulate_scenario("quiet", BENCH, duration_s=4.0, seed=3).record
    both = tuple(replace(c, values=np.concatenate([quiet[c.name][: 4 * RATE], c.values])) for c in loud.channels)
    found = track(replace(loud, channels=both), start=start(), every_s=0.05)
    assert found.totals.changes == ()
    states = [line.state for line in found.lines if 2.5 < line.t < 4.0]
    assert set(states) == {"frozen"}
    middle = next(line for line in found.lines if line.t >= 3.5)
    assert all(v.stale for v in middle.parameters.values())
    assert found.lines[-1].state == "tracking"
    assert not any(v.stale for v in found.lines[-1].parameters.values())
    assert far(found, TRUE) == {}


@pytest.fixture(scope="module")
def steady():
    record = simulated(seconds=2.5, seed=2)
    return record, track(record, memory="all")


def rows(record):
    columns = np.column_stack([record.time_s, *[record[c] for c in ROLES]])
    return [",".join(map(repr, row)) for row in columns.tolist()]


def written(path, lines):
    path.write_text("time [s],voltage [V],current [A],position [m]\n" + "\n".join(lines) + "\n")
    return path


def damaged(lines, how):
    n, m = round(1.6 * RATE), round(1.9 * RATE)
    lost = 400
    if how == "nan":
        for k in range(n, n + lost):
            lines[k] = lines[k].split(",")[0] + ",,,"
    elif how == "gap":
        del lines[n : n + lost]
    elif how == "repeated":
        lines[n + lost : n + lost] = lines[n : n + lost]
    elif how == "late":
        lines[n : n + 2 * lost] = lines[n + lost : n + 2 * lost] + lines[n : n + lost]
    elif how == "clock":
        for k in range(m, len(lines)):
            t, rest = lines[k].split(",", 1)
            lines[k] = f"{float(t) - 1000.0!r},{rest}"
    return lines


@pytest.mark.parametrize(
    ("how", "rejected"), [("nan", 400), ("gap", 400), ("repeated", 400), ("late", None), ("clock", 0)]
)
def test_a_damaged_file_ends_at_the_same_estimate_and_says_what_was_left_out(tmp_path, steady, how, rejected):
    record, plain = steady
    found = track(written(tmp_path / "r.csv", damaged(rows(record), how)), memory="all")
    for name, value in found.lines[-1].parameters.items():
        assert abs(value.value - plain.lines[-1].parameters[name].value) < value.sd
        assert value.sd < 1.2 * plain.lines[-1].parameters[name].sd
    assert found.totals.changes == ()
    if rejected is not None:
        assert found.totals.rejected_samples == rejected
    if how != "late":
        assert found.totals.counts.get("rejected", 0) >= 1
    told = sum(e.samples or 0 for line in found.lines for e in line.events if e.kind == "rejected")
    assert told == found.totals.rejected_samples
    assert np.diff([line.t for line in found.lines]) == pytest.approx(0.01)
    assert found.totals.complete


def test_lost_samples_all_over(tmp_path):
    record = simulated(seconds=3.0, seed=2)
    lines = rows(record)
    rng = np.random.default_rng(4)
    gone = []
    for first in range(round(1.2 * RATE), len(lines) - 800, 800):  # one burst in 800 samples, about 8 long
        for k in range(first, first + int(rng.geometric(1 / 8))):
            lines[k] = lines[k].split(",")[0] + ",,,"
            gone.append(k)
    found = track(written(tmp_path / "r.csv", lines))
    assert found.totals.rejected_samples == len(gone)
    assert far(found, TRUE) == {}
    assert found.totals.changes == ()


def test_the_start_passes_over_a_damaged_beginning(tmp_path, steady):
    lines = rows(steady[0])
    lines[100] = lines[100].split(",")[0] + ",,,"
    found = track(written(tmp_path / "r.csv", lines))
    assert found.lines[0].t > 0.83 + 100 / RATE
    assert far(found, TRUE) == {}
    with pytest.raises(AmbidError, match="damaged"):
        track(tmp_path / "r.csv", start=0.5)


def test_a_start_from_a_file_begins_at_the_first_sample(tmp_path, steady):
    record, _ = steady
    (tmp_path / "e.json").write_text(json.dumps(estimate_to_json(start(2))))
    found = track(record, start=tmp_path / "e.json", to_s=0.5)
    assert found.lines[0].t == pytest.approx(0.01)
    assert found.header.start["k_i"].value == pytest.approx(start(2).values["k_i"])
    assert found.totals.samples == RATE // 2


def test_starts_that_do_not_fit_are_refused(tmp_path, steady):
    record, _ = steady
    half = replace(record, rate_hz=RATE / 2)
    with pytest.raises(AmbidError, match="20000 Hz, the record of 'one-axis' at 10000 Hz"):
        track(half, start=start(2))
    with pytest.raises(AmbidError, match="they must agree"):
        track(record, replace(default_rig("coil"), record=default_rig().record), start=start(2))


def test_records_that_are_too_short_are_refused(steady):
    record, _ = steady
    with pytest.raises(AmbidError, match="leaves nothing"):
        track(record, start=5.0)
    with pytest.raises(AmbidError):
        track(record, to_s=0.002)


def test_flags_and_stops_from_the_outside(steady):
    record, _ = steady
    seen = []

    def on_line(line):
        seen.append(line.state)
        return ("hold",) if len(seen) == 10 else ("track",) if line.t > 2.0 else ()

    found = track(record, on_line=on_line, keep=False)
    assert len(found.lines) == 1  # the last one
    n = round((2.0 - START_S * 2.5 / 3) * 100)
    assert set(seen[10 : n - 2]) == {"hold"}
    assert seen[-1] == "tracking"


def test_what_is_published_before_tracking_is_the_identified_start(steady):
    record, found = steady
    first = round(2.5 / 3 * RATE)
    part = replace(record, channels=tuple(replace(c, values=c.values[:first].copy()) for c in record.channels))
    known = identify(part)
    for name, value in found.header.start.items():
        assert value.value == pytest.approx(known.values[name], rel=1e-9)


def test_the_working_memory_does_not_grow(steady):
    record, _ = steady

    def weight(seconds):
        import tracemalloc

        tracemalloc.start()
        track(record, start=start(2), to_s=seconds, keep=False)
        peak = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
        return peak

    weight(0.5)
    assert weight(2.5) < weight(1.5) + 200_000


def test_a_change_is_followed_at_any_limit_and_interval():
    record = simulated(step("k_i", 0.85, 1.6), seconds=2.2)
    for limit, every_s in ((1.1, 0.05), (5.0, 0.003)):
        found = track(record, limit=limit, every_s=every_s)
        assert [e.parameter for e in found.totals.changes] == ["k_i"]
        assert isinstance(record, Record)
        assert far(found, {**TRUE, "k_i": 0.85 * TRUE["k_i"]}) == {}
        assert found.header.every_s == every_s


SETTINGS = [
    {"every_s": float("nan")}, {"every_s": float("inf")}, {"every_s": 0.0}, {"every_s": -1.0},
    {"limit": float("inf")}, {"limit": float("nan")}, {"limit": 0.0}, {"memory": "x"}, {"memory": float("nan")},
    {"memory": 1e300}, {"memory": 0.0}, {"pace": "x"}, {"start": -0.1}, {"rate_hz": 100.0},
    {"rig": 3}, {"start": [3]}, {"from_s": "x"},
]  # fmt: skip


@pytest.mark.parametrize("wrong", SETTINGS, ids=str)
def test_settings_that_make_no_sense_are_refused_on_one_line(steady, wrong):
    with pytest.raises(AmbidError) as refused:
        track(steady[0], **{"start": start(2), **wrong})
    assert "\n" not in str(refused.value)
    assert next(iter(wrong)).removesuffix("s") in str(refused.value)


def ruled(role, value, sd=None, name="R"):
    rig = default_rig()
    said = tuple(replace(p, role=role, value=value, sd=sd) if p.name == name else p for p in rig.parameters)
    return replace(rig, parameters=said)


def test_a_rig_that_contradicts_the_start_is_refused_or_warned_of(steady):
    record, known = steady[0], start(2)
    brief = {"start": known, "to_s": 0.3}
    with pytest.raises(AmbidError, match="the rig fixes R at"):
        track(record, ruled("fixed", 3.0 * known.values["R"]), **brief)
    with pytest.raises(AmbidError, match="prior of R"):
        track(record, ruled("prior", 3.0 * known.values["R"], 0.01 * known.values["R"]), **brief)
    rig = default_rig()
    late = replace(rig, channels=tuple(replace(c, delay=7) if c.role == "voltage" else c for c in rig.channels))
    with pytest.raises(AmbidError, match=r"voltage\.delay = 7"):
        track(record, late, **brief)
    mild = track(record, ruled("prior", known.values["R"], 0.1 * known.values["R"]), **brief)
    assert any("R prior" in w for w in mild.header.warnings)
    assert track(record, **brief).header.warnings == track(record, rig, **brief).header.warnings == known.warnings


def test_what_the_start_failed_is_passed_on(steady):
    coarse = [
        replace(c, values=np.round(c.values / 4.0) * 4.0) if c.name == "voltage" else c for c in steady[0].channels
    ]
    found = track(replace(steady[0], channels=tuple(coarse)), to_s=2.0)
    assert found.header.warnings


def test_a_track_is_no_better_than_its_start(steady):
    def judged(**more):
        return track(steady[0], start=replace(start(2), **more), to_s=0.3)

    own = start(2)
    harmless, harmful = ({name: f * own[name].sd for name in own.covariance_names} for f in (0.5, 5.0))
    assert judged().verdict.word == judged(extended=("line (13 Hz)",), bias_sd=harmless).verdict.word == "usable"
    for cause in ("cross_talk", "line (13 Hz)", "r_drift (0.2 ohm)"):
        found = judged(extended=(cause,), bias_sd=harmful)
        assert all(found[name].sd > harmful[name] for name in harmful)
        (reason,) = found.verdict.reasons
        assert (reason.check, reason.grave) == ("start", False)
        assert f"extended by {cause}, which tracking leaves out" in reason.text
        assert "Remove the cause" in reason.text
    first_guess = judged(status="stalled").verdict
    assert first_guess.word == "unusable"
    assert first_guess.reasons[0].text.startswith("the start is unusable: the search did not converge")


def test_values_have_what_the_rig_says_of_calibration(steady):
    rig, brief = default_rig(), {"start": start(2), "to_s": 0.3}
    known = {"voltage": 0.03, "current": 0.04}
    channels = tuple(replace(c, gain_sd=known.get(c.role)) for c in rig.channels)
    found = track(steady[0], replace(rig, channels=channels), **brief)
    for name, share in {"R": 0.05, "k_i": 0.03, "k_x": 0.05}.items():  # V/A, V, V A
        p = found[name]
        assert p.sd_calibrated == pytest.approx(np.hypot(p.sd, share * p.value), rel=1e-6)
        assert p.ci95_calibrated[1] - p.value == pytest.approx(1.96 * p.sd_calibrated, rel=1e-4)
    text = " ".join(found.summary().split())
    assert "with calibration" in text
    assert "Some of the calibration is in no interval. 1 % of gain moves: position" in text
    assert found.to_dataframe()["R sd_calibrated"].iloc[-1] == found["R"].sd_calibrated
    untold = track(steady[0], **brief)
    assert (untold["R"].sd_calibrated, untold["R"].ci95_calibrated) == (None, None)
    assert "Intervals are from this record alone. 1 % of gain moves: voltage" in " ".join(untold.summary().split())


def test_a_number_that_the_start_did_not_show_is_no_measure_of_its_error_of_scale():
    header = TrackHeader(
        rate_hz=1e3, limit=1.5, method="rpem", model="one-axis", units={}, every_s=0.1, scale_sd={"R": 0.3, "c": 0.3},
        start={"R": TrackedValue(value=2.0, sd=0.1), "c": TrackedValue(value=0.1, sd=1.0)},
    )  # fmt: skip
    assert header.sd_calibrated("R", TrackedValue(value=10.0, sd=4.0)) == pytest.approx(5.0)
    assert header.sd_calibrated("c", TrackedValue(value=10.0, sd=0.04)) == pytest.approx(0.05)
    assert header.sd_calibrated("L", TrackedValue(value=10.0, sd=4.0)) is None


def test_an_incredible_value_is_rejected_not_learned(steady):
    wild = []
    for c in steady[0].channels:
        values = c.values.copy()
        if c.name == "current":
            values[6000:6020] = 1e10
        wild.append(replace(c, values=values))
    found = track(replace(steady[0], channels=tuple(wild)), start=start(2), to_s=0.6)
    assert found.totals.rejected_samples == 20
    assert kinds(found) == ["rejected"]


def test_complex_samples_are_refused(steady):
    channel = steady[0].channels[0]
    with pytest.raises(AmbidError, match="complex"):
        replace(channel, values=channel.values + 1j)
