"""From a journal to a record: time stays uniform, what is missing is NaN, and nothing is left out without a count."""

import numpy as np
import pytest

from ambid.acquisition.recorder import JournalReader, Recorder, convert, recorded_from
from ambid.errors import DeviceError, RecordError
from ambid.record import read_record
from ambid.record.hdf5_format import read_hdf5
from ambid.tracking.blocks import Block
from tests.acquisition.recorder.signals import COLUMNS, RATE, ROWS, bits, block, header, same_bits, values_at


def recorded(path, blocks, **more):
    with Recorder(path, header(), **more) as recorder:
        for b in blocks:
            recorder.append(b)
    return recorder.result


def values_of(path):
    return np.column_stack([c.values for c in read_hdf5(path).channels])


def test_lost_samples_become_rows_of_nan_that_a_reader_has_to_treat(tmp_path):
    made = recorded(tmp_path / "run.h5", [block(k) for k in (3, 4, 7, 8, 9, 12)])
    assert (made.survey.gaps, made.survey.gap_samples) == (2, 4 * ROWS)
    assert made.survey.rows == 10 * ROWS
    values = values_of(tmp_path / "run.h5")
    missing = np.zeros(10 * ROWS, dtype=bool)
    missing[2 * ROWS : 4 * ROWS] = missing[7 * ROWS : 9 * ROWS] = True
    assert np.isnan(values[missing]).all()
    assert same_bits(values[~missing], values_at(3 * ROWS, 10 * ROWS)[~missing])
    record = read_hdf5(tmp_path / "run.h5")
    assert record.start_s == 3 * ROWS / RATE
    assert record.history[1].name == "gaps"
    assert record.history[1].settings == {"lost_samples": 4 * ROWS, "places": 2}
    with pytest.raises(RecordError, match="gaps='interpolate' or gaps='cut'"):
        read_record(tmp_path / "run.h5")
    assert read_record(tmp_path / "run.h5", gaps="cut").n_samples == 3 * ROWS


def test_the_same_in_csv(tmp_path):
    recorded(tmp_path / "run.csv", [block(k) for k in (0, 1, 3)])
    with pytest.raises(RecordError, match="give gaps="):
        read_record(tmp_path / "run.csv")
    assert read_record(tmp_path / "run.csv", gaps="interpolate").n_samples == 4 * ROWS


def test_nan_of_the_device_itself_is_kept(tmp_path):
    values = values_at(0, ROWS)
    values[5, 1] = np.nan
    made = recorded(tmp_path / "run.h5", [Block(first=0, time_s=0.0, values=values)])
    assert made.survey.gap_samples == 0
    assert same_bits(values_of(tmp_path / "run.h5"), values)


@pytest.mark.parametrize(
    ("numbers", "misplaced"),
    [((0, 1, 1, 2), ROWS), ((0, 2, 1, 3), ROWS), ((5, 6, 0, 1), 2 * ROWS), ((0, 1, 0, 2), ROWS)],
)
def test_numbers_that_came_before_are_counted_and_the_journal_kept(tmp_path, numbers, misplaced):
    made = recorded(tmp_path / "run.h5", [block(k) for k in numbers])
    assert made.survey.misplaced == misplaced
    assert made.keep_journal
    assert (tmp_path / "run.h5.journal").exists()
    assert read_hdf5(tmp_path / "run.h5").history[1].settings["misplaced_samples"] == misplaced
    values = values_of(tmp_path / "run.h5")
    there = np.isfinite(values).all(axis=1)
    first = numbers[0] * ROWS
    assert same_bits(values[there], values_at(first, len(values))[there])
    assert there.sum() + misplaced == ROWS * len(numbers)


def test_a_block_that_overlaps_gives_its_new_rows(tmp_path):
    half = Block(first=ROWS // 2, time_s=0.0, values=values_at(ROWS // 2, ROWS))
    made = recorded(tmp_path / "run.h5", [block(0), half])
    assert made.survey.misplaced == ROWS // 2
    assert same_bits(values_of(tmp_path / "run.h5"), values_at(0, ROWS * 3 // 2))


def test_pieces_and_gaps_of_every_length_fit_together(tmp_path, monkeypatch):
    monkeypatch.setattr(convert, "_ROWS", 64)
    rng = np.random.default_rng(3)
    first, blocks, there = 0, [], []
    for _ in range(60):
        n = int(rng.integers(1, 200))
        blocks.append(Block(first=first, time_s=first / RATE, values=values_at(first, n)))
        there.append(np.arange(first, first + n))
        first += n + (int(rng.integers(1, 200)) if rng.random() < 0.3 else 0)
    made = recorded(tmp_path / "run.h5", blocks)
    values, there = values_of(tmp_path / "run.h5"), np.concatenate(there)
    assert made.survey.samples == len(there)
    assert same_bits(values[there], values_at(0, first)[there])
    assert np.isfinite(values).all(axis=1).sum() == len(there)
    assert len(values) == there[-1] + 1


def test_numbers_that_no_recording_has_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(convert, "_GAP_ROWS", 1000)
    with pytest.raises(DeviceError, match=r"samples are missing.*journal is kept"):
        recorded(tmp_path / "run.h5", [block(0), block(10**9)])
    assert [p.name for p in tmp_path.iterdir()] == ["run.h5.journal"]


def test_a_clock_that_does_not_agree_with_the_numbers_is_told(tmp_path):
    late = Block(first=ROWS, time_s=ROWS / RATE + 0.01, values=values_at(ROWS, ROWS))
    made = recorded(tmp_path / "run.h5", [block(0), late])
    assert made.survey.stamp_error_s == pytest.approx(0.01)
    assert read_hdf5(tmp_path / "run.h5").history[0].settings["stamp_error_s"] == pytest.approx(0.01)


def test_a_clock_that_tells_nothing_starts_where_the_number_says(tmp_path):
    made = recorded(tmp_path / "run.h5", [Block(first=100, time_s=float("nan"), values=values_at(100, ROWS))])
    assert made.survey.start_s == 100 / RATE


def test_a_gap_at_the_end_of_a_journal_that_was_cut_off_is_not_made_up(tmp_path):
    with Recorder(tmp_path / "run.h5", header()) as recorder:
        for k in range(4):
            recorder.append(block(k))
        recorder.flush()
        data = recorder.journal.read_bytes()
    (tmp_path / "cut.h5.journal").write_bytes(data[:-10])
    with JournalReader.open(tmp_path / "cut.h5.journal") as reader:
        made = recorded_from(reader, tmp_path / "cut.h5")
    assert made.survey.rows == 3 * ROWS
    assert made.survey.gap_samples == 0
    assert made.survey.damage.tail_bytes > 0
    assert bits(values_of(tmp_path / "cut.h5")).shape == (3 * ROWS, COLUMNS)
