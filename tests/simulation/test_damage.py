"""Lost samples: of every kind, apart from each other, and read back as gaps."""

from pathlib import Path

import numpy as np
import pytest

from ambid.errors import RecordError
from ambid.physics.presets import preset
from ambid.record import read_record, write_record
from ambid.simulation import Simulation, simulate_scenario
from ambid.simulation.scenarios import damage, losses


@pytest.fixture(scope="module")
def steady() -> Simulation:
    return simulate_scenario("change", preset("rmit-axis"), duration_s=0.2, seed=2, amplitude=10.0)


def test_losses_are_apart_of_every_kind_and_as_many_as_asked() -> None:
    found = losses(200_000, 0.02, 5, first=1000)
    edges = np.array([(x.first, x.stop) for x in found])
    assert edges[0, 0] >= 1000
    assert edges[-1, 1] <= 200_000 - 8
    assert np.all(edges[:, 1] > edges[:, 0])
    assert np.all(edges[1:, 0] > edges[:-1, 1])
    assert {x.kind for x in found} == {"cells", "rows", "skipped"}
    assert (edges[:, 1] - edges[:, 0]).sum() == pytest.approx(0.02 * 199_000, rel=0.15)
    assert losses(200_000, 0.02, 5, first=1000) == found
    assert losses(200_000, 0.02, 6, first=1000) != found


@pytest.mark.parametrize("name", ["lost.csv", "lost.csv.gz"])
def test_what_is_lost_reads_as_gaps_and_the_rest_to_the_last_bit(steady: Simulation, tmp_path: Path, name: str) -> None:
    record = steady.record
    lost = damage(record, tmp_path / name, share=0.05, seed=3, comments=("damaged",))
    with pytest.raises(RecordError, match="missing"):
        read_record(tmp_path / name)
    read = read_record(tmp_path / name, gaps="interpolate")
    assert read.n_samples == record.n_samples
    assert read.names == record.names
    whole = np.ones(record.n_samples, dtype=bool)
    for x in lost:
        whole[x.first : x.stop] = False
    assert 0 < np.count_nonzero(~whole) < 0.08 * record.n_samples
    for channel in record.names:
        assert np.array_equal(read[channel][whole], record[channel][whole])
    assert not np.array_equal(read["position"], record["position"])
    (note,) = [s for s in read.history if s.name == "gaps_interpolated"]
    assert note.settings["longest"] >= max(x.stop - x.first for x in lost if x.kind != "cells")  # type: ignore[operator]


def test_rows_that_are_missing_make_time_jump(steady: Simulation, tmp_path: Path) -> None:
    lost = damage(steady.record, tmp_path / "lost.csv", share=0.05, seed=3)
    rows = (tmp_path / "lost.csv").read_text().splitlines()[1:]
    time = np.array([float(row.split(",")[0]) for row in rows])
    skipped = [x for x in lost if x.kind == "skipped"]
    assert len(rows) == steady.record.n_samples - sum(x.stop - x.first for x in skipped)
    jumps = np.rint(np.diff(time) * 20_000.0).astype(int)
    assert sorted(jumps[jumps > 1]) == sorted(x.stop - x.first + 1 for x in skipped)
    empty = [row for row in rows if ",," in row or row.endswith(",")]
    assert len(empty) == sum(x.stop - x.first for x in lost if x.kind != "skipped")
    assert all(row.split(",")[4] for row in rows)  # the truth is known throughout


def test_damage_leaves_the_record_alone_and_refuses_what_it_cannot_do(steady: Simulation, tmp_path: Path) -> None:
    before = steady.record["position"].values.copy()
    damage(steady.record, tmp_path / "lost.csv", share=0.01, seed=0)
    assert np.array_equal(steady.record["position"], before)
    write_record(steady.record, tmp_path / "whole.csv")
    assert read_record(tmp_path / "whole.csv").n_samples == steady.record.n_samples
    with pytest.raises(RecordError, match="CSV only"):
        damage(steady.record, tmp_path / "lost.h5", share=0.01, seed=0)
    with pytest.raises(RecordError, match="share"):
        losses(1000, 0.9, 0)
    with pytest.raises(RecordError, match="Record for longer"):
        losses(1000, 0.1, 0, first=950)
