"""Dialects of CSV: preambles, units below or behind names, decimal commas, thousands separators; taken where the file
leaves no other, else the layout's word is asked for. What was understood goes into the record's history.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ambid.errors import RecordError, UnitError
from ambid.record.record import utf8_text
from ambid.settings.caller import setting
from ambid.units import parse_unit

_WORDS = {
    "decimal": {",": ",", "comma": ",", ".": ".", "point": "."},
    "separator": {",": ",", "comma": ",", ";": ";", "semicolon": ";", "\t": "\t", "tab": "\t"},
    "thousands": {",": ",", "comma": ",", ".": ".", "point": ".", " ": " ", "space": " ", "'": "'", "apostrophe": "'"},
    "units": {x: x for x in ("row", "parentheses", "brackets", "none")},
    "encoding": {x: x for x in ("utf-8", "utf-16", "utf-16-le", "utf-16-be", "latin-1", "cp1252")},
}
_MARKS = str.maketrans("\u2019\u00a0\u202f", "'  ")
_POWER = r"(?:[eE][+-]?\d+)?"
_DECIMAL = re.compile(rf"[+-]?(?:[1-9]\d{{0,2}}(?:[.' ]\d{{3}})+|\d*),\d*{_POWER}")
_THOUSANDS = re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:,\d{{3}})+(?:\.\d*)?{_POWER}")
_NUMBER = re.compile(rf"[+-]?(?:\d{{1,3}}(?:[.,' ]\d{{3}})+|\d*)(?:[.,]\d*)?{_POWER}")
_PARENTHESES = re.compile(r"(?P<name>.*\S)\s*\((?P<unit>[^()]*)\)")
_SPACED = re.compile("\\d([' \u00a0\u202f\u2019])\\d")
_FEW = 8  # rows of numbers below a header, without which a text is no table


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """A text in another dialect, and what it reads in the usual one."""

    row: int  # line of the header row, counted from 1; rows of numbers begin below
    delimiter: str
    cells: tuple[str, ...]  # of the header row
    units: tuple[str | None, ...] | None  # where they are not behind the names in brackets
    comments: tuple[str, ...]
    lines: list[str]  # of the whole file; numbers with a decimal point
    settings: Mapping[str, object]  # what was understood


def decoded(data: bytes, path: Path, layout: Mapping[str, str]) -> tuple[str, str]:
    """Return the text and its encoding: the one that is told, UTF-16 by its mark, else UTF-8."""
    encoding = words_of(layout, path).get("encoding", "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8")
    if encoding == "utf-8":
        return utf8_text(data, path), encoding
    try:
        return utf8_text(data.decode(encoding).encode(), path), encoding
    except UnicodeDecodeError:
        raise RecordError(f"record {path} is no text in {encoding}. Correct layout encoding") from None


def words_of(layout: Mapping[str, str], path: Path) -> dict[str, str]:
    """Return a layout in signs: ``comma`` is ``,`` and so on."""
    words = {}
    for word, value in layout.items():
        if value.lower() not in _WORDS[word]:
            raise RecordError(f"{path}: layout {word}={value!r}; it is one of {', '.join(_WORDS[word])}. Correct it")
        words[word] = _WORDS[word][value.lower()]
    if words.get("decimal", "") == words.get("separator", "."):
        raise RecordError(f"{path}: comma cannot be both decimal and separator. Correct the layout")
    return words


def recognised(lines: list[str], path: Path, layout: Mapping[str, str]) -> Dialect | None:
    """Recognise a dialect; None where the text is usual, or no table. Raises where it could be read in two ways."""
    words = words_of(layout, path)
    begin = next((k for k, line in enumerate(lines) if line.strip() and not line.startswith("#")), None)
    table = None if begin is None else _table(lines, begin, words.get("separator"))
    if begin is None or table is None:
        return None
    at, delimiter, n = table
    above = [k for k in range(begin, at) if lines[k].strip() and not lines[k].startswith("#")]
    heads = [_cells(lines[k], delimiter) for k in above]
    if not heads or not _is_header(heads[-1], n):
        return None
    header, units = _names_and_units(heads, above, n, path, words.get("units"))
    cells = heads[above.index(header)]
    settings: dict[str, object] = {}
    if units is not None:
        settings["units"] = "row"
    elif (parsed := _in_parentheses(cells, header, path, words.get("units"))) is not None:
        cells, units = parsed
        settings["units"] = "parentheses"
    if header != begin:
        settings["preamble"] = above.index(header)
    body, marks = _plain_numbers(lines, at, delimiter, path, words)
    settings |= marks
    if not (settings or words):
        return None
    comments = [x.lstrip("#").strip() for k, x in enumerate(lines[:at]) if x.strip() and k not in (header, above[-1])]
    return Dialect(
        row=at, delimiter=delimiter, cells=tuple(cells), units=None if units is None else tuple(units),
        comments=tuple(comments), lines=body, settings=settings,
    )  # fmt: skip


def _cells(line: str, delimiter: str) -> list[str]:
    """Take a row apart; a delimiter within quotes is none."""
    parts = next(csv.reader([line], delimiter=delimiter), [""]) if '"' in line else line.split(delimiter)
    return [x.strip() for x in parts]


def _is_number(cell: str) -> bool:
    text = cell.translate(_MARKS)
    return any(map(str.isdigit, text)) and _NUMBER.fullmatch(text) is not None


def _is_header(cells: Sequence[str], n: int) -> bool:
    texts = len(cells) == n and all(x and not _is_number(x) for x in cells)
    return texts and len(set(cells)) == n


def _table(lines: Sequence[str], begin: int, word: str | None) -> tuple[int, str, int] | None:
    """Find the first rows of numbers of one width: their place, delimiter and width."""
    for k in range(begin + 1, min(len(lines), begin + 1000)):
        for delimiter in (word,) if word else ("\t", ";", ","):
            cells = _cells(lines[k], delimiter)
            if (len(cells) > 1 or word) and all(map(_is_number, cells)):
                rows = [_cells(line, delimiter) for line in lines[k : k + _FEW]]
                if len(rows) == _FEW and all(len(row) == len(cells) and any(map(_is_number, row)) for row in rows):
                    return k, delimiter, len(cells)
    return None


def _names_and_units(
    heads: Sequence[list[str]], above: Sequence[int], n: int, path: Path, word: str | None
) -> tuple[int, list[str | None] | None]:
    """Return the line of the names, counted from 0, and the units of a row below them."""
    texts = [x.strip("[]()") for x in heads[-1]]
    doubtful = len(heads) > 1 and _is_header(heads[-2], n)
    if word == "row":
        if not doubtful:
            raise RecordError(f"{path}, row {above[-1] + 1}: no names stand above these units. Correct the layout")
        return above[-2], list(texts)
    if doubtful and word is None:
        if all(map(_is_unit, texts)) and not any("[" in x for x in heads[-2]):
            return above[-2], list(texts)
        raise RecordError(
            f"{path}: rows {above[-2] + 1} and {above[-1] + 1} may both hold the names. Say whether the second holds "
            f"units: {setting('layout', 'units=row')}, or {setting('layout', 'units=none')}"
        )
    return above[-1], None


def _is_unit(text: str) -> bool:
    """Whether a text is a known unit and no number."""
    try:
        parse_unit(text)
    except UnitError:
        return False
    return not text.isdigit()


def _in_parentheses(
    cells: Sequence[str], header: int, path: Path, word: str | None
) -> tuple[list[str], list[str | None]] | None:
    """Return names and units of ``name (unit)``; None where no unit is written so."""
    matches = [None if "[" in x else _PARENTHESES.fullmatch(x.strip('"')) for x in cells]
    units = [None if x is None else x["unit"].strip() for x in matches]
    recognised = [_is_unit(x) for x in units if x is not None]
    if word not in (None, "parentheses") or not any(recognised) or (word is None and any("[" in x for x in cells)):
        return None
    if word is None and not all(recognised):
        doubtful = next(x for x in units if x is not None and not _is_unit(x))
        raise RecordError(
            f"{path}, row {header + 1}: ({doubtful}) is no known unit, others in parentheses are. Say whether "
            f"they are units: {setting('layout', 'units=parentheses')}, or {setting('layout', 'units=none')}"
        )
    return [x if m is None else m["name"] for x, m in zip(cells, matches, strict=True)], units


def _plain_numbers(
    lines: list[str], at: int, delimiter: str, path: Path, word: Mapping[str, str]
) -> tuple[list[str], dict[str, object]]:
    """Return the lines with numbers in the usual form, and the marks that were found in them."""
    quoted = any('"' in line for line in lines[at:])
    spaced = next((match[1] for line in lines[at:] if (match := _SPACED.search(line))), None)
    if delimiter == "," and not (quoted or spaced or "thousands" in word):
        return lines, {"delimiter": delimiter} if "separator" in word else {}
    decimal, thousands = _marks(lines, at, delimiter, path, word)
    marks: dict[str, object] = {"delimiter": delimiter} if delimiter != "," else {}
    marks |= {"decimal": decimal} if decimal == "," else {}
    marks |= {"thousands": thousands or spaced} if thousands or spaced else {}
    if decimal == thousands:
        raise RecordError(f"{path}: a comma cannot be both decimal and thousands separator. Correct the layout")
    if not (quoted or spaced or thousands) and decimal == ".":
        return lines, marks if "separator" in word else {}
    group = f"[{re.escape(thousands or '')} ']" if thousands else "[ ']"
    form = re.compile(rf"[+-]?(?:[1-9]\d{{0,2}}(?:{group}\d{{3}})+|\d*)(?:{re.escape(decimal)}\d*)?{_POWER}")
    body = [*lines[:at]]
    for k in range(at, len(lines)):
        if decimal == "," and not (quoted or spaced or thousands or "." in lines[k]):
            body.append(lines[k].replace(",", "."))
            continue
        cells = _cells(lines[k].translate(_MARKS), delimiter)
        for j, cell in enumerate(cells):
            if _is_number(cell):
                if not form.fullmatch(cell):
                    raise RecordError(
                        f"{path}, row {k + 1}: {cell!r} is not a number with decimal {decimal!r}"
                        f"{f' and thousands {thousands!r}' if thousands else ''}, as others are. Correct it, or give "
                        f"{setting('layout', 'decimal=… thousands=…')}"
                    )
                cells[j] = re.sub(group, "", cell).replace(decimal, ".")
        body.append(delimiter.join(cells) if lines[k].strip() else lines[k])
    return body, marks


def _marks(
    lines: Sequence[str], at: int, delimiter: str, path: Path, word: Mapping[str, str]
) -> tuple[str, str | None]:
    """Return decimal mark and thousands separator, as told or as the first number shows that is not ambiguous."""
    decimal, thousands, doubt = word.get("decimal"), word.get("thousands"), ""
    for row, cell in _marked(lines, at, delimiter):
        text = cell.translate(_MARKS)
        as_decimal, as_thousands = _DECIMAL.fullmatch(text), _THOUSANDS.fullmatch(text)
        if thousands is None and (decimal == "," or as_decimal) and "." in text and "," in text and not as_thousands:
            thousands = "."
        if decimal is None and as_decimal and (not as_thousands or thousands == "."):
            decimal = ","
        elif as_thousands and (decimal == "." or not as_decimal):
            decimal, thousands = decimal or ".", thousands or ","
        elif decimal is None and thousands is None and as_thousands:
            doubt = doubt or f"{path}, row {row}: {cell!r} may be {text.replace(',', '.')} or {text.replace(',', '')}"
        if decimal == "," and thousands:
            break
    if doubt and decimal is None and thousands is None:
        raise RecordError(
            f"{doubt}; no number of the file decides. Give {setting('layout', 'decimal=comma')}, or "
            f"{setting('layout', 'thousands=comma')}"
        )
    return decimal or ".", thousands


def _marked(lines: Sequence[str], at: int, delimiter: str) -> Iterator[tuple[int, str]]:
    """Yield row and text of the cells that hold a comma."""
    for k in range(at, len(lines)):
        if "," in lines[k]:
            for cell in _cells(lines[k], delimiter):
                if "," in cell:
                    yield k + 1, cell
