"""The likelihood search: an optimum is an optimum, priors follow Bayes' rule, a Jacobian tells what a search finds."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.estimation import likelihood
from ambid.estimation.likelihood import evaluate, innovations, linearise, prior_rows, score_statistic, search, weight_of
from ambid.estimation.linear import directions
from ambid.estimation.predictor import assemble
from tests.bearing.benches import problem_of, run, stationary_gain
from tests.estimation import reference
from tests.estimation.reference import complex_step
from tests.validation.wrong import WithoutMotionalVoltage


def fitted(name, n=1500, seed=1, **settings):
    problem, vector = problem_of(run(name, n, seed), **settings)
    return search(problem, vector)


@pytest.fixture(scope="module", params=["thesis", "bearing", "coil", "falling rotor"])
def fit(request):
    names = {"falling rotor": ("k_x", "k_i"), "coil": ("R", "L")}.get(request.param, ("m", "k_x", "k_i", "R", "L"))
    return fitted(request.param, estimated=names)


def posterior(fit):
    return directions(np.vstack([fit.J, fit.J_prior])).inverse()


def criterion_of(problem):
    """n log det of the plain implementation's innovation covariance, and the priors: complex-capable."""

    def value(v):
        e = reference.innovations(problem, v)
        cov = e.T @ e / problem.n_used
        r, _ = prior_rows(problem, np.real(v))
        _, j = prior_rows(problem, np.real(v))
        r = r + 1j * (j @ np.imag(v))
        return problem.n_used * np.log(np.linalg.det(cov)) + np.sum(r * r)

    return value


def test_the_search_converges_to_a_zero_gradient(fit):
    assert fit.status == "converged"
    gradient = complex_step(lambda v: np.array(criterion_of(fit.problem)(v)), fit.vector)
    # the criterion is twice a log-likelihood: half its gradient times the covariance is the Newton step that is left
    step, n = posterior(fit) @ gradient / 2, fit.problem.n_physical
    sd = np.sqrt(np.diag(posterior(fit)))
    assert np.max(np.abs(step / sd)[:n]) < 0.05
    assert gradient @ step / 2 < 0.05  # what the criterion could still fall by


def test_one_standard_deviation_away_the_criterion_has_risen_by_one(fit):
    # along every direction of the covariance: the information matrix is the curvature of the likelihood
    values, directions = np.linalg.eigh(posterior(fit))
    value = criterion_of(fit.problem)
    at = np.real(value(fit.vector))
    n_physical = fit.problem.n_physical
    for spread, direction in zip(values, directions.T, strict=True):
        rises = [np.real(value(fit.vector + sign * np.sqrt(spread) * direction)) - at for sign in (-1, 1)]
        assert min(rises) > 0  # it is the minimum of the determinant, not only a fixed point of the weighting
        # noise levels are curved; what is mostly physical must follow the parabola
        if np.linalg.norm(direction[:n_physical]) > 0.9:
            assert np.mean(rises) == pytest.approx(1.0, abs=0.15)


def test_criterion_and_covariance_are_those_of_the_plain_implementation(fit):
    e = reference.innovations(fit.problem, fit.vector)
    np.testing.assert_allclose(fit.covariance, e.T @ e / len(e), rtol=1e-6)
    assert fit.criterion == pytest.approx(float(np.real(criterion_of(fit.problem)(fit.vector))), abs=1e-3)
    value, covariance = evaluate(fit.problem, fit.vector)
    assert value == pytest.approx(fit.criterion, abs=1e-6)
    np.testing.assert_allclose(covariance, fit.covariance, rtol=1e-9)


def test_information_is_that_of_the_whole_jacobian(fit):
    weight = weight_of(fit.covariance)
    whole = np.einsum("ab,kbq->kaq", weight, complex_step(lambda v: reference.innovations(fit.problem, v), fit.vector))
    whole = whole.reshape(-1, fit.problem.size)
    size = np.linalg.norm(whole, axis=0)
    np.testing.assert_allclose(
        fit.J.T @ fit.J / np.outer(size, size), whole.T @ whole / np.outer(size, size), atol=1e-6
    )


def test_reweighting_beats_any_fixed_weighting(fit):
    n_y = fit.problem.y.shape[1]
    rng = np.random.default_rng(0)
    for _ in range(5):
        moved = fit.vector + 0.3 * np.sqrt(np.diag(posterior(fit))) * rng.standard_normal(fit.problem.size)
        assert evaluate(fit.problem, moved)[0] > fit.criterion
    if n_y == 2:
        once = search(fit.problem, fit.vector * 1.001, steps=1)
        assert fit.criterion <= once.criterion + 0.02


def test_the_end_does_not_hang_on_the_start():
    problem, vector = problem_of(run("bearing", 2000, 3), estimated=("m", "k_x", "k_i", "R", "L"))
    best = search(problem, vector)
    sd = np.sqrt(np.diag(posterior(best)))
    for factor in (0.85, 1.2):
        start = vector.copy()
        start[problem.slices["physical"]] *= factor
        start[problem.slices["noise"]] = -1.0
        other = search(problem, start)
        assert other.status == "converged"
        assert abs(other.criterion - best.criterion) < 0.02
        assert np.max(np.abs(other.vector - best.vector) / sd) < 0.1


def with_prior(problem, name, mean, sd):
    means, sds, j = problem.prior_mean.copy(), problem.prior_sd.copy(), problem.estimated.index(name)
    means[j], sds[j] = mean, sd
    return replace(problem, prior_mean=means, prior_sd=sds)


@pytest.mark.parametrize("name", ["R", "k_i"])
@pytest.mark.parametrize("strength", [0.3, 1.0, 3.0])
def test_a_prior_combines_as_gaussians_do(name, strength):
    plain = fitted("bearing", estimated=("m", "k_x", "k_i", "R", "L"))
    j = plain.problem.estimated.index(name)
    size = plain.problem.magnitude[j]
    value, sd = plain.vector[j] * size, np.sqrt(posterior(plain)[j, j]) * size
    mean, prior_sd = value + 1.5 * sd, sd / strength
    both = search(with_prior(plain.problem, name, mean, prior_sd), plain.vector)
    precision = 1 / sd**2 + 1 / prior_sd**2
    wanted = (value / sd**2 + mean / prior_sd**2) / precision
    assert both.vector[j] * size == pytest.approx(wanted, abs=0.06 * sd)
    assert np.sqrt(posterior(both)[j, j]) * size == pytest.approx(precision**-0.5, rel=0.03)


def test_a_strong_prior_pins_and_a_weak_one_does_nothing():
    plain = fitted("bearing", estimated=("m", "k_x", "k_i", "R", "L"))
    m = plain.problem.magnitude[0]
    pinned = search(with_prior(plain.problem, "m", 1.05 * m, 1e-6 * m), plain.vector)
    assert pinned.vector[0] == pytest.approx(1.05, abs=1e-5)
    free = search(with_prior(plain.problem, "m", 3 * m, 1e4 * m), plain.vector)
    assert free.vector[0] == pytest.approx(plain.vector[0], abs=0.02 * np.sqrt(posterior(plain)[0, 0]))
    # pinned by a prior is fixed: the others end where they end with m fixed
    names = ("k_x", "k_i", "R", "L")
    bench = run("bearing", 1500, 1)
    short, vector = problem_of(bench, estimated=names)
    fixed = search(replace(short, known={**short.known, "m": 1.05 * m}), vector)
    sd = np.sqrt(np.diag(posterior(fixed)))[:4]
    assert np.max(np.abs(fixed.vector[:4] - pinned.vector[1:5]) / sd) < 0.02


def test_prior_rows_are_residuals_in_standard_deviations():
    problem, vector = problem_of(run("bearing", 300, 1))
    problem = with_prior(problem, "R", 1.5, 0.2)
    r, jacobian = prior_rows(problem, vector)
    n_noise = 3
    assert r.shape == (1 + n_noise,)
    assert r[0] == pytest.approx((problem.parameters(vector)["R"] - 1.5) / 0.2)
    np.testing.assert_allclose(complex_step(lambda v: jacobian @ v, vector), jacobian)
    assert jacobian[0] @ (vector - 0) - r[0] == pytest.approx(1.5 / 0.2)  # linear in the vector
    none, empty = prior_rows(*problem_of(run("bearing", 300, 1), noise="gain"))
    assert none.size == 0
    assert empty.shape[0] == 0


def test_the_score_statistic_promises_what_a_search_then_finds():
    # 3 % of a sample of delay that the smaller model does not know
    bench = run("bearing", 4000, 5, delay=1.03)
    known, vector = problem_of(bench, delay=1, lag=0.0, skip=4)
    small = search(known, vector)
    free = replace(known, fractional=True)
    start = np.insert(small.vector, free.slices["fraction"].start, 0.0)
    promise = score_statistic(small, free, start)
    found = search(free, start)
    fall = small.criterion - found.criterion
    assert fall > 20
    assert promise == pytest.approx(fall, rel=0.15)


def test_the_score_statistic_is_chi_squared_where_nothing_is_missing():
    # levels against a free gain: three more numbers, not needed (a record long enough to show the levels themselves)
    found = []
    for seed in range(20):
        bench = run("bearing", 4000, 100 + seed)
        problem, vector = problem_of(bench, estimated=("m", "k_x", "k_i", "R", "L"))
        small = search(problem, vector)
        free = replace(problem, noise="gain")
        start = np.zeros(free.size)
        for group in ("physical", "offset", "initial"):
            start[free.slices[group]] = small.vector[problem.slices[group]]
        start[free.slices["noise"]] = assemble(problem, small.vector, with_derivatives=False).gain.ravel()
        found.append(score_statistic(small, free, start))
    # mean 3, sd of the mean of 20 draws sqrt(6/20) = 0.55
    assert 3 - 3.3 * 0.55 < np.mean(found) < 3 + 3.3 * 0.55


def test_a_free_gain_ends_at_least_as_low_as_levels():
    bench = run("bearing", 1500, 2)
    levels = search(*problem_of(bench))
    problem, vector = problem_of(bench, noise="gain")
    gain = search(problem, vector)
    assert gain.status == "converged"
    assert gain.criterion < levels.criterion + 0.1
    wanted = stationary_gain(problem, bench)
    sd = np.sqrt(np.diag(posterior(gain)))[problem.slices["noise"]].reshape(wanted.shape)
    got = gain.vector[problem.slices["noise"]].reshape(wanted.shape)
    assert np.max(np.abs(got - wanted) / sd) < 4.5


def test_failure_is_a_status_and_not_an_exception():
    problem, vector = problem_of(run("bearing", 300, 1))
    vector[0] = -1.0
    fit = search(problem, vector)
    assert fit.status == "failed"
    assert fit.criterion == np.inf
    assert evaluate(problem, vector) == (np.inf, None)
    assert score_statistic(fit, problem, vector) == 0.0


def test_a_hopeless_model_ends_with_a_status():
    # a coil that hears nothing of the motion, on a record made of it: the search wanders where predictors are few
    bench = run("thesis", 16_000, 33)
    problem, vector = problem_of(bench, estimated=("m", "k_x", "k_i", "R", "L"))
    fit = search(replace(problem, model=WithoutMotionalVoltage()), vector)
    assert fit.status in ("converged", "stalled", "failed")


def test_a_predictor_that_is_found_only_once_at_a_point_ends_no_search(monkeypatch):
    # the search for the gain begins from the last one found, so that a second evaluation may end without any
    seen = []

    def moody(problem, vector, weight, work):
        again = any(np.array_equal(vector, x) and np.array_equal(weight, w) for x, w in seen)
        seen.append((vector.copy(), weight.copy()))
        return None if again else linearise(problem, vector, weight, work)

    monkeypatch.setattr(likelihood, "linearise", moody)
    problem, vector = problem_of(run("bearing", 300, 1))
    assert search(problem, vector, steps=3).evaluations >= 4


def test_too_few_evaluations_are_reported():
    problem, vector = problem_of(run("bearing", 1500, 1))
    vector[problem.slices["physical"]] *= 0.6
    assert search(problem, vector, steps=1).status == "stalled"


def test_progress_can_interrupt():
    class StopNow(Exception):
        pass

    def tick():
        raise StopNow

    with pytest.raises(StopNow):
        search(*problem_of(run("bearing", 300, 1)), tick=tick)


def test_linearise_and_innovations_agree():
    problem, vector = problem_of(run("rmit", 900, 2))
    e = innovations(problem, vector)
    at = linearise(problem, vector, np.eye(2))
    assert np.linalg.norm(at.r) == pytest.approx(np.linalg.norm(e), rel=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.4])
def test_steps_of_several_samples_know_a_disturbance_at_each_sample(delay):
    """Without correction by outputs, errors of prediction at every third sample are those of single steps."""
    bench = run("thesis", 600, 5)
    bench = replace(bench, delay=delay)
    known = np.random.default_rng(1).standard_normal((600, 2)) * [0.1, 1.0]
    gain = np.zeros((3, 2))
    single, vector = problem_of(bench, noise="given", gain=gain, extra=known)
    several, _ = problem_of(bench, noise="given", gain=gain, extra=known, stride=3)
    np.testing.assert_allclose(innovations(several, vector), innovations(single, vector)[::3], rtol=1e-9, atol=1e-9)
    at = assemble(several, vector)
    for q in range(several.n_physical):
        step = np.eye(several.size)[q] * 1e-6
        ends = [assemble(several, vector + sign * step, with_derivatives=False).M for sign in (1.0, -1.0)]
        slope = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(at.dM[:, :, q], slope, rtol=1e-4, atol=1e-6 * np.abs(slope).max())
