"""A bearing of a ledger over time, as a page draws it: a number only where its record showed one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ambid.console.envelope import rounded
from ambid.estimation.result import NORMAL_95
from ambid.ledger import History, Series

_MOST = 2000  # estimates that are drawn, the latest


def drawn(found: History) -> Mapping[str, Any]:
    """Return verdict, series, estimates and events of a history; of a long one the latest."""
    from ambid.job.presentation import text

    first = max(0, len(found.estimates) - _MOST)
    asked = ("taken_at", "record", "job", "status", "verdict", "failed", "version")
    verdict = found.verdict
    return {
        "bearing": found.bearing, "plant": found.plant, "verdict": verdict.word,
        "reasons": [r.text for r in verdict.reasons], "text": text(found, width=110), "left_out": first,
        "estimates": [{k: getattr(e, k) for k in asked} for e in found.estimates[first:]],
        "series": {name: _series(found, s, first) for name, s in found.measured.items()},
        "events": [{k: getattr(e, k) for k in ("at", "kind", "text", "parameter")} for e in found.events],
    }  # fmt: skip


def _series(found: History, s: Series, first: int) -> Mapping[str, Any]:
    """Return one series; `verdict`: of each estimate, or that its record did not show this number."""
    of = s.estimate >= first
    said = zip(s.estimate[of], s.identifiable[of], strict=True)
    return {
        "unit": s.unit, "t": s.taken_at[of].tolist(), "value": rounded(s.value[of], 9),
        "sd": rounded(s.sd[of]), "half": rounded(NORMAL_95 * s.sd[of]),
        "verdict": [found.estimates[k].verdict if seen else "hidden" for k, seen in said],
        "known": int(np.count_nonzero(np.isfinite(s.value))),
    }  # fmt: skip
