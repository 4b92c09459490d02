"""The recorder at 20 kHz x 8 channels: share of a core, what it writes, and a hundred kills at random moments.

``python bench/recorder.py`` prints its tables; RECORDER_S and RECORDER_KILLS shorten or lengthen it.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
for place in (str(HERE), str(HERE.parent)):  # the second one for the kills, which the tests have too
    if place not in sys.path:
        sys.path.insert(0, place)

import numpy as np  # noqa: E402

from ambid.acquisition.device import Column  # noqa: E402
from ambid.acquisition.recorder import JournalHeader, Recorder, journal_path  # noqa: E402
from ambid.tracking.blocks import Block  # noqa: E402
from table import Table  # noqa: E402
from timing import quantity  # noqa: E402

SECONDS = float(os.environ.get("RECORDER_S", "20"))
KILLS = int(os.environ.get("RECORDER_KILLS", "100"))
RATE, CHANNELS = 20_000.0, 8
SIZES = (20, 100, 400)
GROUP = "Recorder: 20 kHz, 8 channels"
COLUMNS = (
    "samples of a block", "values", "load of a core", "of it the pacing alone", "written", "acknowledged", "overruns",
    "journal to record",
)  # fmt: skip


def header() -> JournalHeader:
    columns = tuple(Column(name=f"c{k}", role="extra", unit="1") for k in range(CHANNELS))
    return JournalHeader(columns=columns, rate_hz=RATE)


def sources() -> dict[str, np.ndarray]:
    """Values of one second: counts of a converter, and numbers that only float64 holds."""
    rng = np.random.default_rng(7)
    shape = (round(RATE), CHANNELS)
    return {"10-bit counts": rng.integers(0, 1024, shape).astype(float), "float64": rng.normal(size=shape)}


def paced(values: np.ndarray, size: int, take: object, seconds: float) -> float:
    """Give blocks at their own pace, and return the processor time of the whole process, s."""
    blocks, per_second = round(seconds * RATE / size), len(values) // size
    begin, before = time.perf_counter(), time.process_time()
    for k in range(blocks):
        due = begin + (k + 1) * size / RATE
        while (left := due - time.perf_counter()) > 0:
            time.sleep(left)
        at = (k % per_second) * size
        take(Block(first=k * size, time_s=k * size / RATE, values=values[at : at + size]))  # type: ignore[operator]
    return time.process_time() - before


def load(kind: str, values: np.ndarray, size: int, folder: Path) -> tuple[tuple[str, ...], dict[str, object]]:
    """One row: record for SECONDS, then make the record."""
    pacing = paced(values, size, lambda _: None, SECONDS / 4) * 4
    path = folder / "run.h5"
    with Recorder(path, header(), seconds=SECONDS) as recorder:
        used = paced(values, size, recorder.append, SECONDS)
        assert recorder.flush()
        written, acknowledged = journal_path(path).stat().st_size, recorder.acknowledged
        overruns, before = recorder.overruns, time.perf_counter()
    made_s = time.perf_counter() - before
    path.unlink()
    data: dict[str, object] = {
        "kind": kind, "size": size, "seconds": SECONDS, "used_s": used, "pacing_s": pacing, "bytes": written,
        "acknowledged": acknowledged, "overruns": overruns, "made_s": made_s,
    }  # fmt: skip
    cells = (
        str(size), kind, f"{used / SECONDS:.2%}", f"{pacing / SECONDS:.2%}", f"{written / SECONDS / 1e6:.2f} MB/s",
        f"{acknowledged} of {round(SECONDS * RATE / size)}", str(overruns), quantity(made_s, "s"),
    )  # fmt: skip
    return cells, data


def recorder_tables() -> Iterator[Table]:
    """Load of a core, and what kills cost."""
    with tempfile.TemporaryDirectory() as folder:
        rows, data = [], {}
        for kind, values in sources().items():
            for size in SIZES:
                cells, found = load(kind, values, size, Path(folder))
                rows.append(cells)
                data[f"{kind}, {size}"] = found
                print("; ".join(cells), flush=True)
    before = (
        f"{SECONDS:.0f} s at their own pace; processor time of the whole process, thread that writes and pacing of the"
        " blocks included; brought to the disk every 0.5 s."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, data=data)
    yield kill_table()


def kill_table() -> Table:
    """Recordings under full load, killed at random moments, recovered, and compared bit by bit."""
    from tests.acquisition.recorder.kills import killed

    with tempfile.TemporaryDirectory() as folder:
        found = list(killed(folder, KILLS, seed=11))
    moments = Counter(kill.when for kill in found)
    data = {
        "kills": KILLS,
        "acknowledged": sum(k.acknowledged for k in found),
        "recovered": sum(k.recovered for k in found),
        "faults": [k.fault for k in found if k.fault], "when": dict(moments),
    }  # fmt: skip
    row = (str(KILLS), str(data["acknowledged"]), str(data["recovered"]), str(len(data["faults"])))  # type: ignore[arg-type]
    print("; ".join(row), dict(moments), flush=True)
    return Table(
        group="Recorder: killed under full load", rows=(row,), data=data,
        columns=("kills", "acknowledged blocks", "recovered blocks", "recordings with a loss or a wrong bit"),
        remarks=(", ".join(f"{n} {when}" for when, n in sorted(moments.items())),),
    )  # fmt: skip


if __name__ == "__main__":
    for table in recorder_tables():
        print("\n" + table.as_markdown())
