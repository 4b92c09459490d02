"""The bench's plant, compiled for this machine, against the package's own models and independent integration."""

import ctypes
import subprocess

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from ambid.physics.linear_model import model
from ambid.physics.presets import preset
from tests.firmware.conftest import BENCH

TICK_HZ = 16e6
DRIVEN, OFF = 0, 1
POSITION, CURRENT, THIRD = 0, 1, 2
LINEAR = ("thesis", "unstable-bearing", "rmit-axis", "levitated-ball")
STAGE = {"high_voltage": 24.0, "low_voltage": -24.0}


@pytest.fixture(scope="session")
def library(native_cc, tmp_path_factory):
    path = tmp_path_factory.mktemp("plant") / "plant.so"
    sources = [str(BENCH / name) for name in ("noise.c", "plant.c", "plant_file.c")]
    flags = ["-std=gnu99", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([native_cc, *flags, "-o", str(path), *sources, "-lm"], check=True)
    c = ctypes.CDLL(str(path))
    c.plant_open.restype = ctypes.c_void_p
    c.plant_open.argtypes = [ctypes.c_char_p, ctypes.c_uint64]
    c.plant_advance.restype = ctypes.c_double
    c.plant_advance.argtypes = [ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_double]
    c.plant_pin.restype = ctypes.c_double
    c.plant_pin.argtypes = [ctypes.c_void_p, ctypes.c_int]
    c.plant_push.argtypes = [ctypes.c_void_p, ctypes.c_double]
    c.plant_draw.argtypes = [ctypes.c_void_p, ctypes.c_uint]
    c.plant_get.argtypes = [ctypes.c_void_p, ctypes.c_double * 3]
    c.plant_set.argtypes = [ctypes.c_void_p, ctypes.c_double * 3]
    c.plant_close.argtypes = [ctypes.c_void_p]
    return c


class Native:
    """A plant of the bench."""

    def __init__(self, c, path, seed=1):
        self._c = c
        self._at = c.plant_open(str(path).encode(), seed)
        assert self._at

    def advance(self, ticks, volts, drive=DRIVEN):
        return self._c.plant_advance(self._at, ticks, drive, volts)

    @property
    def state(self):
        out = (ctypes.c_double * 3)()
        self._c.plant_get(self._at, out)
        return np.array(out)

    @state.setter
    def state(self, values):
        self._c.plant_set(self._at, (ctypes.c_double * 3)(*values))

    def push(self, newton):
        self._c.plant_push(self._at, newton)

    def draw(self, ticks=800):
        self._c.plant_draw(self._at, ticks)

    def pin(self, which):
        return self._c.plant_pin(self._at, which)

    def close(self):
        self._c.plant_close(self._at)


@pytest.fixture
def native(library, tmp_path):
    """Make plants of the bench from a file's entries."""
    made = []

    def make(seed=1, more=(), **entries):
        path = tmp_path / f"{len(made)}.plant"
        lines = [f"{k} {v!r}" if isinstance(v, float) else f"{k} {v}" for k, v in (STAGE | entries).items()]
        path.write_text("\n".join([*lines, *more]) + "\n")
        made.append(Native(library, path, seed))
        return made[-1]

    yield make
    for one in made:
        one.close()


def entries_of(name):
    """Entries of a preset's nonlinear plant."""
    p = preset(name).plant
    w = p.magnet.coenergy
    low, high = preset(name).limits.position
    out = {"m": p.m, "R": p.R, "c": p.c, "k": w.k_b, "leakage": w.leakage, "gravity": p.gravity}
    out |= {"stop_low": low, "stop_high": high, "start_position": preset(name).operating_point.position}
    pair = w.i0 > 0.0
    return {"kind": "differential" if pair else "single"} | out | ({"gap": w.s_b, "bias": w.i0} if pair else {})


def pieces(rng, n, low, high):
    """Ticks and volts of pieces as a switched power stage makes them: two to each period of 800 ticks."""
    duty = rng.integers(1, 800, n)
    ticks = np.column_stack([duty, 800 - duty]).ravel()
    return ticks.tolist(), np.tile([high, low], n).tolist()


@pytest.mark.parametrize("name", LINEAR)
def test_the_linear_plant_is_the_exact_discretisation(native, name):
    p = dict(preset(name).parameters)
    space = model("one-axis").matrices(p)
    plant = native(kind="linear", **p)
    rng = np.random.default_rng(7)
    state, rates = np.array([1e-5, 1e-3, 0.1]), np.zeros((5, 5))
    rates[:3, :3], rates[:3, 3] = space.A, space.B[:, 0]
    rates[1, 4] = 1.0 / p["m"]
    plant.state, largest, worst = state, np.abs(state), 0.0
    for ticks, volts in zip(*pieces(rng, 300, -24.0, 24.0), strict=True):
        force = float(rng.normal())
        plant.push(force)
        assert plant.advance(ticks, volts) == pytest.approx(volts)
        state = (expm(rates * ticks / TICK_HZ) @ np.array([*state, volts, force]))[:3]
        largest = np.maximum(largest, np.abs(state))
        worst = max(worst, float(np.max(np.abs(plant.state - state) / largest)))
    assert worst < 1e-9


def test_a_linear_plant_holds_about_its_rest_point(native):
    b = preset("levitated-ball")
    point = b.operating_point
    rest = {"rest_position": point.position, "rest_current": point.current, "rest_voltage": point.voltage}
    plant = native(kind="linear", **dict(b.parameters), **rest)
    plant.state = point.position, 0.0, point.current
    plant.advance(16000, point.voltage)
    assert plant.state == pytest.approx([point.position, 0.0, point.current], rel=1e-12)


@pytest.mark.parametrize("name", ["unstable-bearing", "levitated-ball"])
def test_the_magnets_move_as_the_package_says(native, name):
    b = preset(name)
    plant = native(**entries_of(name))
    point = b.operating_point
    rng, state = np.random.default_rng(3), np.array([point.position, 0.0, point.current])
    plant.state, start = state, state.copy()
    low, high = b.limits.voltage
    largest, worst, travelled = np.abs(state), 0.0, 0.0
    for ticks, volts in zip(*pieces(rng, 100, low, high), strict=True):
        volts = point.voltage + 0.1 * volts
        plant.push(0.05 * volts)
        plant.advance(ticks, volts)
        solved = solve_ivp(
            lambda _, x, v=volts: b.plant.derivative(tuple(x), v, 0.05 * v),
            (0.0, ticks / TICK_HZ),
            state,
            method="DOP853",
            rtol=1e-12,
            atol=1e-15,
        )
        state = solved.y[:, -1]
        largest = np.maximum(largest, np.abs(state))
        worst = max(worst, float(np.max(np.abs(plant.state - state) / largest)))
        travelled = max(travelled, abs(float(state[0] - start[0])))
    assert worst < 1e-6
    # It moved far enough for the magnet not to be a straight line.
    assert travelled > (0.01 if name == "unstable-bearing" else 0.001) * b.limits.position[1]


@pytest.mark.parametrize("name", ["unstable-bearing", "levitated-ball"])
def test_the_magnets_rest_where_the_package_says(native, name):
    b = preset(name)
    low, high = b.limits.position
    at = b.plant.equilibrium(b.operating_point.position + 0.1 * (high - low))
    plant = native(**entries_of(name))
    plant.state = at.position, 0.0, at.current
    plant.advance(160, at.voltage)
    assert plant.state == pytest.approx([at.position, 0.0, at.current], abs=1e-12)


def test_the_rotor_stops_without_rebound(native):
    plant = native(**entries_of("unstable-bearing"))
    plant.state = 1.9e-4, 0.05, 0.0
    for _ in range(40):
        plant.advance(800, 0.0)
        assert plant.state[0] <= 2e-4
    assert plant.state[:2] == pytest.approx([2e-4, 0.0], abs=1e-12)


def test_a_bridge_that_is_off_lets_the_current_run_against_the_supply_until_there_is_none(native):
    coil = {"kind": "linear", "m": 1e3, "k_x": 0.0, "k_i": 1e-9, "R": 1.0, "L": 10e-3, "supply": 20.0}
    for sign in (1.0, -1.0):
        plant = native(**coil, off="diodes")
        plant.state = 0.0, 0.0, sign
        assert plant.advance(800, 5.0, OFF) == pytest.approx(-20.0 * sign)
        assert plant.state[2] == pytest.approx(sign * (21.0 * np.exp(-50e-6 / 10e-3) - 20.0), rel=1e-9)
        plant.advance(16000, 5.0, OFF)
        assert plant.state[2] == 0.0
        assert plant.advance(800, 5.0, OFF) == 0.0
    short = native(**coil, off="short")
    short.state = 0.0, 0.0, 1.0
    short.advance(16000, 5.0, OFF)
    assert short.state[2] == pytest.approx(np.exp(-0.1), rel=1e-9)


def test_a_single_transistor_gives_no_current_the_other_way(native):
    plant = native(kind="linear", m=1e3, k_x=0.0, k_i=1e-9, R=1.0, L=1e-3, current="one-way")
    plant.state = 0.0, 0.0, 0.5
    plant.advance(1600, -24.0)
    assert plant.state[2] == 0.0
    plant.advance(800, 24.0)
    assert plant.state[2] > 0.0


def test_noise_has_the_density_that_the_file_gives(native):
    plant = native(kind="linear", m=1.0, k_x=0.0, k_i=0.0, R=0.0, L=1.0, force_noise=0.02, voltage_noise=0.3)
    changes = []
    for _ in range(20000):
        before = plant.state
        plant.draw()
        plant.advance(800, 0.0)
        changes.append(plant.state[1:] - before[1:])
    # Held white noise of density s has the rms s sqrt(20 kHz / 2); over 50 us it changes v and i by that much.
    wanted = np.array([0.02, 0.3]) * np.sqrt(10e3) * 50e-6
    assert np.std(changes, axis=0) == pytest.approx(wanted, rel=0.02)
    assert np.abs(np.mean(changes, axis=0)) == pytest.approx([0.0, 0.0], abs=float(5 * wanted.max() / np.sqrt(20000)))


def test_the_same_seed_gives_the_same_bench(native):
    entries = entries_of("unstable-bearing") | {"force_noise": 0.01, "position_noise": 1e-7, "position_gain": 1e4}

    def run(seed):
        plant = native(seed=seed, **entries)
        said = []
        for _ in range(50):
            plant.draw()
            plant.advance(800, 1.0)
            said.append(plant.pin(POSITION))
        return said

    assert run(5) == run(5)
    assert run(5) != run(6)


def test_sensors_show_what_the_file_says(native):
    table = ["position_point 4.5 -1e-3", "position_point 2.0 0", "position_point 0.5 1e-3"]
    straight = {"current_gain": 2.0, "current_offset": 2.5, "third_position_gain": 1e3, "third_offset": 1.0}
    plant = native(kind="linear", m=1.0, k_x=0.0, k_i=0.0, R=1.0, L=1.0, more=table, **straight)
    plant.state = 0.5e-3, 0.0, -0.25
    assert [plant.pin(k) for k in (POSITION, CURRENT, THIRD)] == pytest.approx([1.25, 2.0, 1.5])
    plant.state = -0.5e-3, 0.0, 0.0
    assert plant.pin(POSITION) == pytest.approx(3.25)


GOOD = "kind linear\nm 1\nR 1\nk_x 0\nk_i 1\nL 1e-3\nhigh_voltage 12\nlow_voltage -12\n"
DIFFERENTIAL = "kind differential\nm 1\nR 1\nk 1e-6\ngap 1e-3\nbias 1\nhigh_voltage 12\nlow_voltage -12\n"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (GOOD + "mass 2\n", "9: mass 2: is not a known key"),
        (GOOD + "m 2\n", "9: m 2: is given twice"),
        (GOOD + "c two\n", "9: c two: is not a number"),
        (GOOD + "c 1e999\n", "9: c 1e999: is not a number"),
        (GOOD + "c\n", "9: c : has no value"),
        (GOOD + "c 1 2\n", "9: c 1: has more than one value"),
        (GOOD + "pwm fast\n", "9: pwm fast: is not a word"),
        (GOOD + "gap 1\n", "gap does not belong"),
        (GOOD.replace("m 1\n", ""), "m is missing"),
        (GOOD.replace("m 1\n", "m 0\n"), "2: m 0: must be positive"),
        (GOOD.replace("kind linear\n", ""), "no kind"),
        (GOOD + "stop_low 1\nstop_high -1\n", "stop_low must be below"),
        (GOOD + "stop_low 1\nstop_high 2\n", "start_position is outside"),
        (GOOD + "position_point 1 1\n", "a table of one point"),
        (GOOD + "position_point 1 1\nposition_point 2 2\nposition_point 3 1.5\n", "11: position_point 3: turns round"),
        (DIFFERENTIAL, "inside the air gap"),
        (DIFFERENTIAL + "stop_low -1e-3\nstop_high 1e-3\n", "inside the air gap"),
    ],
)
def test_a_wrong_plant_file_is_refused_with_one_line(library, tmp_path, capfd, text, complaint):
    path = tmp_path / "wrong.plant"
    path.write_text(text)
    assert not library.plant_open(str(path).encode(), 0)
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert complaint in said


def test_a_plant_file_that_is_not_there_is_refused(library, tmp_path, capfd):
    assert not library.plant_open(str(tmp_path / "none.plant").encode(), 0)
    assert "none.plant: No such file" in capfd.readouterr().err
