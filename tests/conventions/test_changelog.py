"""CHANGELOG.md is made from changes/, and is up to date."""

import pytest

from tests.conventions.sources import ROOT
from tools.changelog import changelog


def test_the_changelog_is_up_to_date():
    written = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert written == changelog(ROOT / "changes"), "run `make changelog`"


def test_notes_are_grouped_by_version_and_kind(tmp_path):
    for name, text in {
        "README.md": "how",
        "0002-b.md": "kind: fixed\nB.\n",
        "0001-a.md": "kind: fixed\nA,\non two lines.\n",
        "0003-c.md": "kind: added\nC.\n",
        "0.9.0/0001-x.md": "kind: added\nX.\n",
        "0.10.0/0001-y.md": "kind: changed\nY.\n",
    }.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    lines = [line for line in changelog(tmp_path).splitlines() if line.startswith(("#", "-"))]
    assert lines == [
        "# Changelog",
        *("## Unreleased", "### Added", "- C.", "### Fixed", "- A, on two lines.", "- B."),
        *("## 0.10.0", "### Changed", "- Y."),
        *("## 0.9.0", "### Added", "- X."),
    ]


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("0001-a.md", "Something is new.\n", "its first line is"),
        ("0001-a.md", "kind: new\nSomething.\n", "one of added, changed, fixed, removed"),
        ("0001-a.md", "kind: added\n\n", "nothing follows"),
        ("next/0001-a.md", "kind: added\nA.\n", "is no version"),
    ],
)
def test_a_wrong_note_is_refused(tmp_path, name, text, complaint):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=complaint):
        changelog(tmp_path)
