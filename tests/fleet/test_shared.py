"""Several runs on one list: what others have in hand is left to them; time left of a fleet."""

import random
import threading
import time

import pytest

import ambid
from ambid.fleet import pace
from ambid.fleet.pace import Pace
from ambid.fleet.run import job_of, run_fleet
from ambid.ledger import open_ledger
from ambid.ledger.entry import entry_of, key_of, rig_sha_of, sha_of
from ambid.ledger.leases import Leases
from ambid.ledger.store import Failure
from ambid.rig import default_rig
from tests.fleet.jobs import judge


def test_what_another_run_has_in_hand_is_left_to_it(tmp_path):
    paths = [tmp_path / f"{k}.txt" for k in range(6)]
    for k, path in enumerate(paths):
        path.write_text(str(k))
    rig, said = default_rig(), job_of(judge, {}).said
    shas = [sha_of(path) for path in paths]
    keys = [key_of(sha, rig_sha_of(rig), said) for sha in shas]
    with open_ledger(tmp_path / "l.db") as place:
        other = Leases(place)
        other.take(dict.fromkeys(keys[:3], "x"))

        def work():
            time.sleep(1.0)
            about = {"bearing": "b", "rig_sha": rig_sha_of(rig), "settings": said}
            place.add([entry_of(judge(paths[0], rig), bearing="b", sha=shas[0], rig=rig, settings=said, taken_at=1.0)])
            place.fail([Failure(record="1.txt", sha=shas[1], version=ambid.__version__, reason="no", **about)])
            other.close()  # the third is given back

        thread = threading.Thread(target=work)
        thread.start()
        run = run_fleet([*paths], ledger=tmp_path / "l.db", job=judge, taken_at="file", workers=1)
        thread.join()
        assert [row.state for row in run.rows] == ["known", "failed", "done", "done", "done", "done"]
        assert (run.rows[0].status, run.rows[1].reason) == ("converged", "no")
        with place._reading() as c:
            assert c.exec_driver_sql("SELECT count(*) FROM claim").scalar_one() == 0


@pytest.mark.parametrize("by_size", [0.0, 1e-3])
@pytest.mark.parametrize("order", ["as they come", "small first"])
def test_time_left_is_right_after_a_tenth(monkeypatch, by_size, order):
    """Two workers, 200 records of different lengths, of which a process's first takes 3 s longer."""
    rng = random.Random(1)
    sizes = [rng.choice((100, 1000, 5000)) * rng.uniform(0.8, 1.2) for _ in range(200)]
    sizes = sorted(sizes) if order == "small first" else sizes
    now = 0.0
    monkeypatch.setattr(pace.time, "monotonic", lambda: now)
    over, free_at, answers = Pace(sizes, 2), [1.0, 1.5], []
    for k, size in enumerate(sizes):
        worker = free_at.index(min(free_at))
        seconds = (0.3 + by_size * size) * rng.uniform(0.8, 1.2) + (3.0 if k < 2 else 0.0)
        free_at[worker] += seconds
        answers.append((free_at[worker], size, seconds, k < 2))
    end, told, work = max(free_at), [], 0.0
    for now, size, seconds, first in sorted(answers):
        over.over(size)
        over.take(size, seconds, first=first)
        work += 0.3 + by_size * size
        if work > 0.1 * sum(0.3 + by_size * x for x in sizes) and not told:
            told.append(over.left_s() / (end - now))
            assert over.share() == pytest.approx(now / (now + over.left_s()))
    assert told[0] == pytest.approx(1.0, abs=0.3)
    assert over.left_s() == pytest.approx(0.0, abs=1e-9)
