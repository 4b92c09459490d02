"""Speed, synchronous response, unbalance and runout of the independent simulator's spinning rotor."""

import dataclasses
import functools

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.record import Channel, Record
from ambid.rotor.balance import Machine, Turned, balance_by_trials, balance_rotor, estimate_unbalance, read_by
from ambid.rotor.likelihood import Point
from ambid.rotor.spectra import period_spectra
from ambid.rotor.synchronous import rotation_of, separate
from tests.rotor_benches import DATUM, model_of, needs_simulator, truth

pytestmark = needs_simulator

SHORT = {"period": 0.5, "periods": 4, "settle": 1}


@functools.cache
def spinning(rpm, **more):
    """Return bench, model, numbers and record of the rigid rotor at a speed."""
    bench = dataclasses.replace(truth.BENCHES["rigid-spin"], rpm=rpm, **SHORT, **more)
    model, theta = model_of(bench)
    return bench, model, theta, record_of(bench, truth.simulate(bench, 1))


def record_of(bench, d):
    channels = [Channel(name="angle", unit="rad", values=d["angle"])]
    for j, axis in enumerate(truth.AXES):
        for key, unit in (("voltage", "V"), ("current", "A"), ("position", "m"), ("reference", "A")):
            channels.append(Channel(name=f"{axis}_{key}", unit=unit, values=d[key][:, j]))
    return Record(rate_hz=bench.rate, channels=tuple(channels))


def without(record, *names, **values):
    """Return a record with channels left out or put in."""
    kept = [c for c in record.channels if c.name not in (*names, *values)]
    more = [Channel(name=n, unit=u, values=v) for n, (u, v) in values.items()]
    return dataclasses.replace(record, channels=(*kept, *more))


def true_machine(model, theta, bench, sd=0.0):
    """Return the machine that is true, its numbers known to `sd` of their size."""
    names = tuple(n for n in theta if n.endswith(("k_i", "k_x", "R", "L")) or n in ("m", "Id", "Ip"))
    size = np.array([sd * theta[n] for n in names])
    return Machine(
        model=model, at=Point(theta=theta, delays=np.full(4, float(bench.delay))), names=names,
        covariance=np.diag(size**2),
    )  # fmt: skip


def test_steps_along_a_covariance_keep_the_smallest_numbers():
    bench, model, theta, _ = spinning(9000.0)
    machine = true_machine(model, theta, bench, sd=1e-4)
    sd, n = np.sqrt(np.diag(machine.covariance)), len(machine.names)
    loads = np.random.default_rng(1).standard_normal((n, 2 * n))
    R = loads @ loads.T
    R /= np.sqrt(np.outer(np.diag(R), np.diag(R)))
    steps = dataclasses.replace(machine, covariance=R * np.outer(sd, sd)).steps / sd
    np.testing.assert_allclose(steps.T @ steps, R, atol=1e-9)


def planes_of(bench):
    """Return the unbalance by bearing plane that does what that of the bench does."""
    a, b = bench.z_bearing
    whole = bench.unbalance * np.exp(1j * bench.phase_unbalance)
    return np.array([whole * (b - bench.z_unbalance), whole * (bench.z_unbalance - a)]) / (b - a)


def test_every_source_of_speed_gives_the_same():
    bench, model, _, record = spinning(17777.0)
    speed, angle = bench.rpm * np.pi / 30, record["angle"].values
    found = separate(record, model).response
    assert found.speed == pytest.approx(speed, rel=1e-9)
    wrapped = without(record, angle=("rad", np.angle(np.exp(1j * angle))))
    assert rotation_of(wrapped, model).speed == pytest.approx(speed, rel=1e-6)
    pulses = without(record, "angle", tacho=("V", 5.0 * (np.mod(angle, 2 * np.pi) < 0.5)))
    tacho = rotation_of(pulses, model)
    assert tacho.marked
    # A sample is 0.19 rad, an edge in the middle of two samples half of one late on average.
    assert np.abs(np.angle(np.exp(1j * (tacho.angle - angle)))).max() < 0.12
    assert tacho.speed == pytest.approx(speed, rel=2e-5)
    silent, at_rest = without(record, "angle"), dataclasses.replace(model, speed=0.0)
    logged = without(silent, speed=("rad/s", np.full(angle.size, 0.98 * speed)))
    for quiet, of in ((silent, dataclasses.replace(model, speed=1.02 * speed)), (silent, at_rest), (logged, at_rest)):
        said = separate(quiet, of).response.rotation
        assert (said.source, said.marked) == ("lines", False)
        assert said.speed == pytest.approx(speed, rel=2e-6)


def test_a_rotor_at_rest_does_not_turn():
    bench = dataclasses.replace(truth.BENCHES["rigid"], **SHORT)
    model, _ = model_of(bench)
    record = without(record_of(bench, truth.simulate(bench, 1)), "angle")
    assert separate(record, dataclasses.replace(model, polar=True)).response is None


def test_a_drift_is_followed_and_told():
    rng, n, rate = np.random.default_rng(1), 20000, 10000.0
    t = np.arange(n) / rate
    angle = 900.0 * t + 1.5 * t**2  # 0.7 % faster at the end
    _, model, _, _ = spinning(17777.0)
    values = {f"{a}_position": ("m", np.cos(angle - 0.5 * np.pi * (a[1] == "y"))) for a in truth.AXES}
    others = {role: ("V", rng.standard_normal(n)) for role in (*model.inputs, *model.outputs) if role not in values}
    record = without(spinning(17777.0)[3], *spinning(17777.0)[3].names, **values, **others)
    found = separate(record, dataclasses.replace(model, speed=905.0))
    assert np.ptp(found.response.rotation.angle - angle) < 0.01
    assert found.response.rotation.drift == pytest.approx(6.0 / 903.0, rel=0.05)
    assert ["the speed changes by 0.66%" in line for line in found.warnings("r.csv", 905.0)] == [True]


@pytest.mark.parametrize(
    ("pulses", "said"),
    [
        (np.zeros(100), "constant"),
        (np.arange(100) % 60 < 5, "has 1 pulses"),
        (np.isin(np.arange(1000) // 20, [1, 3, 5, 9, 11, 13]), "missing or double"),
    ],
)
def test_a_bad_tacho_is_refused(pulses, said):
    _, model, _, _ = spinning(17777.0)
    record = Record(rate_hz=1e3, channels=(Channel(name="tacho", unit="V", values=1.0 * pulses),))
    with pytest.raises(EstimationError, match=said):
        rotation_of(record, model)


def test_the_synchronous_part_is_taken_out_whole_and_nothing_else():
    """Off the lines of the period, the spectra of a record are those of the same record without unbalance."""
    _, model, _, record = spinning(17777.0)
    _, _, _, still = spinning(17777.0, unbalance=0.0, runout=0.0)
    found = separate(record, model)
    assert found.record.history[-1].name == "without_synchronous"
    for role in (*model.inputs, *model.outputs):
        left = found.record[role].values - still[role].values
        share = np.std(left - left.mean()) / np.std(record[role].values - still[role].values)
        assert share < 0.05  # noise at five harmonics


def test_two_speeds_give_unbalance_and_run_out():
    parts = [spinning(rpm) for rpm in (17777.0, 12000.0)]
    responses = [separate(record, model).response for _, model, _, record in parts]
    assert [all(r.together) for r in responses] == [False, True]
    bench, model, theta, _ = parts[0]
    found = estimate_unbalance(true_machine(model, theta, bench), responses)
    expected = np.array([*planes_of(bench), *[bench.runout * np.exp(1.1j)] * 2])
    assert found.names == ("A.z", "B.z", "A.z_sensor", "B.z_sensor")
    assert np.abs(found.value[:2] / expected[:2] - 1.0).max() < 0.01
    assert np.abs(found.value[2:] / expected[2:] - 1.0).max() < 0.03
    assert deviations(found, expected).max() < 3.5
    assert found.misfit < 2.5
    assert all(found.entry(name)["identifiable"] for name in found.names)


def deviations(found, expected):
    """Return how many standard deviations each number is off."""
    sd = np.sqrt(0.5 * np.sum(found.half**2, axis=1).reshape(2, -1).sum(axis=0))
    return np.abs(found.value[: expected.size] - expected) / sd[: expected.size]


def test_a_mirrored_record_turns_backward():
    """With every y reversed the rotor turns from y to x; its unbalance has the opposite phase."""
    bench, model, theta, record = spinning(17777.0)
    values = {c.name: (c.unit, -c.values) for c in record.channels if c.name[1] == "y" or c.name == "angle"}
    mirrored = without(record, **values)
    back = dataclasses.replace(model, speed=-model.speed)
    one = estimate_unbalance(true_machine(model, theta, bench), [separate(record, model).response])
    other = estimate_unbalance(true_machine(back, theta, bench), [separate(mirrored, back).response])
    np.testing.assert_allclose(other.value, np.conj(one.value), rtol=1e-6)
    np.testing.assert_allclose(other.half @ other.half.T, _mirrored(one.half @ one.half.T), rtol=1e-3, atol=1e-22)


def _mirrored(covariance):
    n = covariance.shape[0] // 2
    sign = np.array([1.0] * n + [-1.0] * n)
    return covariance * np.outer(sign, sign)


def test_a_rotor_without_voltages_needs_two_speeds():
    """Far above its rigid modes a rotor turns about its centre of gravity at any speed, as a runout does."""
    parts = []
    for rpm in (17777.0, 12000.0):
        bench, model, theta, record = spinning(rpm)
        parts.append((bench, dataclasses.replace(model, drives=("current",) * 4), theta, record))
    bench, model, theta, _ = parts[0]
    numbers = {p.name: theta[p.name] for p in model.parameters}
    machine = Machine(model=model, at=Point(theta=numbers, delays=np.zeros(4)), names=(), covariance=np.zeros((0, 0)))
    turned = []
    for k, (_, of, _, record) in enumerate(parts):
        found = separate(record, of)
        spectra = period_spectra(found.record, of, found.excitation, found.speed)
        turned.append(Turned(record=k, response=found.response, spectra=spectra))
    alone = balance_rotor(machine, turned[:1])
    assert not any(p["identifiable"] for p in alone["unbalance"]["planes"].values())
    assert "a second record at another speed" in alone["hint"]
    both = estimate_unbalance(machine, [t.response for t in turned])
    assert deviations(both, planes_of(bench)).max() < 3.5
    assert all(both.entry(p)["identifiable"] for p in ("A.z", "B.z"))


@functools.cache
def balanced():
    bench, model, theta, record = spinning(12000.0)
    machine, found = true_machine(model, theta, bench, sd=1e-3), separate(record, model)
    spectra = period_spectra(found.record, model, found.excitation, found.speed)
    turned = Turned(record=0, response=found.response, spectra=spectra, controller=controller_of(bench))
    return machine, turned, balance_rotor(machine, [turned], clearance=2e-4)


def test_influence_and_feedback_predict_the_synchronous_response():
    """At 12 000 rpm the speed is a line of the excitation; its part is taken out before."""
    bench, *_ = spinning(12000.0)
    _, quiet_model, _, quiet = spinning(12000.0, excitation="none")
    machine, turned, said = balanced()
    measured, sd, apart = turned.own()
    assert apart
    reference = separate(quiet, quiet_model).response
    silent = np.array([reference.of(role) for role in (*machine.model.inputs, *machine.model.outputs)])
    assert np.abs((measured - silent) / sd).max() < 5.0
    # what it makes of the true unbalance and runout, at both ends of the loop
    model, loop = machine.model, turned.loop(machine)
    planes, run_out = planes_of(bench), sum(read_by(model).values()) * bench.runout * np.exp(1.1j)
    of_unbalance = machine.forced(turned.response.speed, machine.shapes) @ planes
    expected = loop @ (of_unbalance + run_out)
    assert np.abs((measured[4:] - expected) / sd[4:]).max() < 5.0
    influence = [[x["value"] * np.exp(1j * x["phase"]) for x in e["sensors"].values()] for e in said["influence"]]
    np.testing.assert_allclose(planes @ np.array(influence), (loop @ of_unbalance)[:4], rtol=1e-6)


def controller_of(bench):
    """Return K of u = F r - K y at the speed."""
    K = truth.controller_frf(bench, np.array([bench.rpm / 60.0]))[0]
    return bench.kc * np.hstack([K * np.eye(4), np.eye(4)])


def test_the_proposal_takes_the_unbalance_away():
    bench, *_ = spinning(12000.0)
    _, _, said = balanced()
    masses = [x["value"] * np.exp(1j * x["phase"]) for x in said["balancing"]["correction"].values()]
    assert np.abs(masses + planes_of(bench)).max() < 0.01 * bench.unbalance
    one = said["unbalance"]["one_plane"]
    assert one["fits"]
    assert abs(one["z"] - (DATUM + bench.z_unbalance)) < 3.5 * one["sd"] + 1e-4
    grade = 1e3 * bench.unbalance * bench.rpm * np.pi / 30 / bench.m
    assert said["unbalance"]["static"]["grade_mm_s"] == pytest.approx(grade, rel=0.01)
    for x in said["balancing"]["vibration"]:
        assert x["after"] < 0.3 * x["before"]
        assert x["after"] < x["at_most"]
    orbit = said["records"][0]["orbits"]["B"]
    assert orbit["forward"]
    assert orbit["major"] == pytest.approx(orbit["minor"], rel=0.05)
    assert orbit["clearance"] == 2e-4


@functools.cache
def bending(rpm):
    """Return model, numbers and response of a rotor with bending modes, out of balance in its middle."""
    bench = dataclasses.replace(truth.BENCHES["utrc"], rpm=rpm, period=0.25, periods=3, settle=2)
    model, theta = model_of(bench)
    return bench, model, theta, separate(record_of(bench, truth.simulate(bench, 1)), model).response


def test_a_bending_rotor_needs_two_speeds_or_the_plane_of_its_unbalance():
    bench, model, theta, fast = bending(15000.0)
    true = bench.unbalance * np.exp(1j * bench.phase_unbalance)
    machine = true_machine(model, theta, bench)
    alone = estimate_unbalance(machine, [fast])
    assert not any(alone.entry(name)["identifiable"] for name in ("A.z", "B.z", "mode1", "mode3"))
    said = balance_rotor(machine, [Turned(record=0, response=fast)])
    assert "more speeds" in said["hint"]
    assert "balancing" not in said
    both = estimate_unbalance(machine, [fast, bending(9600.0)[3]])
    modal = truth.modal_of(bench)
    z = [machine.z(p) - theta["z_cg"] for p in ("A.z", "B.z")]
    planes = true * np.linalg.solve([[1.0, 1.0], z], modal.unbalance[:2])
    beyond = modal.unbalance[2:] * true - np.array([machine.shape(p)[2:] for p in ("A.z", "B.z")]).T @ planes
    assert deviations(both, np.array([*planes, *beyond])).max() < 3.5
    assert np.abs(both.value[:2] / planes - 1.0).max() < 0.02  # of 0.75 s
    # with the plane and the shape of the modes there, one speed is enough
    disc = dataclasses.replace(machine, beside={"disc": (DATUM + modal.unbalance[1], *modal.unbalance[2:])})
    known = estimate_unbalance(disc, [fast])
    assert known.names == ("disc", "A.z_sensor", "B.z_sensor")
    assert deviations(known, np.array([true])).max() < 3.5
    assert abs(known.value[0] / true - 1.0) < 0.04  # of 0.75 s
    assert known.entry("disc")["identifiable"]


def test_trial_weights_balance_without_a_model():
    """The rotor answers linearly: with noise, the correction scatters as its standard deviations say."""
    rng = np.random.default_rng(3)
    A = rng.standard_normal((4, 2)) + 1j * rng.standard_normal((4, 2))
    true, sd = np.array([3e-6 + 1e-6j, -2e-6j]), 2e-8
    weights = {"A.z": (2e-6, 0.3), "B.z": (3e-6, -1.0)}

    def run(u):
        y = A @ (true + u) + sd * (rng.standard_normal(4) + 1j * rng.standard_normal(4))
        of = zip(truth.AXES, y, strict=True)
        response = {
            f"{a}_position": {"amplitude": [abs(x)], "phase": [np.angle(x)], "sd": [sd]} for a, x in of
        }  # fmt: skip
        return {"record": 0, "speed": 900.0, "response": response}

    deviations = []
    for _ in range(60):
        trials = {
            p: (run(size * np.exp(1j * phase) * np.eye(2)[k]), size, phase)
            for k, (p, (size, phase)) in enumerate(weights.items())
        }
        said = balance_by_trials(run(np.zeros(2)), trials)["balancing"]
        for u, c in zip(-true, said["correction"].values(), strict=True):
            deviations += [
                (c["value"] - abs(u)) / c["sd"],
                np.angle(np.exp(1j * (c["phase"] - np.angle(u)))) / c["phase_sd"],
            ]
    assert 0.8 < np.sqrt(np.mean(np.square(deviations))) < 1.2
    assert all(x["after"] < 0.2 * x["before"] for x in said["vibration"])
    with pytest.raises(EstimationError, match="same speed"):
        balance_by_trials(run(np.zeros(2)), {"A.z": ({**run(np.zeros(2)), "speed": 950.0}, 1e-6, 0.0)})
