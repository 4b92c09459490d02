"""Schedules: lines, jumps, warm-up and exact integrals."""

import numpy as np
import pytest

from ambid.errors import ModelError
from ambid.simulation import Schedule

RATE = 1000.0


def at(schedule: Schedule, *times_s: float, before: bool = False) -> list[float]:
    return schedule.at(np.array(times_s) * RATE, RATE, before=before).tolist()


def test_a_jump_happens_at_its_sample_and_holds_the_later_value() -> None:
    s = Schedule.step(2.0, 3.0, 0.5)
    assert at(s, 0.0, 0.499, 0.5, 0.501, 9.0) == [2.0, 2.0, 3.0, 3.0, 3.0]
    assert at(s, 0.499, 0.5, 0.501, before=True) == [2.0, 2.0, 3.0]


def test_a_ramp_is_a_line_between_its_ends() -> None:
    s = Schedule.ramp(1.0, 2.0, 1.0, 3.0)
    assert at(s, 0.0, 1.0, 1.5, 3.0, 4.0) == [1.0, 1.0, 1.25, 2.0, 2.0]


def test_jumps_inside_lines_keep_both_sides() -> None:
    s = Schedule(times_s=(0.0, 1.0, 1.0, 2.0), values=(0.0, 1.0, 5.0, 6.0))
    assert at(s, 0.5, 1.0, 1.5) == [0.5, 5.0, 5.5]
    assert at(s, 1.0, before=True) == [1.0]
    assert at(Schedule(times_s=(1.0, 1.0, 2.0), values=(7.0, 0.0, 1.0)), 0.5, 1.0, 1.5) == [7.0, 0.0, 0.5]


def test_many_samples_give_what_each_gives_alone() -> None:
    s = Schedule(times_s=(0.1, 0.2, 0.2, 0.7), values=(1.0, 4.0, 2.0, -1.0))
    k = np.arange(0.0, 1000.0, 0.5)
    for values in (s.at, s.integral):
        assert np.array_equal(values(k, RATE), np.concatenate([values(x, RATE) for x in np.split(k, 2000)]))


def test_the_integral_is_exact() -> None:
    speed = Schedule.ramp(0.0, 100.0, 1.0, 3.0)
    t = np.array([0.0, 0.5, 1.0, 1.7, 3.0, 10.0])
    wanted = np.where(t < 3.0, 25.0 * np.clip(t - 1.0, 0.0, None) ** 2, 100.0 * (t - 3.0) + 100.0)
    assert speed.integral(t * RATE, RATE) == pytest.approx(wanted, rel=1e-14)
    with_jump = Schedule(times_s=(-1.0, 0.0, 2.0, 2.0), values=(9.0, 1.0, 3.0, 0.0))
    assert with_jump.integral(np.array([1000.0, 2000.0, 5000.0]), RATE) == pytest.approx([1.5, 4.0, 4.0], rel=1e-14)


@pytest.mark.parametrize(
    ("times", "values", "said"),
    [((), (), "at least"), ((0.0,), (1.0, 2.0), "as many"), ((0.0, np.nan), (1.0, 2.0), "finite"),
     ((1.0, 0.0), (1.0, 2.0), "fall")],
)  # fmt: skip
def test_bad_knots_are_refused(times: tuple[float, ...], values: tuple[float, ...], said: str) -> None:
    with pytest.raises(ModelError, match=said):
        Schedule(times_s=times, values=values)
