"""A job on many records: which rig belongs to which, what a ledger knows, what is refused before anything runs."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest

import ambid
from ambid.errors import AmbidError, CircumstanceError
from ambid.fleet.run import job_of, run_fleet
from ambid.fleet.sources import fit_for_ledger, items
from ambid.ledger import open_ledger
from ambid.rig import default_rig, write_rig
from ambid.rig.draft import rig_of_preset
from tests.fleet.jobs import count, judge


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """40 records, of which one kills, one hangs, one is refused; one holds what another one holds."""
    made = tmp_path_factory.mktemp("fleet")
    words = {5: "4", 7: "kill", 21: "hang", 33: "nothing"}
    for k in range(40):
        place = made / "records" / "ab"[k % 2]
        place.mkdir(parents=True, exist_ok=True)
        (place / f"2026-03-01T{k // 2:02}.txt").write_text(words.get(k, str(k)))
    write_rig(default_rig(), made / "a.toml")
    write_rig(default_rig(), made / "b.toml")
    write_rig(replace(default_rig(), name=" "), made / "unnamed.toml")
    return made


@pytest.fixture(scope="module")
def runs(folder):
    """Run it twice, then failed ones again."""
    where = {"ledger": folder / "f.db", "job": judge, "workers": 2, "limit_s": 0.7}
    records, rigs = f"{folder}/records/{{bearing}}/{{taken_at}}.txt", f"{folder}/{{bearing}}.toml"
    first, second = (run_fleet([records], rigs, **where) for _ in range(2))
    (folder / "records/b/2026-03-01T16.txt").write_text("33")
    return first, second, run_fleet([records], rigs, **where, again=True)


def of(run, state):
    return {r.record.rpartition("records/")[2]: r for r in run.rows if r.state == state}


def test_all_but_the_poison_are_done_and_stored(runs, folder):
    first = runs[0]
    assert first.counts == {"done": 36, "failed": 3, "known": 1, "left": 0}
    assert [r.record for r in first.rows] == sorted(r.record for r in first.rows)
    row = of(first, "done")["a/2026-03-01T02.txt"]
    assert (row.values["m"], row.bearing, row.taken_at) == ((4.0, 0.1), "a", 1772330400.0)
    assert of(first, "done")["a/2026-03-01T16.txt"].values["m"] == (None, None)  # 32: not shown by the record
    same, as_it = (of(first, state)[f"{at}/2026-03-01T02.txt"] for state, at in (("known", "b"), ("done", "a")))
    assert (same.values, same.verdict) == (as_it.values, as_it.verdict)
    with open_ledger(folder / "f.db", write=False) as ledger:
        assert [(b.name, b.estimates) for b in ledger.bearings()] == [("a", 20), ("b", 17)]


def test_failures_have_their_reasons(runs):
    found = {names[0].rpartition("records/")[2]: reason for reason, names in runs[0].failures.items()}
    assert found == {
        "b/2026-03-01T03.txt": "killed its worker by signal 9, twice when run alone",
        "b/2026-03-01T10.txt": "took longer than the limit of 0.7 s",
        "b/2026-03-01T16.txt": "record … holds 'nothing', and no number. Correct it",
    }
    assert runs[0].verdict.word == "caution"
    assert "3 of 40 records failed" in runs[0].summary()


def test_what_is_done_is_not_done_again(runs):
    assert runs[1].counts == {"done": 0, "failed": 3, "known": 37, "left": 0}
    assert runs[1].failures == runs[0].failures


def test_what_the_ledger_knows_stands_in_the_table_again(tmp_path):
    records = []
    for k in (1, 2):
        ambid.write_record(ambid.simulate("thesis", duration=0.05, seed=k), tmp_path / f"{k}.h5")
        records.append(tmp_path / f"{k}.h5")
    where = {"ledger": tmp_path / "l.db", "taken_at": "file", "workers": 1}
    first, again = (ambid.fleet(records, **where) for _ in range(2))
    assert again["state"].tolist() == ["known", "known"]
    same = ["verdict", "checks", "k_i", "k_i sd", "R"]
    assert again[same].equals(first[same])


def test_margins_of_many_records_are_kept_over_time(tmp_path):
    rig = rig_of_preset(ambid.preset("rmit-axis"))
    ambid.write_record(ambid.simulate(rig, duration=0.5, seed=1), tmp_path / "1.h5")
    where = {"job": "margins", "ledger": tmp_path / "l.db", "taken_at": "file", "workers": 1}
    table = ambid.fleet(tmp_path / "1.h5", replace(rig, name="A"), **where)
    with open_ledger(tmp_path / "l.db", write=False) as ledger:
        peak = ledger.history("A")["x.sensitivity"]
    assert (peak.unit, peak.value[0]) == ("dB", table["x.sensitivity"].iloc[0])
    assert 6.0 < peak.value[0] < 7.5


def test_failed_ones_are_done_again_where_that_is_wished(runs):
    assert runs[2].counts == {"done": 1, "failed": 2, "known": 37, "left": 0}


def test_a_run_is_read_back_and_shown(runs, tmp_path):
    runs[0].save(tmp_path / "f.json")
    back = ambid.load(tmp_path / "f.json")
    assert back.rows == runs[0].rows
    assert back.to_dataframe()["m"].count() == 28  # 30 and more are not shown by their records
    runs[0].plot().savefig(tmp_path / "f.png")


def test_other_settings_are_another_result(folder, runs):
    """The ledger's key holds the settings."""
    again = run_fleet([f"{folder}/records/a/*T0[0-4].txt"], job=judge, settings={"add": 0.5}, ledger=folder / "f.db",
                      taken_at="file", workers=1)  # fmt: skip
    assert [r.values["m"][0] for r in again.rows] == [0.5, 2.5, 4.5, 6.5, 8.5]


def test_another_function_of_the_same_name_is_another_job(monkeypatch):
    first = job_of(judge, {}).said
    assert job_of(judge, {}).said == first
    monkeypatch.setattr("inspect.getsource", lambda _: "def judge(record, rig): ...")
    assert job_of(judge, {}).said != first


def test_a_cluster_gives_the_same_to_the_last_digit():
    pytest.importorskip("distributed", reason="Dask's distributed is not installed")
    records = [ambid.simulate("thesis", duration=0.05, seed=k) for k in (1, 2)]
    table, here = ambid.fleet(records, scheduler="local:1"), ambid.fleet(records, workers=1)
    assert table["state"].tolist() == ["done", "done"]
    assert table[["k_i", "k_i sd", "R", "verdict"]].equals(here[["k_i", "k_i sd", "R", "verdict"]])


@pytest.mark.parametrize("scheduler", ["local", "local:", "local:0", "local:x", "local:1025"])
def test_a_cluster_of_no_number_is_refused(scheduler):
    with pytest.raises(AmbidError, match="local:N has a number of workers, 1 to 1024"):
        ambid.fleet([], scheduler=scheduler)


def test_records_in_memory_give_a_table():
    table = ambid.fleet([ambid.simulate("thesis", duration=0.01, seed=k) for k in range(2)], job=count, workers=1)
    assert table["n"].tolist() == [3.0, 3.0]
    assert table.index.tolist() == ["record 1", "record 2"]


def test_it_ends_when_it_is_told_to_and_goes_on_later(folder):
    where = {"ledger": folder / "g.db", "job": judge, "workers": 1, "taken_at": "file"}
    told = []

    def tick(stage, done=None, /):
        told.append((stage, done))

    some = [f"{folder}/records/a/*.txt"]
    first = run_fleet(some, **where, stopped=lambda: len(told) > 4, tick=tick)
    assert 4 < first.counts["done"] < 20
    assert first.verdict.reasons[-1].check == "interrupted"
    assert "records/s" in told[0][0]
    second = run_fleet(some, **where)
    assert (second.counts["known"], second.counts["done"]) == (first.counts["done"], 20 - first.counts["done"])


# --- which rig ------------------------------------------------------------------------------------------------------


def test_a_table_says_rig_bearing_and_time(folder):
    (folder / "map.csv").write_text("pattern,rig,bearing,taken_at\na/{taken_at}.txt,a.toml,left,\n"
                                    "b/*.txt,b.toml,right,2026-04-01\n")  # fmt: skip
    found = items([f"{folder}/records/*/*T05.txt"], folder / "map.csv")
    assert [(i.bearing, i.rig.source.name, i.taken_at) for i in found] == [
        ("left", "a.toml", 1772341200.0), ("right", "b.toml", 1775001600.0),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ("pattern,rig\na/*.txt,a.toml\n", "b/2026-03-01T05.txt matches no pattern of"),
        ("pattern,rig\n*/*.txt,a.toml\nb/*.txt,b.toml\n", "matches several patterns of"),
        ("pattern,rig,serial\n*,a.toml,7\n", "has the columns pattern, rig, serial"),
        ("pattern,rig\n*.txt,\n", "row 2: a cell is missing"),
        ("pattern,rig\n*.txt,{name}.toml\n", r"\{name\}"),
        ("pattern,rig\n*.txt,c.toml\n", "c.toml"),
    ],
)
def test_a_table_that_leaves_something_open_is_refused(folder, tmp_path, table, why):
    for name in "ab":
        write_rig(default_rig(), tmp_path / f"{name}.toml")
    (tmp_path / "map.csv").write_text(table)
    with pytest.raises(AmbidError, match=why):
        items([f"{folder}/records/*/*T05.txt"], tmp_path / "map.csv")


@pytest.mark.parametrize(
    ("records", "more", "why"),
    [
        (["no/*.h5"], {}, "no record matches"),
        (["{folder}/records/a/*.txt"], {"rigs": "{{name}}.toml"}, "records' pattern has not"),
        (["{folder}/a.toml"], {"rigs": ["a.toml", "b.toml"]}, "2 rigs for 1 record"),
        (["{folder}/records/{{taken_at}}/*T05.txt"], {}, "taken_at of .* is 'a'"),
        ([], {"job": "identfy"}, "Did you mean 'identify'"),
        ([], {"settings": {"form_s": 1}}, "Did you mean 'from_s'"),
        ([], {"job": "fit"}, "fit needs structure"),
        ([], {"settings": {"from_s": "x"}}, "from_s is 'x'; it must be a number"),
        ([], {"settings": {"gaps": "none"}}, "it must be one of error"),
        ([], {"settings": {"validate": "no.h5"}}, "validate no.h5 does not exist"),
        ([], {"job": "fit", "settings": {"structure": "arx", "orders": "zz"}}, "'zz' is not NAME=NUMBER"),
        ([], {"job": "fit", "settings": {"structure": "arxx"}}, "structure 'arxx' is unknown"),
        (["{folder}/a.toml", "{folder}/b.toml"], {"ledger": "{folder}/no.db"}, "2 of 2 records, the first "),
        (["{folder}/a.toml"], {"ledger": "{folder}/no.db", "rigs": "{folder}/unnamed.toml"}, "bearing has no name"),
        ([], {"limit_s": math.nan}, "limit_s is nan"),
        ([], {"workers": 0}, "workers is 0"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_does(folder, records, more, why):
    given = [r.format(folder=folder) for r in records]
    with pytest.raises(AmbidError, match=why):
        run_fleet(given, **{k: v.format(folder=folder) if isinstance(v, str) else v for k, v in more.items()})
    assert not (folder / "no.db").exists()


def test_what_says_nothing_of_a_record_is_not_remembered(tmp_path):
    """A time that is lacking fails a job of one's own when it is done; with it the record is done again."""
    (tmp_path / "1.txt").write_text("1")
    where = {"ledger": tmp_path / "l.db", "job": judge, "workers": 1}
    first = run_fleet([tmp_path / "1.txt"], **where)
    assert "does not say when it was taken" in first.rows[0].reason
    assert run_fleet([tmp_path / "1.txt"], **where, taken_at="file").counts["done"] == 1


def test_a_record_that_is_gone_when_its_turn_comes_is_not_remembered(tmp_path):
    path = tmp_path / "1.txt"
    path.write_text("1")
    (item,) = items([path], None, "file")
    path.unlink()
    with pytest.raises(CircumstanceError, match=r"1.txt is gone since the fleet began"):
        job_of(judge, {}, stored=True)(SimpleNamespace(item=item))


def test_the_time_in_a_record_counts(tmp_path):
    said = replace(ambid.simulate("thesis", duration=0.01, seed=1), provenance={"started": "2026-03-01T06:00"})
    ambid.write_record(said, tmp_path / "1.h5")
    ambid.write_record(replace(said, provenance={}), tmp_path / "2.h5")
    (tmp_path / "3.h5").write_text("damaged")
    first, damaged = fit_for_ledger(items([tmp_path / "1.h5", tmp_path / "3.h5"], None), strict=True)
    assert (first.taken_at, damaged.taken_at) == (1772344800.0, None)
    with pytest.raises(AmbidError, match=r"1 of 2 records, the first .*2.h5, do not say when taken"):
        fit_for_ledger(items([tmp_path / "1.h5", tmp_path / "2.h5"], None), strict=True)


def test_urls_are_fetched(folder, tmp_path):
    import fsspec

    found = items([f"file://{folder}/records/{{bearing}}/*T05.txt"], None)
    assert [i.bearing for i in found] == ["a", "b"]
    with found[0].here(found[0].digest()) as path:
        assert path.read_text() == "10"
    assert not path.exists()
    assert found[0].when() is None  # nobody says it, and the file's time is never taken unasked
    assert items([f"file://{folder}/records/a/*T05.txt"], None, "file")[0].when() > 1.7e9
    with pytest.raises(AmbidError, match="changed while the fleet ran"), found[0].here("0"):
        pass
    ambid.write_record(ambid.simulate("thesis", duration=0.01), tmp_path / "r.h5")
    fsspec.filesystem("memory").pipe("/many/r.h5", (tmp_path / "r.h5").read_bytes())
    assert items("memory://many/*.h5", None)[0].source.n_samples == 100
    with pytest.raises(AmbidError, match="cannot be reached"):
        items("nowhere://x/*.h5", None)
