"""Margins and poles of a loop against python-control, which builds the same loop from its own parts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from ambid.control.closed import ClosedLoop, Plant
from ambid.control.controller import controller_of_loop
from ambid.control.margins import margins_by_axis
from ambid.physics.linear_model import discretise, model
from ambid.physics.presets import preset
from ambid.simulation.plant import closed_loop_poles

control = pytest.importorskip("control", reason="python-control is an optional dependency (ambid[control])")


@pytest.fixture(scope="module", params=["prototype", "unstable-bearing", "rmit-axis"])
def both(request):
    """A bench with one sample of delay: its loop here, and in python-control opened at the position and the input."""
    bench, of = preset(request.param), model("one-axis")
    loop = replace(bench.loop, delay=1.0)
    T, tau = 1.0 / bench.rate_hz, loop.filter_s
    plant = Plant(model=of, theta=bench.parameters, delays=np.array([1.0]), rate_hz=bench.rate_hz)
    here = ClosedLoop.of(plant, controller_of_loop(loop, of, bench.rate_hz))
    d, _ = discretise(plant.space, T)
    z = control.tf("z")
    z.dt = T
    late = control.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], T)
    G = control.ss(d.A, d.B, d.C, np.zeros((2, 1)), T) * late
    kd = control.tf([loop.kd, -loop.kd], [tau + T, -tau], T)
    C = control.ss(loop.kp + kd + (control.tf([loop.ki * T], [1.0, -1.0], T) if loop.ki else 0.0))
    p, q = of.outputs.index("position"), of.outputs.index("current")
    inner = control.feedback(G, control.ss([], [], [], np.eye(2)[[q]] * loop.kc, T))
    K = control.append(C, control.ss([], [], [], [[loop.kc]], T)) if p < q else None
    assert K is not None
    at_input = control.ss([], [], [], [[1.0, 1.0]], T) * K * G
    return here, {"position": C * inner[p, 0], "command": at_input}, closed_loop_poles(bench.parameters, loop, 1.0 / T)


def roots(f, of):
    """Return where a real function of frequency changes its sign, to rounding."""
    x = of(f)
    return [brentq(of, f[k], f[k + 1], xtol=1e-13, rtol=1e-13) for k in np.flatnonzero(x[1:] * x[:-1] < 0.0)]


@pytest.mark.parametrize("place", ["position", "command"])
def test_gain_phase_delay_and_disk_margins_are_those_of_python_control(both, place):
    """Its own search for crossings gives up on the polynomials of sampled loops: they are sought in its response."""
    here, openings, _ = both
    found, L = getattr(margins_by_axis(here)["x"], place), openings[place]
    T, f = L.dt, np.geomspace(1e-6, 0.4999, 2000) / L.dt

    def at(hz):
        return L(np.exp(2j * np.pi * hz * T))

    real = [at(hz).real for hz in roots(f, lambda hz: at(hz).imag)]
    real += [at(0.5 / T).real] + ([L(1.0).real] if np.min(np.abs(L.poles() - 1.0)) > 1e-6 else [])
    gains = np.array([-1.0 / x for x in real if x < 0.0])
    down, up = gains[gains < 1.0], gains[gains > 1.0]
    assert found.gain_down == (pytest.approx(down.max(), rel=1e-8) if down.size else None)
    assert found.gain_up == (pytest.approx(up.min(), rel=1e-8) if up.size else None)
    crossings = np.array(roots(f, lambda hz: abs(at(hz)) - 1.0))
    angle = np.array([np.angle(-at(hz)) for hz in crossings])
    assert found.phase_deg == pytest.approx(np.degrees(np.abs(angle).min()), rel=1e-8)
    assert found.delay_s == pytest.approx(((angle % (2.0 * np.pi)) / (2.0 * np.pi * crossings)).min(), rel=1e-8)
    size, gain_db, phase = control.disk_margins(L, 2.0 * np.pi * here.frequency_hz)
    assert found.disk.size == pytest.approx(size, rel=1e-8)
    assert found.disk.phase_deg == pytest.approx(phase, rel=1e-8)
    if found.disk.gain_up is not None:
        assert 20.0 * np.log10(found.disk.gain_up) == pytest.approx(gain_db, rel=1e-8)


def test_poles_are_those_of_python_control(both):
    _, openings, poles = both
    peer = control.feedback(openings["command"], 1).poles()
    for pole in peer:
        assert np.min(np.abs(poles - pole)) < 1e-8
    assert np.abs(poles).max() == pytest.approx(np.abs(peer).max(), rel=1e-8)
