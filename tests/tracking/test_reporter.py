"""Lines of a track: when they come, what they hold, and what they say of samples that were not used."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.recursive.lines import TrackLine
from ambid.tracking.blocks import Rejection
from ambid.tracking.evidence import Samples
from ambid.tracking.reporter import Reporter, header
from ambid.tracking.rpem import PhysicalRpem
from ambid.tracking.supervisor import Supervisor
from tests.tracking.runs import RATE, arrays, simulated, start


@pytest.fixture(scope="module")
def signals():
    return arrays(simulated(seconds=1.5))


def reporter(every_s=0.01, *, flags=(), first=RATE, t0=0.0, back=()):
    lines: list[TrackLine] = []
    supervisor = Supervisor(PhysicalRpem(start()), t0=t0, listener=lambda event: made.note(event))

    def emit(line):
        lines.append(line)
        return back

    made = Reporter(supervisor, every_s=every_s, on_line=emit, flags=flags, t0=t0, first=first)
    return made, lines


def give(made, signals, first, last, block=200, *, restart=False):
    u, y = signals
    for k in range(first, last, block):
        stop = min(k + block, last)
        made.consume(Samples(u=u[k:stop], y=y[k:stop]), k, restart=restart and k == first)


@pytest.mark.parametrize("every_s", [0.01, 0.0123, 0.1, 0.00333])
@pytest.mark.parametrize("t0", [0.0, -3.5])
def test_lines_come_at_whole_intervals_whatever_the_rate(signals, every_s, t0):
    made, lines = reporter(every_s, t0=t0)
    give(made, signals, RATE, RATE + 6000, block=777)
    assert made.every_s == every_s
    assert [line.t - t0 for line in lines] == pytest.approx(
        [k * every_s for k in range(1, 2000) if RATE < round(k * every_s * RATE) <= RATE + 6000], abs=1e-9
    )
    assert made.lines == len(lines)
    assert made.samples == 6000


def test_an_interval_is_one_sample_at_least(signals):
    made, lines = reporter(1e-9)
    give(made, signals, RATE, RATE + 50)
    assert made.every_s == 1.0 / RATE
    assert len(lines) == 50


def gap(samples, first, kind="gap"):
    return Rejection(kind=kind, samples=samples, t=first / RATE, why="lost")


@pytest.mark.parametrize("kind", ["gap", "nan", "stuck", "range"])
def test_lines_go_on_where_samples_are_missing(signals, kind):
    made, lines = reporter()
    give(made, signals, RATE, 21_100)
    made.reject(gap(1_300, 21_100, kind))
    assert lines[-1].t == pytest.approx(1.12)
    give(made, signals, 22_400, 24_000, restart=True)
    assert np.diff([line.t for line in lines]) == pytest.approx(0.01)
    told = [(line.t, e.samples) for line in lines for e in line.events if e.kind == "rejected"]
    assert told == [(pytest.approx(1.06), 1_300)]
    assert made.rejected == 1_300
    assert made.samples == 1_100 + 1_600


@pytest.mark.parametrize("kind", ["repeated", "overlap", "contradiction", "shape", "clock"])
def test_what_has_no_place_in_the_stream_takes_no_time(signals, kind):
    made, lines = reporter()
    give(made, signals, RATE, 21_000)
    made.reject(gap(700, 20_300, kind))
    give(made, signals, 21_000, 22_000)
    assert np.diff([line.t for line in lines]) == pytest.approx(0.01)
    assert made.rejected == 700
    assert [e.kind for line in lines for e in line.events] == ["rejected"]


def test_numbers_are_stale_after_a_second_without_samples_and_an_hour_has_no_lines(signals):
    made, lines = reporter(0.1)
    give(made, signals, RATE, 22_000)
    made.reject(gap(3600 * RATE, 22_000))
    assert len(lines) < 10
    assert lines[-1].state == "frozen"
    assert all(v.stale for v in lines[-1].parameters.values())
    assert [e.kind for line in lines for e in line.events] == ["rejected", "frozen"]
    u, y = signals
    first = 22_000 + 3600 * RATE
    made.consume(Samples(u=u[22_000:], y=y[22_000:]), first, restart=True)
    assert lines[-1].state == "tracking"
    assert lines[-1].t == pytest.approx(first / RATE + 0.4)
    start_sd = start().covariance.diagonal() ** 0.5
    assert lines[-1].parameters["m"].sd > start_sd[0]  # an hour of walking


def test_flags_are_set_in_their_interval_in_the_order_given(signals):
    made, lines = reporter(flags=((1.105, "hold"), (1.2, "track"), (0.2, "hold"), (1.05, "track"), (1.2, "hold")))
    give(made, signals, RATE, 26_000)
    states = {round(line.t, 2): line.state for line in lines}
    assert {states[t] for t in (1.01, 1.04, 1.11, 1.19, 1.2, 1.3)} == {"hold"}
    assert {states[t] for t in (1.05, 1.1)} == {"tracking"}


def test_an_unknown_flag_from_outside_is_refused_not_raised(signals):
    made, lines = reporter(back=("holt",))
    give(made, signals, RATE, RATE + 1000)
    refused = [e for line in lines for e in line.events if e.kind == "refused"]
    assert "holt" in refused[0].why


def test_what_happens_after_the_last_line_gets_one(signals):
    made, lines = reporter()
    give(made, signals, RATE, 21_000)
    made.reject(gap(50, 21_000))
    made.finish()
    assert lines[-1].t == pytest.approx(1.06)
    assert lines[-1].events[0].samples == 50
    made.finish()
    assert len(lines) == 6


def test_header_and_summary_hold_what_the_contract_says(signals):
    made, lines = reporter()
    top = header(made.supervisor, limit=1.5, every_s=0.01, method="rpem", record={"file": "a.csv"})
    assert top.units == {
        "m": "kg", "k_x": "N/m", "k_i": "N/A", "R": "ohm", "L": "H", "gain_position": "1", "gain_current": "1",
        "unbalance": "kg m", "unbalance_phase": "rad",
    }  # fmt: skip
    assert {n: v.value for n, v in top.start.items()} == pytest.approx({n: start().values[n] for n in top.start})
    give(made, signals, RATE, 24_000)
    made.reject(gap(10, 24_000))
    summary = made.summary(computing_s=0.1, complete=False)
    assert (summary.samples, summary.rejected_samples, summary.complete) == (4000, 10, False)
    assert summary.seconds_of_record == pytest.approx(0.2)
    assert summary.counts == {"rejected": 1}
    assert summary.updates == made.supervisor.publication.updates > 0
    assert len({line.parameters["m"].value for line in lines}) <= summary.updates + 1


def test_a_predictor_that_never_settles_is_not_said_to_track(signals):
    made, lines = reporter()
    settles = made.supervisor.rpem.stream.settling_samples
    assert settles > 8
    u, y = signals
    for k in range(RATE, RATE + 8_000, settles):  # one sample is lost before each piece
        made.consume(Samples(u=u[k + 1 : k + settles], y=y[k + 1 : k + settles]), k + 1, restart=True)
    assert made.samples > 7_000
    assert np.isnan([line.error for line in lines if line.t > lines[0].t + 0.1]).all()
    assert lines[0].state == "tracking"
    assert lines[-1].state == "frozen"  # there never was anything to go by
    assert all(v.stale for v in lines[-1].parameters.values())
    assert [e.kind for line in lines for e in line.events] == ["frozen"]
    made.consume(Samples(u=u[28_000:], y=y[28_000:]), 3 * RATE, restart=True)
    assert lines[-1].state == "tracking"
    assert np.isfinite(lines[-1].error)


def test_the_error_is_not_known_while_the_predictor_settles_after_a_long_gap(signals):
    made, lines = reporter()
    give(made, signals, RATE, 24_000)
    assert np.isfinite(lines[-1].error)
    made.reject(gap(4_000, 24_000))
    assert np.isnan(lines[-1].error)
    assert lines[-1].state == "tracking"
    give(made, signals, 28_000, 30_000, restart=True)
    assert np.isfinite(lines[-1].error)
