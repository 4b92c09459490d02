"""Accidents at random moments: from the accident to ENABLE low, in emulated time."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ambid.acquisition.scales import PWM_HZ
from table import Table
from tests.bars.host import prototype
from tests.bars.rates import at_rate
from tests.bars.safety import HOST_MS, KINDS, SILENT, Trip, trip

MOMENTS = int(os.environ.get("ACQUISITION_MOMENTS", "40"))
GROUP = "Acquisition: into the safe state (emulated)"
RATES = {2000: MOMENTS, 1000: MOMENTS // 4}  # Hz; the second is the slowest with output
COLUMNS = (
    "rate",
    "accident",
    "cause told",
    "moments",
    "median",
    "90 %",
    "largest",
    "within 2 ms",
    "anything else wrong",
)


def safety_tables() -> Iterator[Table]:
    """One table over the kinds of accidents."""
    rng, rig, rows, data = np.random.default_rng(6), prototype(), [], {}
    with tempfile.TemporaryDirectory() as folder:
        for rate_hz, moments in RATES.items():
            slow = at_rate(rig, round(PWM_HZ / rate_hz))
            for kind, what in KINDS.items():
                found = [trip(kind, slow, Path(folder) / f"{rate_hz}-{kind}-{k}", rng) for k in range(moments)]
                rows.append((f"{rate_hz} Hz", kind, what.cause, *_cells(found)))
                data[f"{kind}, {rate_hz} Hz"] = [asdict(f) for f in found]
                print("; ".join(rows[-1]), flush=True)
    before = (
        "The prototype levitates; at a random moment between 0.45 and 0.75 s after lift-off began, the"
        " accident happens. Times are from the bench's log: from the accident to the falling edge of ENABLE. "
        f"{' and '.join(SILENT)}: what it takes longer than limits.host_ms = {HOST_MS} since the last frame that was"
        " answered, counted from the tick before the answer, at most one tick too much. `Else`: levitating"
        " before, one falling edge only, pulse width that of no voltage and so to the end, samples flow on and say"
        " the cause, `clear` refused while over-current or an open interlock last, granted after."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, data=data)


def _cells(found: Sequence[Trip]) -> tuple[str, ...]:
    ms = 1e3 * np.array([f.delay_s for f in found])
    wrong = sorted({w for f in found for w in f.wrong})
    return (
        str(len(found)), f"{np.median(ms):.2f} ms", f"{np.quantile(ms, 0.9):.2f} ms", f"{ms.max():.2f} ms",
        f"{np.count_nonzero(ms <= 2.0)} of {len(found)}", "; ".join(wrong) or "nothing",
    )  # fmt: skip
