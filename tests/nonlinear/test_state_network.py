"""State-space networks: exact slopes, canonical weights, delay, feedback, grey residual model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.nn import nn
from ambid.nonlinear.state_network import ONE_AXIS, Layout, StateNetwork, StateProblem
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.signals import multisine
from ambid.simulation import simulate_preset
from tests.nonlinear.systems import smooth
from tests.tiers import runs


def one_axis(neurons: int, *, gain: bool) -> Layout:
    return Layout(
        form="one-axis", dt=0.05, n_inputs=1, heads=(2, 0), steps=(), entries=ONE_AXIS,
        scale=(1.0, 2.0, 0.5, 3.0), rates=(1.5, 0.7), rows=(1, 2), gain=gain, neurons=neurons,
    )  # fmt: skip


def free(neurons: int, *, gain: bool) -> Layout:
    return Layout.free(0.05, (2, 1), (0.3, 0.0, 0.0), (1.0,) * 5, gain=gain, neurons=neurons)


@pytest.mark.parametrize(
    "layout",
    [one_axis(2, gain=False), one_axis(2, gain=True), free(0, gain=True), free(2, gain=True)],
    ids=["one-axis", "one-axis with gain", "free", "free with network"],
)  # fmt: skip
def test_the_triangle_holds_slopes_of_errors_and_of_the_prior(layout: Layout) -> None:
    rng = np.random.default_rng(3)
    y, u = rng.standard_normal((40, layout.p)), rng.standard_normal((40, layout.n_inputs + 1))
    u[:, -1] = 1.0
    problem = StateProblem(
        layout=layout, parts=((y[:15], u[:15]), (y[25:], u[25:])),
        weight=np.array([[1.3, 0.4], [0.0, 0.8]])[: layout.p, : layout.p], prior=2.0,
    )  # fmt: skip
    v = 0.3 * rng.standard_normal(layout.n_theta + 2 * layout.n)
    R = problem.triangle(v)
    assert np.sum(R[:, -1] ** 2) == pytest.approx(problem.cost(v), rel=1e-10)
    slope = -2 * R[:, :-1].T @ R[:, -1]
    step = 1e-6
    for k in range(v.size):
        e = np.zeros(v.size)
        e[k] = step
        assert (problem.cost(v + e) - problem.cost(v - e)) / (2 * step) == pytest.approx(
            slope[k], rel=1e-5, abs=1e-5 * np.abs(slope).max()
        )
    rows = np.concatenate([*(x.reshape(-1, v.size + 1) for x in problem.sample_rows(v)), problem.prior_rows(v)])
    np.testing.assert_allclose(rows.T @ rows, R.T @ R, atol=1e-9 * np.abs(R.T @ R).max())


def sampled(n: int, seed: int, *, noise: float = 0.0, delay: int = 0) -> tuple[IOData, np.ndarray, np.ndarray]:
    """A lightly damped second-order system with one output, seen through noise."""
    A, B = np.array([[0.9, 0.4], [-0.35, 0.8]]), np.array([0.1, 0.5])
    rng = np.random.default_rng(seed)
    u, x, y = rng.standard_normal(n), np.zeros(2), np.zeros(n)
    for t in range(n):
        y[t] = x[0]
        x = A @ x + B * (u[t - delay] if t >= delay else 0.0)
    y = y + noise * rng.standard_normal(n)
    units = {"u": "V", "y": "1"}
    record = IOData(
        u=u[:, None], y=y[:, None], dt=0.01, inputs=("u",), outputs=("y",), units=units, open_loop=True
    )  # fmt: skip
    return record, A, B


def test_states_that_are_not_measured_are_found_and_counted() -> None:
    record, A, _ = sampled(2000, 1, noise=0.05)
    fit = nn([record], {})
    assert fit.model is not None
    assert fit.settings["states"] == 2
    found = np.sort_complex(np.linalg.eigvals(np.array(fit.details["A"])))
    np.testing.assert_allclose(found, np.sort_complex(np.linalg.eigvals(A)), atol=2e-3)
    assert not fit.details["gain"]
    assert float(np.sqrt(fit.noise_covariance[0, 0])) == pytest.approx(0.05, rel=0.05)
    continuous = np.linalg.eigvals(np.array(fit.details["continuous"]["A"]))
    np.testing.assert_allclose(np.sort_complex(np.exp(continuous * 0.01)), found, atol=1e-9)


def test_weights_are_covered_by_their_intervals() -> None:
    # of the impulse response's first values, which no choice of states changes
    A0, B0 = sampled(10, 0)[1:]
    inside, total = 0, 0
    n = runs(100, short=25)
    for seed in range(n):
        fit = nn([sampled(400, 200 + seed, noise=0.2)[0]], {"states": 2, "descent": 0})
        assert fit.model is not None
        assert fit.covariance is not None

        def impulse(theta: np.ndarray, fit: NonlinearFit = fit) -> np.ndarray:
            m = fit.model.with_theta(theta)  # type: ignore[union-attr]
            return np.array([(np.linalg.matrix_power(m.A, k) @ m.B)[0, 0] for k in range(4)])

        theta = fit.model.theta
        J = np.stack([(impulse(theta + h) - impulse(theta - h)) / 2e-6 for h in 1e-6 * np.eye(theta.size)], axis=1)
        sd = np.sqrt(np.diag(J @ fit.covariance @ J.T))
        true = np.array([(np.linalg.matrix_power(A0, k) @ B0)[0] for k in range(4)])
        inside, total = inside + np.count_nonzero(np.abs(impulse(theta) - true) < 1.96 * sd), total + 4
    assert n.limit(0.89) <= inside / total <= n.limit(0.99)


def test_a_known_delay_is_taken_into_account() -> None:
    record, _, _ = sampled(800, 2, noise=0.01, delay=5)
    fit = nn([record], {"states": 2, "delay": 5})
    assert fit.model is not None
    assert fit.model.lag == 5 + 6
    assert float(np.sqrt(fit.noise_covariance[0, 0])) == pytest.approx(0.01, rel=0.1)
    left = (fit.model.simulate(record.u, record.y) - record.y)[fit.model.lag :]
    assert np.std(left) < 0.012
    J, theta = fit.model.jacobian(record.u, record.y), fit.model.theta
    for k in range(theta.size):
        h = np.zeros(theta.size)
        h[k] = 1e-6
        both = [fit.model.with_theta(theta + s * h).predict(record.u, record.y)[11:] for s in (1, -1)]
        np.testing.assert_allclose(J[11:, :, k], (both[0] - both[1]) / 2e-6, atol=1e-6)


def test_all_states_measured_is_the_thesis_network() -> None:
    p = preset("thesis")
    u = np.repeat(np.random.default_rng(4).standard_normal(400), 10) * 7.0
    done = simulate_preset(p, u, seed=4)
    y = done.states + np.random.default_rng(5).standard_normal(done.states.shape) * [5e-7, 2e-3, 1e-4]
    units = {"voltage": "V", "position": "m", "velocity": "m/s", "current": "A"}
    record = IOData(
        u=done.record["voltage"][:, None], y=y[:, [2, 0, 1]], dt=1e-4, inputs=("voltage",),
        outputs=("current", "position", "velocity"), units=units, open_loop=True,
    )  # fmt: skip
    fit = nn([record], {})
    assert fit.model is not None
    assert fit.sd is not None
    found = dict(zip(fit.model.names, zip(fit.model.theta, fit.sd, strict=True), strict=True))
    for name, true in (("a23", -3100.8), ("a32", 310.08 / 59.6e-3), ("a33", -1.25 / 59.6e-3), ("b3", 1 / 59.6e-3)):
        assert found[name][0] == pytest.approx(true, rel=2e-3)
        assert abs(found[name][0] - true) < 3.5 * found[name][1]
    one_step = fit.details["one_step_training"]["Gauss-Newton"]["A"]  # noise on the states biases it: it is only shown
    assert abs(one_step[2][2] / (-1.25 / 59.6e-3) - 1) > 0.003


def test_units_decide_on_the_form_and_a_wrong_one_is_refused() -> None:
    record, _, _ = sampled(300, 3, noise=0.01)
    assert nn([record], {"states": 2}).settings["form"] == "free"
    with pytest.raises(EstimationError, match="one-axis"):
        nn([record], {"form": "one-axis"})
    with pytest.raises(EstimationError, match="states"):
        nn([replace(record, y=np.hstack([record.y, record.y**2]), outputs=("y", "z"))], {"states": 1})


def test_an_interrupted_search_gives_its_best_network() -> None:
    record, _, _ = sampled(600, 7, noise=0.02)
    whole = nn([record], {"states": 2, "neurons": 4, "starts": 1})
    calls = 0

    def tick(stage: str, done: float | None = None) -> None:
        nonlocal calls
        calls += stage == "hidden layer"
        if calls == 4:
            raise KeyboardInterrupt

    part = nn([record], {"states": 2, "neurons": 4, "starts": 1}, tick=tick)
    assert part.status == "stalled"
    assert part.settings == whole.settings
    assert part.model is not None
    assert "x1: unit 4" in part.model.names  # three iterations of the hidden layer are kept
    assert part.noise_covariance[0, 0] < 1.1 * whole.noise_covariance[0, 0]


# --- the nonlinear bearing: unstable, under feedback ---------------------------------------------------------------


def bearing(n: int, amplitude: float, seed: int, *, quiet: float = 1.0) -> IOData:
    """The differential bearing at up to a third of its gap; the loop's command acts one sample late."""
    u = multisine(n, 20_000.0, amplitude=amplitude, band=(5.0, 1500.0), seed=seed, amplitude_is="rms", shape="pink")
    noise = Noise(position=1e-7 * quiet, current=2e-3 * quiet)
    r = simulate_preset(preset("unstable-bearing"), u, seed=seed, nonlinear=True, substeps=4, noise=noise).record
    return IOData(
        u=r["voltage"][:, None], y=np.stack([r["position"], r["current"]], axis=1), dt=1 / 20_000.0,
        inputs=("voltage",), outputs=("position", "current"),
        units={"voltage": "V", "position": "m", "current": "A"},
    )  # fmt: skip


def linearised() -> dict[str, float]:
    plant = preset("unstable-bearing").plant
    assert plant is not None
    p = plant.linearise(0.0)
    return {
        "a21": -p["k_x"] / p["m"], "a23": p["k_i"] / p["m"], "a32": -p["k_i"] / p["L"], "a33": -p["R"] / p["L"],
        "b3": 1 / p["L"],
    }  # fmt: skip


def off(fit: NonlinearFit) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of the weights, and errors in standard deviations."""
    assert fit.model is not None
    assert fit.sd is not None
    found = dict(zip(fit.model.names, zip(fit.model.theta, fit.sd, strict=True), strict=True))
    true = linearised()
    return (
        np.array([found[k][0] / v - 1 for k, v in true.items()]),
        np.array([(found[k][0] - v) / found[k][1] for k, v in true.items()]),
    )


@pytest.fixture(scope="module")
def swung() -> IOData:
    return bearing(8000, 4.0, 1)


def test_anchored_network_gives_the_linearisation_that_physics_alone_misses(swung: IOData) -> None:
    alone = nn([swung], {"delay": 1, "descent": 0})
    grey = nn([swung], {"delay": 1, "descent": 0, "neurons": 6, "starts": 1})
    relative, in_sd = off(alone)
    assert np.max(np.abs(relative)) > 0.015
    assert np.max(np.abs(in_sd)) > 10
    assert grey.model is not None
    found = dict(zip(grey.model.names, grey.model.theta, strict=True))
    assert max(abs(found[k] / v - 1) for k, v in linearised().items()) < 0.005
    assert grey.sd is None  # they held in half of the cases
    assert any("the error of its units" in w for w in grey.warnings)
    # one-step errors fall to the sensors' noise
    np.testing.assert_allclose(np.sqrt(np.diag(grey.noise_covariance)), [1e-7, 2e-3], rtol=0.03)
    assert np.sqrt(alone.noise_covariance[1, 1]) > 1.05 * 2e-3
    # and so do those of free runs over 3 ms (a third of the unstable pole's time constant), quiet new data
    new = bearing(4000, 4.0, 2, quiet=0.01)
    assert free_runs(grey, new) < 0.7 * free_runs(alone, new)


def free_runs(fit: NonlinearFit, record: IOData, length: int = 60) -> float:
    assert fit.model is not None
    left = [
        (fit.model.simulate(record.u[k : k + length], record.y[k : k + length]) - record.y[k : k + length])[-1, 1]
        for k in range(0, record.n_samples - length, length)
    ]
    return float(np.sqrt(np.mean(np.square(left))))


def test_an_unstable_plant_is_held_by_its_predictor() -> None:
    fit = nn([bearing(4000, 1.0, 3)], {"delay": 1})  # nearly linear
    relative, in_sd = off(fit)
    assert np.max(np.abs(in_sd)) < 4
    assert np.max(np.abs(relative)) < 0.05
    unstable = np.linalg.eigvals(np.array(fit.details["A"])).real.max()
    assert unstable == pytest.approx(113.7, rel=0.05)
    assert not any("biased" in w for w in fit.warnings)  # a predictor gain: consistent under feedback


@pytest.mark.parametrize(
    ("place", "value"), [("entries", [[0, 9]]), ("entries", [[-1, 0]]), ("heads", [5]), ("rows", [7])]
)
def test_a_file_whose_weights_lie_outside_the_matrices_is_refused(place: str, value: list[object]) -> None:
    model = nn([smooth()], {"form": "free", "states": 2, "neurons": 1, "starts": 1}).model
    assert model is not None
    written = model.as_json()
    written["layout"] = {**written["layout"], place: value}
    with pytest.raises(EstimationError, match="not a state network"):
        StateNetwork.from_json(written)
