"""Laws in whole numbers: what the words say, what rounding does, against long simulation and against C."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ambid.acquisition.devices._kernels import law_tick
from ambid.acquisition.law_words import BEGIN, LawWords
from ambid.control.knobs import Counts, Family, fixed_point
from ambid.control.lqg import SampledPlant, lqg
from ambid.errors import RigError
from ambid.physics.law import l1_norms
from tests.control.test_lqg import of_preset, weights_of

COUNTS = Counts(position=2.5e-3 / 1024, current=2.5 / 1024, command=24.0 / 800)  # of preset prototype
REST = 400  # counts of pulse width
KNOBS = [(1.0, 2.0), (0.1, 1.0), (1.0, 0.3)]


def words_of(effort, disturbance):
    bench, plant = of_preset("prototype")
    law = lqg(plant, weights_of(bench), bench.noise, effort=effort, disturbance=disturbance).law
    return plant, law, fixed_point(law, plant, COUNTS)


def ordered(found, y, low=0, high=800, z=None):
    """What the controller orders, bit by bit, for pairs of counts; its states are moved on."""
    words = np.array(found.words.words, dtype=np.int64)
    z = np.full(found.words.order, BEGIN) if z is None else z
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


@pytest.mark.parametrize(("effort", "disturbance"), KNOBS)
def test_peak_in_words_is_within_a_tenth_of_a_decibel(effort, disturbance):
    plant, law, found = words_of(effort, disturbance)
    family = Family(plants=(plant,))
    shift = 20.0 * math.log10(np.max(family.peaks(found.realised)) / np.max(family.peaks(law)))
    assert found.peak_shift_db == pytest.approx(shift)
    assert abs(shift) < 0.1
    assert found.largest_pole < 1.0
    f = np.geomspace(0.2, 990.0, 50)
    size = np.abs(law.response(f))
    assert np.max(np.abs(found.realised.response(f) - law.response(f)) / size.max(axis=0)) < 2e-3


def test_fewer_bits_cost_margin():
    plant, law, found = words_of(0.1, 1.0)
    kept = np.array(found.words.words)
    coarse = 256 * np.rint(kept / 256.0).astype(int)
    coarse[0], coarse[3::7] = kept[0], kept[3::7]  # shifts
    rough = fixed_point(law, plant, COUNTS, LawWords(words=tuple(coarse.tolist())))
    assert abs(found.peak_shift_db) < 0.1 < 0.5 < abs(rough.peak_shift_db)


@pytest.mark.parametrize(("effort", "disturbance"), KNOBS)
def test_whole_numbers_follow_the_law_within_their_rounding(effort, disturbance):
    _, _, found = words_of(effort, disturbance)
    rng = np.random.default_rng(1)
    law, per = found.realised, np.array([COUNTS.position, COUNTS.current])
    y = np.rint(rng.standard_normal((3000, 2)) * 10.0).astype(int)
    z, exact = np.zeros(law.order), []
    for pair in y:
        w = law.C @ z + law.D @ (pair * per)
        exact.append(w[0] / COUNTS.command)
        z = law.A @ z + law.B @ (pair * per)
    given = ordered(found, y, -9000, 9000)
    kept = np.flatnonzero(found.words.rows[:, 1])  # an integrator adds up exactly
    A, C = law.A[np.ix_(kept, kept)], law.C[:, kept] / COUNTS.command
    states = 0.5 * np.sum(l1_norms(A, A - np.eye(kept.size), C)) + 0.5 * np.sum(np.abs(law.C)) / COUNTS.command
    assert states < 5.0
    assert np.max(np.abs(given - exact)) < 0.51 + states  # counts: of the pulse width, of the states


@pytest.mark.parametrize(("effort", "disturbance"), KNOBS)
def test_states_stay_within_their_bounds_where_all_is_driven_to_its_end(effort, disturbance):
    _, _, found = words_of(effort, disturbance)
    rng, z = np.random.default_rng(2), np.full(found.words.order, BEGIN)
    for _ in range(30):
        ordered(found, np.sign(rng.standard_normal((100, 2))) * 150.0, z=z)
        assert np.max(np.abs(z - BEGIN)) < 1 << 29  # none was cut


def rest_of(found, plant, n, start):
    """Positions of the closed loop with all that rounds, nothing from outside; the last half."""
    of = SampledPlant.of(plant)
    x, z, seen = np.zeros(of.A.shape[0]), np.full(found.words.order, BEGIN), []
    x[0] = start
    for _ in range(n):
        y = of.C @ x / [COUNTS.position, COUNTS.current]
        duty = ordered(found, [np.rint(y)], z=z)[0]
        x = of.A @ x + of.B[:, 0] * (duty * COUNTS.command)
        seen.append(x[0])
    return np.array(seen[n // 2 :])


@pytest.mark.parametrize(("effort", "disturbance"), KNOBS)
def test_limit_cycles_at_rest_are_within_their_bound(effort, disturbance):
    plant, _, found = words_of(effort, disturbance)
    assert found.cycle_of_states < 0.2 * found.cycle  # the words add less than converter and pulse width
    seen = rest_of(found, plant, 4000, 5.3e-6)
    assert np.max(np.abs(seen)) <= found.cycle
    assert np.max(np.abs(seen)) > 0.02 * found.cycle  # and it is no bound of nothing


def test_noise_of_rounding_is_as_told():
    bench, plant = of_preset("prototype")
    law = lqg(plant, weights_of(bench), bench.noise, effort=1.0, disturbance=2.0).law
    found = fixed_point(law, plant, COUNTS)
    of, rng, sd = SampledPlant.of(plant), np.random.default_rng(3), np.array([2e-6, 2e-3])
    per, left = np.array([COUNTS.position, COUNTS.current]), []
    x, z = np.zeros(of.A.shape[0]), np.full(found.words.order, BEGIN)
    exact_x, exact_z, exact = np.zeros(of.A.shape[0]), np.zeros(found.realised.order), found.realised
    for e in rng.standard_normal((6000, 2)) * sd:
        y = np.rint((of.C @ x + e) / per).astype(int)
        h = z >> 14
        w = exact.C @ h + exact.D @ (y * per)  # before the pulse width is rounded
        ordered(found, [y], z=z)
        seen = of.C @ exact_x + (y * per - of.C @ x)  # the same errors of the sensors
        v = exact.C @ exact_z + exact.D @ seen
        left.append(float((w - v)[0]))
        x, exact_x = of.A @ x + of.B @ w, of.A @ exact_x + of.B @ v
        exact_z = exact.A @ exact_z + exact.B @ seen
    assert np.std(left) == pytest.approx(found.noise, rel=0.1)


def test_a_pid_in_words_is_that_pid():
    bench, plant = of_preset("prototype")
    found = fixed_point(bench.loop.as_law(plant.rate_hz), plant, COUNTS)
    assert abs(found.peak_shift_db) < 0.005
    assert any((row[1:3] == 0).all() for row in found.words.rows)  # a pure integrator


def test_what_does_not_fit_is_refused():
    bench, plant = of_preset("prototype")
    law = lqg(plant, weights_of(bench), bench.noise).law
    grows = replace(law, A=law.A + 0.6 * np.eye(law.order), G=None)
    with pytest.raises(RigError, match="does not track its states back"):
        fixed_point(grows, plant, COUNTS)
    with pytest.raises(RigError, match="one count of a sensor would demand too much"):
        fixed_point(law.scaled([1e4, 1.0]), plant, COUNTS)
