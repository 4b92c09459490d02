"""``ambid export``: what is written, what is refused, and what stays."""

import json

import pytest
from scipy.io import loadmat


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a good record and its estimate, and a record that shows nothing."""
    from ambid.cli import run

    folder = tmp_path_factory.mktemp("made")
    for words in (
        ("simulate", "unstable-bearing", "--duration", "0.3", "-o", folder / "r.csv"),
        ("simulate", "unstable-bearing", "--duration", "0.02", "--amplitude", "1e-4", "-o", folder / "weak.csv"),
        ("identify", folder / "r.csv", "--json", folder / "e.json"),
        ("identify", folder / "weak.csv", "--json", folder / "weak.json"),
    ):
        assert run([str(word) for word in words]) == 0
    return folder


def test_an_export_is_replaced_by_the_next(made, ambid, monkeypatch):
    monkeypatch.chdir(made)
    done = ambid("export", "e.json", "-o", "again.mat")
    assert (done.code, done.out, done.err) == (0, "again.mat: matrices for MATLAB\n", "")
    assert ambid("export", "e.json", "-o", "again.mat").err == "again.mat is replaced\n"


def test_what_a_record_does_not_show_is_not_exported(made, ambid, monkeypatch):
    monkeypatch.chdir(made)
    done = ambid("export", "weak.json", "-o", "weak.c")
    assert done.code == 2
    assert len(done.err.splitlines()) == 1
    assert "its plant is not exported" in done.err
    assert "now 'ambid export" in ambid("identify", "weak.csv", "--export", "weak.c").err
    assert json.loads((made / "weak.json").read_text())["verdict"]["word"] != "usable"
    assert not list(made.glob("*weak.c"))
    assert ambid("export", "weak.json", "-o", "weak.mat").code == 2
    assert ambid("export", "weak.json", "-o", "weak.mat", "--anyway").code == 0
    assert "NOT TO BE RELIED ON" in str(loadmat(made / "weak.mat")["about"])


@pytest.mark.parametrize(("rows", "said"), [(0, "does not follow from the parameters"), (1, "m = -")])
def test_an_estimate_that_was_edited_is_refused_in_one_line(made, ambid, monkeypatch, rows, said):
    monkeypatch.chdir(made)
    document = json.loads((made / "e.json").read_text())
    document["parameters"]["m"]["value"] *= -1.0
    if rows:  # the equation of motion too
        document["continuous"]["A"][1] = [-x for x in document["continuous"]["A"][1]]
    (made / "edited.json").write_text(json.dumps(document))
    for ending in ("c", "mat", "fmu", "py"):
        done = ambid("export", "edited.json", "-o", f"edited.{ending}")
        assert (done.code, done.out, len(done.err.splitlines())) == (2, "", 1)
        assert said in done.err
    assert not list(made.glob("edited.[!j]*"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("r.csv", "-o", "a.c"), "not JSON"),
        (("nothing.json", "-o", "a.c"), "does not exist"),
        (("e.json", "-o", "a.slx"), "must end in .mat"),
        (("e.json", "-o", "e.json"), "must end in .mat"),
        (("e.json", "-o", "a.mat", "--library", "control"), "is for scripts"),
        (("e.json", "-o", "a.py", "--library", "ross"), "holds a rotor"),
        (("e.json", "-o", "no/a.c"), "there is no folder"),
        (("e.json", "-o", "."), "is a folder"),
        (("e.json", "-o", "mine.py"), "exists, and is not a result of ambid"),
        (("r.json", "-o", "a.c"), "holds no linear plant"),
    ],
)  # fmt: skip
def test_what_cannot_be_exported_is_refused_in_one_line(made, ambid, monkeypatch, words, said):
    monkeypatch.chdir(made)
    (made / "mine.py").write_text('"""Mine."""')
    assert said != "holds no linear plant" or ambid("info", "r.csv", "--json", "r.json").code == 0
    done = ambid("export", *words)
    assert (done.code, done.out, len(done.err.splitlines())) == (2, "", 1)
    assert said in done.err
    assert not list(made.glob("a.*"))
    assert (made / "mine.py").read_text() == '"""Mine."""'
