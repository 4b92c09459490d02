"""Score tests of one axis: each cause is named where it is, and none where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import ambid
from ambid.bearing.linear import greybox
from ambid.estimation.estimate import Check
from ambid.job.data import load_bench, signals_of
from ambid.physics.linear_model import model
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.record import Channel, Record
from ambid.rig import default_rig, rig_of_preset
from ambid.signals import multisine
from ambid.simulation import LinearPlant, simulate
from ambid.simulation.variation import Schedule, Variation
from ambid.validation import causes as causes_module
from ambid.validation.causes import Cause, causes, causes_check, named_bias
from ambid.validation.physical import by_bands
from tests.bearing.benches import SETTINGS
from tests.tiers import runs


def fitted(columns, rate_hz):
    bench = load_bench(columns, default_rig(), rate_hz=rate_hz, units={"voltage": "V", "current": "A", "position": "m"})
    rig = default_rig()
    fit = greybox(rig.plant, signals_of(bench, rig.plant), rig.parameters)
    return fit, {name: float(bench[name].values.mean()) for name in bench.names}


def columns_of(name, seed, duration=1.0):
    record = ambid.simulate(rig_of_preset(preset(name)), duration=duration, seed=seed)
    return {c.name: c.values.copy() for c in record.channels}, record.rate_hz


def strongest(columns, rate_hz):
    fit, means = fitted(columns, rate_hz)
    return [c for c in causes(fit, means, default_rig(), thorough=True) if c.p < 1e-4]


def test_sound_records_name_no_cause():
    seeds = range(1, 1 + runs(40, short=4))
    named = [
        c.name for seed in seeds for name in ("thesis", "unstable-bearing") for c in strongest(*columns_of(name, seed))
    ]
    assert len(named) <= max(1, len(seeds) // 20)


def test_probabilities_are_those_of_chance_on_sound_records():
    """Of all scores on sound records as many are below a probability as it says: none holds what is fed back."""
    chances = []
    for seed in range(1, 1 + runs(60, short=8)):
        for name in ("thesis", "unstable-bearing", "prototype"):
            fit, means = fitted(*columns_of(name, seed, 0.5))
            chances += [c.p for c in causes(fit, means, default_rig(), thorough=False)]
    p = np.array(chances)
    n = p.size
    for level in (0.01, 0.1, 0.5):
        assert abs(np.count_nonzero(p < level) - level * n) < 4.5 * np.sqrt(level * (1 - level) * n) + 0.02 * n


def hum(c, t):
    c["current"] += 0.02 * c["current"].std() * np.sin(2 * np.pi * 50.0 * t)


def drift(c, t):
    c["voltage"] += 0.1 * c["voltage"].std() * (t / t[-1] - 0.5)


def talk(c, t):
    c["position"] += 0.02 * c["position"].std() / c["current"].std() * c["current"]


@pytest.mark.parametrize("preset", ["thesis", "unstable-bearing"])
@pytest.mark.parametrize(
    ("spoil", "cause", "channel"),
    [
        (hum, "line", "current"),
        (drift, "slow_voltage", "voltage"),
        (talk, "cross_talk", "position"),
    ],
)
def test_the_cause_is_named(preset, spoil, cause, channel):
    columns, rate_hz = columns_of(preset, 1)
    spoil(columns, np.arange(columns["voltage"].size) / rate_hz)
    sure = strongest(columns, rate_hz)
    alike = [c for c in sure if c.gain > 0.7 * sure[0].gain]
    assert (cause, channel) in [(c.name, c.channel) for c in alike]
    if cause == "line":
        assert sure[0].size == pytest.approx(50.0, abs=1.0)


def test_a_current_that_is_late_by_a_part_of_a_sample_is_named_with_its_lag():
    """No force leads its current: where one would have to, the current is late, and the delay has followed it."""
    columns, rate_hz = columns_of("levitated-ball", 1, 4.0)
    k, part = np.arange(-40, 41), 0.3
    ahead = np.sinc(k - part) * np.kaiser(81, 8.0)
    columns["current"] = np.convolve(np.pad(columns["current"], 40, mode="edge"), ahead / ahead.sum(), "valid")
    found = strongest(columns, rate_hz)
    lag = next(c for c in found if c.name == "current_lag")
    assert lag.gain > 0.7 * found[0].gain
    assert 0.5 * part < lag.size * rate_hz < 1.5 * part
    assert not any(c.name in ("eddy_pole", "sensor_lag", "amplifier_lag") and c.size < 0.0 for c in found)


def test_a_delay_that_is_given_wrong_is_named():
    columns, rate_hz = columns_of("unstable-bearing", 1)
    columns["voltage"] = np.concatenate([columns["voltage"][1:], columns["voltage"][-1:]])  # acts a sample later now
    bench = load_bench(columns, default_rig(), rate_hz=rate_hz, units={"voltage": "V", "current": "A", "position": "m"})
    rig = default_rig()
    fit = greybox(rig.plant, signals_of(bench, rig.plant), rig.parameters, delay=0.0)
    first = causes(fit, {}, default_rig(), thorough=True, delay_given=True)[0]
    assert first.name == "input_delay"
    assert first.size > 0.25 / rate_hz
    assert "input_delay" not in [c.name for c in causes(fit, {}, default_rig(), thorough=True)]


def test_size_and_shift_are_what_a_drift_of_the_resistance_did():
    """The estimate with its named shift taken back is that of the record without the drift."""
    columns, rate_hz = columns_of("unstable-bearing", 1)
    clean, _ = fitted(columns, rate_hz)
    i = columns["current"] + 2.0
    columns["current"] = i
    columns["voltage"] += 1.6 * 2.0 + 0.02 * np.linspace(-1.0, 1.0, i.size) * i
    spoiled, means = fitted(columns, rate_hz)
    drift_found = next(c for c in causes(spoiled, means, default_rig(), thorough=False) if c.name == "r_drift")
    assert drift_found.size == pytest.approx(0.02, rel=0.1)
    n, size = spoiled.problem.n_physical, spoiled.problem.magnitude
    moved = (spoiled.problem.parameters(spoiled.vector), clean.problem.parameters(clean.vector))
    away = np.array([moved[0][k] - moved[1][k] for k in spoiled.problem.estimated])
    sd = np.sqrt(np.diag(np.linalg.inv(clean.J.T @ clean.J)))[:n] * size
    assert np.any(np.abs(away) > sd)
    assert np.all(np.abs(away + drift_found.shift) < 0.3 * np.abs(away) + 0.2 * sd)


def test_intervals_hold_what_a_named_cause_did():
    columns, rate_hz = columns_of("unstable-bearing", 1)
    columns["position"] += 0.01 * columns["position"].std() / columns["current"].std() * columns["current"]
    spoiled, means = fitted(columns, rate_hz)
    found = causes(spoiled, means, default_rig(), thorough=True)
    bias = named_bias(found, np.zeros(spoiled.problem.n_physical))
    assert np.any(np.abs(bias) > 0.0)
    units = {"voltage": "V", "current": "A", "position": "m"}
    estimate = ambid.identify(columns, rate_hz=rate_hz, units=units)
    assert estimate.verdict.word != "usable"
    assert estimate.verdict.reasons[0].cause
    for shift, name in zip(bias, spoiled.problem.estimated, strict=True):
        assert estimate[name].sd >= 0.99 * abs(shift)


def test_a_model_is_extended_by_lines_between_the_frequencies_of_the_record_and_by_a_walk():
    """Hum with a harmonic in the current beside a voltage that walks: taken in, and nothing is off.

    Chance lets a walk go on beyond its waves in one of a hundred looks, of which a record may have two: a caution then.
    """
    taken, n = 0, runs(10, short=2)
    units = {"voltage": "V", "current": "A", "position": "m"}
    for seed in range(1, 1 + n):
        columns, rate_hz = columns_of("unstable-bearing", seed)
        clean = ambid.identify(columns, rate_hz=rate_hz, units=units)
        t = np.arange(columns["voltage"].size) / rate_hz
        for hz, share in ((50.37, 0.1), (151.11, 0.05)):
            columns["current"] = columns["current"] + share * columns["current"].std() * np.sin(2 * np.pi * hz * t + 1)
        columns["voltage"] = columns["voltage"] + 0.1 * columns["voltage"].std() * np.sin(2 * np.pi * 0.4 * t)
        estimate = ambid.identify(columns, rate_hz=rate_hz, units=units)
        if not estimate.extended:
            assert estimate.verdict.word == "caution"
            continue
        taken += 1
        assert estimate.extended[0] == "line (151 Hz)"
        assert estimate.extended[1].startswith("slow_voltage (0.")
        assert estimate.verdict.word == "usable"
        for name in ("m", "k_x", "k_i", "R", "L"):
            assert estimate[name].value == pytest.approx(clean[name].value, abs=2.0 * estimate[name].sd)
            assert estimate[name].sd < 2.0 * clean[name].sd
    assert taken >= 0.9 * n


UNITS = {"voltage": "V", "current": "A", "position": "m"}


def dead_time(c, t):
    c["voltage"] += 0.05 * c["voltage"].std() * np.sign(c["current"])


def sensor_drift(c, t):
    c["current"] += 0.2 * c["current"].std() * (t / t[-1]) ** 2


def amplifier(c, t):
    """What is logged is the command of an amplifier that follows it over three samples."""
    v = c["voltage"]
    c["voltage"] = v + 0.3 * (v - np.append(v[0], v[:-1]))


@pytest.mark.parametrize("preset", ["thesis", "unstable-bearing"])
@pytest.mark.parametrize(
    ("spoil", "cause"), [(dead_time, "dead_time"), (sensor_drift, "slow_current"), (amplifier, "amplifier_lag")]
)
def test_what_the_amplifier_and_the_current_sensor_do_is_named(preset, spoil, cause):
    columns, rate_hz = columns_of(preset, 1)
    spoil(columns, np.arange(columns["voltage"].size) / rate_hz)
    sure = strongest(columns, rate_hz)
    assert cause in [c.name for c in sure if c.gain > 0.7 * sure[0].gain]


def test_a_fixed_value_that_is_wrong_is_the_cause_and_what_it_moved_is_held():
    columns, rate_hz = columns_of("unstable-bearing", 1)
    rig = rig_of_preset(preset("unstable-bearing"))
    truth = {p.name: p.value for p in rig.parameters}
    free = {name: {"unit": unit} for name, unit in (("k_x", "N/m"), ("k_i", "N/A"), ("R", "ohm"), ("L", "H"))}
    mass = {"m": {"value": 1.05 * truth["m"], "unit": "kg", "role": "fixed"}}
    said = {"schema": "ambid.rig/1", "name": "heavier", "model": "one-axis", "parameters": mass | free}
    estimate = ambid.identify(columns, said, rate_hz=rate_hz, units=UNITS)
    reason = next(r for r in estimate.verdict.reasons if r.check == "causes")
    assert reason.cause == "fixed_value"
    assert reason.size == pytest.approx(-0.05 * truth["m"], rel=0.3)
    assert not estimate.checks["fixed_agree"].passed
    for name in free:
        assert abs(estimate[name].value - truth[name]) < 4.0 * estimate[name].sd


def weighed(value, **channels):
    free = {name: {"unit": unit} for name, unit in (("k_x", "N/m"), ("k_i", "N/A"), ("R", "ohm"), ("L", "H"))}
    mass = {"m": {"value": value, "unit": "kg", "role": "fixed"}}
    return {"schema": "ambid.rig/1", "name": "weighed", "model": "one-axis", "parameters": mass | free, **channels}


@pytest.mark.parametrize("wrong", ["voltage", "current", "position", "rate"])
def test_a_scale_that_a_weighed_mass_contradicts_is_named_beside_it_and_held(wrong):
    """The record shows a contradiction alone: the mass, a gain or the rate is wrong, and each moves other numbers."""
    columns, rate_hz = columns_of("unstable-bearing", 1)
    truth = {p.name: p.value for p in rig_of_preset(preset("unstable-bearing")).parameters}
    if wrong == "rate":
        rate_hz *= 1.03
    else:
        columns[wrong] = 1.03 * columns[wrong]
    estimate = ambid.identify(columns, weighed(truth["m"]), rate_hz=rate_hz, units=UNITS)
    reason = next(r for r in estimate.verdict.reasons if r.check == "causes")
    assert (reason.cause, *reason.alternatives[:2]) == ("fixed_value", "sensor_gain", "rate")
    for name in ("k_x", "k_i", "R", "L"):
        assert abs(estimate[name].value - truth[name]) < 2.0 * estimate[name].sd


def test_a_scale_that_the_rig_knows_is_not_blamed():
    columns, rate_hz = columns_of("unstable-bearing", 1)
    mass = 1.05 * next(p.value for p in rig_of_preset(preset("unstable-bearing")).parameters if p.name == "m")
    channels = {c: {"column": c, "gain_sd": 1e-3} for c in ("voltage", "current", "position")}
    known = ambid.identify(
        columns, weighed(mass, channels=channels, record={"rate_sd": 1e-4}), rate_hz=rate_hz, units=UNITS
    )
    guessed = ambid.identify(columns, weighed(mass), rate_hz=rate_hz, units=UNITS)
    reason = next(r for r in known.verdict.reasons if r.check == "causes")
    assert reason.cause == "fixed_value"
    assert not {"sensor_gain", "rate"} & set(reason.alternatives)
    assert known["R"].sd < 0.5 * guessed["R"].sd


def test_bands_of_a_sound_record_agree():
    """Beyond 4 standard deviations by chance nearly never, of what is not fed back."""
    for seed in range(1, 1 + runs(20, short=3)):
        fit, _ = fitted(*columns_of("thesis", seed))
        assert not np.any(by_bands(fit))


def test_intervals_hold_what_a_band_of_disturbance_moved():
    """A motion beside that of the record, with its voltage, is that of a force that is not white: stiffness and mass
    are drawn to what that force would need, and the rest of the record does not agree.
    """
    plain = rig_of_preset(preset("unstable-bearing"))
    truth = {p.name: p.value for p in plain.parameters}
    columns, rate_hz = columns_of("unstable-bearing", 1)
    clean = ambid.identify(columns, rate_hz=rate_hz, units=UNITS)
    rng, n = np.random.default_rng(1), columns["position"].size
    f = np.fft.rfftfreq(n, 1.0 / rate_hz)
    motion = np.fft.irfft(((f > 50.0) & (f < 150.0)) * np.exp(2j * np.pi * rng.random(f.size)), n)
    motion *= 0.15 * columns["position"].std() / motion.std()
    columns["position"] = columns["position"] + motion
    columns["voltage"] = columns["voltage"] + truth["k_i"] * (np.roll(motion, -1) - motion) * rate_hz
    fit, _ = fitted(columns, rate_hz)
    estimate = ambid.identify(columns, rate_hz=rate_hz, units=UNITS)
    assert estimate.verdict.word != "usable"
    assert max(abs(estimate[name].value - truth[name]) / clean[name].sd for name in ("m", "k_x")) > 8.0
    assert np.any(by_bands(fit))
    for name in ("m", "k_x", "k_i", "R", "L"):
        assert abs(estimate[name].value - truth[name]) < 3.0 * estimate[name].sd


def test_no_number_is_identified_where_the_verdict_is_not_to_use_it():
    columns, rate_hz = columns_of("unstable-bearing", 1)
    columns["position"] = 1e6 * columns["position"]  # in micrometres, and said to be in metres
    estimate = ambid.identify(columns, rate_hz=rate_hz, units=UNITS)
    assert estimate.verdict.word == "unusable"
    assert not any(p.identifiable for p in estimate.parameters if p.role != "fixed")


def test_a_force_whose_frequency_changes_is_named_by_its_band_and_taken_in():
    rig = rig_of_preset(preset("unstable-bearing"))
    clean = ambid.simulate(rig, duration=1.0, seed=1)
    t = np.arange(clean.n_samples) / clean.rate_hz
    columns = {c.name: c.values.copy() for c in clean.channels}
    turn = 2 * np.pi * (60.0 * t + 1.5 * t**2)
    columns["position"] = columns["position"] + 0.05 * columns["position"].std() * np.sin(turn)
    sure = strongest(columns, clean.rate_hz)
    assert sure[0].name in ("coloured_force", "coloured_voltage", "line")
    assert sure[0].size == pytest.approx(61.5, abs=4.0)


def walked(seed, tau_s, newton):
    """A record under a force that is forgotten in `tau_s`, of an rms in N, and its truth."""
    s, rng = SETTINGS["bearing"], np.random.default_rng(seed)
    u = multisine(8192, s.rate_hz, amplitude=s.rms, band=s.band, seed=seed, amplitude_is="rms")
    keep = np.exp(-1.0 / (tau_s * s.rate_hz))
    force = lfilter([newton * np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(u.size))
    done = simulate(
        LinearPlant(model=model(s.model), parameters=s.truth), u, rate_hz=s.rate_hz, seed=seed, loop=s.loop,
        noise=Noise.held(rate_hz=s.rate_hz, **s.noise),
        variation=Variation(force=Schedule(times_s=tuple(np.arange(u.size) / s.rate_hz), values=tuple(force))),
    )  # fmt: skip
    return {c.name: c.values for c in done.record.channels}, s.rate_hz, s.truth


def test_a_force_that_walks_is_taken_in_as_noise(tmp_path):
    """It goes on beyond any waves: a low pass of the force holds it, and intervals are right."""
    usable, beyond = 0, 0
    for seed in range(1, 1 + runs(12, short=3)):
        columns, rate_hz, truth = walked(seed, 0.1, 10 * SETTINGS["bearing"].noise["force"])
        estimate = ambid.identify(columns, rate_hz=rate_hz, units=UNITS)
        assert any("_force" in cause for cause in estimate.extended) or estimate.verdict.word == "caution"
        usable += estimate.verdict.word == "usable"
        beyond += sum(abs(estimate[k].value - truth[k]) > 1.96 * estimate[k].sd for k in ("m", "k_x", "k_i", "R", "L"))
        estimate.save(tmp_path / "estimate.json")  # of the plant's own order, for those who read it
        assert ambid.load(tmp_path / "estimate.json").noise.gain.shape == (3, 2)
    n = runs(12, short=3)
    assert usable >= 0.5 * n
    assert beyond <= 5 * n * 0.05 + 3.0 * np.sqrt(5 * n * 0.05)


def test_noise_of_a_band_in_the_current_is_named_with_its_middle_and_taken_in():
    """An aliased tone of an amplifier that changes in amplitude and phase."""
    columns, rate_hz = columns_of("unstable-bearing", 1)
    clean = ambid.identify(columns, rate_hz=rate_hz, units=UNITS)
    rng, n = np.random.default_rng(1), columns["current"].size
    turn, keep = 2 * np.pi * 300.0 / rate_hz, np.exp(-2 * np.pi * 10.0 / rate_hz)
    tone = lfilter([1.0], [1.0, -2 * keep * np.cos(turn), keep**2], rng.standard_normal(n))
    noisy = {**columns, "current": columns["current"] + 1.5e-3 * tone / tone.std()}
    first = strongest(noisy, rate_hz)[0]
    assert first.name in ("coloured_current", "coloured_voltage")
    assert first.size == pytest.approx(300.0, abs=20.0)
    estimate = ambid.identify(noisy, rate_hz=rate_hz, units=UNITS)
    assert estimate.extended[0].startswith("coloured_")
    assert estimate.verdict.word == "usable"
    for name in ("m", "k_x", "k_i", "R", "L"):
        assert estimate[name].value == pytest.approx(clean[name].value, abs=3.0 * estimate[name].sd)


def test_a_line_whose_channel_is_not_clear_is_held_by_force_and_voltage():
    """Two columns of waves in force and voltage hold a line of any channel: the numbers are those without it."""
    columns, rate_hz = columns_of("unstable-bearing", 1)
    clean = ambid.identify(columns, rate_hz=rate_hz, units=UNITS)
    t = np.arange(columns["voltage"].size) / rate_hz
    for name, share in (("current", 0.2), ("position", 0.2)):
        columns[name] = columns[name] + share * columns[name].std() * np.sin(2 * np.pi * 73.3 * t)
    found = strongest(columns, rate_hz)
    assert {part[0] for column in found[0].columns for part in column} == {"force", "voltage"}
    estimate = ambid.identify(columns, rate_hz=rate_hz, units=UNITS)
    assert estimate.extended == ("line (73.3 Hz)",)
    assert estimate.verdict.word == "usable"
    for name in ("m", "k_x", "k_i", "R", "L"):
        assert estimate[name].value == pytest.approx(clean[name].value, abs=2.0 * estimate[name].sd)


def cause(name, gain, **more):
    return Cause(name=name, gain=gain, p=0.0, size=19.0, shift=np.full(1, 9.0), sizes=np.ones(1), **more)


@pytest.mark.parametrize(
    ("far", "every", "named", "also"),
    [
        (False, 1, "fixed_value", ("friction",)),
        (True, 1, "friction", ("fixed_value",)),  # a mass that would have to be thousands of times itself
        (False, 10, "sampling", ("fixed_value", "friction")),
    ],
)
def test_a_weighed_value_is_blamed_where_it_can_be_what_is_wrong(far, every, named, also):
    rng, n = np.random.default_rng(3), 20_000
    v, i = rng.standard_normal(n), np.zeros(n)
    for k in range(n - 1):
        i[k + 1] = 0.95 * i[k] + 0.05 * v[k]
    i += 1e-4 * rng.standard_normal(n)
    columns = {"voltage": v, "current": i, "position": i**2}
    channels = tuple(Channel(name=name, values=x[::every], unit="V", source_unit="V") for name, x in columns.items())
    record = Record(channels=channels, rate_hz=1e3, start_s=0.0, provenance={}, history=())
    failed = Check(passed=False, detail="", values={"gain": 250.0})
    found = [cause("fixed_value", 250.0, channel="m", far=far), cause("friction", 180.0)]
    check = causes_check(
        found, {"estimates_agree": failed, "fixed_agree": failed}, np.ones(1), robust=True, record=record
    )["causes"]
    assert (check.cause, check.alternatives) == (named, also)
    assert check.size == (None if named == "sampling" else 19.0)  # which is the fixed value's
    if named == "fixed_value":
        assert "the fixed m fits better +19 (SI) from where it is" in check.detail


def test_a_fixed_value_is_compared_with_causes_over_the_samples_in_which_those_are_looked_for(monkeypatch):
    """Its gain in half of a record is half; a column that the half does not see is no invalid number."""
    columns, rate_hz = columns_of("unstable-bearing", 1)
    fit, means = fitted(columns, rate_hz)
    freed = {"c": (300.0, np.append(np.zeros(fit.problem.n_physical), 0.1))}
    gains = [_fixed_gain(fit, means, freed)]
    monkeypatch.setattr(causes_module, "_LONGEST", fit.problem.n_used // 2)
    gains.append(_fixed_gain(fit, means, freed))
    assert gains == pytest.approx([300.0, 150.0], rel=1e-3)
    own = np.array([[4.0, 1e-20], [1e-20, -1e-20]])  # of rounding
    assert np.isfinite(causes_module._scales(own)).all()


def _fixed_gain(fit, means, freed):
    return next(
        c.gain for c in causes(fit, means, default_rig(), thorough=False, freed=freed) if c.name == "fixed_value"
    )


def test_intervals_hold_the_shift_of_the_cause_that_is_named_before_a_far_value_of_larger_gain():
    found = [cause("fixed_value", 250.0, channel="m", far=True), cause("friction", 100.0)]
    found[1] = replace(found[1], shift=np.full(1, -11.0))
    assert abs(named_bias(found, np.zeros(1))) == 11.0
    failed = Check(passed=False, detail="", values={"gain": 250.0})
    passed = {"estimates_agree": Check(passed=True, detail=""), "fixed_agree": failed}
    check = causes_check(found, passed, np.ones(1), robust=True, record=None)["causes"]
    assert check.cause == "friction"
