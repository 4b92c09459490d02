"""Standard deviations: the information matrix inverted plainly, and the Cramer-Rao bound by brute force."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing.uncertainty import experiment_hint, uncertainty
from ambid.estimation.likelihood import search
from ambid.estimation.linear import directions
from ambid.estimation.uncertainty import WEAK
from tests.bearing.benches import problem_of, run
from tests.estimation.kalman import cramer_rao_sd
from tests.validation.wrong import WithoutMotionalVoltage

AXIS = ("m", "k_x", "k_i", "R", "L")
CASES = [("bearing", AXIS, 2500), ("thesis", AXIS, 3000), ("rmit", AXIS, 2500), ("coil", ("R", "L"), 2000),
         ("sprung rotor", ("k_x", "k_i", "c"), 2000), ("falling rotor", ("k_x", "k_i"), 2000)]  # fmt: skip


@pytest.mark.parametrize(("name", "names", "n"), CASES, ids=[c[0] for c in CASES])
def test_standard_deviations_are_the_cramer_rao_bound(name, names, n):
    bench = run(name, n, 7)
    problem, vector = problem_of(bench, estimated=names)
    fit = search(problem, vector)
    # at the truth, so that only the formula is compared, not where the noise has taken the estimate
    known = uncertainty(search(problem, vector, steps=0))
    bound = cramer_rao_sd(bench, names)
    got = np.sqrt(np.diag(known.fisher))
    np.testing.assert_allclose(got, bound, rtol=0.05)
    z = (fit.vector[: len(names)] * problem.magnitude - [bench.truth[k] for k in names]) / bound
    assert np.max(np.abs(z)) < 4


def test_covariance_is_the_inverse_of_the_information_matrix():
    fit = search(*problem_of(run("bearing", 8000, 3), estimated=AXIS))
    known = uncertainty(fit)
    whole = np.vstack([fit.J, fit.J_prior])
    info = whole.T @ whole
    size = np.sqrt(np.diag(info))
    plain = np.linalg.inv(info / np.outer(size, size)) / np.outer(size, size)
    unit = np.outer(fit.problem.magnitude, fit.problem.magnitude)
    np.testing.assert_allclose(known.fisher, plain[:5, :5] * unit, rtol=1e-6)
    np.testing.assert_allclose(known.information, known.fisher, rtol=1e-6)  # the record is long enough
    np.testing.assert_allclose(known.standard_deviations(robust=False), np.sqrt(np.diag(known.information)))
    np.testing.assert_allclose(known.relative_sd(robust=False), known.standard_deviations(robust=False) / known.scale)


@pytest.mark.parametrize(("name", "names", "n"), CASES, ids=[c[0] for c in CASES])
def test_nothing_is_added_to_the_bound_of_a_long_record(name, names, n):
    known = uncertainty(search(*problem_of(run(name, 20_000, 9), estimated=names)))
    ratio = np.sqrt(np.diag(known.information) / np.diag(known.fisher))
    assert np.all((ratio > 0.999) & (ratio < 1.1)), ratio


def test_four_times_the_record_halves_the_standard_deviation():
    short, long = (uncertainty(search(*problem_of(run("bearing", n, 3), estimated=AXIS))) for n in (4000, 16_000))
    ratio = short.standard_deviations(robust=False) / long.standard_deviations(robust=False)
    assert np.all((ratio > 1.7) & (ratio < 2.35))


def test_robust_standard_deviations_agree_where_the_model_is_right():
    known = [uncertainty(search(*problem_of(run("bearing", 6000, s), estimated=AXIS))) for s in range(4)]
    ratio = np.mean([np.diag(k.robust) / np.diag(k.information) for k in known], axis=0)
    assert np.all((ratio > 0.5) & (ratio < 1.6))
    assert max(k.inflation for k in known) < 2.0


def test_robust_standard_deviations_grow_where_the_spring_wanders():
    # half the record with another spring: the information matrix cannot see that the parameter is not one number
    one, other = run("bearing", 6000, 1), run("bearing", 6000, 1)
    problem, vector = problem_of(one, estimated=AXIS)
    y = problem.y.copy()
    y[3000:] += 0.02 * (y[3000:] - other.states[3000:, [0, 2]].mean(axis=0))
    assert uncertainty(search(replace(problem, y=y), vector)).inflation > 2.0


def test_singular_values_are_relative_precisions():
    fit = search(*problem_of(run("bearing", 2000, 3), estimated=AXIS))
    known = uncertainty(fit)
    relative = known.information / np.outer(known.scale, known.scale)
    np.testing.assert_allclose(np.sort(1 / known.singular_values**2), np.linalg.eigvalsh(relative), rtol=1e-6)
    assert np.all(np.diff(known.singular_values) <= 0)
    direction = np.array([known.weakest[k] for k in AXIS])
    assert np.max(np.abs(direction)) == pytest.approx(1.0)
    unit = direction / np.linalg.norm(direction)
    assert unit @ relative @ unit == pytest.approx(1 / known.singular_values[-1] ** 2, rel=1e-6)


def test_without_motional_voltage_only_ratios_to_the_mass_are_seen():
    # the current-driven rotor: scaling m, k_x, k_i and the force together changes nothing (theory.md sec. 1)
    bench = run("falling rotor", 3000, 2)
    fit = search(*problem_of(bench, estimated=("m", "k_x", "k_i")))
    known = uncertainty(fit)
    assert not any(known.identifiable_at(robust=False))
    # all by the same factor: k_x is negative, so its change over its magnitude has the other sign
    shares = np.array([known.weakest[k] for k in ("m", "k_x", "k_i")])
    np.testing.assert_allclose(shares / shares[0], [1, -1, 1], rtol=0.02)
    hint = experiment_hint(known, {**bench.truth}, 2.0, robust=False)
    assert "ratios" in hint
    assert "fix m" in hint
    fixed = uncertainty(search(*problem_of(bench, estimated=("k_x", "k_i"))))
    assert all(fixed.identifiable_at(robust=False))
    assert experiment_hint(fixed, {**bench.truth}, 2.0, robust=False) is None


def test_an_inductance_beyond_half_the_rate_asks_for_a_faster_one():
    known = uncertainty(search(*problem_of(run("coil", 2000, 3), estimated=("R", "L"))))
    unseen = replace(known, bias=np.array([0.0, 1.0]))
    truth = dict(run("coil", 2000, 3).truth)
    for L, advice in ((truth["L"], "for L, excite at"), (1e-9, "for L, sample faster")):
        assert advice in str(experiment_hint(unseen, {**truth, "L": L}, (1.0, 1.0, 5000.0), robust=True)).replace(
            "For", "for"
        )


def test_a_prior_on_the_mass_is_what_the_rotor_then_knows():
    bench = run("falling rotor", 3000, 2)
    problem, vector = problem_of(bench, estimated=("m", "k_x", "k_i"))
    sd = 0.02 * bench.truth["m"]
    problem = replace(problem, prior_mean=np.array([bench.truth["m"], 0, 0]), prior_sd=np.array([sd, np.inf, np.inf]))
    known = uncertainty(search(problem, vector))
    assert np.sqrt(known.information[0, 0]) == pytest.approx(sd, rel=0.01)
    assert known.data_only_sd[0] > 20 * sd
    assert all(known.identifiable_at(robust=False))


def test_a_damping_near_zero_is_judged_against_critical_damping():
    fit = search(*problem_of(run("bearing", 4000, 3)))
    known = uncertainty(fit)
    theta = fit.problem.parameters(fit.vector)
    j = known.names.index("c")
    assert known.scale[j] == pytest.approx(fit.problem.model.references(theta)["c"])
    for name, scale in zip(known.names, known.scale, strict=True):
        if name != "c":
            assert scale == pytest.approx(abs(theta[name]))


def test_identifiable_means_a_relative_sd_below_a_quarter():
    known = uncertainty(search(*problem_of(run("bearing", 2000, 3), estimated=AXIS)))
    relative = known.relative_sd(robust=False)
    assert known.identifiable_at(robust=False) == tuple((relative < 0.25).tolist())
    assert WEAK == 0.25
    blurred = replace(known, information=known.information * (0.26 / relative[1]) ** 2)
    assert known.identifiable_at(robust=False)[1]
    assert not blurred.identifiable_at(robust=False)[1]


def test_delay_has_a_standard_deviation_where_it_is_a_number():
    problem, vector = problem_of(run("bearing", 4000, 3, delay=1.4), fractional=True, estimated=AXIS)
    fit = search(problem, vector)
    known = uncertainty(fit)
    assert 0 < known.delay_sd < 0.05
    assert abs(problem.delay_samples(fit.vector) - 1.4) < 4 * known.delay_sd
    assert uncertainty(search(*problem_of(run("bearing", 1000, 3), estimated=AXIS))).delay_sd is None


def test_an_unseen_column_has_a_huge_variance_and_not_a_wrong_one():
    a = np.random.default_rng(0).standard_normal((20, 3))
    np.testing.assert_allclose(directions(a).inverse(), np.linalg.inv(a.T @ a), rtol=1e-10)
    a[:, 1] = 0.0
    found = directions(a).inverse()
    assert found[1, 1] > 1e100
    kept = np.linalg.inv(a[:, ::2].T @ a[:, ::2])
    np.testing.assert_allclose(found[::2, ::2], kept, rtol=1e-10)


def test_standard_deviations_are_numbers_even_of_a_hopeless_fit():
    problem, vector = problem_of(run("thesis", 4000, 33), estimated=AXIS)
    known = uncertainty(search(replace(problem, model=WithoutMotionalVoltage()), vector))
    for robust in (False, True):
        assert np.all(np.isfinite(known.standard_deviations(robust=robust)))
        assert np.all(np.diag(known.covariance(robust=robust)) > 0)
    assert known.inflation > 0


def test_robust_covariance_is_the_larger_and_has_its_correlations():
    known = uncertainty(search(*problem_of(run("bearing", 3000, 3), estimated=AXIS)))
    sd = known.standard_deviations(robust=True)
    assert np.all(sd >= known.standard_deviations(robust=False) * (1 - 1e-12))
    both = known.covariance(robust=True)
    np.testing.assert_allclose(np.sqrt(np.diag(both)), sd, rtol=1e-10)
    assert np.linalg.eigvalsh(both / np.outer(sd, sd)).min() > -1e-10
    np.testing.assert_array_equal(known.covariance(robust=False), known.information)
