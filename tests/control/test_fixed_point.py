"""Laws in whole numbers: what the words say, what rounding does, against long simulation and against C."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ambid.control.fixed_point import Counts, fixed_point, l1_norms
from ambid.control.knobs import Family
from ambid.control.lqg import SampledPlant, lqg
from ambid.errors import ModelError
from ambid.physics.law import StateLaw
from tests.control.test_lqg import of_preset, weights_of

COUNTS = Counts(position=2.5e-3 / 1024, current=2.5 / 1024, command=24.0 / 800, largest=380)  # of preset prototype
KNOBS = [(1.0, 2.0), (0.1, 1.0), (1.0, 0.3)]


def words_of(effort, disturbance, **options):
    bench, plant = of_preset("prototype")
    law = lqg(plant, weights_of(bench), bench.noise, effort=effort, disturbance=disturbance).law
    return plant, law, fixed_point(law, plant, COUNTS, **options)


def test_l1_norms_are_the_largest_answers_to_bounded_signals():
    A, B, C = np.array([[0.9, 0.2], [-0.2, 0.9]]), np.array([[1.0], [0.5]]), np.array([[1.0, -2.0]])
    answers = [(C @ np.linalg.matrix_power(A, k) @ B)[0, 0] for k in range(1000)]
    assert l1_norms(A, B, C)[0, 0] == pytest.approx(np.sum(np.abs(answers)), rel=2e-4)
    slow = np.array([[0.9999]])
    assert l1_norms(slow, np.ones((1, 1)))[0, 0] == pytest.approx(1e4, rel=2e-4)
    assert np.isinf(l1_norms(np.array([[1.0]]), np.ones((1, 1))))[0, 0]


@pytest.mark.parametrize(("effort", "disturbance"), KNOBS)
def test_peak_in_words_is_within_a_tenth_of_a_decibel(effort, disturbance):
    plant, law, found = words_of(effort, disturbance)
    family = Family(plants=(plant,))
    shift = 20.0 * math.log10(np.max(family.peaks(found.realised)) / np.max(family.peaks(law)))
    assert found.peak_shift_db == pytest.approx(shift)
    assert abs(shift) < 0.02
    assert found.largest_pole < 1.0
    f = np.geomspace(0.2, 990.0, 50)
    size = np.abs(law.response(f))
    assert np.max(np.abs(found.realised.response(f) - law.response(f)) / size.max(axis=0)) < 2e-3
    assert len(found.words) <= 3 + 7 * 6
    assert all(-32768 <= w <= 32767 for w in found.words)
    assert len(found.rows) == 4  # the command on its way needs no state: what was ordered is known


def test_fewer_bits_cost_margin():
    shifts = [abs(words_of(0.1, 1.0, word_bits=bits)[2].peak_shift_db) for bits in (8, 16)]
    assert shifts[1] < 0.02 < 1.0 < shifts[0]


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
    given = np.array(list(found.run(y, low=-4000, high=4000)))
    kept = np.flatnonzero(found.rows[:, 1])  # an integrator adds up exactly
    A, C = law.A[np.ix_(kept, kept)], law.C[:, kept] / COUNTS.command
    states = 0.5 * np.sum(l1_norms(A, A - np.eye(kept.size), C)) + 0.5 * np.sum(np.abs(law.C)) / COUNTS.command
    assert states < 5.0
    assert np.max(np.abs(given - exact)) < 0.51 + states  # counts: of the pulse width, of the states


@pytest.mark.parametrize(("effort", "disturbance"), KNOBS)
def test_states_stay_within_their_bounds_where_all_is_driven_to_its_end(effort, disturbance):
    _, _, found = words_of(effort, disturbance)
    assert np.all(found.bounds <= 32767)
    rng = np.random.default_rng(2)
    y = np.sign(rng.standard_normal((3000, 2))).astype(int) * 300
    z, largest = [0] * len(found.rows), 0
    for _ in found.run(y, low=-380, high=380, z=z):
        largest = max(largest, *(abs(x) for x in z))
    assert largest < (1 << 29) - (1 << 13) - 1  # none was cut


def rest_of(found, plant, n, start):
    """Positions of the closed loop with all that rounds, nothing from outside; the last half."""
    of = SampledPlant.of(plant)
    x, z, seen = np.zeros(of.A.shape[0]), [0] * len(found.rows), []
    x[0] = start
    for _ in range(n):
        y = of.C @ x / [COUNTS.position, COUNTS.current]
        duty = next(found.run([np.rint(y).astype(int)], low=-380, high=380, z=z))
        x = of.A @ x + of.B[:, 0] * (duty * COUNTS.command)
        seen.append(x[0])
    return np.array(seen[n // 2 :])


@pytest.mark.parametrize(("effort", "disturbance"), KNOBS)
def test_limit_cycles_at_rest_are_within_their_bound(effort, disturbance):
    plant, _, found = words_of(effort, disturbance)
    assert found.cycle_of_states < COUNTS.position  # the words add less than the converter
    seen = rest_of(found, plant, 4000, 5.3e-6)
    assert np.max(np.abs(seen)) <= found.cycle
    assert np.max(np.abs(seen)) > 0.02 * found.cycle  # and it is no bound of nothing


def test_noise_of_rounding_is_as_told():
    bench, plant = of_preset("prototype")
    law = lqg(plant, weights_of(bench), bench.noise, effort=1.0, disturbance=2.0).law
    found = fixed_point(law, plant, COUNTS)
    of, rng, sd = SampledPlant.of(plant), np.random.default_rng(3), np.array([2e-6, 2e-3])
    per, left = np.array([COUNTS.position, COUNTS.current]), []
    x, z = np.zeros(of.A.shape[0]), [0] * len(found.rows)
    exact_x, exact_z, exact = np.zeros(of.A.shape[0]), np.zeros(found.realised.order), found.realised
    for e in rng.standard_normal((6000, 2)) * sd:
        y = np.rint((of.C @ x + e) / per).astype(int)
        h = [(v + (1 << 13)) >> 14 for v in z]
        w = exact.C @ h + exact.D @ (y * per)  # before the pulse width is rounded
        next(found.run([y], low=-380, high=380, z=z))
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
    assert tuple(found.rows[0][1:3]) == (0, 0)  # a pure integrator


def test_what_does_not_fit_is_refused():
    bench, plant = of_preset("prototype")
    law = lqg(plant, weights_of(bench), bench.noise).law
    with pytest.raises(ModelError, match="Give G"):
        fixed_point(replace(law, G=None), plant, COUNTS)
    wide = StateLaw(A=0.5 * np.eye(7) * np.arange(1, 8)[:, None] / 7.0, B=np.ones((7, 2)), C=np.ones((1, 7)),
                    D=np.zeros((1, 2)), rate_hz=plant.rate_hz)  # fmt: skip
    with pytest.raises(ModelError, match="at most 6 states"):
        fixed_point(wide, plant, COUNTS)
    with pytest.raises(ModelError, match="larger than its words"):
        fixed_point(law.scaled([1e4, 1.0]), plant, COUNTS)
    twin = replace(law, A=np.array([[0.5, 1.0], [0.0, 0.5]]), B=np.ones((2, 2)), C=np.ones((1, 2)), G=np.zeros((2, 1)))
    with pytest.raises(ModelError, match="two poles"):
        fixed_point(twin, plant, COUNTS)
