"""One nonlinear model over all measured records of the levitated ball: gravity balance, laboratory's inductance, mass.

The balance uses no fit: where the ball stands, f = dL/dz i^2/2 = m g and k_i/m = 2 g/i0 (z grows away: negative), i0
the mean current of all samples near that position.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ambid.cli import run
from ambid.job.identification import identify_nonlinear
from ambid.job.results import load
from ambid.physics.linear_model import Parameter
from ambid.rig import load_rig
from tests.measured import ABSENT, MAGLEV

pytestmark = pytest.mark.skipif(not MAGLEV.is_dir(), reason=ABSENT)

MASS, GRAVITY, RESISTANCE = 0.06054, 9.81, 4.17
LEVITATION = ("stairs_a", "stairs_b", "updown_c", "sine_d", "sine_e")
COIL = ("1", "2", "3", "4", "20mm")
SETS = {"four records": (("updown_c", "sine_d"), ("1", "20mm")), "ten records": (LEVITATION, COIL)}
RIG = """schema = "ambid.rig/1"
name = "maglev, upper coil"
model = "one-axis"
[channels.voltage]
column = "duty_upper"
table = "{table}"
[channels.current]
column = "current_upper"
[channels.position]
column = "position"
[parameters]
m = {{ value = 60.54, unit = "g", role = "fixed" }}
c = {{ value = 0.0, unit = "N s/m", role = "fixed" }}
R = {{ unit = "ohm" }}
[magnet]
off_below = 0.0431
[record]
from = 2.0
"""


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """The laboratory's table, with the dead zone up to a duty of 0.048 that it describes beside it."""
    folder = tmp_path_factory.mktemp("rig")
    head, first, *rest = (MAGLEV / "duty_to_voltage.csv").read_text(encoding="utf-8").splitlines()
    (folder / "table.csv").write_text("\n".join([head, first, "0.048,0.043", *rest]) + "\n", encoding="utf-8")
    path = folder / "maglev.toml"
    path.write_text(RIG.format(table="table.csv"), encoding="utf-8")
    return path


def over_all(rig):
    return identify_nonlinear(
        [MAGLEV / f"levitate_{n}.csv" for n in LEVITATION], rig, held=[MAGLEV / f"coil_steps_{n}.csv" for n in COIL]
    )


@pytest.fixture(scope="module", params=SETS)
def files(rig, tmp_path_factory, request):
    """What the command of docs/nonlinear_bearing.md writes, of two records of each kind and of all."""
    at = tmp_path_factory.mktemp("estimate")
    levitation, coil = SETS[request.param]
    words = ["identify", *(MAGLEV / f"levitate_{n}.csv" for n in levitation), "--rig", rig, "--nonlinear"]
    for n in coil:
        words += ["--held", MAGLEV / f"coil_steps_{n}.csv"]
    assert run([str(w) for w in (*words, "--json", at / "ball.json", "--plot", at / "ball.png")]) == 0
    return at


@pytest.fixture(scope="module")
def estimate(files):
    return load(files / "ball.json")


@cache
def moving():
    """Position and current of all moving records."""
    names = [MAGLEV / f"levitate_{n}.csv" for n in LEVITATION]
    return np.concatenate([np.loadtxt(n, delimiter=",", skiprows=2001, usecols=(2, 3)) for n in names])


def standing(z):
    """Mean current of all moving records within 0.3 mm of a position."""
    every = moving()
    return float(every[np.abs(every[:, 0] - z) < 0.3e-3, 1].mean())


@pytest.mark.parametrize("z", [8e-3, 10e-3, 12e-3])
def test_force_per_current_is_that_of_the_gravity_balance(estimate, z):
    i0 = standing(z)
    at = estimate.curves(z, i0)
    assert at.k_i.value[0] / MASS == pytest.approx(-2 * GRAVITY / i0, rel=0.10)
    assert at.force.value[0] == pytest.approx(-MASS * GRAVITY, rel=0.05)
    assert at.k_x.value[0] < 0  # a negative spring
    assert at.inside[0]


def test_inductance_is_the_laboratorys(estimate):
    z, i = (a.ravel() for a in np.meshgrid(np.linspace(8e-3, 12e-3, 9), np.linspace(0.75, 1.15, 5)))
    ell = estimate.curves(z, i).L
    laboratory = 0.0654 + 0.0404 * np.exp(-158.5 * z) + 0.0329 * np.arctan(5.297 * i - 1.042)
    assert ell.value == pytest.approx(laboratory, rel=0.07)
    assert np.all(np.diff(ell.value.reshape(5, 9), axis=1) < 0)  # falls with the distance


def test_stiffness_follows_from_the_same_energy(estimate):
    # k_x = -L'' i^2/2 of the laboratory's L, which this fit has not seen
    i0 = standing(10e-3)
    laboratory = -0.5 * 0.0404 * 158.5**2 * np.exp(-1.585) * i0**2
    assert estimate.curves(10e-3, i0).k_x.value[0] == pytest.approx(laboratory, rel=0.10)
    assert estimate.values["R"] == pytest.approx(RESISTANCE, rel=0.03)


def test_delays_of_a_sample_and_a_half_and_of_the_slow_records(estimate):
    fast, slow = estimate.delay["1000 Hz"], estimate.delay["200 Hz"]
    assert 1.2 < fast.samples + fast.fraction < 1.7
    assert slow.samples + slow.fraction < 0.5


def test_the_model_error_is_owned_up_to(estimate):
    assert estimate.status == "converged"
    assert estimate.covariance_method == "robust"
    assert not estimate.checks["residuals_white"].passed
    assert estimate.checks["carries_its_weight"].passed
    assert any("does not fully fit" in w for w in estimate.warnings)


def test_the_command_draws_and_judges(files, capsys):
    assert (files / "ball.png").read_bytes().startswith(b"\x89PNG")
    assert run(["validate", str(files / "ball.json"), str(MAGLEV / "levitate_updown_c.csv")]) == 0
    said = capsys.readouterr().out
    for check in ("innovations_consistent", "inside_range", "carries_its_weight"):
        assert f"✓ {check}" in said


def test_a_free_mass_is_right_or_flagged(rig):
    known = load_rig(rig)
    law = replace(known.magnet, kind="single", gap="hyperbolic", saturation=False, rise=False)
    free = tuple(Parameter(name="m", unit="kg") if p.name == "m" else p for p in known.parameters)
    estimate = over_all(replace(known, magnet=law, parameters=free))
    m = estimate.parameter("m")
    assert m.ci95[0] < MASS < m.ci95[1] or not m.identifiable
