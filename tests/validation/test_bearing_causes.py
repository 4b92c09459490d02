"""Score tests of a nonlinear bearing: each cause is named where it is, none where there is none, and lines are taken in
so that numbers come out as without them.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import ambid
from ambid.bearing.magnet_likelihood import search, uncertainty
from ambid.job.identification import identify_nonlinear
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.presets import preset
from ambid.rig import rig_of_preset
from ambid.validation.bearing_causes import bearing_causes, bearing_look, extended_bearing
from tests.bearing.magnet.bearings import problem_of
from tests.bearing.magnet.stops import NOISE, RATE, STOPS, TRUTH, ball_between_stops
from tests.tiers import runs

N = 3000
T = np.arange(N) / RATE
FREE = {"k", "s", "L_leak", "R"}


@cache
def ball(seed, *, force_hz=0.0):
    """A ball that is moved slowly between its stops; something pushes it at a frequency."""
    rng = np.random.default_rng(seed)
    setpoint = np.interp(np.arange(N), np.arange(0, N + 600, 600), rng.uniform(1.6e-3, 2.0e-3, N // 600 + 1))
    setpoint = np.convolve(np.pad(setpoint, (150, 0), mode="edge"), np.ones(151) / 151, "valid")
    push = 0.02 * (force_hz > 0.0) * np.sin(2.0 * np.pi * force_hz * T + rng.uniform(0.0, 6.0))
    record = ball_between_stops(setpoint, seed, volts=1.0, beside=np.column_stack([np.zeros(N), push]))
    assert STOPS[0] < record.y[:, 0].min() < record.y[:, 0].max() < STOPS[1]
    return record


def ball_of_its_own(seed):
    sound = ball(seed)
    return replace(sound, u=sound.u.copy(), y=sound.y.copy())


def fitted(record, estimated=frozenset(FREE)):
    problem = problem_of([record], TRUTH, MagnetLaw(), set(estimated), NOISE, 0.0)
    return search(problem, problem.start())


def found(record):
    fit = fitted(record)
    return fit, bearing_causes(bearing_look(fit, 0), thorough=True, delay_given=True)


@pytest.mark.parametrize(
    ("where", "number", "size"), [("force", "g", 1.0 / TRUTH["m"]), ("voltage", "v_offset", 1.0),
                                  ("position", "x_offset", 1.0), ("current", "i_offset", 1.0)],
)  # fmt: skip
def test_a_signal_shows_as_the_number_that_it_is(where, number, size):
    """A constant force is gravity, a constant voltage the offset of the supply, an error of a sensor its zero."""
    fit = fitted(ball(1), FREE | {number})
    look = bearing_look(fit, 0)
    place = [n.name for n in fit.problem.estimated].index(number)
    way = look.through([((where, np.ones(N)),)])[:, 0, 400:].T
    slope = look.slopes[400:, :, place] / fit.problem.chain(fit.vector)[place] * size
    assert np.abs(way - slope).max() < 1e-3 * np.abs(slope).max()


def test_a_sound_record_names_no_cause_and_its_probabilities_are_those_of_chance():
    """None holds what is fed back: of all scores as many are below a probability as it says."""
    seeds, chances = range(1, 1 + runs(30, short=5)), list[float]()
    for seed in seeds:
        every = found(ball(seed))[1]
        chances += [c.p for c in every if c.colour is None]
    p = np.array(chances)
    assert np.count_nonzero(p < 1e-4) <= len(seeds) // 20
    for level in (0.01, 0.1, 0.5):
        assert (
            np.count_nonzero(p < level) - level * p.size < 4.5 * np.sqrt(level * (1 - level) * p.size) + 0.02 * p.size
        )


def late(record):
    """A position that is logged a sample late."""
    record.y[1:, 0] = record.y[:-1, 0].copy()


def hum(record):
    record.y[:, 1] += 5e-3 * np.sin(2.0 * np.pi * 50.0 * T)


def talk(record):
    record.y[:, 0] += 2e-5 * (record.y[:, 1] - record.y[:, 1].mean())


def warm(record):
    """The logged voltage is what a coil of a resistance that rises by 5 % would have."""
    record.u[:] += 0.05 * TRUTH["R"] * T / T[-1] * record.y[:, 1]


@pytest.mark.parametrize(
    ("spoil", "cause", "channel"),
    [(late, "sensor_lag", "position"), (hum, "line", "current"), (talk, "cross_talk", "position"),
     (warm, "r_drift", "voltage")],
)  # fmt: skip
def test_the_cause_is_named(spoil, cause, channel):
    record = ball_of_its_own(2)
    spoil(record)
    every = found(record)[1]
    alike = [(c.name, c.channel) for c in every if c.p < 1e-4 and c.gain > 0.7 * every[0].gain]
    assert (cause, channel) in alike


@pytest.mark.parametrize("hz", [13.0, 97.0])
def test_a_force_at_a_frequency_is_taken_in_and_moves_no_number(hz):
    record = ball(3, force_hz=hz)
    fit, every = found(record)
    assert every[0].name == "line"
    assert every[0].channel == "force" or hz > 50.0  # there it shows as an error of the position would
    assert every[0].size == pytest.approx(hz, abs=0.5)
    fit, taken = extended_bearing(fit, every, record, (), delay_given=True)
    assert [c.name for c in taken] == ["line"]
    force = np.hypot(*taken[0].sizes[:2])
    assert force == pytest.approx(0.02, rel=0.1)
    spread, values = uncertainty(fit), fit.problem.values(fit.vector)
    sd = np.sqrt(np.diag(spread.covariance(robust=False)))
    assert max(abs((values[n] - TRUTH[n]) / s) for n, s in zip(spread.names, sd, strict=True)) < 4.0
    assert np.all(np.diag(fit.beside) >= 0.0)
    again = bearing_causes(bearing_look(fit, 0), thorough=True, delay_given=True)
    assert not [c.name for c in again if c.p < 1e-4]


def test_the_job_names_what_signals_show_and_takes_in_a_hum():
    rig = rig_of_preset(preset("levitated-ball"))
    record = ambid.simulate("levitated-ball", duration=1.0, seed=2, nonlinear=True)
    columns = {c.name: c.values.copy() for c in record.channels}
    t = np.arange(record.n_samples) / record.rate_hz
    hummed = {**columns, "current": columns["current"] + 5e-3 * np.sin(2.0 * np.pi * 50.0 * t)}
    words = {"rate_hz": record.rate_hz, "units": {c.name: c.unit for c in record.channels}}
    sound, extended = (identify_nonlinear(x, rig, **words) for x in (columns, hummed))
    assert (sound.verdict.word, sound.extended) == ("usable", ())
    assert {"signals_sound", "within_limits", "in_time", "causes"} <= sound.checks.keys()
    assert (extended.verdict.word, extended.extended) == ("usable", ("line (50 Hz)",))
    assert extended["R"].value == pytest.approx(sound["R"].value, abs=3.0 * sound["R"].sd)
    jumps = columns["current"].copy()
    jumps[:: record.n_samples // 10] += 0.5
    spiky = identify_nonlinear({**columns, "current": jumps}, rig, **words)
    assert spiky.checks["signals_sound"].cause == "spikes"


def test_a_mass_that_is_fixed_wrong_is_named():
    problem = problem_of([ball(1)], {**TRUTH, "m": 1.2 * TRUTH["m"]}, MagnetLaw(), FREE, NOISE, 0.0)
    fit = search(problem, problem.start())
    every = bearing_causes(bearing_look(fit, 0), thorough=True, delay_given=True)
    named = next(c for c in every if c.name == "fixed_value")
    assert named.channel == "m"
    assert named.gain > 0.7 * every[0].gain > 10.0
    assert named.size == pytest.approx(-0.2 * TRUTH["m"], rel=0.3)


def test_a_rate_that_is_said_wrong_is_named():
    fit = fitted(replace(ball(1), rate_hz=1.02 * RATE))
    every = bearing_causes(bearing_look(fit, 0), thorough=True, delay_given=True)
    named = next(c for c in every if c.name == "rate")
    assert named.gain > 0.7 * every[0].gain > 10.0
    assert named.size == pytest.approx(0.02, rel=0.2)
