"""When the firmware's inputs are held and when its pulse widths act, measured on the emulated bench."""

import csv
from dataclasses import dataclass

import numpy as np
import pytest

from ambid.acquisition.scales import PWM_HZ
from tests.firmware.controller_host import Host
from tests.firmware.test_firmware_emulated import BENCH, PLANT, gains_for

DRIVE, LEVITATE = 2, 3
DUTY = 0x08


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What a run left: rows of the trajectory, samples, period of the ticks in s, last status."""

    rows: np.ndarray
    samples: list
    tick_s: float
    status: object

    def phases_us(self):
        """Holds of first current, position and second current of each tick, from the begins of their periods, us."""
        begin, pwm_s = self.rows[:-1, 6], 1.0 / PWM_HZ
        held = self.rows[:-1, 8] - begin, self.rows[:-1, 0] - begin, self.rows[1:, 7] - begin - pwm_s
        inside = np.abs(np.diff(self.rows[:, 0]) - self.tick_s) < 0.2 * pwm_s  # ticks, one after the other
        return [1e6 * phase[inside] for phase in held]

    def lags_us(self):
        """From each tick's hold of the position to the moment at which its pulse width acts, us, where it differs."""
        on = [s for s in self.samples if s["state"] & 15 in (DRIVE, LEVITATE)]
        assert [s["tick"] for s in on] == list(range(on[0]["tick"], on[0]["tick"] + len(on)))
        duty = np.array([s.values[-1] for s in on], dtype=float)
        acted = (self.rows[:, 4] + 12.0) / 24.0 * 800  # mean since the row before
        before, after = duty[:-8], duty[1:-7]
        # The bench's first row may be another conversion: the rows that fit the ticks are those of the least error.
        guess = after + 175e-6 / self.tick_s * (before - after)
        errors = [np.median(np.abs(acted[k : k + guess.size] - guess)) for k in range(acted.size - guess.size + 1)]
        acted = acted[np.argmin(errors) :][: guess.size]
        moved = np.abs(before - after) >= 4
        assert np.count_nonzero(moved) > 1000
        return 1e6 * self.tick_s * (acted - after)[moved] / (before - after)[moved]


@pytest.fixture
def run(emulated, tmp_path):
    """Run the output with excitation, and commands that come all the time; returns a `Run`."""

    def of(*, mode, period=10, stream=0x0B, ticks=6000, each=20, commands=("ping",)):
        plant = tmp_path / "bench.plant"
        numbers = "".join(f"{k} {v}\n" for k, v in (PLANT | BENCH).items())
        plant.write_text("kind linear\npwm averaged\n" + numbers, encoding="utf-8")
        bench = emulated(plant, trajectory=True)
        host = Host(bench.port)
        try:
            limits = {"position_low": 60} if mode == DRIVE else {}
            host.make_ready(period=period, stream=stream, gains=gains_for(PWM_HZ / period), limits=limits)
            host.done("excitation", kind=2, amplitude=10, hold=1, length=10, cycles=0, seed=1)
            host.done("start", mode=mode)
            host.done("excite", on=1)
            while len(host.samples) < ticks:
                host.flow(each)
                for name in commands:
                    host.send(name)
            status = host.ask("ask_status")
            host.done("stop")
        finally:
            host.close()
        bench.close(keep=True)
        with bench.trajectory_path.open() as file:
            rows = np.array([[float(v) for v in row.values()] for row in csv.DictReader(file)])
        assert host.lost() == 0
        return Run(rows=rows, samples=host.samples, tick_s=period / PWM_HZ, status=status)

    return of


@pytest.mark.parametrize(("period", "stream"), [(10, 0x0B), (10, 0x0F), (8, 0x0B)])
def test_the_currents_lie_about_the_begin_of_a_period_and_the_position_midway(run, period, stream):
    first, position, second = run(mode=LEVITATE, period=period, stream=stream, ticks=3000).phases_us()
    assert np.median(first) == pytest.approx(-8.0, abs=1.0)
    assert np.median(second) == pytest.approx(8.0, abs=1.0)
    assert np.median(position) == pytest.approx(25.0, abs=1.0)
    # A byte on the line may be in the way for 5 us.
    assert np.mean(np.abs(first + second) <= 1.0) > 0.96
    assert np.mean(np.abs(position - np.median(position)) <= 1.0) > 0.96
    assert np.max(np.abs(first + second)) < 25.0


@pytest.mark.parametrize(
    ("mode", "period", "stream", "commands"),
    [
        (LEVITATE, 10, 0x0B, ("ping",)),
        (LEVITATE, 10, 0x0F, ("ping", "ask_status")),
        (LEVITATE, 8, 0x0F, ("ping",)),
        (LEVITATE, 11, 0x0B, ("ping",)),
        (DRIVE, 10, 0x0B, ("ping",)),
    ],
)
def test_a_pulse_width_acts_a_fixed_time_after_its_tick(run, mode, period, stream, commands):
    done = run(mode=mode, period=period, stream=stream, commands=commands)
    lags = done.lags_us()
    # At 2.5 kHz the last sample is still on the line: its bytes may keep the hold waiting for a microsecond or two.
    assert np.median(lags) == pytest.approx(175.0, abs=2.0)
    # A command's bytes may come just when an order is due: at most one order a command, 1 tick in 20, could act a
    # period later; how many do depends on when the host sends. A hold that was late itself moves the tick by some us.
    late = int(np.count_nonzero(lags > 175.0 + 0.5e6 / PWM_HZ))
    assert late <= done.status["overruns"] <= 0.01 * len(done.samples)  # what acts late is counted
    assert np.mean(np.abs(lags - 175.0) < 10.0) >= 0.99
