"""What errors of calibration do to a nonlinear bearing: by its scaling laws, by scaled records, in its words."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.job.identification import identify_nonlinear
from ambid.job.results import load
from ambid.physics.coenergy_law import law_numbers
from ambid.physics.presets import preset
from ambid.report.parameters import calibration_lines
from tests.estimation.test_calibration import wrong
from tests.tiers import sample

BALL = preset("levitated-ball")
SD = {"voltage": 0.01, "current": 0.02, "position": 0.01, "rate": 0.002}
WEIGHED = f'role = "fixed", value = {BALL.parameters["m"]!r}'


def rig_of(sd=(), *, mass=WEIGHED, magnet="", offset=""):
    """A rig of a single magnet that says how well its channels are known; `offset`: of the current."""
    given = dict(sd)
    channels = [
        f"[channels.{c}]\n{f'gain_sd = {given[c]}' if c in given else ''}\n{offset if c == 'current' else ''}"
        for c in ("voltage", "current", "position")
    ]
    rate = f"[record]\nrate_sd = {given['rate']}" if "rate" in given else ""
    numbers = f'[parameters]\nm = {{ unit = "kg", {mass} }}\nc = {{ unit = "N s/m", role = "fixed", value = 0.0 }}'
    law = f'[magnet]\nkind = "single"\ngap = "hyperbolic"\nsaturation = false\nrise = false\n{magnet}'
    return "\n".join(['schema = "ambid.rig/1"\nname = "ball"\nmodel = "one-axis"', *channels, rate, numbers, law])


def ball(seed, position=None):
    return ambid.simulate("levitated-ball", 2.0, seed=seed, nonlinear=True, position=position)


@pytest.fixture(scope="module")
def records():
    return [ball(1, 9e-3), ball(2, 11e-3)]


@pytest.fixture(scope="module")
def weighed(records):
    return identify_nonlinear(records, rig_of())


def test_where_the_mass_is_free_the_gains_of_the_coil_move_whole_powers(records):
    """Inductance and force over co-energy: with i too large by e, R, k and L are too small by e and m too large."""
    e = identify_nonlinear(records, rig_of(mass='role = "free"'))
    powers = {"k": 1.0, "s": 0.0, "L_leak": 1.0, "m": 1.0, "R": 1.0}
    for channel, sign in (("voltage", 1.0), ("current", -1.0)):
        for name, power in powers.items():
            wanted = power * (sign if name != "m" else 1.0)
            apart = (e.calibration[channel][name] - wanted) * 0.01 * e[name].value / e[name].sd
            assert abs(apart) < 0.1, (channel, name)
        assert e.calibration[channel]["R"] == pytest.approx(sign, abs=0.01)


@pytest.mark.parametrize("channel", sample(["position", "rate", "current"], 0))
def test_a_scale_that_is_wrong_moves_the_numbers_as_it_says(records, weighed, channel):
    up, down = (identify_nonlinear([wrong(r, channel, 1.0 + e) for r in records], rig_of()) for e in (2e-3, -2e-3))
    for name, per_cent in weighed.calibration[channel].items():
        p = weighed[name]
        seen = (up[name].value - down[name].value) / (4e-3 * p.value)
        assert seen == pytest.approx(per_cent, rel=0.05, abs=20.0 * p.sd / abs(p.value)), name


@pytest.mark.parametrize("seed", sample(range(8), 0))
def test_numbers_and_curves_are_within_the_interval_of_scales_that_are_drawn(seed):
    rng, magnet = np.random.default_rng(40 + seed), BALL.plant.magnet.coenergy
    records = [ball(100 + seed, 9e-3), ball(200 + seed, 11e-3)]
    for channel, sd in SD.items():
        factor = 1.0 + sd * rng.standard_normal()
        records = [wrong(r, channel, factor) for r in records]
    e = identify_nonlinear(records, rig_of(SD))
    truth = {**law_numbers(magnet), "R": BALL.parameters["R"]}
    apart = {name: (e[name].value - truth[name]) / e[name].sd_calibrated for name in ("k", "s", "L_leak", "R")}
    assert max(map(abs, apart.values())) < 3.0, apart
    x, i = np.array([9e-3, 10e-3, 11e-3]), np.full(3, 0.95)
    found, alone = e.curves(x, i), replace(e, calibration_sd={}).curves(x, i)
    for c, plain, exact in (
        (found.k_i, alone.k_i, magnet.force_per_current),
        (found.k_x, alone.k_x, magnet.displacement_coefficient),
    ):
        error = c.value - [exact(a, b) for a, b in zip(x, i, strict=True)]
        assert np.all(np.abs(error) < 3.0 * c.sd)
        assert np.all(c.sd > plain.sd)


def test_without_a_word_on_calibration_a_line_says_what_one_per_cent_would_do(weighed):
    (line,) = calibration_lines(weighed)
    assert line.startswith("Intervals are from this record alone. 1 % of gain moves: voltage ")
    assert "; m (fixed) k +1 %" in line
    assert line in " ".join(weighed.summary().split())
    assert all(p.sd_calibrated is None for p in weighed.parameters)


def test_an_offset_moves_the_law_unless_it_is_estimated(records, tmp_path):
    """A ball is held where s + x is sqrt(k/(2 m g)) times the current: a current too large by e moves s by that, and
    the offset of the voltage by R e.
    """
    known = identify_nonlinear(records, rig_of(SD, offset="offset_sd = 0.05"))
    for name, per_ampere in (
        ("s", np.sqrt(known["k"].value / (2.0 * known["m"].value * known["g"].value))),
        ("v_offset", known["R"].value),
    ):
        assert known.calibration["current.offset"][name] * known[name].value == pytest.approx(per_ampere, rel=0.02)
        spread = [SD.get(c, 0.05) * known.calibration[c][name] for c in (*SD, "current.offset")]
        wide = np.hypot(known[name].sd, known[name].value * np.linalg.norm(spread))
        assert known[name].sd_calibrated == pytest.approx(wide)
    (line,) = calibration_lines(known)
    assert "1 % of gain moves: m (fixed) k +1 %" in line
    free = 'parameters = { i_offset = { unit = "A", role = "free" } }'
    own = identify_nonlinear(records, rig_of(offset="offset_sd = 0.05", magnet=free))
    assert "current.offset" not in own.calibration
    assert all(p.sd_calibrated is None for p in own.parameters)
    assert calibration_lines(own)[-1] == "An offset of current moves the number that stands for it alone"
    known.save(path := tmp_path / "ball.json")
    again = load(path)
    assert (again.parameters, again.calibration) == (known.parameters, known.calibration)
    assert np.array_equal(again.curves(0.01, 0.9).k_i.sd, known.curves(0.01, 0.9).k_i.sd)
