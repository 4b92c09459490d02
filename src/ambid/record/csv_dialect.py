"""Dialects of CSV: preambles, units below or behind names, decimal commas, thousands separators; taken where the file
leaves no other, else the layout's word is asked for. What was understood goes into the record's history.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from ambid.errors import RecordError
from ambid.record.record import utf8_text
from ambid.record.words import is_time, label_of, quantities, rate_of, unit_or_none
from ambid.settings.caller import setting

_WORDS = {
    "decimal": {",": ",", "comma": ",", ".": ".", "point": "."},
    "separator": {",": ",", "comma": ",", ";": ";", "semicolon": ";", "\t": "\t", "tab": "\t", " ": " ", "blank": " "},
    "thousands": {",": ",", "comma": ",", ".": ".", "point": ".", " ": " ", "space": " ", "'": "'", "apostrophe": "'"},
    "units": {x: x for x in ("row", "parentheses", "brackets", "none")},
    "encoding": {x: x for x in ("cp932", "gb18030", "utf-8", "utf-16", "utf-16-le", "utf-16-be", "latin-1", "cp1252")},
}
_MARKS = str.maketrans("\u2019\u00a0\u202f", "'  ")
_WIDE = str.maketrans("（）［］", "()[]")
_POWER = r"(?:[eE][+-]?\d+)?"
_DECIMAL = re.compile(rf"[+-]?(?:[1-9]\d{{0,2}}(?:[.' ]\d{{3}})+|\d*),\d*{_POWER}")
_THOUSANDS = re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:,\d{{3}})+(?:\.\d*)?{_POWER}")
_NUMBER = re.compile(rf"[+-]?(?:\d{{1,3}}(?:[.,' ]\d{{3}})+|\d*)(?:[.,]\d*)?{_POWER}")
_PARENTHESES = re.compile(r"(?P<name>.*\S)\s*\((?P<unit>[^()]*)\)")
_NO_OTHER = re.compile(
    r"(?:deg ?|°|º)?[CFK]|[℃℉]|N\.?m|m?bar|counts?|lsb|digits?|-|a\.?u\.?", re.IGNORECASE
)  # units, not places
_KEYS = {
    "units": re.compile(r"y_unit_label|[vy]?_?units?|vertical_units?|einheit(?:en)?"),
    "names": re.compile(r"(?:trace|channel|signal|kanal)_?names?|label|names?"),
}
_SPACED = re.compile("\\d([' \u00a0\u202f\u2019])\\d")
_NAMED_NUMBER = re.compile(
    rf"(?P<name>[^\W\d][^,;:=\t]*?)\s*[=:,;\t ]\s*(?P<number>\d{{1,3}}(?:[ '\u00a0\u2009\u202f]\d{{3}})+|"
    rf"\d*[.,]?\d+{_POWER})\s*[,;\t]?\s*(?P<unit>[A-Za-zµμ]{{0,3}}(?:/s)?)"
)
_HEAD = 1 << 14  # bytes in which the words of an encoding are looked for
_FASTEST = 2e6  # Hz, of a bearing
_MOST_COLUMNS = 4096
_NOTED = 64  # rows of a table within which notes beside it end
_FEW = 8  # rows of numbers below a header, without which a text is no table


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """A text in another dialect, and what it reads in the usual one."""

    row: int  # line of the header row, counted from 1; rows of numbers begin below
    delimiter: str
    cells: tuple[str, ...]  # of the header row
    units: tuple[str | None, ...] | None  # where they are not behind the names in brackets
    texts: Mapping[str, Sequence[str]]  # columns that hold no numbers
    beside: Mapping[str, tuple[float, str | None]]  # numbers above the table, with their units
    comments: tuple[str, ...]
    lines: list[str]  # of the whole file; numbers with a decimal point
    settings: Mapping[str, object]  # what was understood


def decoded(data: bytes, path: Path, layout: Mapping[str, str]) -> tuple[str, str]:
    """Return the text and its encoding: the one that is told, UTF-16 by its mark or its zeros, UTF-8, else the older
    one in which the head names most quantities.
    """
    marked = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    zeros = [not marked and len(data) > 16 and not any(data[k : 1 << 12 : 2][:-1]) for k in (1, 0)]
    usual = "utf-16" if marked else "utf-16-le" if zeros[0] else "utf-16-be" if zeros[1] else "utf-8"
    encoding = words_of(layout, path).get("encoding", usual)
    if encoding == "utf-8" and "encoding" not in layout and not _is_utf8(data):
        heads = {name: data[:_HEAD].decode(name, "replace") for name in ("cp1252", "cp932", "gb18030")}
        count = {name: sum(bool(quantities(x)) for x in re.split(r"[\s,;]+", text)) for name, text in heads.items()}
        best = max(heads, key=lambda name: (count[name], name == "cp1252"))
        encoding = "latin-1" if best == "cp1252" else best
    if encoding == "utf-8":
        return utf8_text(data, path), encoding
    try:
        return utf8_text(data.decode("cp1252" if encoding == "latin-1" else encoding).encode(), path), encoding
    except UnicodeDecodeError:
        raise RecordError(f"record {path} is no text in {encoding}. Correct layout encoding") from None


def _is_utf8(data: bytes) -> bool:
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def words_of(layout: Mapping[str, str], path: Path) -> dict[str, str]:
    """Return a layout in signs: ``comma`` is ``,`` and so on."""
    words = {}
    for word, value in layout.items():
        if word not in _WORDS:
            continue
        if value.lower() not in _WORDS[word]:
            raise RecordError(f"{path}: layout {word}={value!r}; it is one of {', '.join(_WORDS[word])}. Correct it")
        words[word] = _WORDS[word][value.lower()]
    if words.get("decimal", "") == words.get("separator", "."):
        raise RecordError(f"{path}: comma cannot be both decimal and separator. Correct the layout")
    return words


def refuse_width(n: int, row: int, path: Path) -> None:
    """Refuse more columns than a record of anything has."""
    if n > _MOST_COLUMNS:
        raise RecordError(
            f"{path}, row {row}: {n} columns; a record has at most {_MOST_COLUMNS}. Export those of the bearing"
        )


def recognised(lines: list[str], path: Path, layout: Mapping[str, str]) -> Dialect | None:
    """Recognise a dialect; None where the text is usual, or no table. Raises where it could be read in two ways."""
    words = words_of(layout, path)
    begin = next((k for k, line in enumerate(lines) if line.strip() and not line.startswith("#")), None)
    block = None if begin is None else _first_block(lines, words.get("separator"))
    if begin is None or block is None:
        return None
    refuse_width(len(block.kinds), block.at + 1, path)
    block = _without_notes(lines, block)
    heads = _heads(lines, block, path, words.get("units"))
    if heads is None:
        return None
    at, delimiter, settings = block.at, block.delimiter, dict(heads.settings)
    if block.blank:
        lines, delimiter = [*lines[:at], *("\t".join(x.split()) for x in lines[at:])], "\t"
    above, names, units = lines[:at], list(heads.names), None if heads.units is None else list(heads.units)
    texts: dict[str, Sequence[str]] = {}
    if any(kind != "number" for kind in block.kinds):
        rows = [_cells(line, delimiter) for line in lines[at:] if line.strip()]
        ragged = next((k for k, row in enumerate(rows) if len(row) != len(block.kinds)), None)
        if ragged is not None:
            raise RecordError(
                f"{path}, row {at + 1 + ragged}: {len(rows[ragged])} cells instead of {len(block.kinds)}. Correct the "
                "row, or remove it if it was cut off"
            )
        columns = list(zip(*rows, strict=True))
        keep = [j for j, kind in enumerate(block.kinds) if kind == "number" or (kind == "empty" and any(columns[j]))]
        texts = {names[j]: columns[j] for j, kind in enumerate(block.kinds) if kind == "text"}
        kept = [[f'"{x}"' if delimiter in x else x for x in columns[j]] for j in keep]
        lines = [*above, *map(delimiter.join, zip(*kept, strict=True))]
        names, units = [names[j] for j in keep], None if units is None else [units[j] for j in keep]
    body, marks = _plain_numbers(lines, at, delimiter, path, words)
    if block.blank:
        marks["delimiter"] = " "
    settings |= marks
    if heads.row is not None and begin < heads.row and not above[begin].startswith("%"):
        settings["preamble"] = sum(bool(x.strip()) and not x.startswith("#") for x in above[begin : heads.row])
    if any(x.startswith("%") for x in above):
        settings["comments"] = "%"
    if texts:
        settings["left_out"] = list(texts)
    elif len(names) < len(block.kinds):
        settings["empty"] = len(block.kinds) - len(names)
    if not (settings or words):
        return None
    used = {heads.row, *heads.below}
    comments = [x.lstrip("#%").strip() for k, x in enumerate(above) if x.strip() and k not in used]
    return Dialect(
        row=at, delimiter=delimiter, cells=tuple(names), units=None if units is None else tuple(units), texts=texts,
        comments=tuple(comments), lines=body, settings=settings, beside=heads.beside,
    )  # fmt: skip


def _cells(line: str, delimiter: str) -> list[str]:
    """Take a row apart; a delimiter within quotes is none."""
    parts = line.split(delimiter)
    if '"' in line:
        with suppress(csv.Error):  # of a quote that nothing ends
            parts = next(csv.reader([line], delimiter=delimiter), [""])
    return [x.strip() for x in parts]


def _is_number(cell: str) -> bool:
    text = cell.translate(_MARKS)
    return any(map(str.isdigit, text)) and _NUMBER.fullmatch(text) is not None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Block:
    """The first rows of numbers."""

    at: int  # their place, counted from 0
    delimiter: str
    kinds: tuple[str, ...]  # of each column: number, text or empty
    blank: bool  # separated by blanks, several of which are one


def _first_block(lines: Sequence[str], word: str | None) -> _Block | None:
    """Find the first rows of one width that hold two columns of numbers, or one where the separator is told."""
    for k in range(min(len(lines), 1000)):
        for delimiter in (word,) if word else ("\t", ";", " ", ","):
            cells = _split(lines[k], delimiter)
            if sum(map(_is_number, cells)) < (1 if word else 2):
                continue
            rows = [_split(line, delimiter) for line in lines[k : k + _FEW]]
            if len(rows) < _FEW or any(len(row) != len(cells) or not any(map(_is_number, row)) for row in rows):
                continue
            kinds = tuple(map(_kind, zip(*rows, strict=True)))
            first = all(_is_number(x) or kind != "number" or not x for x, kind in zip(cells, kinds, strict=True))
            if first and kinds.count("number") >= (1 if word else 2):
                return _Block(at=k, delimiter=delimiter, kinds=kinds, blank=delimiter == " ")
    return None


def _without_notes(lines: Sequence[str], block: _Block) -> _Block:
    """Take columns of numbers that end long before the others, as notes beside a table do, for texts."""
    if block.blank or len(lines) < block.at + 2 * _NOTED:
        return block
    later = [_cells(x, block.delimiter) for x in (lines[block.at + _NOTED], next(filter(str.strip, reversed(lines))))]
    if all(later[0]) or any(len(x) != len(block.kinds) for x in later):
        return block
    rows = [_cells(x, block.delimiter) for x in lines[block.at + _NOTED :]]
    noted = [j for j, x in enumerate(later[0]) if not (x or any(len(row) > j and row[j] for row in rows))]
    kinds = tuple("text" if j in noted and x == "number" else x for j, x in enumerate(block.kinds))
    return replace(block, kinds=kinds)


def _split(line: str, delimiter: str) -> list[str]:
    """Take a row of numbers apart; blanks separate where nothing else does."""
    if delimiter != " ":
        return _cells(line, delimiter)
    cells = line.split()
    return cells if all(map(_is_number, cells)) and not any(x.endswith((",", ";")) for x in cells) else []


def _kind(column: Sequence[str]) -> str:
    """Return what a column holds; a single cell that is none does not make it other than of numbers."""
    numbers = sum(_is_number(x) or x.lower().lstrip("+-") in ("nan", "inf") for x in column)
    empty = sum(not x for x in column)
    return "number" if numbers >= 2 or numbers + empty == _FEW > empty else "empty" if empty == _FEW else "text"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Heads:
    """What the rows above the numbers say."""

    row: int | None  # line of the names, counted from 0; None: there is none
    below: tuple[int, ...]  # further lines between it and the numbers
    names: tuple[str, ...]
    units: tuple[str | None, ...] | None
    settings: Mapping[str, object]
    beside: Mapping[str, tuple[float, str | None]]


def _heads(lines: Sequence[str], block: _Block, path: Path, word: str | None) -> _Heads | None:
    """Find names and units above the numbers; None where the row above them is a header of another form."""
    n, rows, k = len(block.kinds), list[tuple[int, list[str]]](), block.at - 1
    while k >= 0 and len(rows) < 3:  # names, units, and what explains them
        line = lines[k].lstrip("#%").strip(" ") if lines[k].startswith(("#", "%")) else lines[k]
        if line.strip():
            cells = _head_cells(line, block, n)
            if cells is None or "End_of_Header" in line or (rows and _KEYS["units"].fullmatch(_key(cells[0]))):
                break
            rows.insert(0, (k, cells))
        k -= 1
    keyed, beside = _keyed(lines[: block.at], block)
    if "names" in keyed and (not rows or all(keyed["names"])):
        rows = [(int(keyed["at"][0]), keyed["names"])]
    above = next((x for x in reversed(lines[: block.at]) if x.strip() and not x.startswith(("#", "%"))), "")
    cells = _cells(above, block.delimiter if not block.blank else "\t")
    if sum(map(_is_number, cells)) > 1 and not any(lines[j] is above for j, _ in rows):
        return None  # numbers of another form: what is wrong with them is told where rows are read
    if not rows and above and (len(cells) > 1 or "[" in above or any(x in above for x in ",;\t")):
        return None
    if word == "row" and len(rows) < 2:
        raise RecordError(f"{path}, row {block.at}: no names stand above these units. Correct the layout")
    units_at = _units_row([c for _, c in rows], word)
    if units_at is None and word is None and len(rows) > 1 and rows[-1][1] != rows[-2][1]:
        if not lines[rows[-2][0]].startswith(("#", "%")):
            raise RecordError(
                f"{path}: rows {rows[-2][0] + 1} and {rows[-1][0] + 1} may both hold the names. Say whether the second "
                f"holds units: {setting('layout', 'units=row')}, or {setting('layout', 'units=none')}"
            )
        rows = rows[-1:]
    names_at = len(rows) - 1 if units_at is None else units_at - 1
    settings: dict[str, object] = {}
    units: list[str | None] | None = None
    if units_at is not None:
        texts = rows[units_at][1]
        units = [x.strip("[]()") or None for x in texts]
        settings["units"] = "row"
    if names_at < 0 or not rows:
        names, row = [f"column {j + 1}" for j in range(n)], None
        settings["header"] = "none"
    else:
        row, names = rows[names_at]
        if units_at is not None:  # numbers among the units belong to the names above them
            beside |= {
                a: (float(b), None) for a, b in zip(names, rows[units_at][1], strict=True) if a and _plain_float(b)
            }
        elif (parsed := _in_parentheses(names, row, path, word)) is not None:
            names, units = parsed
            settings["units"] = "parentheses"
        elif word is None and all(names) and any(label_of(x)[1] for x in names if "[" not in x):
            names, units = map(list, zip(*map(label_of, names), strict=True))
            settings["units"] = "behind"
    if "units" in keyed and units is None and (keyed["units"][0] or block.kinds[0] == "empty" or is_time(names[0])):
        units = [u or ("s" if x.startswith("X_Value") else None) for x, u in zip(names, keyed["units"], strict=True)]
        settings["units"] = "row"
    counted = [x or f"column {j + 1}" for j, x in enumerate(names)]
    if "" in names:
        settings["header"] = "incomplete"
    elif row is not None and lines[row].startswith(("#", "%")):
        settings["header"] = "comment"
    return _Heads(
        row=row, below=tuple(k for k, _ in rows if k != row), names=tuple(counted),
        units=None if units is None else tuple(units), settings=settings, beside=beside,
    )  # fmt: skip


def _head_cells(line: str, block: _Block, n: int) -> list[str] | None:
    """Take a row above the numbers apart; None where it is none of `n` names or units."""
    line = line.translate(_WIDE)
    if block.blank or block.delimiter == "\t":
        ways = [line.split("\t"), re.split(r"\t|\s{2,}", line.strip()), re.split(r"\s+(?![\[(])", line.strip())]
        cells = next(([x.strip() for x in way] for way in ways if len(way) in (n, n + 1)), [])
    else:
        cells = _cells(line, block.delimiter)
    cells = cells[:n] if len(cells) == n + 1 and cells[n].lower() == "comment" else cells
    cells += [""] * (len(cells) == n - 1 and block.kinds[-1] == "empty")  # a delimiter ends the rows of numbers alone
    texts = [x for x, kind in zip(cells, block.kinds, strict=False) if kind == "number"]
    if len(cells) != n or not any(texts) or (any(map(_is_number, texts)) and not _numbered(texts)):
        return None
    return [x.strip('"').strip() for x in cells]


def _numbered(texts: Sequence[str]) -> bool:
    """Whether channels are named 1, 2, 3 beside a name that is none, as oscilloscopes do."""
    numbers = [x for x in texts if _is_number(x)]
    return len(numbers) < len(texts) and numbers == [str(k + 1) for k in range(len(numbers))]


def _plain_float(text: str) -> bool:
    return re.fullmatch(rf"[+-]?\d*\.?\d+{_POWER}", text) is not None


def _units_row(rows: Sequence[Sequence[str]], word: str | None) -> int | None:
    """Return which row holds units: most of its texts are known ones, and nothing above it has any in brackets."""
    if word is not None:
        return len(rows) - 1 if word == "row" else None
    for k, cells in enumerate(rows):
        texts = [x.strip("[]()") for x in cells if x and not _plain_float(x)]
        if sum(map(_is_unit, texts)) > len(texts) / 2 and not any("[" in x for row in rows[:k] for x in row):
            named = sum(bool(quantities(x)) and len(x) == 1 for x in texts)  # t u i x may be names, s V A m are not
            if k > 0 or named < len(texts) / 2:
                return k
    return None


def _key(text: str) -> str:
    return text.strip('"').replace(" ", "_").lower()


def _keyed(lines: Sequence[str], block: _Block) -> tuple[dict[str, list[str]], dict[str, tuple[float, str | None]]]:
    """Return names and units of columns that stand behind a key, as instruments write them, and the numbers that are
    the same for every column; in a measurement of LabVIEW the interval is in s.
    """
    found, beside, n = dict[str, list[str]](), dict[str, tuple[float, str | None]](), len(block.kinds)
    labview = any("End_of_Header" in x for x in lines)
    for k, line in enumerate(lines):
        key, *cells = [x.strip('"') for x in _cells(line, "\t" if block.blank else block.delimiter)]
        while len(cells) >= n and not cells[-1]:
            cells.pop()
        cells = ["", *cells] if len(cells) == n - 1 else cells
        if len(cells) != n or not any(cells):
            continue
        if kind := next((kind for kind, form in _KEYS.items() if form.fullmatch(_key(key))), ""):
            found |= {kind: cells, "at": [str(k)]} if kind == "names" else {kind: cells}
        values = {x.replace(",", ".") for x in cells if x}
        if len(values) == 1 and _plain_float(text := values.pop()):
            beside[key] = (float(text), "s" if labview and key == "Delta_X" else None)
    return found, beside


def named_numbers(comments: Sequence[str]) -> dict[str, tuple[float, str | None]]:
    """Return the numbers that the lines above a table name, with their units."""
    pairs: dict[str, tuple[float, str | None]] = {}
    for line in comments:
        match = _NAMED_NUMBER.fullmatch(line.rstrip(",;\t "))
        if match and not _thousandfold(**match.groupdict()):
            number = re.sub(r"[\s']", "", match["number"]).replace(",", ".")
            pairs[match["name"].strip()] = (float(number), match["unit"] or None)
    return pairs


def _thousandfold(name: str, number: str, unit: str) -> bool:
    """Whether a rate may be 50 or 50 000 Hz, as ``50.000`` and ``50,000`` say."""
    if not re.fullmatch(r"[1-9]\d{0,2}[.,]\d{3}", number):
        return False
    readings = [rate_of(name, float(number.replace(",", mark).replace(".", mark)), unit or None) for mark in (".", "")]
    return all(x is not None and x[0] <= _FASTEST for x in readings)


def _is_unit(text: str) -> bool:
    """Whether a text is a known unit and no number."""
    return not text.isdigit() and unit_or_none(text) is not None


def _in_parentheses(
    cells: Sequence[str], header: int, path: Path, word: str | None
) -> tuple[list[str], list[str | None]] | None:
    """Return names and units of ``name (unit)``; None where no unit is written so."""
    matches = [None if "[" in x else _PARENTHESES.fullmatch(x.strip('"')) for x in cells]
    units = [None if x is None else x["unit"].strip() for x in matches]
    recognised = [_is_unit(x) or _NO_OTHER.fullmatch(x) is not None for x in units if x is not None]
    if word not in (None, "parentheses") or not any(recognised) or (word is None and any("[" in x for x in cells)):
        return None
    if word is None and not all(recognised):
        doubtful = next(
            x for x, known in zip([x for x in units if x is not None], recognised, strict=True) if not known
        )
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
