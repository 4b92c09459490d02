"""Texts that people read keep to the glossary: none of its words to avoid, counts with their plural, p as a bound."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from ambid.errors import counted
from ambid.estimation.uncertainty import p_text
from tests.conventions.sources import ROOT, package_files, parsed, shown

GLOSSARY = ROOT / "docs" / "glossary.md"
PAGES = [ROOT / "README.md", *sorted(path for path in (ROOT / "docs").rglob("*.md") if path != GLOSSARY)]
SHOWN_AS_PROBABILITY = re.compile(r"\bp = $")


@cache
def words_to_avoid() -> list[str]:
    table = GLOSSARY.read_text(encoding="utf-8").partition("## Words to avoid")[2]
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \|$", table, re.MULTILINE)
    return [word.strip().lower() for row in rows[1:] for word in row.split(";")]


def texts(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and text of every literal, docstrings too, ``{}`` for what an f-string fills in."""
    inner = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = (str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
            yield node.lineno, "".join(parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inner:
            yield node.lineno, node.value


def objections(text: str) -> list[str]:
    return re.findall("|".join(map(re.escape, words_to_avoid())), " ".join(text.split()).lower())


def test_the_glossary_names_words_to_avoid():
    words = words_to_avoid()
    assert {"motional voltage", "not shown", "stands feedback"} <= set(words)
    assert all(len(word) > 4 for word in words), words
    assert objections("the Motional\n    voltage") == ["motional voltage"]
    assert objections("the back-EMF") == []


@pytest.mark.parametrize("path", package_files(), ids=shown)
def test_literals_and_docstrings_avoid_them(path: Path):
    found = [f"line {line}: {word!r}" for line, text in texts(parsed(path)) for word in objections(text)]
    assert not found, f"{shown(path)}: {'; '.join(found)}; docs/glossary.md says what to write instead"


@pytest.mark.parametrize("path", PAGES, ids=shown)
def test_pages_avoid_them(path: Path):
    lines = enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
    found = [f"line {k}: {word!r}" for k, line in lines for word in objections(line)]
    assert not found, f"{shown(path)}: {'; '.join(found)}; docs/glossary.md says what to write instead"


def test_probabilities_are_printed_in_one_way():
    assert p_text(0.0) == "p < 1e-16"
    assert p_text(0.0123) == "p = 0.012"
    for path in package_files():
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.JoinedStr):
                before = [str(part.value) for part in node.values[:-1] if isinstance(part, ast.Constant)]
                wrong = any(SHOWN_AS_PROBABILITY.search(text) for text in before)
                assert not wrong or path.name in ("uncertainty.py", "response.py"), (
                    f"{shown(path)}:{node.lineno}: p_text"
                )


@pytest.mark.parametrize(
    ("number", "text"),
    [(0, "0 samples"), (1, "1 sample"), (2, "2 samples"), (1.0, "1 sample"), (3.25, "3.25 samples"), ("1", "1 sample")],
)
def test_counts_have_their_plural(number, text):
    assert counted(number, "sample") == text
