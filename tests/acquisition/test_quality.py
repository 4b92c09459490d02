"""Quality against known truth: noise, signal, gaps, saturation and standstill that were put in are found again."""

import math

import numpy as np
import pytest

from ambid.acquisition.device import Column, DeviceInfo, Program
from ambid.acquisition.program import expected, program
from ambid.acquisition.quality import Quality, QualityReport
from ambid.tracking.blocks import Block, Frame

RATE = 2000.0
COLUMNS = (
    Column(name="gap", role="position", unit="1", span=(0.0, 1023.0)),
    Column(name="coil", role="current", unit="1", span=(0.0, 1023.0)),
    Column(name="duty", role="voltage", unit="1", span=(20.0, 780.0)),
)


def info(*columns: Column, kind="emulated") -> DeviceInfo:
    return DeviceInfo(kind=kind, port="bench", rate_hz=RATE, columns=columns or COLUMNS, identity={})


def fed(quality: Quality, x, *, size=37, first=0, rate_hz=RATE) -> QualityReport:
    """Give samples in blocks of an odd size, as they come from a line."""
    x = np.asarray(x, dtype=np.float64)
    for k in range(0, len(x), size):
        part = x[k : k + size]
        number = first + k
        block = Block(first=number, time_s=number / RATE, values=part)
        quality.add(Frame(block=block, arrived_s=100.0 + (number + len(part)) / rate_hz))
    return quality.report()


def noise(n, *sd, seed=0):
    return np.random.default_rng(seed).standard_normal((n, len(sd))) * sd


def healthy(n=8000):
    return np.array([512.0, 500.0, 400.0]) + noise(n, 60.0, 60.0, 50.0)


def test_moments_are_those_of_the_whole_stream_whatever_the_blocks():
    x = 1e6 + healthy(5000) ** 2
    for size in (1, 37, 5000):
        report = fed(Quality(info()), x, size=size)
        for k, column in enumerate(report.columns):
            assert column.mean == pytest.approx(x[:, k].mean(), rel=1e-12)
            assert column.sd == pytest.approx(x[:, k].std(), rel=1e-9)
            assert column.rms == pytest.approx(np.sqrt(np.mean(x[:, k] ** 2)), rel=1e-9)
            assert (column.least, column.most) == (x[:, k].min(), x[:, k].max())
        assert report.samples == 5000
        assert report.seconds == 2.5


def test_all_is_well_with_a_healthy_stream():
    report = fed(Quality(info()), healthy())
    assert report.verdict == ()
    assert (report.lost, report.gaps, report.repeated, report.damaged) == (0, 0, 0, 0)
    assert report.columns[0].used == pytest.approx(np.ptp(healthy()[:, 0]) / 1023.0)


@pytest.mark.parametrize("kind", ["multisine", "prbs"])
def test_the_periods_of_an_excitation_tell_noise_from_signal(kind):
    played = program(kind, amplitude_v=2.0, band=(4.0, 400.0), rate_hz=RATE, seconds=10.0, seed=1)
    u = expected(played, 20_000)
    for sd in (0.05, 2.0):
        x = np.column_stack([512.0 + 3.0 * u, 500.0 - u, 400.0 + 0.0 * u]) + noise(20_000, sd, 0.5, 0.7)
        report = fed(Quality(info(), played), x)
        position, current, _ = report.columns
        assert position.noise_by == "periods"
        assert position.noise_sd == pytest.approx(sd, rel=0.05)
        assert position.signal_sd == pytest.approx(3.0 * u.std(), rel=0.02)
        assert current.noise_sd == pytest.approx(0.5, rel=0.05)
        assert position.snr_db == pytest.approx(20 * np.log10(3.0 * u.std() / sd), abs=0.5)


def test_noise_by_periods_is_unbiased_over_many_streams():
    """200 streams of four periods: the mean noise variance is the truth within three standard errors."""
    played = program("multisine", amplitude_v=2.0, rate_hz=RATE, seconds=0.4, seed=1)
    u = expected(played, 1000)
    column = Column(name="gap", role="position", unit="1")
    noises, signals = [], []
    for seed in range(200):
        x = u[:, None] + noise(1000, 1.5, seed=seed)
        report = fed(Quality(info(column), played), x, size=100)
        noises.append(report.columns[0].noise_sd ** 2)
        signals.append(report.columns[0].signal_sd ** 2)
    for found, truth in ((noises, 1.5**2), (signals, float(u.var()))):
        error = np.std(found) / np.sqrt(len(found))
        assert abs(np.mean(found) - truth) < 3.0 * error


def test_a_period_that_has_hardly_come_again_does_not_tell_the_noise():
    """Noise that hardly changes within 50 samples: their few repetitions are one draw of it, not 50."""
    wave = Program(kind="table", amplitude=1.0, hold=1, length=1000, cycles=0, table=(1,) * 1000)
    column = Column(name="gap", role="position", unit="1")
    x = np.sin(np.arange(2500) * 2e-3 * math.pi)[:, None] + noise(2500, 0.1)
    assert fed(Quality(info(column), wave), x[:2050]).columns[0].noise_by == "differences"
    assert fed(Quality(info(column), wave), x).columns[0].noise_by == "periods"


def test_the_time_before_the_excitation_settles_is_left_out():
    played = program("multisine", amplitude_v=2.0, rate_hz=RATE, seconds=4.0, seed=1)
    late = 200  # the excitation begins so many ticks after the stream, with a transient of a hundred times its size
    u = np.concatenate([np.zeros(late), expected(played, 7800)])
    transient = 200.0 * np.exp(-np.arange(8000) / 100.0)
    x = (u + transient)[:, None] + noise(8000, 0.3)
    report = fed(Quality(info(Column(name="gap", role="position", unit="1")), played), x)
    assert report.columns[0].noise_sd == pytest.approx(0.3, rel=0.1)


def test_an_excitation_that_ends_is_folded_while_it_plays():
    played = Program(kind="step", amplitude=1.0, hold=50, length=2, cycles=20)
    x = expected(played, 6000)[:, None] + noise(6000, 0.1)
    report = fed(Quality(info(Column(name="gap", role="position", unit="1")), played), x, size=333)
    assert report.columns[0].noise_by == "periods"
    assert report.columns[0].signal_sd == pytest.approx(1.0, rel=0.02)


def test_without_an_excitation_noise_is_known_by_differences():
    t = np.arange(20_000) / RATE
    x = np.column_stack([100.0 * np.sin(2 * np.pi * 5.0 * t), 0.0 * t, 0.0 * t]) + noise(20_000, 0.5, 2.0, 1.0)
    position, current, _ = fed(Quality(info()), x).columns
    assert position.noise_by == "differences"
    assert position.noise_sd == pytest.approx(0.5, rel=0.03)
    assert current.noise_sd == pytest.approx(2.0, rel=0.03)
    assert position.snr_db == pytest.approx(20 * np.log10(100.0 / np.sqrt(2.0) / 0.5), abs=0.3)


def test_what_is_lost_doubled_or_no_number_is_counted():
    x = healthy(3000)
    x[1500, 1] = np.nan
    x[1501] = np.inf
    quality = Quality(info())
    fed(quality, x[:1000])
    fed(quality, x[990:2000], first=990)  # ten twice
    report = fed(quality, x[2100:], first=2100)  # a hundred lost
    assert (report.lost, report.gaps, report.repeated, report.damaged) == (100, 1, 10, 2)
    assert report.samples == 3000 - 100 - 2
    assert report.seconds == 1.5
    sound = np.delete(x, [1500, 1501, *range(2000, 2100)], axis=0)
    assert report.columns[0].sd == pytest.approx(sound[:, 0].std(), rel=1e-12)
    assert any("100 samples lost in 1 gap (3.34%)" in line for line in report.verdict)
    assert any("10 samples came twice" in line for line in report.verdict)
    assert any("2 samples with a value that is not a number omitted" in line for line in report.verdict)


def test_a_gap_is_no_noise():
    x = noise(2000, 0.1, 0.1, 0.1) + 1000.0 * np.repeat([[0.0], [1.0]], 1000, axis=0)
    quality = Quality(info())
    fed(quality, x[:1000])
    report = fed(quality, x[1000:], first=1500)
    assert report.columns[0].noise_sd == pytest.approx(0.1, rel=0.1)


def test_samples_at_the_ends_of_the_span_are_saturated():
    x = healthy(10_000)
    x[100:150, 0] = 1023.0
    x[200:250, 0] = 0.0
    x[:150, 2] = 780.0
    report = fed(Quality(info()), x)
    assert report.columns[0].saturated == 0.01
    assert report.columns[1].saturated == 0.0
    assert any("gap is at an end of the converter range in 1.00% of the samples" in v for v in report.verdict)
    assert any("duty is saturated in 1.5% of the samples" in v for v in report.verdict)
    assert len(report.verdict) == 2


def test_a_sensor_that_hardly_moves_the_converter_is_named():
    x = healthy()
    x[:, 0] = 512.0 + np.round(2.0 * np.sin(np.arange(len(x)) / 7.0))
    report = fed(Quality(info()), x)
    assert report.columns[0].used == pytest.approx(4.0 / 1023.0)
    assert any("gap uses 0.4% of the converter range" in line for line in report.verdict)


def test_standstill_is_found_over_the_ends_of_blocks():
    x = healthy()
    x[1000:3400, 1] = 300.0
    played = Program(kind="prbs", amplitude=1.0, hold=2, length=7, seed=3)
    report = fed(Quality(info(), played), x)
    assert report.columns[1].still_s == pytest.approx(1.2)
    assert report.columns[0].still_s == pytest.approx(1 / RATE)
    assert any("coil was constant for 1.2 s during an excitation" in line for line in report.verdict)
    x[:, 1], x[:, 2] = 7.0, 400.0
    report = fed(Quality(info(), played), x)
    assert report.columns[1].still_s == 4.0
    assert any("coil is constant at 7: no sensor there?" in line for line in report.verdict)
    assert any("duty is constant although an excitation was requested" in line for line in report.verdict)


def test_a_stream_that_does_not_answer_to_the_excitation_is_named():
    played = program("prbs", amplitude_v=2.0, band=(4.0, 400.0), rate_hz=RATE, seconds=4.0)
    report = fed(Quality(info(), played), healthy())
    assert report.columns[0].snr_db is None or report.columns[0].snr_db < 0.0
    told = [line for line in report.verdict if "of its power does not come from the excitation" in line]
    assert len(told) <= 2
    assert all(c.signal_sd < 0.2 * c.noise_sd for c in report.columns)


def test_the_rate_is_measured_by_the_times_of_arrival():
    draw = np.random.default_rng(1)
    quality = Quality(info(kind="serial"))
    x = healthy(40_000)
    for k in range(0, 40_000, 40):
        block = Block(first=k, time_s=k / RATE, values=x[k : k + 40])
        quality.add(Frame(block=block, arrived_s=(k + 40) / 1900.0 + draw.exponential(2e-3)))
    report = quality.report()
    assert report.measured_hz == pytest.approx(1900.0, rel=1e-4)
    assert 0.0 < report.measured_sd < 0.1
    assert any("samples arrive per second instead of 2000: the controller clock is wrong" in v for v in report.verdict)
    assert fed(Quality(info()), healthy(), rate_hz=1900.0).verdict == ()  # an emulator keeps its own time


def test_before_anything_came_nothing_is_claimed():
    report = Quality(info(), Program(kind="step", amplitude=1.0, hold=5, length=2)).report()
    assert report.samples == 0
    assert report.verdict == ()
    assert math.isnan(report.measured_hz)
    assert all(math.isnan(c.mean) and c.snr_db is None and c.saturated == 0.0 for c in report.columns)


def test_memory_stays_the_same_however_long_it_runs():
    import pickle

    played = program("multisine", amplitude_v=2.0, rate_hz=RATE, seconds=4.0)
    quality = Quality(info(), played)
    fed(quality, healthy(4000))
    before = len(pickle.dumps(quality))
    fed(quality, healthy(20_000), first=4000)
    assert len(pickle.dumps(quality)) <= before + 500


def test_an_excitation_with_too_long_a_period_is_judged_by_differences():
    played = Program(kind="prbs", amplitude=1.0, hold=100, length=15, seed=1)
    assert fed(Quality(info(), played), healthy()).columns[0].noise_by == "differences"
