"""Coloured noise beside the white parts: its slopes, that it is found where it is and nowhere else, and taken off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim
from scipy.stats import chi2, norm

from ambid.estimation.colours import (
    _SHAPE,
    Colour,
    Coloured,
    _Shaped,
    coloured,
    colours_of,
    with_colours,
    without_colours,
)
from ambid.estimation.likelihood import innovations, search
from ambid.estimation.linear import directions
from ambid.physics.linear_model import model
from ambid.physics.loop import Noise
from ambid.signals import multisine
from ambid.simulation import LinearPlant
from ambid.simulation.bench import VaryingLoop
from tests.bearing.benches import BEARING, SETTINGS, problem_of, run
from tests.tiers import runs

N = 10_000
FORCE = Colour(source="force", omega=2.0 * np.pi * 100.0)
CURRENT = Colour(source="current", omega=2.0 * np.pi * 300.0, damping=0.02)


def noise(colour, seed):
    """White noise that is held over a sample, behind a low pass or a resonance, of rms 1, on the thesis bench."""
    w, z = colour.omega, colour.damping
    A, B = ([[-w]], [[w]]) if z is None else ([[-2.0 * z * w, -w], [w, 0.0]], [[2.0 * z * w], [0.0]])
    C = np.eye(1, len(A))
    system = cont2discrete((np.array(A), np.array(B), C, np.zeros((1, 1))), 1.0 / SETTINGS["thesis"].rate_hz)
    values = dlsim(system, np.random.default_rng(1000 + seed).standard_normal(N + 5000))[1][5000:, 0]
    return values / values.std()


def pushed(seed):
    """The thesis bench with a coloured force of 10 mN rms beside its white one of 1 mN."""
    s, bench = SETTINGS["thesis"], run("thesis", N, seed)
    loop = VaryingLoop(
        LinearPlant(model=model(s.model), parameters=s.truth), rate_hz=s.rate_hz, seed=seed, loop=s.loop,
        noise=Noise.held(rate_hz=s.rate_hz, **s.noise),
    )  # fmt: skip
    u = multisine(N, s.rate_hz, amplitude=s.rms, band=s.band, seed=seed, amplitude_is="rms")
    done = loop.advance(u, load=0.01 * noise(FORCE, seed))
    return replace(bench, signals=replace(bench.signals, u=done.command[:, None], y=done.measured))


def humming(seed):
    """The thesis bench with narrow-band noise of its current's sensor, of three times the white one's rms."""
    bench = run("thesis", N, seed)
    y = bench.signals.y + 3e-4 * np.outer(noise(CURRENT, seed), [0.0, 1.0])
    return replace(bench, signals=replace(bench.signals, y=y))


def began(bench):
    return search(*problem_of(bench))


SLOW = (Colour(source="force", omega=200.0), Colour(source="position", omega=50.0))
FAST = (
    Colour(source="voltage", omega=900.0, damping=0.1),
    Colour(source="current", omega=1500.0, damping=0.05),
    Colour(source="force", omega=300.0, damping=0.4),
)


@pytest.mark.parametrize(
    ("colours", "which", "shape"),
    [(SLOW, (0, 1), _SHAPE[:1]), (SLOW + FAST, (2, 3, 4), _SHAPE), (FAST + SLOW, (1,), _SHAPE)],
)
def test_slopes_of_the_matrices_are_exact(colours, which, shape):
    """By every parameter of the model, and by frequency and damping of some colours."""
    wide = _Shaped(plain=model("one-axis"), colours=colours, which=which)
    theta = {**BEARING, "c": 3.0, **dict(zip(shape, (0.3, -0.2), strict=False))}
    for name, value in theta.items():
        step = 1e-5 * max(abs(value), 1.0 if name in _SHAPE else 0.0)
        there, back = (wide.matrices({**theta, name: value + s * step}) for s in (1.0, -1.0))
        slope = wide.derivative(theta, name)
        for part in "ABEC":
            central = (getattr(there, part) - getattr(back, part)) / (2.0 * step)
            size = max(float(np.max(np.abs(central))), 1e-6)
            np.testing.assert_allclose(getattr(slope, part), central, atol=1e-6 * size, err_msg=f"{part} by {name}")


def test_a_colour_has_the_power_that_it_says():
    """A low pass passes what is slow, a resonance its middle, unchanged, to where its source acts."""
    plain = model("one-axis")
    theta = {**BEARING, "c": 3.0}
    for colour in SLOW + FAST:
        space = Coloured(plain=plain, colours=(colour,)).matrices(theta)
        s = 1j * (1e-6 if colour.damping is None else colour.omega)
        through = space.C @ np.linalg.solve(s * np.eye(len(space.A)) - space.A, space.E)
        of = (*plain.disturbances, *plain.outputs).index(colour.source)
        white = np.hstack([through[:, :-1], np.eye(2)])[:, of]
        np.testing.assert_allclose(through[:, -1], white, rtol=1e-6, atol=1e-9 * np.max(np.abs(white)))


@pytest.mark.parametrize(
    ("bench", "colour", "start"),
    [
        (pushed, FORCE, Colour(source="force", omega=3.0 * FORCE.omega)),
        (humming, CURRENT, Colour(source="current", omega=1.05 * CURRENT.omega, damping=0.06)),
    ],
)
def test_the_colour_of_a_record_is_found(bench, colour, start):
    """Its frequency and damping are the likeliest, and those of the noise itself no less likely than four standard
    deviations are (chi-squared by Wilks). A sensor's noise is seen itself, a process that forgets at a rate k over a
    time T: its frequency has a standard deviation of (k/T)^1/2, the logarithm of k one of (1/kT)^1/2.
    """
    for seed in range(1, 1 + runs(20, short=3)):
        made = bench(seed)
        fit = began(made)
        found = coloured(fit, [[start]])
        assert found is not None
        right = search(*with_colours(fit.problem, fit.vector, [colour], 2.0))
        assert -0.1 < right.criterion - found.criterion < chi2.isf(2.0 * norm.sf(4.0), colour.order)
        if colour.damping is not None:
            (at,) = colours_of(found.problem)
            rate, seconds = colour.damping * colour.omega, N / fit.problem.rate_hz
            assert abs(at.omega - colour.omega) < 4.0 * np.sqrt(rate / seconds)
            assert at.damping is not None
            assert abs(np.log(at.damping / colour.damping)) < 4.0 / np.sqrt(rate * seconds)
        assert fit.criterion - found.criterion > (1 + colour.order) * np.log(2 * N)
        n = found.problem.n_physical
        sd = np.sqrt(np.diag(directions(np.vstack([found.J, found.J_prior])).inverse())[:n])
        truth = np.array([made.truth[name] for name in found.problem.estimated]) / found.problem.magnitude
        assert np.all(np.abs(found.vector[:n] - truth) < 4.0 * sd)


@pytest.mark.parametrize("start", [3.0, 0.3])
def test_a_colour_does_not_hang_on_where_it_is_begun(start):
    """The same optimum from a third and from three times its frequency."""
    fit = began(pushed(1))
    found = coloured(fit, [[replace(FORCE, omega=start * FORCE.omega)]])
    right = coloured(fit, [[FORCE]])
    assert found is not None
    assert right is not None
    assert found.criterion == pytest.approx(right.criterion, abs=0.1)


def test_the_likeliest_choice_is_taken():
    fit = began(humming(1))
    found = coloured(fit, [[replace(FORCE, omega=w)] for w in (30.0, 300.0)] + [[CURRENT]])
    assert found is not None
    assert [c.source for c in colours_of(found.problem)] == ["current"]
    again = coloured(found, [[FORCE]])
    assert again is None  # there is none beside it


@pytest.mark.parametrize("name", ["thesis", "bearing"])
def test_white_noise_has_no_colour(name):
    for seed in range(1, 1 + runs(20, short=2)):
        fit = began(run(name, 3000, seed))
        for colour in SLOW + FAST:
            assert coloured(fit, [[colour]]) is None, (seed, colour)


def test_colours_are_taken_off_at_the_same_parameters():
    fit = began(humming(2))
    found = coloured(fit, [[CURRENT], [FORCE]])
    assert found is not None
    alone = without_colours(found)
    assert alone.problem.model is fit.problem.model
    assert len(alone.problem.scales.state) == len(fit.problem.model.states)
    assert alone.problem.parameters(alone.vector) == found.problem.parameters(found.vector)
    assert alone.status == "converged"
    assert alone.criterion > found.criterion
    assert alone.criterion - fit.criterion == pytest.approx(0.0, abs=10.0)  # parameters moved by some of their sds
    e = innovations(alone.problem, alone.vector)
    assert e is not None
    np.testing.assert_allclose(e.T @ e / len(e), alone.covariance, rtol=1e-9)
    assert without_colours(fit) is fit
