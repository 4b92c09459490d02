"""Loop, limits and noise: what they mean and what they refuse."""

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.physics.linear_model import model
from ambid.physics.loop import Limits, Loop, Noise, placed_loop

BEARING = {"m": 4.0, "k_x": -1.29e5, "k_i": 55.7, "R": 1.6, "L": 0.026, "c": 20.0}
POLES = (-1500.0, -250 + 250j, -250 - 250j, -20.0)


def test_placed_loop_has_the_poles_asked_for() -> None:
    loop = placed_loop(BEARING, POLES)
    s = model("one-axis").matrices(BEARING)
    # states x, x', i and the integral of -x; D acts on the velocity itself
    a = np.zeros((4, 4))
    a[:3, :3], a[3, 0] = s.A, -1.0
    a[:3] += np.outer(s.B[:, 0], [-loop.kp, -loop.kd, -loop.kc, loop.ki])
    assert np.sort_complex(np.linalg.eigvals(a)) == pytest.approx(np.sort_complex(np.array(POLES)), rel=1e-8)


def test_placed_loop_refuses_what_it_cannot_place() -> None:
    with pytest.raises(ModelError, match="four"):
        placed_loop(BEARING, POLES[:3])
    with pytest.raises(ModelError, match="conjugate"):
        placed_loop(BEARING, (-1.0, -2.0, -3.0, -4.0 + 1j))
    with pytest.raises(ModelError, match="k_i"):
        placed_loop({**BEARING, "k_i": 0.0}, POLES)


def test_held_noise_keeps_its_rms_at_its_rate() -> None:
    noise = Noise.held(rate_hz=20_000.0, force=2.0, voltage=0.05)
    assert noise.held_rms(20_000.0) == pytest.approx((2.0, 0.05), rel=1e-14)
    assert noise.held_rms(5_000.0)[0] == pytest.approx(1.0, rel=1e-14)  # a quarter of the band, half the rms


def test_bad_settings_are_refused() -> None:
    with pytest.raises(ModelError, match=r"loop\.kp"):
        Loop(kp=float("nan"))
    with pytest.raises(ModelError, match=r"loop\.delay"):
        Loop(delay=-1.0)
    with pytest.raises(ModelError, match=r"limits\.voltage"):
        Limits(voltage=(1.0, -1.0))
    with pytest.raises(ModelError, match=r"noise\.force"):
        Noise(force=-1.0)
