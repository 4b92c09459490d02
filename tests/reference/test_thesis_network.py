"""Thesis sec. 4.2 and 5.3.1: the network whose weights are A and B, on the simulated rig of table 4.1."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.data import IOData
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.nn import nn
from ambid.physics.linear_model import model
from ambid.physics.presets import preset
from ambid.simulation import simulate_preset

ENTRIES = ("a21", "a23", "a32", "a33", "b3")
PUBLISHED = {"a21": -6231.1, "a23": -3279.2, "a32": 5315.7, "a33": -18.9, "b3": 16.61}  # eq. 4.11


def white_noise_record(seed: int) -> IOData:
    """2 s at 10 kHz, open loop, white noise of 7 V rms held for 1 ms, with the rig's sensor noise."""
    u = np.repeat(np.random.default_rng(seed).standard_normal(2000), 10) * 7.0
    r = simulate_preset(preset("thesis"), u, seed=seed).record
    return IOData(
        u=r["voltage"][:, None],
        y=np.stack([r["position"], r["current"]], axis=1),
        dt=1e-4,
        inputs=("voltage",),
        outputs=("position", "current"),
        units={"voltage": "V", "position": "m", "current": "A"},
        open_loop=True,
    )


def truth() -> dict[str, float]:
    s = model("one-axis").matrices(preset("thesis").parameters)
    return {"a21": s.A[1, 0], "a23": s.A[1, 2], "a32": s.A[2, 1], "a33": s.A[2, 2], "b3": s.B[2, 0]}


@pytest.fixture(scope="module")
def fits() -> list[NonlinearFit]:
    return [nn([white_noise_record(seed)], {}) for seed in (1, 2, 3)]


def weights(fit: NonlinearFit) -> dict[str, tuple[float, float]]:
    assert fit.model is not None
    assert fit.sd is not None
    return {k: (v, s) for k, v, s in zip(fit.model.names, fit.model.theta, fit.sd, strict=True)}


def test_a_and_b_within_three_thousandths_where_the_thesis_was_one_to_ten_per_cent_off(
    fits: list[NonlinearFit],
) -> None:
    true = truth()
    assert max(abs(PUBLISHED[k] / true[k] - 1) for k in ENTRIES) > 0.09
    for fit in fits:
        assert fit.status == "converged"
        found = weights(fit)
        for k in ENTRIES:
            value, sd = found[k]
            assert abs(value / true[k] - 1) < 0.003, k
            assert abs(value / true[k] - 1) < 0.3 * abs(PUBLISHED[k] / true[k] - 1), k
            assert abs(value - true[k]) < 3.5 * sd, k
            assert sd < 0.0015 * abs(true[k]), k


def test_sensor_noise_comes_out_as_it_went_in(fits: list[NonlinearFit]) -> None:
    for fit in fits:
        assert not fit.details["gain"]  # white sensor noise wants no predictor gain
        np.testing.assert_allclose(np.sqrt(np.diag(fit.noise_covariance)), [5e-7, 1e-4], rtol=0.02)


def test_both_trainings_stand_beside_each_other(fits: list[NonlinearFit]) -> None:
    descent, newton, fine = fits[0].curves
    assert "thesis" in descent.method
    assert descent.training.size == 11  # ten iterations, as in fig. 5.19
    assert newton.training.size == 2
    assert descent.training[0] == newton.training[0]
    assert np.all(np.diff(descent.training) < 0)
    assert newton.training[-1] <= descent.training[-1]
    assert fine.training[-1] < 0.1 * fine.training[0]


def test_validated_with_another_signal(fits: list[NonlinearFit]) -> None:
    # thesis sec. 4.3: a plain voltage; the free run stays within the sensors' noise
    t = np.arange(3000) * 1e-4
    r = simulate_preset(preset("thesis"), 5.0 * np.sign(np.sin(2 * np.pi * 20 * t)), seed=9).record
    u, y = r["voltage"][:, None], np.stack([r["position"], r["current"]], axis=1)
    fitted = fits[0].model
    assert fitted is not None
    left = (y - fitted.simulate(u, y))[fitted.lag :]
    assert np.all(left.std(axis=0) < 2.0 * np.array([5e-7, 1e-4]))
    assert np.all(left.std(axis=0) < 0.02 * y.std(axis=0))


def test_the_absolute_mass_follows_from_the_weights(fits: list[NonlinearFit]) -> None:
    # theory.md sec. 1: five entries fix m, k_x, k_i, R, L
    w = {k: v for k, (v, _) in weights(fits[0]).items()}
    ell = 1 / w["b3"]
    k_i = -w["a32"] * ell
    assert k_i / w["a23"] == pytest.approx(0.1, rel=1e-3)
    assert k_i == pytest.approx(-310.08, rel=1e-3)
    assert -w["a33"] * ell == pytest.approx(1.25, rel=1e-3)
