"""Facts and causes of a coil whose rotor is held: those of voltage and current, and what they say fits the model."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from scipy.signal import lfilter

import ambid
from ambid.record import Channel, Record
from ambid.rig import default_rig
from ambid.validation.facts import agreements
from tests.tiers import runs

R, L, RATE, N = 4.0, 0.1, 2000.0, 8000
UNITS = {"voltage": "V", "current": "A"}


def coil(seed, bias=1.0, limit=np.inf, r_drift=0.0, dead=0.0, hum=0.0):
    """A voltage and its current, exact from sample to sample, with white noise on both."""
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -0.9], rng.standard_normal(N))
    u /= u.std()
    volts = np.clip(u, -limit, limit) + R * bias + 2e-3 * rng.standard_normal(N)
    i, out = bias, np.empty(N)
    for k in range(N):
        out[k] = i
        r = R * (1.0 + r_drift * (k / N - 0.5))
        keeps = np.exp(-r / (L * RATE))
        i = keeps * i + (1.0 - keeps) / r * (volts[k] - dead * np.sign(i))
    noise = 5e-4 * rng.standard_normal(N)
    return {"voltage": u + R * bias, "current": out + noise + hum * np.sin(2.0 * np.pi * 50.0 * np.arange(N) / RATE)}


def identified(**what):
    return ambid.identify(coil(**what), default_rig("coil"), rate_hz=RATE, units=UNITS)


def test_sound_records_of_a_coil_stay_usable():
    found = [identified(seed=seed) for seed in range(1, 1 + runs(20, short=6))]
    words = Counter(e.verdict.word for e in found)
    assert words["usable"] >= len(found) - 2
    assert not any(r.cause for e in found for r in e.verdict.reasons)
    assert all({"ohm", "sampling", "log_runs", "causes"} <= e.checks.keys() for e in found)
    assert not any({"belonging", "position_size", "gravity_balance", "in_time"} & e.checks.keys() for e in found)


@pytest.mark.parametrize(
    ("what", "cause"),
    [({"limit": 1.2}, "limiter"), ({"dead": 0.3, "bias": 0.0}, "dead_time")],
)
def test_a_cause_of_a_coil_is_named(what, cause):
    estimate = identified(seed=1, **what)
    assert estimate.verdict.word != "usable"
    assert estimate.checks["causes"].cause == cause
    for name, true in (("R", R), ("L", L)):
        assert abs(estimate[name].value - true) < 4.0 * estimate[name].sd
    assert "range of motion" not in " ".join(r.text for r in estimate.verdict.reasons)


@pytest.mark.parametrize(("what", "cause"), [({"hum": 0.02}, "line"), ({"r_drift": 0.05}, "r_drift")])
def test_a_coil_is_extended_by_what_changes_in_time(what, cause):
    estimate = identified(seed=1, **what)
    assert estimate.verdict.word == "usable"
    assert estimate.extended[0].startswith(cause)
    for name, true in (("R", R), ("L", L)):
        assert abs(estimate[name].value - true) < 4.0 * estimate[name].sd


def test_a_log_that_stands_still_is_told_of_a_held_rotor_but_not_of_steps_of_the_voltage():
    columns = coil(seed=1)
    stopped = {name: x.copy() for name, x in columns.items()}
    for x in stopped.values():
        x[4000:4100] = x[4000]
    steps = {name: np.repeat(x[::20], 20)[:N] for name, x in columns.items()}
    steps["current"][1::2] += 1e-3  # moves beside the voltage, then the voltage and it stand
    steps["current"][:2000] = steps["current"][0]
    theta, sd = {"R": R, "L": L}, {"R": 1e-2, "L": 1e-3}
    for x, passed in ((columns, True), (stopped, False), (steps, True)):
        channels = tuple(Channel(name=k, values=v, unit=UNITS[k], source_unit=UNITS[k]) for k, v in x.items())
        record = Record(channels=channels, rate_hz=RATE, start_s=0.0, provenance={}, history=())
        assert agreements(record, default_rig("coil"), theta, sd, sd)["log_runs"].passed is passed
