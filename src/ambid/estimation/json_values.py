"""Results as JSON: plain values, numbers that are not finite as null."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ambid.estimation.estimate import Check, Delay


def plain_json(value: Any) -> Any:
    """Turn mappings, sequences and arrays into plain JSON values.

    `value`: anything that a result holds. Returns dicts, lists, strings, booleans, numbers and None; None for a number
    that is not finite.
    """
    if isinstance(value, Mapping):
        return {str(k): plain_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_json(v) for v in value]
    if isinstance(value, (bool, str)) or value is None:
        return value
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, np.ndarray):
        return plain_json(value.tolist())
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (complex, np.complexfloating)):
        return [plain_json(value.real), plain_json(value.imag)]
    number = float(value)
    return number if math.isfinite(number) else None


def check_json(check: Check) -> dict[str, Any]:
    """Return a check as JSON.

    Returns ``passed``, ``p`` where there is one, its further values, ``detail``.
    """
    p = {} if check.p is None else {"p": check.p}
    return {"passed": check.passed, **p, **dict(check.values), "detail": check.detail}


def delay_json(delay: Delay) -> dict[str, Any]:
    """Return a delay as JSON.

    Returns ``samples``, ``fraction``, their sum ``total``, ``sd`` and ``how``.
    """
    return {
        "samples": delay.samples,
        "fraction": delay.fraction,
        "total": delay.samples + delay.fraction,
        "sd": delay.sd,
        "how": delay.how,
    }


def check_from_json(document: Mapping[str, Any]) -> Check:
    """Read a check back.

    `document`: what `check_json` made.
    """
    return Check(
        passed=bool(document["passed"]),
        detail=document["detail"],
        p=document.get("p"),
        values={k: v for k, v in document.items() if k not in ("passed", "detail", "p")},
    )
