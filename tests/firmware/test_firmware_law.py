"""The state-space law in fixed point: the C of the firmware against a bit-exact model and against floating point."""

import numpy as np
import pytest

from ambid.acquisition.devices._kernels import law_tick
from ambid.acquisition.law_words import BEGIN, LAW_ROW, LawWords, law_words
from ambid.errors import RigError
from ambid.physics.law import StateLaw
from ambid.physics.loop import Loop
from tests.firmware.native.console import Console, build
from tests.firmware.test_firmware_control import _signals, _steps

RATE = 2000.0
REST = (0, 0, 0, 0, 0, 512, 512, 400)  # no gains; set point, rest, bias
PID = Loop(kp=2.5, ki=60.0, kd=0.01, kc=0.7, derivative_cutoff_hz=300.0).as_law(RATE)


@pytest.fixture(scope="module")
def console(native_cc, tmp_path_factory):
    """The C of the firmware on this machine."""
    return Console(build(native_cc, tmp_path_factory.mktemp("console")))


def of_six_states(rng=None):
    """Return a law with an integrator, two complex pairs and a real pole."""
    rng = rng or np.random.default_rng(5)
    radius, angle = rng.uniform(0.3, 0.995, 2), rng.uniform(0.05, 2.0, 2)
    a = np.zeros((6, 6))
    for k, (r, w) in enumerate(zip(radius, angle, strict=True)):
        a[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = r * np.array([[np.cos(w), np.sin(w)], [-np.sin(w), np.cos(w)]])
    a[4, 4], a[5, 5] = rng.uniform(0.8, 0.99), 1.0
    mix = rng.normal(size=(6, 6))
    b, c = rng.normal(size=(6, 2)), rng.normal(size=(1, 6)) * 0.3
    b[5] = [-0.02, 0.0]
    c[0, 5] = 1.0
    to, back = mix, np.linalg.inv(mix)
    return StateLaw(A=to @ a @ back, B=to @ b, C=c @ back, D=[[-8.0, -1.0]], G=to @ (0.02 * b[:, :1]), rate_hz=RATE)


def duties_of(console, words, signals, low=0, high=800):
    """Return what the C orders."""
    lines = console(
        [f"law {' '.join(map(str, REST))}", f"words {' '.join(map(str, words))}", _steps(low, high, *signals)]
    )
    assert lines[:2] == ["0", "0"]
    return np.array(lines[2].split(), dtype=int)


def modelled(words, signals, low=0, high=800):
    """Return what the model orders, and its states at the end."""
    z = np.full(words[0] & 0xFF, BEGIN)
    of = np.array(words, dtype=np.int64)
    found = [
        law_tick(of, z, int(x) - 512, int(i) - 512, 400 + int(e), low, high) for x, i, e in zip(*signals, strict=True)
    ]
    return np.array(found), z


def floating(law, signals, low=0.0, high=800.0):
    """Return the law in floating point."""
    z, found = np.zeros(law.order), []
    for x, i, e in zip(*signals, strict=True):
        y = np.array([x - 512.0, i - 512.0])
        wanted = 400.0 + e + (law.C @ z + law.D @ y)[0]
        found.append(min(max(wanted, low), high))
        z = law.A @ z + law.B @ y + law.windup[:, 0] * (found[-1] - wanted)
    return np.array(found)


@pytest.mark.parametrize("law", [PID, of_six_states()], ids=["pid", "six states"])
def test_the_controller_runs_the_words_bit_by_bit_and_the_law_to_a_count(console, law):
    words = law_words(law)
    signals = _signals(np.random.default_rng(1), 3000, 12)
    got = duties_of(console, words.words, signals)
    np.testing.assert_array_equal(got, modelled(words.words, signals)[0])
    wanted = floating(law, signals)
    assert np.ptp(wanted) > 150
    assert wanted.min() > 0
    assert wanted.max() < 800
    assert np.abs(got - wanted).max() < 0.5 + 0.6


def test_rounding_leaves_the_response_and_what_is_limited(console):
    for law in (PID, of_six_states()):
        words = law_words(law)
        f = np.geomspace(0.1, 990.0, 200)
        ratio = words.law(RATE).response(f) / law.response(f)
        assert np.abs(20.0 * np.log10(np.abs(ratio))).max() < 0.05
        signals = _signals(np.random.default_rng(2), 2000, 60)
        got = duties_of(console, words.words, signals, 330, 470)
        np.testing.assert_array_equal(got, modelled(words.words, signals, 330, 470)[0])
        assert set(got) >= {330, 470}


def test_an_integrator_has_no_dead_band(console):
    law = StateLaw(A=[[1.0]], B=[[1e-4, 0.0]], C=[[1.0]], D=[[0.0, 0.0]], rate_hz=RATE)
    steady = (np.full(40_000, 513), np.full(40_000, 512), np.zeros(40_000, dtype=int))
    got = duties_of(console, law_words(law).words, steady)
    assert got[-1] == pytest.approx(400 + 4.0, abs=0.51)


def test_extremes_saturate_and_never_wrap(console):
    rng = np.random.default_rng(3)
    requests, models = [], []
    for trial in range(60):
        n = int(rng.integers(1, 7))
        words = [n | int(rng.choice([0, 0, 1, 15])) << 8, *rng.choice([-LAW_ROW // 8, LAW_ROW // 8], 2).tolist()]
        for k in range(n):
            row = (
                [int(v) for v in rng.choice([-9830, 9830], 5)]
                if trial % 3
                else [0, 0, int(rng.choice([-32768, 32767])), 0, 0]
            )
            if n % 2 and k == n - 1:
                row[1] = 0
            words += [int(rng.choice([0, 0, 1, 7, 8, 9, 15])), *row, int(rng.choice([-6100, 6100]))]
        LawWords(words=tuple(words))
        position = np.tile([0, 1023], 100) if trial % 2 else rng.integers(0, 1024, 200)
        signals = (position, 1023 - position if trial % 5 else position, rng.choice([-800, 800], 200))
        requests += [f"law {' '.join(map(str, REST))}", f"words {' '.join(map(str, words))}", _steps(40, 760, *signals)]
        models.append(modelled(words, signals, 40, 760))
    lines = console(requests)  # the sanitizer ends it at a signed overflow
    assert set(lines[::3]) | set(lines[1::3]) == {"0"}
    for line, (duties, _) in zip(lines[2::3], models, strict=True):
        np.testing.assert_array_equal(np.array(line.split(), dtype=int), duties)
    assert {int(z.min()) for _, z in models} >= {-(1 << 29)}
    assert max(int(z.max()) for _, z in models) == (1 << 29) - 1


@pytest.mark.parametrize(
    "change",
    [{0: 0}, {0: 7}, {0: 2 | 16 << 8}, {3: 16}, {3: -1}, {4: 32767, 6: 16385}, {1: -32768, 9: 16384}],
    ids=["no state", "too many", "shift", "shift of a row", "negative shift", "row", "output"],
)
def test_words_that_could_overflow_are_refused_on_both_sides(console, change):
    words = [2, 0, 0, *[0] * 14]
    assert console([f"law {' '.join(map(str, REST))}", f"words {' '.join(map(str, words))}"])[1] == "0"
    for place, word in change.items():
        words[place] = word
    assert console([f"law {' '.join(map(str, REST))}", f"words {' '.join(map(str, words))}"])[1] == "1"
    with pytest.raises(RigError, match="the words of a law"):
        LawWords(words=tuple(words))


def test_the_integral_is_carried_from_gains_to_law_to_law_and_back(console):
    """The pulse width at rest stays to a count, whatever runs."""
    gains = "law 10240 1966 20480 33739 2867 512 512 400"
    away = (np.full(300, 520), np.full(300, 512), np.zeros(300, dtype=int))
    rest = (np.full(50, 512), np.full(50, 512), np.zeros(50, dtype=int))
    requests = [gains, _steps(0, 800, *away), _steps(0, 800, *rest)]
    for law in (PID, of_six_states(), of_six_states(np.random.default_rng(8))):
        requests += [f"words {' '.join(map(str, law_words(law).words))}", _steps(0, 800, *rest)]
    requests += ["gains", _steps(0, 800, *rest)]
    lines = console(requests)
    before = int(lines[2].split()[-1])
    assert abs(before - 400) > 50
    after = [int(line.split()[0]) for line in (*lines[4::2],)]
    assert max(abs(d - before) for d in after) <= 1


def test_laws_that_cannot_be_held_are_refused():
    a, b = np.diag([0.5] * 7), np.ones((7, 2))
    with pytest.raises(RigError, match=r"loop.A has 7 states; the controller has room for 1 to 6. Reduce"):
        law_words(StateLaw(A=a, B=b, C=np.ones((1, 7)), D=[[0.0, 0.0]], rate_hz=RATE))
    jordan = 0.5 * np.eye(4) + np.eye(4, k=1)
    with pytest.raises(RigError, match="more than two poles so close"):
        law_words(StateLaw(A=jordan, B=b[:4], C=np.ones((1, 4)), D=[[0.0, 0.0]], rate_hz=RATE))
    with pytest.raises(RigError, match=r"the row of loop.C and D sums up to .* whose limit is 49151"):
        law_words(StateLaw(A=[[0.5]], B=[[1.0, 0.0]], C=[[1.0]], D=[[400.0, 0.0]], rate_hz=RATE))
    with pytest.raises(RigError, match="outside the unit circle"):
        law_words(StateLaw(A=[[1.01]], B=[[1.0, 0.0]], C=[[1.0]], D=[[0.0, 0.0]], rate_hz=RATE))
