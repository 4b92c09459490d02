"""The sampled response of a rotor against an independent simulator's, and its exact derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.physics.rotor_model import RotorModel
from ambid.rotor.response import Sampled
from tests.rotor_benches import model_and_truth, needs_simulator, truth

pytestmark = needs_simulator
_F = np.concatenate([np.arange(3.0, 40.0, 7.0), np.arange(140.0, 150.0, 1.0), np.arange(500.0, 1200.0, 60.0)])


def _sampled(model: RotorModel, theta: dict[str, float], delays: np.ndarray, *, held: bool = True) -> Sampled:
    return Sampled(
        space=model.matrices(theta), omega=2.0 * np.pi * _F, rate_hz=20_000.0, delays=delays, held=(held,) * 4
    )


@pytest.mark.parametrize("name", ["flexible", "utrc"])
def test_a_held_voltage_gives_the_response_of_the_independent_simulator(name: str) -> None:
    model, theta = model_and_truth(name)
    wanted = truth.open_loop_frf(truth.BENCHES[name], _F)
    found = _sampled(model, theta, np.ones(4)).transfer()
    assert np.max(np.abs(found - wanted)) < 1e-11 * np.max(np.abs(wanted))


def test_a_delay_of_a_fraction_goes_over_into_the_next_whole_sample() -> None:
    model, theta = model_and_truth("flexible")
    almost = _sampled(model, theta, np.full(4, 2.0 - 1e-9)).transfer()
    whole = _sampled(model, theta, np.full(4, 2.0)).transfer()
    assert np.max(np.abs(almost - whole)) < 1e-7 * np.max(np.abs(whole))


@pytest.mark.parametrize(("held", "late"), [(True, 1.0), (True, 0.3), (False, 0.0)])
def test_slopes_are_the_differences_of_responses(held: bool, late: float) -> None:
    model, theta = model_and_truth("utrc")
    if not held:
        model = replace(model, drives=("current",) * 4)
    delays, U = np.full(4, late), np.random.default_rng(0).normal(size=(_F.size, 4)) + 0j
    names = [p.name for p in model.parameters]
    found = _sampled(model, theta, delays, held=held).slopes(U, [model.derivative(theta, n) for n in names])
    for k, name in enumerate(names):
        h = 1e-6 * max(abs(theta[name]), 1e-2)
        up, down = (
            np.einsum("kyu,ku->ky", _sampled(model, {**theta, name: theta[name] + d}, delays, held=held).transfer(), U)
            for d in (h, -h)
        )
        size = np.max(np.abs(found[:, :, k]))
        assert np.max(np.abs((up - down) / (2 * h) - found[:, :, k])) <= 2e-4 * size + 1e-9 * np.max(np.abs(up)) / h, (
            name
        )


def test_the_slope_by_a_delay_is_the_difference_of_responses() -> None:
    model, theta = model_and_truth("flexible")
    U, h = np.random.default_rng(1).normal(size=(_F.size, 4)) + 0j, 1e-6
    found = _sampled(model, theta, np.full(4, 1.4)).slopes(U, [], 4)
    for k in range(4):
        moved = np.full(4, 1.4)
        moved[k] += h
        up, here = (np.einsum("kyu,ku->ky", _sampled(model, theta, d).transfer(), U) for d in (moved, np.full(4, 1.4)))
        assert np.max(np.abs((up - here) / h - found[:, :, k])) < 1e-3 * np.max(np.abs(found[:, :, k]))
