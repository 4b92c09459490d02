"""Checks of black-box fits: what is wrong is found, and only that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.instrumental import cliv
from ambid.blackbox.model import Offsets, StateSpaceModel, TransferModel
from ambid.blackbox.polynomial import arma, armax, bj, oe
from ambid.blackbox.prediction import errors, gradient, innovations_form, polynomial_gradient
from ambid.blackbox.subspace import n4sid, pbsid
from ambid.validation.fits import judge
from tests.validation.blackbox.fits import DT, arx, io, polynomial, run

TRUTH = polynomial(A=(1, -1.5, 0.7), B=((0, 1.0, 0.5),))
BJ = polynomial(F=((1, -1.5, 0.7),), B=((0, 1.0, 0.5),), C=(1, 0.4), D=(1, -0.8))


def record(model=TRUTH, seed=0, n=800, **options):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n, 1))
    return io(u, run(model, u, 0.3 * rng.standard_normal((n, 1))), **options)


def loop(seed=0, n=800, gain=0.5, integral=False, **options):
    """An output-error plant with coloured noise under u = r - gain y, or a tenth of the sum of y in its place."""
    rng = np.random.default_rng(seed)
    v = lfilter([1.0], [1, -0.9], 0.3 * rng.standard_normal(n))
    x, u, y = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(2, n):
        x[k] = 1.5 * x[k - 1] - 0.7 * x[k - 2] + 0.3 * u[k - 1] + 0.1 * u[k - 2]
        y[k] = x[k] + v[k]
        u[k] = rng.standard_normal() - gain * (0.1 * y[:k].sum() if integral else y[k])
    return io(u, y, **options)


def failed(fit):
    return {k for k, c in fit.checks.items() if not c.passed}


def test_a_right_model_passes_everything():
    data = record()
    fit = judge(arx(data, 2, 2), data)
    assert not failed(fit)
    assert {"residuals_white", "residuals_uncorrelated", "feedback", "stable_predictor", "orders_supported"} == set(
        fit.checks
    )
    assert fit.passed
    assert all(c.detail for c in fit.checks.values())


def test_a_missing_order_is_found():
    data = record()
    assert {"residuals_white", "residuals_uncorrelated"} <= failed(judge(arx(data, 1, 1), data))


def test_a_late_delay_is_found_in_the_inputs():
    data = record()
    assert "residuals_uncorrelated" in failed(judge(arx(data, 2, 2, nk=2), data))


def test_a_missing_noise_model_is_found_although_the_inputs_are_white():
    data = record(polynomial(A=(1, -1.5, 0.7), B=((0, 1.0, 0.5),), C=(1, 0.8)))
    assert "residuals_white" in failed(judge(arx(data, 2, 2), data))


def test_coloured_noise_is_no_fault_of_an_output_error_model():
    data = record(BJ)
    fit = judge(oe(data, {"nb": 2, "nf": 2, "nk": 1}), data)
    assert fit.checks["residuals_white"].passed
    assert fit.checks["residuals_white"].p < 1e-3
    assert "residuals_uncorrelated" not in failed(fit)
    assert sum("coloured" in w for w in fit.warnings) == 1


@pytest.mark.parametrize("told", [False, True])
def test_feedback_fails_an_output_error_model_and_warns_a_noise_model(told):
    data = loop(open_loop=told)
    biased = judge(oe(data, {"nb": 2, "nf": 2, "nk": 1}), data)
    assert "feedback" in failed(biased)
    assert any("depends on past residuals" in w and "biases" in w for w in biased.warnings)
    consistent = judge(bj(data, {"nb": 2, "nc": 0, "nd": 1, "nf": 2, "nk": 1}), data)
    assert "feedback" not in failed(consistent)
    assert consistent.checks["feedback"].values["seen"] == 1.0
    assert any("open_loop was given" in w for w in consistent.warnings) == told


@pytest.mark.parametrize("method", [lambda d: oe(d, {"nb": 2, "nf": 2, "nk": 1}), lambda d: n4sid(d, {"n": 3})])
def test_what_says_that_there_is_a_loop_counts_where_the_data_do_not_show_it(method):
    """Of weak feedback, a bias that one record does not show is one all the same."""
    for how in ({"looped": True}, {"reference": loop(n=400).u, "references": ("r",)}):
        data = loop(gain=0.01, n=400, **how)
        fit = judge(method(data), data)
        assert fit.checks["feedback"].values["seen"] == 0.0
        assert "feedback" in failed(fit)
        assert fit.verdict.word != "usable"
    declared = loop(gain=0.0, n=400, looped=True, open_loop=True)
    assert "feedback" not in failed(judge(method(declared), declared))


def test_feedback_by_an_integral_is_seen():
    """It moves an input over far more samples than the lags that are looked at one by one."""
    found = []
    for seed in range(8):
        data = loop(seed=seed, n=2000, gain=0.1, integral=True)
        found.append("feedback" in failed(judge(oe(data, {"nb": 2, "nf": 2, "nk": 1}), data)))
    assert sum(found) >= 6


@pytest.mark.parametrize("kind", ["noise", "periodic", "slow"])
def test_slow_noise_without_feedback_is_none(kind):
    seen, rng = 0, np.random.default_rng(0)
    for _ in range(30):
        u = rng.standard_normal(1500)
        if kind == "slow":
            u = lfilter([0.1], [1, -0.98], u)
        if kind == "periodic":
            u = np.tile(u[:250], 6)
        x = lfilter([0, 0.3, 0.1], [1, -1.5, 0.7], u)
        data = io(u, x + lfilter([0.3], [1, -0.9], rng.standard_normal(1500)))
        seen += "feedback" in failed(judge(oe(data, {"nb": 2, "nf": 2, "nk": 1}), data))
    assert seen <= 1  # 0.1 % of each test


def test_in_a_loop_an_output_error_model_is_judged_by_the_reference():
    """Coloured noise goes round the loop and into the inputs: that is no fault of a consistent estimate."""
    plain = loop(seed=6, n=3000)
    reference = plain.u[:, 0] + 0.5 * plain.y[:, 0]
    data = io(plain.u, plain.y, reference=reference[:, None], references=("r0",))
    fit = judge(cliv(data, {"na": 2, "nb": 2}), data)
    assert fit.checks["residuals_uncorrelated"].passed
    assert fit.checks["feedback"].passed
    assert fit.checks["feedback"].values["seen"] == 1.0


def test_two_outputs_are_judged_each_by_itself():
    rng = np.random.default_rng(7)
    u = rng.standard_normal((1500, 1))
    other = polynomial(A=(1, -0.6), B=((0, 0.4),))
    y = np.hstack([run(m, u, 0.2 * rng.standard_normal((1500, 1))) for m in (TRUTH, other)])
    data = io(u, y)
    for method in (n4sid, pbsid):
        right, low = (judge(method(data, {"n": n}), data) for n in (3, 1))
        assert set(right.fit) == {"y0", "y1"}
        assert not failed(right) & {"residuals_white", "residuals_uncorrelated", "feedback"}
        assert {"residuals_white", "residuals_uncorrelated"} <= failed(low)
        assert "y0" in low.checks["residuals_white"].detail


def test_a_time_series_has_no_inputs_to_test():
    rng = np.random.default_rng(8)
    none = np.zeros((600, 0))
    truth = polynomial(A=(1, -1.2, 0.5), B=(), C=(1, 0.4), F=())
    data = io(none, run(truth, none, rng.standard_normal((600, 1))))
    fit = judge(arma(data, {"na": 2, "nc": 1}), data)
    assert not failed(fit)
    assert not {"residuals_uncorrelated", "feedback"} & set(fit.checks)
    assert fit.fit["y0"].simulation is None
    assert "residuals_white" in failed(judge(arma(data, {"na": 1, "nc": 0}), data))


def test_a_wrong_model_alone_is_no_sign_of_feedback():
    rng = np.random.default_rng(4)
    u = lfilter([1.0], [1, -0.9], rng.standard_normal((800, 1)), axis=0)
    data = io(u, run(TRUTH, u, 0.3 * rng.standard_normal((800, 1))))
    fit = judge(arx(data, 1, 1), data)
    assert "residuals_uncorrelated" in failed(fit)
    assert fit.checks["feedback"].p > 1e-3


def test_what_a_model_misses_is_not_called_a_loop_that_the_user_denies():
    """A slow input goes on as it did, so that errors which hold a function of it tell what comes next."""
    rng = np.random.default_rng(2)
    u = np.convolve(rng.standard_normal(1540), np.ones(40) / 6, "valid")[:1500, None]
    y = np.zeros((1500, 1))
    for t in range(30, 1500):
        y[t] = 0.6 * y[t - 1] + u[t - 1] + u[t - 30] + 0.05 * rng.standard_normal()
    data = io(u, y, open_loop=True)
    fit = judge(armax(data, {"na": 1, "nb": 1, "nc": 1, "nk": 1}), data)
    assert fit.checks["feedback"].values["seen"] == 1.0
    assert "an incomplete model" in fit.checks["feedback"].detail
    assert not any("open loop" in w for w in fit.warnings)


def test_the_present_input_of_a_loop_is_no_sign_of_a_missing_delay():
    """It depends on the present error, also where the user says that there is no loop."""
    rng = np.random.default_rng(9)
    u, y = np.zeros(2000), np.zeros(2000)
    for k in range(1, 2000):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + 0.6 * rng.standard_normal()
        u[k] = rng.standard_normal() - 0.4 * y[k]
    data = io(u, y, open_loop=True)
    fit = judge(armax(data, {"na": 1, "nb": 1, "nc": 1, "nk": 1}), data)
    assert fit.checks["residuals_uncorrelated"].passed
    assert any("Omit open_loop" in w for w in fit.warnings)


def test_a_periodic_input_says_nothing_of_feedback():
    t = np.arange(800.0)[:, None]
    u = np.sin(0.3 * t) + np.cos(1.1 * t)
    data = io(u, run(TRUTH, u, 0.3 * np.random.default_rng(5).standard_normal((800, 1))))
    assert judge(arx(data, 2, 2), data).checks["feedback"].passed


@pytest.mark.parametrize(
    ("make", "where"),
    [
        (lambda d: oe(d, {"nb": 3, "nf": 3, "nk": 1}), "B and F"),
        (lambda d: armax(d, {"na": 3, "nb": 3, "nc": 3, "nk": 1}), "A with B and C"),
        (lambda d: bj(d, {"nb": 2, "nc": 2, "nd": 2, "nf": 2, "nk": 1}), "C and D"),
        (lambda d: arx(d, 4, 3), "a4, b3"),
    ],
)
def test_too_high_an_order_is_found(make, where):
    model = {
        "B and F": polynomial(F=((1, -1.5, 0.7),), B=((0, 1.0, 0.5),)),
        "A with B and C": polynomial(A=(1, -1.5, 0.7), B=((0, 1.0, 0.5),), C=(1, 0.5, 0.2)),
        "C and D": BJ,
        "a4, b3": TRUTH,
    }[where]
    data = record(model, n=1500)
    check = judge(make(data), data).checks["orders_supported"]
    assert not check.passed
    assert where in check.detail


def test_gradients_of_the_predictor_agree_with_differences():
    model = polynomial(A=(1, -0.3), B=((0, 1.0, 0.5),), C=(1, 0.4, 0.1), D=(1, -0.6), F=((1, -1.2, 0.5),))
    rng = np.random.default_rng(1)
    u, y = rng.standard_normal((300, 1)), rng.standard_normal(300)

    def predicted(theta):
        p = model.with_theta(theta).outputs[0]
        v = lfilter(p.A, [1.0], y) - lfilter(p.B[0], p.F[0], u[:, 0])
        return y - lfilter(p.D, p.C, v)

    theta = model.theta
    every = polynomial_gradient(model.outputs[0], u, y, y - predicted(theta))
    for k in [k for k, n in enumerate(model.names) if n not in ("a0", "c0", "d0", "f0")]:
        h = np.zeros(theta.size)
        h[k] = 1e-6
        slope = (predicted(theta + h) - predicted(theta - h)) / 2e-6
        np.testing.assert_allclose(every[:, k], slope, atol=1e-6 * np.abs(every).max())


def test_the_tangent_of_a_state_space_holds_the_change_of_every_entry():
    rng = np.random.default_rng(2)
    parts = {
        "A": np.array([[0.8, 0.2], [-0.3, 0.7]]),
        "B": rng.standard_normal((2, 1)),
        "C": rng.standard_normal((2, 2)),
        "D": np.array([[0.3], [0.1]]),
        "K": 0.2 * rng.standard_normal((2, 2)),
    }
    data = io(rng.standard_normal((400, 1)), rng.standard_normal((400, 2)))
    fit = by_hand(StateSpaceModel(**parts, dt=DT), data)
    found = errors(fit, data)
    rows = gradient(fit, data, found).rows
    wide = np.vstack([J[60:] for J in rows])
    # one set of directions serves both outputs, but for those of D
    for name, value in parts.items():
        for at in np.ndindex(value.shape):
            h = np.zeros(value.shape)
            h[at] = 1e-6
            ends = [
                errors(by_hand(StateSpaceModel(**{**parts, name: value + s * h}, dt=DT), data), data) for s in (1, -1)
            ]
            slope = (ends[1].one_step - ends[0].one_step) / 2e-6
            for o, J in enumerate(rows):
                rest = slope[60:, o] - J[60:] @ np.linalg.lstsq(J[60:], slope[60:, o], rcond=1e-10)[0]
                assert np.linalg.norm(rest) < 1e-5 * np.linalg.norm(slope[60:]) + 1e-9, (name, at)
    assert wide.shape[1] == 2 * (2 + 1 + 2) + 2


def by_hand(model, data) -> BlackBoxFit:
    return build_fit(
        "n4sid" if isinstance(model, StateSpaceModel) else "blocks",
        data,
        orders={"n": 2},
        model=model,
        covariance=None,
        n_estimated=4,
        offsets=Offsets(u=np.zeros(data.n_inputs), y=np.zeros(data.n_outputs)),
        noise_covariance=0.01 * np.eye(data.n_outputs),
    )


def test_a_delayed_continuous_model_is_discretised_as_the_plant_samples():
    """2.4 samples of delay: the held input of a fine grid, sampled."""
    fine, n = 10, 200
    rng = np.random.default_rng(3)
    num, den = [3.0, 40.0], [1.0, 4.0, 90.0]
    u = rng.standard_normal(n)
    a, b, c, _, _ = cont2discrete([np.array(m) for m in _companion(num, den)], DT / fine, method="zoh")
    held = np.concatenate([np.zeros(24), np.repeat(u, fine)])[: n * fine]
    x, y = np.zeros(2), np.zeros(n)
    for k in range(n * fine):
        if k % fine == 0:
            y[k // fine] = (c @ x)[0]
        x = a @ x + b[:, 0] * held[k]
    data = io(u, y)
    fit = by_hand(TransferModel(num=((num,),), den=((den,),), dt=None, delay=(2.4 * DT,)), data)
    assert innovations_form(fit).dt == DT
    found = judge(fit, data)
    assert found.fit["y0"].simulation > 1 - 1e-6
    slopes = gradient(fit, data, errors(fit, data))
    assert slopes.rows[0].shape[1] >= 4


def _companion(num, den):
    return [[0.0, 1.0], [-den[2], -den[1]]], [[0.0], [1.0]], [[num[1], num[0]]], [[0.0]]


def test_a_predictor_that_runs_away_fails_its_check_and_breaks_nothing():
    data = record(n=3000)
    model = StateSpaceModel(A=[[1.6]], B=[[1.0]], C=[[1.0]], D=[[0.0]], K=[[0.1]], dt=DT)
    fit = judge(by_hand(model, data), data, second=data)
    assert failed(fit) == {"stable_predictor", "second_record"}
    assert np.isnan(fit.fit["y0"].one_step)
    assert fit.fit["y0"].simulation is None
    assert not fit.criteria


@pytest.mark.parametrize("estimator", [n4sid, pbsid])
def test_a_delay_beyond_the_order_is_seen_in_the_residuals(estimator):
    data = record(polynomial(A=(1, -1.5, 0.7), B=((0, 1.0, 0.5),)))
    late = replace(data, u=data.u[3:], y=data.y[:-3])  # recorded three samples before it acts: three more states
    right, wrong = (judge(estimator(x, {"n": 2}), x) for x in (data, late))
    assert right.checks["residuals_uncorrelated"].passed
    assert not wrong.checks["residuals_uncorrelated"].passed
