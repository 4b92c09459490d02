"""Run-ups and coast-downs: resonances and amplification factors against poles, and closed loops, that are known."""

import dataclasses
import functools

import numpy as np
import pytest

import ambid
from ambid.errors import EstimationError
from ambid.estimation.modes import EstimatedNumber
from ambid.physics.presets import preset
from ambid.physics.rotor_model import Bearing, RotorModel
from ambid.record import Channel, Record
from ambid.rig import rig_of_preset
from ambid.rotor.passage import changes_speed, displacements, track_passage, whirl_of
from ambid.rotor.passage_fit import answers
from ambid.rotor.resonance import Resonance, peaks, required_separation, resonances, scaled_to_limit, separations
from ambid.rotor.synchronous import separate
from ambid.rotor.whirl_points import whirl_points
from ambid.signals.orders import track_orders
from ambid.simulation.plant import closed_loop_poles, excited_loop
from ambid.simulation.rotor_bench import RotorBench
from tests.tiers import long, runs, sample

RPM = 30.0 / np.pi
RATE = 4000.0
PLANE = RotorModel(bearings=(Bearing(name="A", axes=("ax", "ay")),), polar=True, speed=1.0)
POLES = np.array([complex(-0.03 * 700.0, 700.0), complex(-0.4 * 300.0, 280.0)])
SHARES = np.array([6e-11 + 1.5e-11j, 4.5e-11 - 3e-11j])


def passed(w, alpha, s):
    """Return modal coordinates of a pole that unbalance drives at the speeds `w`, integrated sample by sample."""
    from scipy.signal import lfilter

    T, angle = 1.0 / RATE, np.cumsum(w) / RATE
    total = np.zeros(w.size, dtype=complex)
    for at, weight in ((-0.7745966692414834, 5 / 18), (0.0, 8 / 18), (0.7745966692414834, 5 / 18)):
        tau = 0.5 * T * (1.0 + at)
        now, turned = w + alpha * tau, angle + w * tau + 0.5 * alpha * tau**2
        total += weight * T * np.exp(s * (T - tau)) * (now**2 - 1j * alpha) * np.exp(1j * turned)
    moved = lfilter([1.0], [1.0, -np.exp(s * T)], total)
    return np.concatenate([[0.0], moved[:-1]])


@functools.cache
def clean(seconds, low, high, modes=2):
    """Return angle, speed and the motion x + jy of a plane that runs through its poles, forward."""
    n = round(seconds * RATE)
    alpha = (high - low) / seconds
    w = low + alpha * np.arange(n) / RATE
    angle = low * np.arange(n) / RATE + 0.5 * alpha * (np.arange(n) / RATE) ** 2
    scale = np.exp(1j * (angle - np.cumsum(w) / RATE))  # the sum of the speeds is not quite the angle
    z = sum(c * passed(w, alpha, s) for c, s in list(zip(SHARES, POLES, strict=True))[:modes])
    return angle, w, z * scale


def noisy(seconds, low, high, seed, noise=4e-7, modes=2):
    """Return the record of a plane."""
    angle, w, z = clean(seconds, low, high, modes)
    dirty = np.random.default_rng(seed).standard_normal((2, w.size)) * noise
    names = ("ax_position", z.real + dirty[0], "m"), ("ay_position", z.imag + dirty[1], "m"), ("angle", angle, "rad")
    return Record(rate_hz=RATE, channels=tuple(Channel(name=n, unit=u, values=x) for n, x, u in names))


def steady_truth(modes=2):
    """Return the peak of the response at constant speed near the first pole."""
    w = np.linspace(400.0, 900.0, 20_001)
    size = np.abs(sum(c * w**2 / (1j * w - s) for c, s in list(zip(SHARES, POLES, strict=True))[:modes]))
    return max(peaks(w, size), key=lambda p: p.size)


def one(seconds, low, high, seed, modes=2):
    fit = resonances([track_passage(noisy(seconds, low, high, seed, modes=modes), PLANE)])
    return fit, next(r for r in fit.resonances if not r.critically_damped)


@pytest.mark.parametrize("alpha", [3.0, -400.0, 1e-9])
def test_a_pole_answers_as_the_integral_over_its_memory(alpha):
    w, s, u = np.array([5.0, 60.0, 104.0]), complex(-4.0, 60.0), np.linspace(0.0, 6.0, 300_001)
    kernel = np.exp(-(1j * w[:, None] - s) * u + 0.5j * alpha * u**2)
    b, slope, bend = answers(s, w, np.full(3, alpha))
    for got, weight in ((b, 1.0), (slope, u), (bend, 0.5j * alpha * u**2)):
        expected = np.trapezoid(kernel * weight, u, axis=1)
        assert np.abs(got - expected).max() < 1e-5 * np.abs(expected).max()


def test_whirl_and_orbit_follow_the_sense_in_which_the_rotor_turns():
    for sign in (1, -1):  # x + jy = 3 exp(j angle) + 1 exp(-j angle), turning from x to y, or from y to x
        a = np.array([[4.0, -2.0j * sign]])
        w = whirl_of(a, np.ones((1, 2)), reverse=sign < 0)
        assert (w.forward[0], w.backward[0]) == pytest.approx((3.0, 1.0))
        assert w.major[0] == pytest.approx(4.0)


def test_phases_count_from_the_mark_wherever_the_record_begins():
    t = np.arange(20_000) / RATE
    for sense in (1.0, -1.0):
        angle = 1.3 + sense * 2.0 * np.pi * (20.0 * t + 2.0 * t**2)
        tracked = track_orders(np.cos(sense * angle + 0.4)[:, None], angle, RATE)
        assert np.angle(tracked.of(1)[0]) == pytest.approx(0.4, abs=1e-6)


@pytest.mark.parametrize(
    ("low", "high", "way"), sample([(50.0, 1200.0, 1.0), (1200.0, 50.0, -1.0)], 0), ids=["up", "down"]
)
def test_a_passage_shows_the_resonance_of_constant_speed(low, high, way):
    truth = steady_truth()
    fit, r = one(3.0, low, high, 1)
    assert r.speed.value == pytest.approx(truth.speed, abs=4.0 * r.speed.sd)
    assert r.amplification.value == pytest.approx(truth.amplification, abs=4.0 * r.amplification.sd)
    assert r.frequency.value == pytest.approx(abs(POLES[0]), abs=4.0 * r.frequency.sd)
    assert r.speed.sd < 5e-3 * truth.speed
    assert r.forward > 0.99
    assert 0.6 < fit.misfit < 1.6
    assert r.measured is not None  # passed late, by far more than what is left of it
    assert way * (r.measured.speed / truth.speed - 1.0) > 0.015


@long
def test_intervals_of_resonances_cover():
    truth, n, hits = steady_truth(modes=1), runs(200, short=20), np.zeros(4)
    for seed in range(n):
        _, r = one(4.0, 50.0, 1200.0, seed, modes=1)
        pairs = (
            (r.speed, truth.speed), (r.amplification, truth.amplification), (r.frequency, abs(POLES[0])),
            (r.damping, -POLES[0].real / abs(POLES[0])),
        )  # fmt: skip
        hits += [x.ci95[0] <= true <= x.ci95[1] for x, true in pairs]
    assert np.all((hits / n >= n.limit(0.904)) & (hits / n <= n.limit(0.996)))


def steady(bench, speeds):
    """Return the synchronous positions of a bench at constant speeds, (n, n_sensors), of the sampled closed loop."""

    class Rotating:
        name, inputs, outputs = "rotor", bench.model.inputs, bench.model.outputs

        def __init__(self, turned):
            self.turned, self.speed = turned, turned.model.speed

        def matrices(self, _):
            return self.turned._continuous()

    motion = []
    for w in speeds:
        turned = bench.at_speed(float(w))
        z, _, _ = excited_loop(bench.plant.parameters, bench.loop, bench.rate_hz, of=Rotating(turned))
        n, shift = len(turned.model.states), np.exp(1j * w / bench.rate_hz)
        rest = np.r_[:n, n + 2 : z.shape[0]]
        pushed = z[np.ix_(rest, [n, n + 1])] @ np.array([1.0, -1j])
        x = np.linalg.solve(shift * np.eye(rest.size) - z[np.ix_(rest, rest)], pushed)
        motion.append(turned._continuous().C[: len(turned.model.sensors), :n] @ x[:n])
    return np.array(motion)


def model_peaks(bench, plane, low, high):
    """Return the peaks of the major axis in a plane at constant speed."""
    w = np.linspace(low, high, 100) / RPM
    y = steady(bench, w)[:, list(plane)]
    return peaks(w, whirl_of(y, np.zeros((w.size, 2))).major)


@functools.cache
def bench_of(name, runout=True):
    rig = rig_of_preset(preset(name))
    return RotorBench.of(rig if runout else dataclasses.replace(rig, runout=()), None, True)


@functools.cache
def run_of(name, seconds, rpm, runout=True):
    rig = bench_of(name, runout).rig
    return ambid.simulate(rig, seconds, run_up=rpm, seed=1)


@pytest.mark.parametrize(
    ("seconds", "rpm"), [(4.0, (0, 20_000)), pytest.param(12.0, (20_000, 0), marks=long)], ids=["up", "down"]
)
def test_a_run_of_utrc_shows_the_critical_speed_of_its_closed_loop(seconds, rpm):
    bench = bench_of("utrc")
    fit = resonances([track_passage(run_of("utrc", seconds, rpm), bench.model)])
    sharp = [r for r in fit.resonances if not r.critically_damped]
    assert len(sharp) == 1
    (truth,) = model_peaks(bench, (0, 1), 7000.0, 14_000.0)
    assert sharp[0].speed.value == pytest.approx(truth.speed, rel=0.02)
    assert sharp[0].amplification.value == pytest.approx(truth.amplification, rel=0.10)
    assert sharp[0].half_power
    z = closed_loop_poles(bench.plant.parameters, bench.loop, bench.rate_hz, of=bench.model.at_speed(10_050.0 / RPM))
    s = np.log(z[np.abs(z) > 1e-6].astype(complex)) * bench.rate_hz
    mode = s[np.argmin(np.abs(np.abs(s) - 10_056.0 / RPM) + 1e9 * (s.imag <= 0.0))]
    assert sharp[0].frequency.value == pytest.approx(abs(mode), rel=0.003)
    assert sharp[0].damping.value == pytest.approx(-mode.real / abs(mode), rel=0.03)


@long
def test_a_fast_run_through_a_slightly_damped_mode_shows_it_as_at_constant_speed():
    bench = bench_of("utrc", runout=False)
    (truth,) = model_peaks(bench, (0, 1), 37_500.0, 40_000.0)
    for rpm in ((0, 40_000), (40_000, 0)):  # 10 000 rpm/s
        fit = resonances([track_passage(run_of("utrc", 4.0, rpm, runout=False), bench.model)])
        sharp = fit.resonances[-1]
        assert sharp.speed.value == pytest.approx(truth.speed, rel=0.002)
        assert sharp.amplification.value == pytest.approx(truth.amplification, rel=0.03)


@long
def test_a_rigid_spindle_has_no_critical_speed():
    bench = bench_of("spindle")
    passage = track_passage(run_of("spindle", 2.0, (0, 20_000)), bench.model)
    assert all(r.critically_damped and not r.amplification.identifiable for r in resonances([passage]).resonances)
    assert [name for name, _, _ in passage.planes] == ["A", "B"]


@long
def test_ways_of_one_record_and_pulses_in_place_of_the_angle_show_the_same():
    angle, w, z = (
        np.concatenate([x, y]) for x, y in zip(clean(4.0, 50.0, 1200.0), clean(4.0, 1200.0, 50.0), strict=True)
    )
    turned = angle + np.repeat([0.0, clean(4.0, 50.0, 1200.0)[0][-1] + 1200.0 / RATE], w.size // 2)
    motion = np.where(np.arange(w.size) < w.size // 2, z, z * np.exp(1j * (turned - angle)))
    dirty = np.random.default_rng(3).standard_normal((2, w.size)) * 4e-7
    positions = [("ax_position", motion.real + dirty[0], "m"), ("ay_position", motion.imag + dirty[1], "m")]
    pulses = np.where(turned % (2.0 * np.pi) < 0.8, 5.0, 0.0)
    values = []
    for more in (("angle", turned % (2.0 * np.pi), "rad"), ("tacho", pulses, "V"), ("speed", w, "rad/s")):
        channels = tuple(Channel(name=n, unit=u, values=x) for n, x, u in (*positions, more))
        passage = track_passage(Record(rate_hz=RATE, channels=channels), PLANE)
        assert [way.speed[-1] > way.speed[0] for way in passage.ways] == [True, False]
        fit = resonances([passage])
        values.append(next(r for r in fit.resonances if not r.critically_damped).frequency.value)
        assert bool(fit.warnings) == (more[0] == "speed")
    assert values == pytest.approx([abs(POLES[0])] * 3, rel=4e-3)


def test_what_cannot_be_tracked_is_refused():
    record = noisy(4.0, 50.0, 1200.0, 1)
    with pytest.raises(EstimationError, match="neither angle, tacho nor speed"):
        track_passage(dataclasses.replace(record, channels=record.channels[:2]), PLANE)
    still = (*record.channels[:2], Channel(name="speed", unit="rad/s", values=np.full(record.n_samples, 1.0)))
    with pytest.raises(EstimationError, match="blocks of 8 turns"):
        track_passage(dataclasses.replace(record, channels=still), PLANE)


def test_a_record_is_a_run_up_by_its_turns_and_the_range_of_its_speed():
    def of(speed):
        return Record(rate_hz=1000.0, channels=(Channel(name="speed", unit="rad/s", values=speed),))

    assert changes_speed(of(np.linspace(0.0, 500.0, 5000)))
    assert not changes_speed(of(np.full(5000, 500.0)))
    assert not changes_speed(of(0.01 * np.random.default_rng(1).standard_normal(5000).cumsum()))


def test_displacements_count_from_the_centre_with_the_offset():
    record = noisy(4.0, 50.0, 1200.0, 1)
    x, y, angle = record.channels
    moved = dataclasses.replace(x, values=x.values + 4e-5), dataclasses.replace(y, values=y.values - 3e-5), angle
    size = np.hypot(moved[0].values, moved[1].values)
    assert displacements(dataclasses.replace(record, channels=moved), PLANE) == pytest.approx({"A": size.max()})
    assert size.max() > 5e-5
    thrust = RotorModel(bearings=(Bearing(name="T", axes=("ax",), axial=True),))
    low = dataclasses.replace(x, values=x.values - 4e-5)
    along = displacements(dataclasses.replace(record, channels=(low,)), thrust)
    assert along == {"T": np.abs(low.values).max()}


def number(value, sd=0.0):
    return EstimatedNumber.of(value, sd)


def mode(speed, factor, sd=0.0):
    return Resonance(
        speed=number(speed, sd), amplification=number(factor), half_power=True, critically_damped=factor < 2.5,
        frequency=number(speed), damping=number(0.5 / factor), forward=1.0, measured=None, plane="A",
    )  # fmt: skip


def test_separation_follows_the_amplification_factor():
    assert required_separation(2.4, above=True) == required_separation(2.4, above=False) == 0.0
    assert required_separation(4.0, above=False) == pytest.approx(0.17 * (1.0 - 1.0 / 2.5))
    assert required_separation(4.0, above=True) == pytest.approx(0.10 + 0.17 * (1.0 - 1.0 / 2.5))
    assert (required_separation(100.0, above=False), required_separation(100.0, above=True)) == (0.16, 0.26)
    below, within, above, damped = separations(
        [mode(800.0, 4.0), mode(1100.0, 4.0), mode(1400.0, 4.0, sd=10.0), mode(1100.0, 2.0)], (1000.0, 1200.0)
    )
    assert below.actual == pytest.approx(0.2)
    assert below.passed
    assert (within.actual, within.passed) == (0.0, False)
    assert above.actual == pytest.approx(200.0 / 1200.0)
    assert not above.passed
    assert damped.passed


def test_a_response_is_scaled_to_its_limit_in_the_operating_range():
    w = np.linspace(100.0, 2000.0, 500)
    size = 1e-6 / np.sqrt((1.0 - (w / 700.0) ** 2) ** 2 + (0.1 * w / 700.0) ** 2)
    scaled = scaled_to_limit(w, size, (1000.0, 1500.0), limit=3e-6, room=20e-6)
    assert scaled.factor == pytest.approx(3e-6 / np.interp(1000.0, w, size), rel=0.02)
    assert scaled.largest == pytest.approx(scaled.factor * size.max())
    assert scaled.largest_at == pytest.approx(700.0, rel=0.01)
    assert not scaled.passed
    with pytest.raises(EstimationError, match="no speed between"):
        scaled_to_limit(w, size, (3000.0, 3500.0), limit=3e-6, room=20e-6)


@long
def test_noise_shows_the_bending_modes_at_constant_speed():
    bench = bench_of("utrc")
    z = closed_loop_poles(bench.plant.parameters, bench.loop, bench.rate_hz, of=bench.model)
    s = np.log(z[np.abs(z) > 1e-6].astype(complex)) * bench.rate_hz
    points = whirl_points(separate(run_of("utrc", 8.0, (15_000, 15_000)), bench.model), bench.model)
    second = [p for p in points if 25_000.0 < p.frequency.value * RPM < 40_000.0]
    assert [p.direction for p in second] == [-1, 1]
    for p in second:
        near = s[np.argmin(np.abs(s.imag - p.frequency.value))]
        assert p.frequency.value == pytest.approx(near.imag, abs=4.0 * p.frequency.sd)
        assert p.frequency.sd < 5e-3 * near.imag
        assert not p.damping.identifiable  # eight seconds are too short for that
        assert p.speed * RPM == pytest.approx(15_000.0, rel=1e-3)
