"""State-space laws in the firmware's own binary on the emulated bench: bit by bit, in time, and back to the old one."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.acquisition.devices._kernels import law_tick, watch
from ambid.acquisition.law_words import BEGIN, WATCH_MS, law_words
from ambid.errors import AmbidError
from ambid.job.acquiring import acquire
from ambid.physics.law import StateLaw
from ambid.physics.loop import Loop
from tests.bars.host import prototype
from tests.control.laws import observer_law
from tests.firmware.controller_host import Host
from tests.firmware.native.console import LEVITATING, LIMITS
from tests.firmware.test_firmware_emulated import BENCH, PLANT, gains_for

RATE = 2000.0
BOUNDS = {"position_low": 480, "position_high": 545, "confirm_ms": 500}


def law_of(states, *, stiffer=1.0):
    """Return the loop of `gains_for` as a law, with more states that are seen and change little."""
    of = gains_for(RATE)
    pole, kd = of["pole"] / 65536, of["kd"] / 4096
    n = states - 2
    a = np.diag([1.0, pole, *[0.7] * n])
    b = np.array([[-of["ki"] / 65536, 0.0], [kd * (1.0 - pole), 0.0], *[[1.0, 1.0]] * n])
    for k in range(2, 2 + n - n % 2, 2):
        a[k : k + 2, k : k + 2] = 0.9 * np.array([[np.cos(k), np.sin(k)], [-np.sin(k), np.cos(k)]])
    c = np.array([[1.0, stiffer, *[1e-2] * n]])
    d = -stiffer * np.array([[of["kp"] / 4096 + kd, of["kc"] / 4096]])
    return law_words(StateLaw(A=a, B=b, C=c, D=d, G=np.full((states, 1), 0.02), rate_hz=RATE))


@pytest.fixture
def host(emulated, tmp_path):
    """Start the unstable rotor's bench; returns the emulator and the host."""
    hosts = []

    def start(script=None, limits=None):
        plant = tmp_path / "bench.plant"
        numbers = "".join(f"{k} {v}\n" for k, v in (PLANT | BENCH).items())
        plant.write_text("kind linear\npwm averaged\n" + numbers, encoding="utf-8")
        bench = emulated(plant, script=script)
        hosts.append(Host(bench.port))
        hosts[0].make_ready(stream=0x1B, gains=gains_for(RATE), limits=limits)
        return bench, hosts[0]

    yield start
    for one in hosts:
        one.close()


def send_law(host, law, **trial):
    """Send the words, and arm them."""
    for at in range(0, len(law.words), 24):
        host.done("law", offset=at, values=law.words[at : at + 24])
    fields = {"position_low": 0, "position_high": 0, "confirm_ms": 0} | trial
    host.done("arm", period=10, checksum=law.checksum, **fields)


def test_six_states_run_bit_by_bit_and_in_time(host):
    limits = {"duty_low": 350, "duty_high": 440}  # reached on the way up
    bench, one = host(limits=limits)
    law = law_of(6)
    send_law(one, law)
    one.done("excitation", kind=2, amplitude=30, hold=3, length=9, cycles=1, seed=1)
    one.done("start", mode=3)
    one.flow(900)
    one.done("excite", on=1)
    while len(one.samples) < 3000:
        one.flow(20)
        one.send("ping")
        one.send("ask_status")
    status = one.ask("ask_status")
    assert (status["state"], status["dropped"], one.lost()) == (LEVITATING, 0, 0)
    assert status["busy_us"] < 470
    assert status["overruns"] <= 3
    one.done("stop")
    assert one.ask("self_test")["free_bytes"] >= 190
    words, z = np.array(law.words), np.full(6, BEGIN)
    watched = round(1e-3 * WATCH_MS * RATE)
    duties = []
    for k, sample in enumerate(one.samples):
        position, current, _, excitation = sample.values
        if k < watched:
            watch(words, z, position - 512, current - 512, 400, LIMITS["duty_off"], k == watched - 1)
            duties.append(LIMITS["duty_off"])
            continue
        pushed = 400 + (excitation - 65536 if excitation > 32767 else excitation)
        duties.append(law_tick(words, z, position - 512, current - 512, pushed, *limits.values()))
    ordered = [s.values[2] for s in one.samples]
    assert duties == ordered
    assert set(limits.values()) <= set(ordered)
    assert bench.events("end") == []


def test_the_old_law_returns_within_the_tick_and_levitates_on(host):
    """A push on the rotor during the trial moves it out of the bounds, not to the trips."""
    _, one = host(script="+1.2 pulse 0.9 0.02\n")
    one.done("start", mode=3)
    one.flow(1200)
    armed = len(one.samples)
    send_law(one, law_of(4), **(BOUNDS | {"confirm_ms": 5000}))
    one.flow(3000)
    told = one.wait(lambda: next((t for t in one.told if t.name == "law_status" and t["id"] == 0), None))
    position = np.array([s.values[0] for s in one.samples])
    left = armed + int(np.flatnonzero((position[armed:] < 480) | (position[armed:] > 545))[0])
    assert (told["running"], told["trial"], told["cause"]) == (0, 0, 1)
    assert told["tick"] == one.samples[left]["tick"]
    assert told["position"] == position[left]
    assert {s["state"] & 15 for s in one.samples} == {LEVITATING}
    assert np.abs(position[-300:] - 512).max() < 20
    assert one.ask("ask_status")["state"] == LEVITATING


@pytest.mark.parametrize(("keep", "cause"), [(True, 0), (False, 2)])
def test_confirmed_it_stays_and_unconfirmed_it_goes(host, keep, cause):
    _, one = host()
    one.done("start", mode=3)
    one.flow(1200)
    before = [s.values[2] for s in one.samples[-200:]]
    send_law(one, law_of(4), **BOUNDS)
    one.flow(100)
    if keep:
        one.done("settle", keep=1)
    one.flow(1400)
    status = one.ask("ask_law")
    assert (status["running"], status["trial"], status["cause"]) == (int(keep), 0, cause)
    after = [s.values[2] for s in one.samples[1200:1400]]
    assert abs(np.mean(after) - np.mean(before)) < 15  # no jump of what holds the rotor
    assert np.abs(np.array([s.values[0] for s in one.samples[600:]]) - 512).max() < 20


@pytest.fixture
def record_of(bench_program, firmware_elf, tmp_path):
    """Record 6 s of the prototype with a loop, lifted off by it or armed; returns what was sampled."""

    def run(law, *, armed):
        rig = prototype()
        new = replace(rig, loop=Loop(law=law, delay=rig.loop.delay))
        options = {"seconds": 6.0, "excitation": "multisine", "amplitude": 0.6}
        first, arm = (rig, new) if armed else (new, None)
        done = acquire("emulated", first, tmp_path / "run.csv", arm=arm, **options)
        assert done.run.fault is None
        columns = done.record.to_dataframe()
        return [columns[c].to_numpy() for n in ("position", "current", "duty", "excitation") for c in columns if n in c]

    return run


@pytest.mark.parametrize("armed", [False, True], ids=["lifted off", "armed"])
def test_a_law_in_fixed_point_is_that_in_floating_point(record_of, armed):
    """Peak of the sensitivity within 0.1 dB on the emulated bench."""
    _, law = observer_law("prototype")
    x, i, u, e = (np.fft.rfft(v - v.mean()) for v in record_of(law, armed=armed))
    lines = np.abs(e) > 0.2 * np.abs(e).max()
    x, i, u, e = x[lines], i[lines], u[lines], e[lines]
    f = np.fft.rfftfreq(int(6.0 * RATE), 1.0 / RATE)[lines]
    w = law.response(f)[:, 0, :] * np.array([2.44140625e-6, 2.44140625e-3]) / 0.03
    loop = (w[:, 0] * x + w[:, 1] * i) / u
    words, floating = u / e, 1.0 / (1.0 - loop)
    peaks = [20.0 * np.log10(np.abs(s).max()) for s in (words, floating)]
    assert peaks[0] > 3.0
    assert abs(peaks[0] - peaks[1]) < 0.1


def test_a_loop_that_does_not_hold_is_given_up_and_said(bench_program, firmware_elf, tmp_path):
    rig = prototype()
    weak = replace(rig, loop=replace(rig.loop, kp=0.2 * rig.loop.kp, ki=0.0, kd=0.0))
    with pytest.raises(AmbidError, match="returned to the loop that it ran before: the rotor left the bounds"):
        acquire("emulated", rig, tmp_path / "run.csv", seconds=1.0, arm=weak, force=True)
    assert not (tmp_path / "run.csv").exists()
