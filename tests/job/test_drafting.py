"""Any file of numbers: what `init` drafts of it identifies the same bearing, or one question says what is missing."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from ambid.errors import AmbidError
from ambid.job import drafting, identify, info, simulate
from ambid.job.drafting import draft
from ambid.record import read_record
from ambid.rig import load_rig
from tests.job.foreign_files import FILES, QUESTIONS, signals
from tests.tiers import ALL

SHORT = (
    "de_latin.csv", "short_axis.csv", "es_bare_um_mA.csv", "rigol.csv", "labview_multi.lvm", "bare_order.txt",
    "long.csv", "wide.csv", "ja_jis.csv", "closed_loop.csv", "matrix_names.npz", "dspace_packed.mat", "figure.fig",
    "plain.h5", "two_positions.csv", "wrong_mm.csv", "no_position.csv", "no_rate.dat", "scope_plain_channels.csv",
)  # fmt: skip


@pytest.fixture(scope="module")
def record():
    return signals()


@pytest.fixture(scope="module")
def truth(record):
    columns = {"voltage [V]": record.u, "current [A]": record.i, "position [m]": record.x}
    return {p.name: p for p in identify(columns, rate_hz=record.rate).parameters if p.sd}


@pytest.mark.parametrize("name", FILES if ALL else SHORT)
def test_a_file_ends_in_the_same_parameters_or_in_one_question(tmp_path, record, truth, name):
    if name.endswith(".xlsx"):
        pytest.importorskip("openpyxl", reason="openpyxl, of ambid[formats], is not installed")
    path = tmp_path / name
    FILES[name](path, record)

    def through():
        (tmp_path / "rig.toml").write_text(draft(path).text, encoding="utf-8")
        return identify(path, tmp_path / "rig.toml")

    if name in QUESTIONS:
        with pytest.raises(AmbidError) as asked:
            through()
        assert "\n" not in str(asked.value)
        assert re.search(r"Say which|rate_hz|gain or table", str(asked.value))
        return
    found = {p.name: p for p in through().parameters}
    for key, p in truth.items():
        assert abs(found[key].value - p.value) < 0.2 * p.sd


def test_there_are_files_of_every_form():
    assert len(FILES) - len(QUESTIONS) >= 55


def drafted(tmp_path, record, name, **told):
    FILES[name](tmp_path / name, record)
    (tmp_path / "rig.toml").write_text(draft(tmp_path / name, **told).text, encoding="utf-8")
    return load_rig(tmp_path / "rig.toml")


def test_a_question_is_answered_by_a_column_and_its_unit(tmp_path, record, truth):
    paths = {"time": "rec.X.Data", "voltage": "rec.Y(1).Data [V]", "current": "rec.Y(2).Data [A]"}
    paths |= {"position": "rec.Y(3).Data [mm]"}
    for name, told in (
        ("two_positions.csv", {"columns": {"position": "position 1"}}),
        ("wrong_mm.csv", {"columns": {"position": "position [m]"}}),
        ("scope_plain_channels.csv", {"columns": {"current": "CH2 [A]", "position": "CH3"}}),
        ("dspace.mat", {"columns": paths}),
        ("no_rate.npy", {"rate_hz": record.rate}),
    ):
        rig = drafted(tmp_path, record, name, **told)
        if name == "scope_plain_channels.csv":
            assert [c.column for c in rig.channels] == ["CH1", "CH3", "CH2"]
            continue
        found = {p.name: p.value for p in identify(tmp_path / name, rig, rate_hz=told.get("rate_hz")).parameters}
        assert found["R"] == pytest.approx(truth["R"].value, rel=1e-3)
        assert found["m"] == pytest.approx(truth["m"].value, rel=1e-3)


def test_a_coil_is_taken_where_it_is_asked_for(tmp_path, record):
    assert drafted(tmp_path, record, "no_position.csv", coil=True).model == "coil"


def test_the_rig_says_what_was_taken_as_time_and_in_which_unit(tmp_path, record):
    FILES["short_axis.csv"](tmp_path / "short_axis.csv", record)
    made = draft(tmp_path / "short_axis.csv")
    assert "# Time: 'time_ms', because its name says so, and it rises, in [ms] by its name; 20000 Hz" in made.text
    assert re.search(r'unit   = "um" +# CHECK: its name ends in it', made.text)
    assert made.guess.ranked["voltage"][0].channel.name == "U_A"
    seen = info(tmp_path / "short_axis.csv")
    assert seen.roles["position"][0].startswith("pos_um")
    assert "time: 'time_ms', because its name says so, and it rises, in [ms] by its name" in seen.notes
    assert any("position" in x and "[um]" in x for x in seen.notes)


def test_a_setting_that_names_nothing_is_refused(tmp_path, record):
    for columns, said in (
        ({"position": "nothing"}, r"has no column 'nothing'"),
        ({"positon": "position"}, r"no role 'positon'.*Did you mean 'position'"),
    ):
        with pytest.raises(AmbidError, match=said):
            drafted(tmp_path, record, "en.csv", columns=columns)


def test_text_whose_columns_show_nothing_asks_and_shows_their_ranges(tmp_path):
    random = np.random.default_rng(1)
    rows = np.column_stack([np.arange(400) * 1e-4, random.normal(size=(400, 3))])
    np.savetxt(tmp_path / "noise.txt", rows)
    with pytest.raises(
        AmbidError,
        match=r"no column looks like the voltage or the current or the position; there are column 2 \[\?\] -",
    ):
        draft(tmp_path / "noise.txt")


def test_where_neither_names_nor_the_record_show_roles_none_is_put_into_the_question(tmp_path, record, monkeypatch):
    monkeypatch.setattr(drafting, "_trial", lambda *_: None)
    np.savetxt(tmp_path / "bare.txt", np.column_stack([record.t, record.x, record.i, record.u]))
    with pytest.raises(
        AmbidError, match=r"which column is what; there are column 2 -.*column 4 .*'position': 'NAME \[m\]'"
    ):
        draft(tmp_path / "bare.txt")


@pytest.mark.parametrize("name", ["volt\x07age", "v" * 300])
def test_a_name_that_no_rig_can_hold_is_refused(tmp_path, name):
    path = tmp_path / "r.csv"
    path.write_text(f"time [s],{name} [V],i [A]\n" + "".join(f"{k / 1000},{k},{-k}\n" for k in range(99)))
    with pytest.raises(AmbidError, match="no rig can name it"):
        draft(path, coil=True)


@pytest.mark.parametrize("name", ["a\nmodel = 3 #.csv", "a\x1b[31m.csv", "a\udcff.csv"])
def test_the_name_of_a_file_does_not_write_the_rig(tmp_path, record, name):
    FILES["closed_loop.csv"](tmp_path / "plain.csv", record)
    (tmp_path / "plain.csv").rename(tmp_path / name)
    (tmp_path / "rig.toml").write_text(draft(tmp_path / name).text, encoding="utf-8")
    assert load_rig(tmp_path / "rig.toml").plant.name == "one-axis"


def test_counts_without_a_unit_are_not_taken_for_one(tmp_path, record):
    x = {"voltage": record.u * 100, "current": record.i * 1e4, "position": record.x * 1e8}
    np.savez(tmp_path / "r.npz", fs=record.rate, **{k: np.rint(v).astype("i4") for k, v in x.items()})
    with pytest.raises(AmbidError, match="'voltage' has no unit and holds whole numbers, which may be counts"):
        draft(tmp_path / "r.npz")


def test_a_hidden_sheet_is_not_read_before_one_that_is_shown(tmp_path):
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl, of ambid[formats], is not installed")
    book = openpyxl.Workbook()
    hidden = book.create_sheet("old")
    hidden.sheet_state = "hidden"
    for sheet, rows in ((book.active, 20), (hidden, 40)):
        sheet.append(["time [s]", "voltage [V]"])
        for k in range(rows):
            sheet.append([k / 100, k])
    book.save(tmp_path / "r.xlsx")
    assert read_record(tmp_path / "r.xlsx").n_samples == 20
    assert read_record(tmp_path / "r.xlsx", layout={"sheet": "old"}).n_samples == 40


@pytest.fixture(scope="module")
def open_loop():
    """A rotor whose current looks as much like a position to the coil's equation as its position does."""
    found = simulate("thesis", duration=0.5, seed=3)
    return SimpleNamespace(
        t=np.arange(found.n_samples) / found.rate_hz,
        **{key: found[role].values for key, role in (("u", "voltage"), ("i", "current"), ("x", "position"))},
    )


@pytest.mark.parametrize("order", ["uix", "xiu", "iux"])
def test_columns_without_a_header_are_told_in_any_order(tmp_path, open_loop, order):
    np.savetxt(tmp_path / "bare.txt", np.column_stack([open_loop.t, *(getattr(open_loop, key) for key in order)]))
    ranked = draft(tmp_path / "bare.txt").guess.ranked
    for key, role in (("u", "voltage"), ("i", "current"), ("x", "position")):
        assert ranked[role][0].channel.name == f"column {order.index(key) + 2}"


def table(path, s, columns, names="voltage [V],current [A],position [m]"):
    np.savetxt(path, np.column_stack([s.t, *columns]), delimiter=",", header=f"time [s],{names}", comments="")


def test_swapped_columns_are_told_and_the_answer_is_taken(tmp_path, record, open_loop):
    for s in (record, open_loop):
        table(tmp_path / "s.csv", s, (s.u, s.x, s.i))
        with pytest.raises(AmbidError, match="look swapped: 'position' is what the voltage drives") as asked:
            draft(tmp_path / "s.csv")
        assert "\n" not in str(asked.value)
        assert draft(tmp_path / "s.csv", columns={"current": "current"}, first=True)
        table(tmp_path / "right.csv", s, (s.u, s.i, s.x))
        assert draft(tmp_path / "right.csv").guess.question == ""
    made = draft(tmp_path / "s.csv", columns={"current": "position [A]", "position": "current [m]"})
    (tmp_path / "rig.toml").write_text(made.text, encoding="utf-8")
    one, two = identify(tmp_path / "s.csv", tmp_path / "rig.toml"), identify(tmp_path / "right.csv")
    assert one["k_i"].value == pytest.approx(two["k_i"].value, rel=1e-6)


def test_a_unit_of_time_with_which_no_bearing_has_such_sizes_is_asked_about(tmp_path, record):
    path = tmp_path / "s.csv"
    head = "time [ms],voltage [V],current [A],position [m]"
    np.savetxt(path, np.column_stack([record.t, record.u, record.i, record.x]), delimiter=",", header=head, comments="")
    with pytest.raises(AmbidError, match=r"typical if time is a thousand times too small .* Say what is right: layout"):
        draft(path)
    assert draft(path, layout={"time_unit": "s"}).record.rate_hz == pytest.approx(record.rate)
    assert draft(path, layout={"time_unit": "ms"}).record.rate_hz == pytest.approx(1e3 * record.rate)


def test_a_position_that_never_changes_is_told_to_make_a_coil(tmp_path, record):
    table(tmp_path / "held.csv", record, (record.u, record.i, np.full_like(record.x, 1e-4)))
    made = draft(tmp_path / "held.csv")
    assert 'model  = "coil"' in made.text
    assert any("model: a coil, because the position does not move" in note for note in made.guess.notes)


def test_columns_that_nothing_tells_are_asked_for_without_a_trial(tmp_path, record, monkeypatch):
    def trial(*_):
        raise AssertionError("a trial fit")

    monkeypatch.setattr(drafting, "_trial", trial)
    monkeypatch.setattr(drafting, "bearing_of", lambda *_: 0.4)
    np.savetxt(tmp_path / "bare.txt", np.column_stack([record.t, record.x, record.i, record.u]))
    with pytest.raises(AmbidError, match="which column is what"):
        draft(tmp_path / "bare.txt")
