"""Experiments are designed for what identify will report, within limits that simulation keeps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

import ambid
from ambid.control.closed import Plant
from ambid.control.experiment import BROADBAND, ExcitedLoop, Limited, joint_design, reached
from ambid.control.information import Information, Innovation, informed_lines, power_design
from ambid.errors import AmbidError, EstimationError
from ambid.estimation.likelihood import linearise, weight_of
from ambid.estimation.predictor import PredictorProblem, scales_for
from ambid.physics.linear_model import Parameter, model
from ambid.physics.loop import Limits, Loop, Noise
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset
from ambid.rig.rig import RecordSettings, RigChannel
from ambid.simulation import simulate_rig

BENCH = preset("prototype")
PERIOD = 400
LINES = np.array([1, 2, 4, 7, 11, 16, 22, 29, 37, 46, 60, 76])
NAMES = ("k_x", "k_i", "R", "L", "voltage.delay")
NOISE = Noise(position=2e-6, current=2e-3, force=0.01, voltage=0.05)


@pytest.fixture(scope="module")
def loop():
    plant = Plant(
        model=model("one-axis"), theta=dict(BENCH.parameters), delays=np.array([BENCH.loop.delay]),
        rate_hz=BENCH.rate_hz, names=NAMES,
    )  # fmt: skip
    return ExcitedLoop.of(plant, BENCH.loop)


@pytest.fixture(scope="module")
def noise(loop):
    return Innovation.of(loop.plant, NOISE)


def information_of(loop, noise, **how):
    at = LINES * (BENCH.rate_hz / PERIOD)
    inputs = loop.response(LINES, PERIOD, np.zeros(LINES.size, dtype=int))[:, 2:3]
    return Information.of([loop.plant], [noise], at, [inputs], prior_sd={}, **how)


@pytest.fixture(scope="module")
def information(loop, noise):
    return information_of(loop, noise)


@pytest.fixture(scope="module")
def limited(loop):
    T = loop.response(LINES, PERIOD, np.zeros(LINES.size, dtype=int))[:, :3]
    high = np.array([3e-4, 0.3, 9.0])
    return Limited(lines=LINES, period=PERIOD, T=T, low=-0.8 * high, high=high)


def amplitudes(seed):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.2, 1.0, LINES.size) * np.exp(2j * np.pi * rng.random(LINES.size))


def test_the_information_is_that_of_the_predictor_on_a_record(loop, noise, information):
    c = amplitudes(1)
    limits = np.full(4, np.inf)
    T = loop.response(LINES, PERIOD, np.zeros(LINES.size, dtype=int))
    waves = Limited(lines=LINES, period=PERIOD, T=T, low=-limits, high=limits).waves(c)
    periods, plant = 12, loop.plant
    y, u = (np.tile(waves[:, k], (periods, 1)) for k in (slice(0, 2), slice(2, 3)))
    names = NAMES[:-1]
    sizes = np.abs([plant.theta[n] for n in names])
    scales = scales_for(plant.model, plant.theta, np.ones(1), np.sqrt(np.diag(noise.covariance)), plant.rate_hz)
    problem = PredictorProblem(
        model=plant.model, rate_hz=plant.rate_hz, u=u, y=y, estimated=names,
        known={n: x for n, x in plant.theta.items() if n not in names}, magnitude=sizes,
        prior_mean=np.zeros(4), prior_sd=np.full(4, np.inf), scales=scales, fractional=True, noise="given",
        gain=noise.gain * scales.output / scales.state[:, None],
    )  # fmt: skip
    vector = np.zeros(problem.size)
    vector[problem.slices["physical"]], vector[problem.slices["fraction"]] = (
        sizes**-1 * [plant.theta[n] for n in names],
        BENCH.loop.delay,
    )
    weight = weight_of(noise.covariance / np.outer(scales.output, scales.output))
    J = linearise(problem, vector, weight, None).J
    n = len(names) + 1
    left = J[:, :n] - J[:, n:] @ np.linalg.lstsq(J[:, n:], J[:, :n], rcond=None)[0]  # offsets and initial state
    found = left.T @ left
    expected = information.total(np.abs(c) ** 2, periods * PERIOD)[0]
    root = np.sqrt(np.diag(expected))
    assert np.allclose(found / np.outer(root, root), expected / np.outer(root, root), atol=0.02)


def test_the_powers_are_the_best_of_a_convex_problem(information, limited):
    cost = np.sum(np.abs(limited.T / limited.high) ** 2, axis=1)
    power, gap = power_design(information, cost, 1000.0)
    assert power @ cost == pytest.approx(1.0)
    assert 0.0 <= gap < 2e-3

    def value(v):
        share = np.exp(v - v.max())
        M = information.total(share / share.sum() / cost, 1000.0)
        judged, slope = information.judge(M)
        own = share / share.sum()
        gain = np.einsum("pkij,pij->k", information.lines, slope) * 1000.0 / cost
        return np.log(judged), own * (gain - own @ gain) / judged

    other = minimize(value, np.zeros(LINES.size), jac=True, method="BFGS", options={"maxiter": 500, "gtol": 1e-9})
    best = information.judge(information.total(power, 1000.0))[0]
    assert best == pytest.approx(np.exp(other.fun), rel=3e-3)
    # no other design is better by more than the bound
    for seed in range(5):
        share = np.random.default_rng(seed).dirichlet(np.ones(LINES.size))
        assert information.judge(information.total(share / cost, 1000.0))[0] > best / (1.0 + gap)


@pytest.mark.parametrize("criterion", ["all", "k_x"])
def test_slopes_are_exact(loop, noise, limited, criterion):
    information = information_of(loop, noise, criterion=criterion)
    c, rng, h = amplitudes(2), np.random.default_rng(3), 1e-6
    turn = rng.standard_normal(LINES.size) + 1j * rng.standard_normal(LINES.size)
    sizes = [limited.norm(c + s * h * turn, 20.0)[0] for s in (1, -1)]
    assert np.real(limited.norm(c, 20.0)[1] @ turn) == pytest.approx((sizes[0] - sizes[1]) / (2 * h), rel=1e-5)
    power, step = np.abs(c) ** 2, rng.standard_normal(LINES.size)
    values = [information.judge(information.total(power + s * h * step, 100.0))[0] for s in (1, -1)]
    _, slope = information.judge(information.total(power, 100.0))
    along = 100.0 * np.einsum("pkij,pij->k", information.lines, slope) @ step
    assert along == pytest.approx((values[0] - values[1]) / (2 * h), rel=1e-5)


def test_the_search_uses_the_limits_and_stays_broadband(information, limited):
    start = np.exp(1j * np.pi * np.arange(LINES.size) ** 2 / LINES.size)
    before = start / limited.use(start).max()
    c = joint_design(information, limited, [start], 1000.0)
    assert limited.use(c).max() == pytest.approx(1.0)
    power = np.abs(c) ** 2
    assert power.min() >= BROADBAND * power.mean() * (1 - 1e-9)
    sds = [information.judge(information.total(np.abs(x) ** 2, 1000.0))[0] ** 0.5 for x in (before, c)]
    assert sds[1] < 0.7 * sds[0]


def test_the_best_lines_are_kept_and_the_band_covered():
    power = np.ones(400)
    power[[250, 251, 252]] = 100.0
    kept = informed_lines(power, np.ones(400), 20)
    assert {250, 251, 252, 399} <= set(kept.tolist())
    assert kept.size == 20


@pytest.fixture(scope="module")
def bench():
    rig = rig_of_preset(BENCH)
    return replace(rig, noise=replace(BENCH.noise, position_resolution=0.0, current_resolution=0.0))


@pytest.fixture(scope="module")
def designed(bench):
    return ambid.design_experiment(bench, seconds=4.0, period=0.5, lines=30)


def test_the_limits_are_kept_by_plants_that_are_ten_percent_off_from_rest(bench, designed):
    wave = designed.played(3 * designed.period, designed.rate_hz)[:, 0]
    for seed in range(6):
        rng = np.random.default_rng(seed)
        off = tuple(
            replace(p, value=p.value * (1.0 + 0.1 * rng.uniform(-1, 1))) if p.role == "free" else p
            for p in bench.parameters
        )
        found = simulate_rig(replace(bench, parameters=off), wave, rate_hz=designed.rate_hz, seed=seed).record
        for name in ("position", "current", "voltage"):
            assert np.max(np.abs(found[name].values)) < designed.signals[name].high


def test_what_is_expected_is_what_identify_reports(bench, designed):
    found = ambid.identify(ambid.simulate(bench, excitation=designed, seed=5), bench)
    assert found.passed
    for name, x in designed.expected.items():
        sd = found.delay["voltage"].sd if name == "voltage.delay" else found[name].sd
        assert x.sd == pytest.approx(sd, rel=0.1), name
        assert x.sd < (0.6 if name in found else 1.0) * x.flat_sd


@pytest.mark.parametrize("share", [0.02, 1.0, 500.0])
def test_what_was_promised_follows_any_length_of_the_record(bench, designed, share):
    found = ambid.identify(ambid.simulate(bench, excitation=designed, duration=1.0, seed=5), bench)
    samples = round(share * designed.seconds * found.record["rate_hz"])
    sd = {p.name: designed.expected[p.name].sd / np.sqrt(share) for p in found.parameters if p.sd > 0.0}
    same = tuple(replace(p, sd=sd.get(p.name, p.sd)) for p in found.parameters)
    said = reached(designed, replace(found, parameters=same, record={**found.record, "samples": samples})).values
    assert {name: said[name] for name in sd} == pytest.approx(dict.fromkeys(sd, 1.0), rel=0.01)


def test_the_length_for_a_target_counts_what_a_prior_knows_once(bench):
    known = tuple(replace(p, role="prior", sd=0.02 * abs(p.value)) if p.role == "free" else p for p in bench.parameters)
    found = ambid.design_experiment(
        replace(bench, parameters=known), seconds=0.4, period=0.1, lines=4, spread=0.01, target=2e-3
    )
    lengths, asked = found.shown.seconds, 0
    for name, x in found.expected.items():
        if name in {p.name for p in known} and lengths[0] < x.seconds < lengths[-1]:
            there = np.exp(np.interp(np.log(x.seconds), np.log(lengths), np.log(found.shown.by_length[name])))
            assert there == pytest.approx(found.target, rel=0.01), name
            asked += 1
    assert asked


def test_the_model_moves_as_the_simulator_does_from_rest(bench, designed):
    silent = replace(bench, noise=Noise())
    wave = designed.played(2 * designed.period, designed.rate_hz)[:, 0]
    record = simulate_rig(silent, wave, rate_hz=designed.rate_hz, seed=0).record
    for name in ("position", "current", "voltage"):
        use = designed.signals[name]
        reach = use.high - use.reserve
        assert np.max(np.abs(record[name].values)) / reach == pytest.approx(use.from_rest, rel=1e-6)
        last = record[name].values[designed.period :]
        assert np.max(np.abs(last - designed.shown.waves[name])) < 0.02 * use.peak


def test_it_is_read_back(designed, tmp_path):
    designed.save(tmp_path / "e.json")
    again = ambid.load(tmp_path / "e.json")
    assert again.expected == designed.expected
    assert again.signals == designed.signals
    assert np.array_equal(again.excitation["voltage"], designed.excitation["voltage"])
    assert again.summary() == designed.summary()


def test_a_coil_alone_is_designed_for_in_open_loop():
    values = {"R": 1.25, "L": 0.06}
    of = model("coil")
    rig = replace(
        ambid.default_rig(), model="coil",
        channels=tuple(RigChannel(role=x, column=x) for x in (*of.inputs, *of.outputs)),
        parameters=tuple(Parameter(name=p.name, unit=p.unit, value=values[p.name]) for p in of.parameters),
        noise=Noise(current=1e-3), limits=Limits(voltage=(-10.0, 10.0), current=(-1.0, 1.0)),
        record=RecordSettings(rate_hz=2000.0), open_loop=True,
    )  # fmt: skip
    found = ambid.design_experiment(rig, seconds=1.0, lines=10)
    estimate = ambid.identify(ambid.simulate(rig, excitation=found, seed=2), rig, experiment=found)
    assert estimate.checks["experiment"].values == pytest.approx({"R": 1.0, "L": 1.0}, abs=0.15)


def test_what_cannot_be_designed_is_refused(bench):
    short = {"seconds": 0.4, "lines": 8}
    for changed, said in (
        ({"limits": None}, "no limits"),
        ({"noise": None}, "noise"),
        ({"open_loop": True}, "unstable"),
        ({"limits": Limits(position=(-1e-6, 1e-6))}, "nothing is left"),
        ({"loop": Loop(kp=1.0, delay=1.0)}, "unstable"),
    ):
        with pytest.raises(AmbidError, match=said):
            ambid.design_experiment(replace(bench, **changed), **short)
    for how, said in (({"criterion": "kx"}, "k_x"), ({"use": 2.0}, "use"), ({"band": (1e-3, 2e-3)}, "no line")):
        with pytest.raises(AmbidError, match=said):
            ambid.design_experiment(bench, **short, **how)
    with pytest.raises(EstimationError, match="designed for"):
        ambid.design_experiment(bench, **short).played(10, 1234.0)
