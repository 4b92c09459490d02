"""Innovations and their Jacobian: the fast code against a plain complex-step implementation, number by number."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.estimation import likelihood
from ambid.estimation.likelihood import (
    Workspace,
    innovations,
    linearise,
    null_space,
    reduce_rows,
    residual_blocks,
    weight_of,
)
from ambid.estimation.predictor import assemble
from tests.bearing.benches import problem_of, run, stationary_gain
from tests.estimation import reference
from tests.estimation.reference import complex_step

N = 260
BENCHES = ["thesis", "bearing", "coil", "sprung rotor", "falling rotor"]
VARIANTS = {
    "levels": {"noise": "levels"},
    "levels, delay fraction": {"noise": "levels", "fractional": True, "delay": 1, "lag": 0.0},
    "gain": {"noise": "gain"},
    "gain, every third sample": {"noise": "gain", "stride": 3},
    "gain, every third, delay fraction": {"noise": "gain", "stride": 3, "fractional": True, "delay": 1, "lag": 0.0},
    "levels, given fraction": {"noise": "levels", "lag": 0.3},
    "gain, every second, given fraction": {"noise": "gain", "stride": 2, "lag": 0.7},
}


def case(name, variant, *, fraction=0.4, n=N):
    """Problem and a vector off the truth: nothing in the vector is zero by chance."""
    settings = dict(VARIANTS[variant])
    problem, vector = problem_of(run(name, n, 1), skip=6, **settings)
    rng = np.random.default_rng(2)
    sl = problem.slices
    vector[sl["physical"]] *= 1 + 0.02 * rng.standard_normal(problem.n_physical)
    if "c" in problem.estimated:
        vector[problem.estimated.index("c")] = 0.5
    vector[sl["offset"]] = 0.3 * rng.standard_normal(len(problem.model.disturbances))
    vector[sl["initial"]] += rng.standard_normal(len(problem.model.states))
    if problem.fractional:
        vector[sl["fraction"]] = fraction
    return problem, vector


def rows_of(problem, vector, weight):
    """Whole Jacobian (n_used, n_outputs, size) and weighted innovations (n_used, n_outputs)."""
    blocks = [
        r.reshape(-1, problem.size + 1).copy() for r in residual_blocks(problem, vector, weight, Workspace(problem))
    ]
    rows = np.vstack(blocks).reshape(problem.n_used, problem.y.shape[1], problem.size + 1)
    return rows[:, :, :-1], rows[:, :, -1]


def some_weight(n_y):
    return np.array([[1.3]]) if n_y == 1 else np.array([[1.3, 0.0], [-0.4, 0.8]])


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", BENCHES)
def test_innovations_equal_the_plain_implementation(name, variant):
    problem, vector = case(name, variant)
    got, wanted = innovations(problem, vector), reference.innovations(problem, vector)
    assert got.shape == (problem.n_used, len(problem.model.outputs))
    np.testing.assert_allclose(got, wanted, rtol=1e-7, atol=1e-8 * np.abs(wanted).max())


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", BENCHES)
def test_jacobian_equals_a_complex_step(name, variant):
    problem, vector = case(name, variant)
    weight = some_weight(len(problem.model.outputs))
    jacobian, weighted = rows_of(problem, vector, weight)
    wanted = np.einsum("ab,kbq->kaq", weight, complex_step(lambda v: reference.innovations(problem, v), vector))
    groups = {group: range(*s.indices(problem.size)) for group, s in problem.slices.items()}
    for group, places in groups.items():
        for q in places:
            error = np.abs(jacobian[:, :, q] - wanted[:, :, q]).max()
            assert error <= 1e-6 * np.abs(wanted[:, :, q]).max(), (group, q, error)
    np.testing.assert_allclose(weighted, reference.innovations(problem, vector) @ weight.T, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("fraction", [-0.6, 0.0, 0.4, 1.0, 1.7])
def test_delay_is_differentiated_in_every_interval(fraction):
    problem, vector = case("bearing", "levels, delay fraction", fraction=fraction)
    jacobian, _ = rows_of(problem, vector, np.eye(2))
    wanted = complex_step(lambda v: reference.innovations(problem, v), vector)
    q = problem.slices["fraction"].start
    assert np.abs(jacobian[:, :, q] - wanted[:, :, q]).max() <= 1e-6 * np.abs(wanted[:, :, q]).max()
    assert problem.delay_samples(vector) == pytest.approx(1 + fraction)


@pytest.mark.parametrize("total", [1.0, 1.45, 2.0, 2.6])
def test_the_same_delay_written_in_different_ways(total):
    # given whole + given fraction, and estimated about one, two or three samples, are one predictor
    bench = run("bearing", N, 1)
    found = []
    for delay in (1, 2, 3):
        if -1 < total - delay < 2:
            problem, vector = problem_of(bench, fractional=True, delay=delay, skip=6)
            vector[problem.slices["fraction"]] = total - delay
            found.append(innovations(problem, vector))
    given, vector = problem_of(bench, delay=int(total), lag=total - int(total), skip=6)
    found.append(innovations(given, vector))
    assert len(found) >= 2
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=1e-8, atol=1e-9 * np.abs(found[0]).max())


def test_at_the_truth_innovations_are_white_with_the_riccati_covariance():
    bench = run("bearing", 20_000, 4)
    problem, vector = problem_of(bench)
    e = innovations(problem, vector)
    expected = assemble(problem, vector, with_derivatives=False).innovations.S * (1 / 1.5) ** 2
    n = e.shape[0]
    for i in range(2):
        for j in range(2):
            sd = np.sqrt((expected[i, i] * expected[j, j] + expected[i, j] ** 2) / n)
            assert abs((e[:, i] * e[:, j]).mean() - expected[i, j]) < 4 * sd
            for lag in (1, 2, 7):
                late = (e[lag:, i] * e[:-lag, j]).mean() / np.sqrt(expected[i, i] * expected[j, j])
                assert abs(late) < 4 / np.sqrt(n)


@pytest.mark.parametrize("variant", ["levels", "gain, every third sample"])
@pytest.mark.parametrize("name", BENCHES)
def test_compression_keeps_information_gradient_and_norm(name, variant):
    problem, vector = case(name, variant, n=1500)
    weight = some_weight(len(problem.model.outputs))
    jacobian, weighted = rows_of(problem, vector, weight)
    full, r = jacobian.reshape(-1, problem.size), weighted.ravel()
    small = linearise(problem, vector, weight)
    assert small.J.shape == (problem.size + 1, problem.size)
    size = np.linalg.norm(full, axis=0)
    np.testing.assert_allclose(
        small.J.T @ small.J / np.outer(size, size), full.T @ full / np.outer(size, size), atol=1e-11
    )
    np.testing.assert_allclose(small.J.T @ small.r / size, full.T @ r / size, atol=1e-11 * np.linalg.norm(r))
    assert np.linalg.norm(small.r) == pytest.approx(np.linalg.norm(r), rel=1e-12)
    e = innovations(problem, vector)
    np.testing.assert_allclose(small.covariance, e.T @ e / e.shape[0], rtol=1e-9)


@pytest.mark.parametrize("name", ["thesis", "bearing", "coil", "falling rotor"])
def test_blocks_change_nothing(name, monkeypatch):
    problem, vector = case(name, "levels", n=700)
    weight = some_weight(len(problem.model.outputs))
    whole = rows_of(problem, vector, weight)
    monkeypatch.setattr(likelihood, "_BLOCK", 64)
    parts = rows_of(problem, vector, weight)
    for one, other in zip(whole, parts, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-10 * np.abs(one).max())


def test_a_workspace_can_be_used_again():
    problem, vector = case("bearing", "levels")
    work = Workspace(problem)
    first = innovations(problem, vector, work)
    moved = vector.copy()
    moved[problem.slices["noise"]] += 0.7
    innovations(problem, moved, work)
    linearise(problem, moved, np.eye(2), work)
    again = innovations(problem, vector, work)
    np.testing.assert_allclose(again, first, rtol=1e-8, atol=1e-9 * np.abs(first).max())


def test_a_given_gain_is_the_same_predictor_as_a_free_one():
    bench = run("bearing", N, 1)
    free, vector = problem_of(bench, noise="gain")
    given, short = problem_of(bench, noise="given", gain=stationary_gain(free, bench))
    assert given.size == free.size - 6
    np.testing.assert_array_equal(innovations(given, short), innovations(free, vector))
    jacobian, _ = rows_of(free, vector, np.eye(2))
    fewer, _ = rows_of(given, short, np.eye(2))
    keep = np.r_[0 : free.slices["noise"].start, free.slices["noise"].stop : free.size]
    np.testing.assert_allclose(fewer, jacobian[:, :, keep], rtol=1e-12)


def test_scales_are_units_and_nothing_else():
    # the innovations in SI may not hang on the units in which the predictor works
    bench = run("bearing", N, 1)
    problem, vector = problem_of(bench)
    factor = {"state": np.array([3.0, 0.2, 7.0]), "input": np.array([5.0]), "output": np.array([0.3, 11.0]),
              "disturbance": np.array([4.0, 0.5])}  # fmt: skip
    other = replace(
        problem, scales=replace(problem.scales, **{k: getattr(problem.scales, k) * f for k, f in factor.items()})
    )
    moved, sl = vector.copy(), problem.slices
    moved[sl["initial"]] /= factor["state"]
    log_y = np.log(factor["output"])
    moved[sl["noise"]] += np.r_[log_y[0] - np.log(factor["disturbance"]), log_y[0] - log_y[1]]
    a, b = innovations(problem, vector), innovations(other, moved)
    np.testing.assert_allclose(b * factor["output"], a, rtol=1e-7, atol=1e-8 * np.abs(a).max())


@pytest.mark.parametrize("changes", [{"m": -1.0}, {"L": 0.0}, {"k_i": np.nan}])
def test_no_predictor_where_there_is_no_plant(changes):
    problem, vector = problem_of(run("bearing", N, 1))
    for name, value in changes.items():
        vector[problem.estimated.index(name)] = value
    assert assemble(problem, vector) is None
    assert innovations(problem, vector) is None
    assert linearise(problem, vector, np.eye(2)) is None


def test_no_predictor_with_a_gain_that_does_not_stabilise():
    problem, vector = problem_of(run("bearing", N, 1), noise="gain")
    vector[problem.slices["noise"]] = 0.0
    assert assemble(problem, vector) is None  # the bearing falls


@pytest.mark.parametrize("fraction", [-1.0, 2.0, -3.0])
def test_no_predictor_beyond_the_delays_that_are_spread(fraction):
    problem, vector = case("bearing", "levels, delay fraction", fraction=fraction)
    assert assemble(problem, vector) is None


def test_a_delay_before_the_log_is_refused():
    problem, vector = problem_of(run("bearing", N, 1, delay=0.0), fractional=True, delay=0, skip=6)
    vector[problem.slices["fraction"]] = -0.01
    assert assemble(problem, vector) is None  # the plant may not know its input before it was given
    vector[problem.slices["fraction"]] = 0.01
    assert assemble(problem, vector) is not None


@pytest.mark.parametrize("name", ["thesis", "bearing", "sprung rotor", "coil"])
def test_every_noise_level_has_a_predictor(name):
    # a record without process noise sends the search to low levels: a hole in the criterion would stop it
    problem, vector = problem_of(run(name, N, 1))
    holes = []
    for level in np.arange(-16.0, 4.0, 0.25):
        vector[problem.slices["noise"]][: len(problem.model.disturbances)] = level
        holes += [] if assemble(problem, vector, with_derivatives=False) else [float(level)]
    assert not holes


def test_rows_are_reduced_by_an_orthogonal_matrix():
    a = np.random.default_rng(0).standard_normal((2600, 5))
    for few in (reduce_rows(a), reduce_rows(a, last=True)):
        np.testing.assert_allclose(few.T @ few, a.T @ a, rtol=1e-10)
    assert reduce_rows(a).shape[0] < 100
    np.testing.assert_array_equal(reduce_rows(a[:100]), a[:100])
    assert reduce_rows(a, last=True).shape == (5, 5)


def test_null_space_completes_the_rows():
    a = np.random.default_rng(0).standard_normal((2, 5))
    z = null_space(a)
    np.testing.assert_allclose(z @ a.T, np.zeros((3, 2)), atol=1e-14)
    np.testing.assert_allclose(z @ z.T, np.eye(3), atol=1e-14)


def test_weight_whitens():
    s = np.array([[2.0, 0.7], [0.7, 1.0]])
    w = weight_of(s)
    assert w[0, 1] == 0
    np.testing.assert_allclose(w @ s @ w.T, np.eye(2), atol=1e-14)
    np.testing.assert_allclose(w.T @ w, np.linalg.inv(s), rtol=1e-13)
