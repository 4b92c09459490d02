"""Numbers that ``ambid`` gave on a frozen day, compared with those that it gives now.

Each case of frozen_cases.toml runs command lines in a folder of its own, on records made here (without ambid) or
measured ones. What they write is flattened to key and value and compared with frozen_cases.json.gz: texts, truths and
exit codes exactly, numbers within 1e-6 of their size or 1e-3 of their standard deviation. Times, paths and hashes are
left out. Where a case differs only in what another kernel of the linear algebra library moves as well (--rounding, at
most ten times as far), its verdict is "rounding" and no failure.

    python tools/frozen_cases.py [WORDS ...] [--src DIR] [--data DIR] [--jobs N] [--record | --rounding KERNEL]
"""

from __future__ import annotations

import argparse
import csv
import gzip
import hashlib
import json
import math
import os
import re
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory

import numpy as np
from frozen_records import RECORDS, written

ROOT = Path(__file__).resolve().parents[1]
STORED = Path(__file__).with_suffix(".json.gz")
SAID = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
CASES = {name: Template(text).substitute(SAID["words"]).strip() for name, text in SAID["cases"].items()}
WRITES_JSON = {"identify", "fit", "frf", "compare", "validate", "track"}
SHOWS_TEXT = {"demo", "info", "models", "init", "simulate", "--help"}
Value = str | bool | None | float | list[float | None]
Flat = dict[str, Value]

RTOL, OF_SD = 1e-6, 1e-3
BEYOND = 10.0  # times what a value was seen to move by rounding alone: a larger difference counts
LONGEST, KEPT = 60, 40  # longer arrays are stored as mean, rms and that many of their values
LEFT_OUT = {"sha256", "file", "folder", "version"}
TIMES = {"timing_s", "fit_timing_s", "seconds", "computing_s", "latency_s", "update_s"}
DURATION = re.compile(r"\bin [\d.e+-]+ (us|ms|s|min)\b")

# --- running ---------------------------------------------------------------------------------------------------------


def prepare(folder: Path, data: Path) -> dict[str, str]:
    """Write records and rigs, link measured ones; return hashes of the records that were made."""
    made = {}
    for name, record in RECORDS.items():
        text = written(record())
        (folder / name).write_text(text, encoding="utf-8")
        made[name] = hashlib.sha256(text.encode()).hexdigest()[:16]
    for name, text in SAID["rigs"].items():
        (folder / name).write_text(text, encoding="utf-8")
    for name, where in SAID["measured"].items():
        if (data / where / name).is_file():
            (folder / name).symlink_to((data / where / name).resolve())
    return made


def run_case(name: str, inputs: Path, environment: dict[str, str]) -> Flat | None:
    """Run a case and return all that it gave, flattened; None if a measured record is absent."""
    lines = [line.split() for line in CASES[name].split("\n")]
    if any(w in SAID["measured"] and not (inputs / w).exists() for line in lines for w in line):
        return None
    flat: Flat = {}
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for file in inputs.iterdir():
            (folder / file.name).symlink_to(file)
        for k, words in enumerate(lines, 1):
            wants = words[0] in WRITES_JSON and "--help" not in words
            more = ["--json", f"{k}.json"] if wants else ["-o", f"{k}.csv"] if words[0] == "simulate" else []
            command = [sys.executable, "-c", "from ambid.cli import main; main()", *words, *more]
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
            flat[f"{k}/exit code"] = done.returncode
            if done.returncode not in (0, 3):
                flat[f"{k}/error"] = done.stderr
            elif words[0] in SHOWS_TEXT or "--help" in words:
                flat[f"{k}/text"] = plain_text(done.stdout)
            written = folder / f"{k}.json"
            if wants and written.exists():
                text = written.read_text(encoding="utf-8")
                try:
                    document = json.loads(text)
                except json.JSONDecodeError:  # a track: lines of JSON
                    document = [json.loads(line) for line in text.splitlines()]
                    document = {"first": document[0], "lines": document[1:-1], "last": document[-1]}
                flat |= flattened(document, str(k))
            if words[0] == "simulate" and (folder / f"{k}.csv").exists():
                flat |= channels(folder / f"{k}.csv", str(k))
    return flat


def plain_text(text: str) -> str:
    """Return a text without times, hashes and versions."""
    lines = [line for line in text.splitlines() if not line.startswith(("time:", "read 0"))]
    return re.sub(r"sha256=[0-9a-f]{64}", "sha256", DURATION.sub("in ...", "\n".join(lines)))


def channels(path: Path, at: str) -> Flat:
    """Return for each channel of a record how many values there are, mean, sd, extremes, first and last ones."""
    with path.open(encoding="utf-8") as file:
        head, *rows = csv.reader(row for row in file if not row.startswith("#"))
    flat: Flat = {f"{at}/rows": len(rows)}
    for name, cells in zip(head, zip(*rows, strict=True), strict=True):
        v = np.array([float(c) for c in cells if c])
        flat[f"{at}/{name}"] = rounded([v.size, v.mean(), v.std(), v.min(), v.max(), *v[:4], *v[-4:]])
    return flat


# --- flattening ------------------------------------------------------------------------------------------------------


def rounded(values: Sequence[float | None]) -> list[float | None]:
    """Return numbers with ten digits; of a long array mean, rms and some of its values."""
    if len(values) > LONGEST:
        known = np.array([math.nan if v is None else v for v in values], float)
        known = known[np.isfinite(known)]
        few = np.linspace(0, len(values) - 1, KEPT).round().astype(int)
        whole = [float(known.mean()), math.sqrt(float(np.mean(known**2)))] if known.size else [None, None]
        values = [*whole, *(values[j] for j in few)]
    return [v if v is None or v != v or math.isinf(v) else float(f"{v:.10g}") for v in values]


def numbers(value: object) -> Iterator[float | None]:
    """Yield the numbers of a nested list; fail if it holds anything else."""
    if isinstance(value, list):
        for v in value:
            yield from numbers(v)
    elif value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
        yield value
    else:
        raise TypeError


def flattened(value: object, at: str) -> Flat:
    """Return a document as keys with slashes: arrays as lists, long lists of tables as columns."""
    if isinstance(value, dict):
        parts = (flattened(v, f"{at}/{k}") for k, v in value.items() if k not in LEFT_OUT | TIMES)
        return {key: v for part in parts for key, v in part.items()}
    if isinstance(value, str):
        return {at: plain_text(value)}
    if isinstance(value, bool) or value is None:
        return {at: value}
    if isinstance(value, int | float):
        return {at: rounded([value])[0]}
    assert isinstance(value, list)
    try:
        found = list(numbers(value))
    except TypeError:
        pass
    else:
        return {f"{at} [{len(found)}]": rounded(found)}
    if all(isinstance(v, str) for v in value):
        return {at: plain_text("\n".join(value))}
    if len(value) <= 8 or not all(isinstance(v, dict) for v in value):
        return {key: v for k, item in enumerate(value) for key, v in flattened(item, f"{at}/{k}").items()}
    columns: dict[str, list[Value]] = {}
    for item in value:
        for key, v in flattened(item, at).items():
            columns.setdefault(key, []).extend(v if isinstance(v, list) else [v])
    return {key: column(values) for key, values in columns.items()}


def column(values: list[Value]) -> Value:
    """Return a column of a long list: numbers as an array, anything else as text without repetitions."""
    try:
        return rounded(list(numbers(values)))
    except TypeError:
        said = [str(v) for v in values]
        return f"{len(said)}: " + " | ".join(s for k, s in enumerate(said) if k == 0 or s != said[k - 1])


# --- comparing -------------------------------------------------------------------------------------------------------

SD_BESIDE = {"value", "ci95", "polynomials", "state_space", "transfer_function"}


def deviation(key: str, flat: Flat) -> Value:
    """Return the standard deviation that stands beside a number, in its shape or for all of an array; else None."""
    bare, _, shape = key.partition(" [")
    parts, shape = bare.split("/"), shape and f" [{shape}"
    places = [[*parts[:k], "sd", *parts[k + 1 :]] for k, p in enumerate(parts) if p in SD_BESIDE]
    if parts[-2:] == ["parameters", "values"]:
        places.append([*parts[:-2], "sd"])
    found = (flat.get("/".join(place) + end) for place in places for end in (shape, ""))
    return next((v for v in found if v is not None), None)


def excess(key: str, old: Flat, new: Flat) -> float:
    """Return by how many times a value differs more than it may: at most 1 is the same."""
    if key not in old or key not in new:
        return math.inf
    a, b = (v if isinstance(v, list) else [v] for v in (old[key], new[key]))
    if len(a) != len(b) or any(type(x) is not type(y) and not _both_numbers(x, y) for x, y in zip(a, b, strict=True)):
        return math.inf
    sd = deviation(key, old)
    sds = sd if isinstance(sd, list) and len(sd) == len(a) else [None if isinstance(sd, list) else sd] * len(a)
    size = max((abs(x) for x in a if _both_numbers(x, x)), default=0.0)
    worst = 0.0
    for x, y, s in zip(a, b, sds, strict=True):
        if x == y:
            continue
        if not _both_numbers(x, y):
            return math.inf
        allowed = max(RTOL * size, OF_SD * s if _both_numbers(s, s) else 0.0)
        worst = max(worst, abs(x - y) / allowed if allowed else math.inf)
    return worst


def _both_numbers(x: object, y: object) -> bool:
    return all(isinstance(v, int | float) and not isinstance(v, bool) for v in (x, y))


def shown(flat: Flat, key: str, other: Flat) -> str:
    """Return a value in few words: of an array or a text the first part that differs from the other's."""
    value, beside = flat.get(key, "(absent)"), other.get(key)
    if isinstance(value, list):
        pairs = zip(value, beside if isinstance(beside, list) else [], strict=False)
        where = max(((abs((x or 0) - (y or 0)), k) for k, (x, y) in enumerate(pairs)), default=(0, 0))[1]
        return f"[{where}] {value[where] if value else value}"
    if isinstance(value, str) and isinstance(beside, str):
        where = next((k for k, (x, y) in enumerate(zip(value, beside, strict=False)) if x != y), 0)
        value = value[max(where - 30, 0) : where + 40]
    return repr(value) if isinstance(value, str) else str(value)


def _computing() -> float:
    return os.times().children_user + os.times().children_system


def main() -> int:
    """Run the cases; return 1 if any differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="cases whose name holds one of these; default all")
    parser.add_argument("--src", type=Path, default=ROOT / "src", help="where the package lies; default beside this")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of measured records")
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time")
    parser.add_argument("--record", action="store_true", help="store what these cases give, instead of comparing")
    parser.add_argument(
        "--rounding",
        metavar="KERNEL",
        help="store how far results move by rounding alone, with this kernel of OpenBLAS",
    )
    parser.add_argument("--shown", type=int, default=5, help="differing keys that are shown for each case")
    o = parser.parse_args()
    names = [n for n in CASES if not o.words or any(w in n for w in o.words)]
    stored = json.loads(gzip.decompress(STORED.read_bytes())) if STORED.exists() else {}
    hashes, cases, rounding = (stored.setdefault(k, {}) for k in ("records", "cases", "rounding"))
    keep = {k: v for k, v in os.environ.items() if k not in ("PYTHONDONTWRITEBYTECODE", "COLUMNS")}
    environment = keep | {"PYTHONPATH": str(o.src.resolve()), "OPENBLAS_NUM_THREADS": "1", "NO_COLOR": "1"}
    if o.rounding:
        environment["OPENBLAS_CORETYPE"] = o.rounding
    where = [sys.executable, "-c", "import ambid; print(ambid.__file__)"]
    origin = Path(subprocess.run(where, env=environment, capture_output=True, text=True, check=True).stdout.strip())
    if o.src.resolve() not in origin.resolve().parents:
        parser.error(f"ambid is imported from {origin}, not from {o.src}")
    counts: dict[str, int] = {}
    with TemporaryDirectory() as scratch, ThreadPoolExecutor(o.jobs) as pool:
        made = prepare(Path(scratch), o.data)
        for name in [n for n, h in made.items() if not o.record and hashes.get(n, h) != h]:
            print(f"{name} is made differently here than when numbers were stored: its cases cannot be compared")
        begun, spent = time.monotonic(), _computing()
        for name, flat in zip(names, pool.map(lambda n: run_case(n, Path(scratch), environment), names), strict=True):
            old, soft = cases.get(name), rounding.get(name, {})
            keys: list[str] = []
            if flat is None:
                verdict = "left out: a record is absent"
            elif o.record:
                verdict, cases[name] = "stored", flat
                rounding.pop(name, None)
            elif old is None:
                verdict = "not stored"
            else:
                sizes = {k: excess(k, old, flat) for k in {**old, **flat}}
                if o.rounding:
                    rounding[name] = soft | {k: max(s, soft.get(k, 0.0)) for k, s in sizes.items() if s > 1}
                hard = {k for k, s in sizes.items() if s > max(1.0, BEYOND * soft.get(k, 0.0))}
                keys = sorted((k for k, s in sizes.items() if s > 1), key=lambda k: (k not in hard, -sizes[k]))
                verdict = "different" if hard else "rounding" if keys else "same"
            counts[verdict] = counts.get(verdict, 0) + 1
            print(f"{name:24} {verdict}" + (f": {len(keys)} of {len(sizes)} keys" if keys else ""), flush=True)
            for key in keys[: o.shown]:
                known = f", {soft[key]:.2g} by rounding alone" if key in soft else ""
                change = f"{shown(old, key, flat)} → {shown(flat, key, old)}"
                print(f"    {key}: {change} ({sizes[key]:.2g} times what is allowed{known})")
        print(", ".join(f"{n} {k}" for k, n in counts.items()), end="; ")
        print(f"{time.monotonic() - begun:.0f} s, of computing {_computing() - spent:.0f} s")
    if o.record or o.rounding:
        stored["records"] = made if o.record else hashes
        stored["cases"] = {n: cases[n] for n in CASES if n in cases}
        text = json.dumps(stored, ensure_ascii=False, separators=(",", ":"))
        STORED.write_bytes(gzip.compress(text.encode(), 9, mtime=0))
    return 1 if counts.get("different") else 0


if __name__ == "__main__":
    sys.exit(main())
