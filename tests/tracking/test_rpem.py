"""The recursive estimator away from the ordinary: odd starts, impossible steps, other models, silence, unbalance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.job import identify
from ambid.physics.presets import preset
from ambid.record import Channel, Record
from ambid.rig import default_rig
from ambid.simulation import simulate_scenario
from ambid.tracking.evidence import Evidence
from ambid.tracking.numbers import amplitude_and_phase, forcing_of, tracked_numbers
from ambid.tracking.rpem import DriftRates, ParameterFilter, PhysicalRpem
from tests.bearing.benches import SETTINGS
from tests.tracking.starts import BEARING, bearing, bearing_start, bench_record, bench_start, columns, signals


def sound(estimator):
    covariance = estimator.covariance
    sd = np.sqrt(np.diag(covariance))
    assert np.all(np.isfinite(estimator.estimate))
    assert np.all(sd > 0)
    np.linalg.cholesky(covariance / np.outer(sd, sd) + 1e-12 * np.eye(sd.size))


@pytest.mark.parametrize(
    ("bench", "of", "n"), [("coil", "coil", 6000), ("sprung rotor", "rotor", 6000), ("thesis", "one-axis", 30_000)]
)
def test_other_models_are_tracked_to_the_truth(bench, of, n):
    start = bench_start(bench, 2000, 1, of)
    r = PhysicalRpem(start, memory="all")
    r.update(*signals(bench_record(bench, n, 2), of))
    truth = np.array([SETTINGS[bench].truth[k] for k in r.names])
    sd = np.sqrt(np.diag(r.covariance))
    assert np.all(np.abs(r.estimate - truth) < 4.0 * sd)
    assert np.all(sd < np.sqrt(np.diag(start.covariance)))
    sound(r)


@pytest.mark.parametrize("free", [("k_i",), ("m", "R"), ("L",)])
def test_few_free_parameters(free):
    rig = default_rig("one-axis")
    truth = preset(BEARING).parameters
    fixed = tuple(p if p.name in free else replace(p, role="fixed", value=truth[p.name]) for p in rig.parameters)
    start = identify(bearing(4000, 1), replace(rig, parameters=fixed))
    r = PhysicalRpem(start)
    assert r.names == free
    r.update(*columns(bearing(6000, 2)))
    sd = np.sqrt(np.diag(r.covariance))
    assert np.all(np.abs(r.estimate - [truth[k] for k in free]) < 4.0 * sd)


def test_nothing_free_is_refused():
    start = bearing_start(4000, 1)
    nothing = replace(start, covariance_names=(), covariance=np.zeros((0, 0)))
    with pytest.raises(EstimationError, match="no estimated parameters"):
        PhysicalRpem(nothing)
    with pytest.raises(EstimationError):
        PhysicalRpem(replace(start, status="failed"))


@pytest.mark.parametrize("memory", [0.0, -1.0, float("nan")])
def test_a_memory_that_is_not_positive_is_refused(memory):
    with pytest.raises(EstimationError, match="must be positive"):
        PhysicalRpem(bearing_start(4000, 1), memory=memory)


def test_a_start_without_a_predictor_is_refused():
    start = bearing_start(4000, 1)
    values = tuple(replace(p, value=-1.0) if p.name == "m" else p for p in start.parameters)
    with pytest.raises(EstimationError):
        PhysicalRpem(replace(start, parameters=values))


def test_a_parameter_that_nothing_is_known_of_comes_in():
    """A huge standard deviation at the start, and a value half off, as of a parameter that was not identifiable."""
    start = bearing_start(4000, 1)
    numbers = tracked_numbers(start)
    place = numbers.names.index("R")
    covariance, begin = numbers.covariance.copy(), numbers.start.copy()
    covariance[place, :] = covariance[:, place] = 0.0
    covariance[place, place], begin[place] = 100.0, 1.5 * begin[place]
    r = PhysicalRpem(replace(numbers, start=begin, covariance=covariance), memory="all")
    r.update(*columns(bearing(20_000, 2)))
    sd = np.sqrt(np.diag(r.covariance))
    assert np.all(np.abs(r.estimate - [preset(BEARING).parameters[k] for k in r.names]) < 4.0 * sd)
    assert sd[r.names.index("R")] < 0.02


def test_no_step_makes_a_mass_negative():
    """Samples of another bench under a start that is sure of nothing."""
    numbers = tracked_numbers(bearing_start(4000, 1))
    r = PhysicalRpem(replace(numbers, covariance=1e4 * numbers.covariance))
    u, y = columns(bearing(6000, 2))
    place = r.names.index("m")
    for k in range(0, 6000, 100):
        r.update(3.0 * u[k : k + 100], y[k : k + 100] * [-2.0, 1.0])
        assert r.estimate[place] > 0.0
        sound(r)
    assert np.isfinite(r.noise_level)


def test_numbers_without_a_predictor_are_left_again_and_counted():
    r = PhysicalRpem(bearing_start(4000, 1))
    before = r.stream.at.at.copy()
    beyond = before.copy()
    beyond[r.names.index("m")] = -0.5
    assert not r.move_to(beyond)
    assert r.n_unreached == 1
    assert 0.0 < r.stream.at.at[r.names.index("m")] < before[r.names.index("m")]
    r.update(*columns(bearing(6000, 2), 0, 2000))
    assert r.n_unreached == 1
    sound(r)


@pytest.mark.parametrize("memory", ["auto", "all", 2.0])
def test_silence_changes_nothing_that_it_does_not_show(memory):
    simulation = simulate_scenario("quiet", preset(BEARING), duration_s=4.0, seed=3)
    r = PhysicalRpem(bearing_start(20_000, 1), memory=memory)
    u, y = columns(simulation.record)
    truth = np.array([preset(BEARING).parameters[k] for k in r.names])
    for k in range(0, u.shape[0], 20_000):
        r.update(u[k : k + 20_000], y[k : k + 20_000])
        sound(r)
        assert np.all(np.abs(r.estimate - truth) < 4.0 * np.sqrt(np.diag(r.covariance)))
    assert r.noise_level == pytest.approx(1.0, abs=0.1)


def test_unbalance_is_found_through_a_spin_up():
    simulation = simulate_scenario("spin-up", preset(BEARING), duration_s=4.0, seed=5)
    record = simulation.record
    forcing = forcing_of(record)
    numbers = tracked_numbers(bearing_start(20_000, 1), synchronous=True, top_speed=forcing.top_speed)
    r = PhysicalRpem(numbers)
    r.update(*columns(record), forcing.columns)
    at = numbers.places("unbalance")
    size = numbers.magnitude[at]
    a, b = r.filter.q[at] * size
    amplitude, sd, phase, phase_sd = amplitude_and_phase(
        a, b, r.filter.covariance[np.ix_(at, at)] * np.outer(size, size)
    )
    truth = {k: record[f"true_{k}"][-1] for k in ("unbalance", "unbalance_phase")}
    assert abs(amplitude - truth["unbalance"]) < 4.0 * sd
    assert abs(phase - truth["unbalance_phase"]) < 4.0 * phase_sd
    assert sd < 0.02 * amplitude
    values = np.array([preset(BEARING).parameters[k] for k in r.names])
    assert np.all(np.abs(r.estimate - values) < 4.0 * np.sqrt(np.diag(r.covariance)))


def turning(speed_unit=1.0, angle_sign=1.0, lost=()):
    t = np.arange(20_000) / 10_000.0
    speed, angle = 300.0 * t, 150.0 * t**2
    columns = {"speed": speed * speed_unit, "angle": np.mod(angle_sign * np.round(angle / 0.1) * 0.1, 2.0 * np.pi)}
    kept = np.setdiff1d(np.arange(t.size), lost)
    channels = tuple(
        Channel(name=n, unit={"speed": "rad/s", "angle": "rad"}[n], values=v[kept]) for n, v in columns.items()
    )
    return Record(channels=channels, rate_hz=10_000.0)


def test_a_speed_that_is_not_the_derivative_of_its_angle_is_refused():
    assert forcing_of(turning()).top_speed == pytest.approx(600.0, rel=1e-3)
    assert forcing_of(turning(lost=np.arange(4_000, 4_300))) is not None
    for wrong in (turning(speed_unit=2.0 * np.pi / 60.0), turning(speed_unit=9.55), turning(angle_sign=-1.0)):
        with pytest.raises(EstimationError, match="times the speed"):
            forcing_of(wrong)


def test_a_joint_cause_of_one_number_alone_moves_nothing_together(monkeypatch):
    r = PhysicalRpem(bearing_start(4000, 1))
    r._joints = [np.eye(r.filter.q.size)[0]]  # the others start at zero
    monkeypatch.setattr(type(r.drift), "risen", property(lambda drift: np.ones_like(drift.variance)))
    before = r.filter.q.copy()
    r.predict()
    assert np.array_equal(r.filter.q, before)
    sound(r)


JOINT = np.array([1.0, 1.0, 0.0])


def looks(slope, *, seed=1, from_=200, count=400, noise=1.0, alone=0):
    """Numbers that stand still until chunk `from_`, then drift by `slope` a chunk, known by a filter that expects no
    drift: after each chunk, where they are, where it takes them to be, how far that may be off, and their ends.
    """
    rng, p, block_s = np.random.default_rng(seed), 3, 0.05
    rates = np.full(p, 1e-9)
    drift, known = DriftRates(rates, rates, 10.0 * rates, block_s), ParameterFilter(np.zeros(p), 1e-4 * np.eye(p))
    found = []
    for k in range(count):
        known.walk(rates, block_s)
        moved, J = slope * max(k + 0.5 - from_, 0.0), np.triu(40.0 * rng.normal(size=(p, p)))
        evidence = Evidence(
            names=("a", "b", "c"), at=np.zeros(p), J=J, r=noise * rng.normal(size=p) - J @ moved, rest=1.0, n_samples=9,
            n_outputs=1, first=k, last=k + 1,
        )  # fmt: skip
        drift.add(evidence, known)
        known.absorb(evidence)
        seen = drift.look(np.vstack([np.eye(p), JOINT]), alone, 1.0)
        found.append((moved + 0.5 * slope, known.q.copy(), *seen))
    drift.restart()
    assert drift.look(np.eye(p), alone, 1.0).size == 0
    return found


def test_a_drift_that_has_begun_is_seen_with_its_way():
    for seed in (1, 2, 3):
        for now, _, ways, ends, _ in looks(4e-3 * JOINT, seed=seed)[211:216]:
            together = np.all(ways[:, :2] > 0.5 * now[0], axis=1)
            assert together.any()
            assert np.all(ways[together, 2] < 0.05 * now[0])
            assert np.abs(ends[together, 0] - now[0]).min() < 0.35 * now[0]


def test_what_a_drift_leaves_wrong_is_told_of_all_numbers():
    """Without noise: how far an estimate that expects no drift is off until the next look, of what drifts and of what
    stands still beside it.
    """
    slope = 4e-2 * JOINT
    for n in (5, 10, 14, 20):
        now, taken, ways, ends, _ = looks(slope, count=201 + n, noise=0.0)[199 + n]
        right = np.argmin(np.abs(ends - now - slope).max(axis=1))
        np.testing.assert_allclose(ends[right], now + slope, atol=1e-4)
        np.testing.assert_allclose(ways[right], np.abs(now + slope - taken), rtol=0.02, atol=1e-6)


@pytest.mark.parametrize(("alone", "share"), [(0, 0.06), (3, 0.28)])
def test_without_a_drift_little_is_suspected(alone, share):
    """Of one of three parameters alone two standard deviations count, over 0.5 and 1 s: 5 % each, which overlap."""
    seen = [ways.size > 0 for seed in (1, 2, 3) for *_, ways, _, _ in looks(0.0 * JOINT, seed=seed, alone=alone)]
    assert np.mean(seen) < share


@pytest.mark.parametrize("known", [1.0, 1e4, 1e8])
def test_a_ramp_that_the_data_do_not_tell_at_all_is_none(known):
    """All that is known of two numbers came in one chunk, of their sum: what is left of a ramp's information is
    rounding, and with little known before so is the covariance.
    """
    p, rates = 3, np.full(3, 1e-9)
    drift, before = DriftRates(rates, rates, 10.0 * rates, 0.05), ParameterFilter(np.zeros(p), known * np.eye(p))
    J = np.array([[1e4, 1e4, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    for k in range(30):
        evidence = Evidence(
            names=("a", "b", "c"), at=np.zeros(p), J=J if k == 9 else 0.0 * J, r=np.ones(p), rest=1.0, n_samples=9,
            n_outputs=1, first=k, last=k + 1,
        )  # fmt: skip
        drift.add(evidence, before)
        before.absorb(evidence)
        assert drift.look(np.eye(p), 0, 1.0).size == 0


def test_a_look_is_one_between_chunks_and_the_same_without_adaptation():
    p, rates = 3, np.full(3, 1e-9)
    evidence = Evidence(
        names=("a", "b", "c"), at=np.zeros(p), J=np.eye(p), r=np.zeros(p), rest=1.0, n_samples=9, n_outputs=1, first=0,
        last=1,
    )  # fmt: skip
    for ceiling in (10.0 * rates, rates):
        drift, known = DriftRates(rates, rates, ceiling, 0.025), ParameterFilter(np.zeros(p), np.eye(p))
        first = drift.look(np.eye(p), 0, 1.0)
        for _ in range(13):
            drift.add(evidence, known)
        assert first.size == 0
        assert drift.look(np.eye(p), 0, 1.0) is (None if drift.adapts else first)
        drift.restart()
        drift.add(evidence, known)
        assert drift.look(np.eye(p), 0, 1.0) is first  # the window before is forgotten at once


def test_a_ramp_is_tested_as_in_the_dense_regression():
    """Of all rows at once: numbers known before, a ramp along each cause, and white noise."""
    rng, p, noise = np.random.default_rng(10), 3, 1.7
    walk, before = 0.1 * rng.uniform(size=p), ParameterFilter(np.zeros(p), np.diag(rng.uniform(1.0, 2.0, p)))
    drift = DriftRates(walk, walk, 2.0 * walk, 0.05)
    rows, known = [], []
    for k in range(9):
        J, r, at = np.triu(rng.normal(size=(p, p))), rng.normal(size=p), rng.normal(size=p)
        before.q = rng.normal(size=p)
        evidence = Evidence(
            names=("a", "b", "c"), at=at, J=J, r=r, rest=1.0, n_samples=9, n_outputs=1, first=k, last=k + 1
        )
        drift.add(evidence, before)
        rows.append((J, r - J @ at))
        known.append(before.q)
    causes = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, -2.0]])
    lengths = np.array([3, 6])
    statistics, each = drift.ramps(lengths, causes, noise)
    for n, found, (off, ends, spread) in zip(lengths, statistics, np.swapaxes(each, 0, 1), strict=True):
        J, left = (np.concatenate(x) for x in zip(*rows[-n:], strict=True))
        P, w = before.covariance + n * 0.025 * np.diag(walk), np.repeat((np.arange(n) + 0.5) / n, p)
        for statistic, cause, b, end, variance in zip(found, causes, off, ends, spread, strict=True):
            # unknown: the numbers before the ramp, and its size
            full = np.column_stack([J, w * (J @ cause)])
            information = full.T @ full / noise
            information[:p, :p] += np.linalg.inv(P)
            covariance = np.linalg.inv(information)
            solved = covariance @ np.r_[np.linalg.solve(P, known[-n]) - J.T @ left / noise, -full[:, p] @ left / noise]
            on, size = cause * (n + 1) / n, solved[p]
            alone = np.linalg.solve(information[:p, :p], information[:p, p])  # what is drawn along if there is no ramp
            assert statistic == pytest.approx(size**2 / covariance[p, p], rel=1e-9)
            np.testing.assert_allclose(end, solved[:p] + size * on, rtol=1e-9)
            np.testing.assert_allclose(b, np.abs(size * (on - alone)), rtol=1e-9)
            chance = np.diag(np.linalg.inv(information[:p, :p])) + covariance[p, p] * (on - alone) ** 2
            np.testing.assert_allclose(variance, chance + (solved[:p] - known[-n]) ** 2, rtol=1e-9)
