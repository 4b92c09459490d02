"""Start values: the weak form integrates by parts exactly, and each regression is what it says."""

import numpy as np
import pytest

from ambid.bearing.multistart import Regressors, take_moments, weak_form_values
from tests.bearing.benches import run


def test_moments_are_derivatives_without_differentiating():
    # of a smooth signal, the moments of its derivatives are those of the derivatives themselves
    n, rate = 4096, 1000.0
    t = np.arange(n) / rate
    x = np.exp(-0.4 * t) * np.sin(2 * np.pi * 7.3 * t) + 0.2 * t
    a, w = -0.4, 2 * np.pi * 7.3
    d = np.exp(a * t) * (a * np.sin(w * t) + w * np.cos(w * t)) + 0.2
    dd = np.exp(a * t) * ((a * a - w * w) * np.sin(w * t) + 2 * a * w * np.cos(w * t))
    of_x, of_d, of_dd = (take_moments({"x": v}, (), rate) for v in (x, d, dd))
    lines = slice(3, 400)
    for order, direct in ((1, of_d), (2, of_dd)):
        got, wanted = of_x.signals["x"][order][lines], direct.signals["x"][0][lines]
        np.testing.assert_allclose(got, wanted, atol=1e-6 * np.abs(wanted).max())


def test_moments_of_a_constant_vanish_beyond_the_window():
    m = take_moments({"x": np.full(1000, 5.0)}, (), 100.0)
    for values in m.signals["x"]:
        assert np.abs(values[3:]).max() < 1e-9 * 1000


def test_a_held_input_is_taken_as_held():
    # the spectrum of the staircase itself, summed on a fine grid
    rng, n, rate, fine = np.random.default_rng(0), 256, 100.0, 64
    u = rng.standard_normal(n)
    held = take_moments({"u": u}, ("u",), rate)
    stairs = take_moments({"u": np.repeat(u, fine)}, (), rate * fine)
    lines = slice(3, 60)
    got, wanted = held.signals["u"][0][lines], stairs.signals["u"][0][lines] / fine
    np.testing.assert_allclose(held.omega[lines], stairs.omega[lines])
    # the window, too, is held over a sample in the one and not in the other
    assert np.linalg.norm(got - wanted) < 0.02 * np.linalg.norm(wanted)


def test_ordinary_least_squares_is_exact_without_noise():
    rng = np.random.default_rng(1)
    a, b = (rng.standard_normal(50) + 1j * rng.standard_normal(50) for _ in range(2))
    y = 2.5 * a - 0.3 * b
    one = np.ones(50)
    got = Regressors([("a", one, a), ("b", one, b)], one, {}).regress(("", 0 * one, y))[0]
    np.testing.assert_allclose(got, [2.5, -0.3], rtol=1e-12)


def test_errors_in_variables_have_no_bias():
    rng, n = np.random.default_rng(2), 20_000
    clean = rng.standard_normal(n) + 1j * rng.standard_normal(n)
    noise = [0.5 * (rng.standard_normal(n) + 1j * rng.standard_normal(n)) for _ in range(2)]
    one = np.ones(n)

    def regress(levels):
        return Regressors([("x", one, clean + noise[1])], one, levels).regress(("y", one, 2.0 * clean + noise[0]))[0]

    assert regress({})[0] == pytest.approx(2.0 / 1.25, rel=0.02)  # attenuated
    assert regress({"x": 0.5, "y": 0.5})[0] == pytest.approx(2.0, rel=0.02)
    # only ratios of the levels matter
    np.testing.assert_allclose(regress({"x": 5.0, "y": 5.0}), regress({"x": 0.5, "y": 0.5}), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "known"),
    [("thesis", ("c",)), ("bearing", ("c",)), ("rmit", ("c",)), ("coil", ()), ("sprung rotor", ("m",)),
     ("falling rotor", ("m", "c"))],
)  # fmt: skip
def test_some_band_is_near_the_truth(name, known):
    bench = run(name, 6000, 5)
    columns = dict(
        zip((*bench.model.inputs, *bench.model.outputs), np.c_[bench.signals.u, bench.signals.y].T, strict=True)
    )
    columns = {k: v - v.mean() for k, v in columns.items()}
    m = take_moments(columns, bench.model.inputs, bench.signals.rate_hz)
    noise = dict(zip(bench.model.outputs, bench.sensor, strict=True))
    given = {k: bench.truth[k] for k in known}
    found = [v for _, v in weak_form_values(bench.model.name, m, noise, [bench.delay], bench.signals.rate_hz, given)]
    assert len(found) == 8
    assert all(set(f) == set(bench.truth) for f in found)
    assert all(f[k] == given[k] for f in found for k in known)
    free = [k for k in bench.truth if k not in known and k != "c"]
    worst = [max(abs(f[k] / bench.truth[k] - 1) for k in free) for f in found]
    # the spring shows last; a start within a third is plenty for the search
    assert min(worst) < 0.35


def test_start_values_take_the_delay_into_account():
    bench = run("coil", 8000, 6, delay=3.0)
    columns = {"voltage": bench.signals.u[:, 0], "current": bench.signals.y[:, 0] - bench.signals.y.mean()}
    m = take_moments(columns, ("voltage",), bench.signals.rate_hz)
    (_, right), (_, wrong) = list(weak_form_values("coil", m, {}, (3.0, 0.0), bench.signals.rate_hz, {}))[12:14]
    assert right["L"] == pytest.approx(bench.truth["L"], rel=0.05)
    # up to 125 Hz a delay d looks like an inductance R d
    assert wrong["L"] == pytest.approx(bench.truth["L"] + bench.truth["R"] * 3e-4, rel=0.05)
