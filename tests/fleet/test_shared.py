"""Several runs on one list: what others have in hand is left to them."""

import threading
import time

import ambid
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
