"""Laws in whole numbers: what the words say, and what rounding does, against the controller's arithmetic."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ambid.acquisition.devices._kernels import law_tick
from ambid.acquisition.law_words import BEGIN, law_words
from ambid.control.design import examine
from ambid.errors import RigError
from ambid.physics.law import l1_norms
from ambid.physics.loop import Loop
from tests.control.laws import observer_law, of_preset

POSITION, CURRENT, COMMAND = 2.5e-3 / 1024, 2.5 / 1024, 24.0 / 800  # SI of a count, of preset prototype
REST = 400  # counts of pulse width
KNOBS = [(1.0, 2.0), (0.5, 1.0), (0.5, 2.0)]


def in_words(law):
    """The words of a law, and the law that they say, in SI."""
    words = law_words(law.in_units((POSITION, CURRENT), 1.0 / COMMAND))
    return words, words.law(law.rate_hz).in_units((1.0 / POSITION, 1.0 / CURRENT), COMMAND)


def designed(effort, disturbance):
    return observer_law("prototype", effort=effort, disturbance=disturbance)


def ordered(law, y, low=0, high=800, z=None):
    """What the controller orders, bit by bit, for pairs of counts; its states are moved on."""
    words = np.array(law.words, dtype=np.int64)
    z = np.full(law.order, BEGIN) if z is None else z
    return np.array([law_tick(words, z, int(a), int(b), REST, low, high) - REST for a, b in y])


def test_l1_norms_are_the_largest_answers_to_bounded_signals():
    A, B, C = np.array([[0.9, 0.2], [-0.2, 0.9]]), np.array([[1.0], [0.5]]), np.array([[1.0, -2.0]])
    answers = [(C @ np.linalg.matrix_power(A, k) @ B)[0, 0] for k in range(1000)]
    assert l1_norms(A, B, C)[0, 0] == pytest.approx(np.sum(np.abs(answers)), rel=2e-4)
    slow = np.array([[0.9999]])
    assert l1_norms(slow, np.ones((1, 1)))[0, 0] == pytest.approx(1e4, rel=2e-4)
    assert np.isinf(l1_norms(np.array([[1.0]]), np.ones((1, 1))))[0, 0]
    weak = np.array([[1.0, 1e-5]])  # a slow pole that is seen late, behind a fast one
    assert l1_norms(np.diag([0.5, 1.0 - 1e-5]), np.ones((2, 1)), weak)[0, 0] == pytest.approx(3.0, rel=2e-4)


def moved(plant, law, realised):
    """By how many decibels the words move the peak of the sensitivity."""
    exact, rounded = (examine(plant, Loop(law=x, delay=plant.delays[0]), (0.0, 0.0)).figures for x in (law, realised))
    assert rounded.stable
    return 20.0 * math.log10(rounded.peak / exact.peak)


@pytest.mark.parametrize(("effort", "disturbance"), KNOBS)
def test_peak_in_words_is_within_a_tenth_of_a_decibel(effort, disturbance):
    plant, law = designed(effort, disturbance)
    _, realised = in_words(law)
    assert abs(moved(plant, law, realised)) < 0.1
    f = np.geomspace(0.2, 990.0, 50)
    size = np.abs(law.response(f))
    assert np.max(np.abs(realised.response(f) - law.response(f)) / size.max(axis=0)) < 2e-3


@pytest.mark.parametrize(("effort", "disturbance"), KNOBS)
def test_whole_numbers_follow_the_law_within_their_rounding(effort, disturbance):
    words, law = in_words(designed(effort, disturbance)[1])
    rng, per = np.random.default_rng(1), np.array([POSITION, CURRENT])
    y = np.rint(rng.standard_normal((3000, 2)) * 10.0).astype(int)
    z, exact = np.zeros(law.order), []
    for pair in y:
        w = law.C @ z + law.D @ (pair * per)
        exact.append(w[0] / COMMAND)
        z = law.A @ z + law.B @ (pair * per)
    given = ordered(words, y, -9000, 9000)
    kept = np.flatnonzero(words.rows[:, 1])  # an integrator adds up exactly
    A, C = law.A[np.ix_(kept, kept)], law.C[:, kept] / COMMAND
    states = 0.5 * np.sum(l1_norms(A, A - np.eye(kept.size), C)) + 0.5 * np.sum(np.abs(law.C)) / COMMAND
    assert states < 5.0
    assert np.max(np.abs(given - exact)) < 0.51 + states  # counts: of the pulse width, of the states


@pytest.mark.parametrize(("effort", "disturbance"), KNOBS)
def test_states_stay_within_their_bounds_where_all_is_driven_to_its_end(effort, disturbance):
    words, _ = in_words(designed(effort, disturbance)[1])
    rng, z = np.random.default_rng(2), np.full(words.order, BEGIN)
    for _ in range(30):
        ordered(words, np.sign(rng.standard_normal((100, 2))) * 150.0, z=z)
        assert np.max(np.abs(z - BEGIN)) < 1 << 29  # none was cut


def test_a_pid_in_words_is_that_pid():
    bench, plant = of_preset("prototype")
    pid = bench.loop.as_law(plant.rate_hz)
    words, realised = in_words(pid)
    assert abs(moved(plant, pid, realised)) < 0.005
    assert any((row[1:3] == 0).all() for row in words.rows)  # a pure integrator


def test_what_does_not_fit_is_refused():
    _, law = designed(1.0, 1.0)
    grows = replace(law, A=law.A + 0.6 * np.eye(law.order), G=None)
    with pytest.raises(RigError, match="does not track its states back"):
        in_words(grows)
    with pytest.raises(RigError, match="one count of a sensor would demand too much"):
        in_words(law.scaled([1e4, 1.0]))
