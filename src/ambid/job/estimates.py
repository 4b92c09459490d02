"""Estimates and fits as they come from files: one reader for every job that goes on from one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate

if TYPE_CHECKING:
    from ambid.bearing.magnet.result import NonlinearBearingEstimate
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.nonlinear.fit import NonlinearFit


def read_estimate(path: str | Path) -> Estimate | NonlinearBearingEstimate | BlackBoxFit | NonlinearFit:
    """Read an estimate, linear or nonlinear, or a black-box or nonlinear fit from its file.

    `path`: JSON, schema ``ambid.estimate/1`` or ``ambid.fit/1``.
    """
    from ambid.blackbox.fit_file import SCHEMA, fit_from_json
    from ambid.estimation.estimate_file import SCHEMA as ESTIMATE
    from ambid.estimation.estimate_file import estimate_from_json
    from ambid.record.files import file_bytes, utf8_text

    path = Path(path)
    text = utf8_text(file_bytes(path, EstimationError, "estimate"), path, EstimationError, "estimate")
    try:
        document = json.loads(text)
    except json.JSONDecodeError as failure:
        raise EstimationError(
            f"estimate {path}, row {failure.lineno}: not JSON ({failure.msg}). Give what 'ambid identify --json' wrote"
        ) from None
    except (RecursionError, ValueError):
        raise EstimationError(
            f"estimate {path} is nested too deep, or holds a number that is too long. "
            "Give what 'ambid identify --json' wrote"
        ) from None
    if isinstance(document, dict) and document.get("schema") == SCHEMA:
        from ambid.nonlinear.structures import NONLINEAR_STRUCTURES

        if str(document.get("structure")) in NONLINEAR_STRUCTURES:
            from ambid.nonlinear.fit_file import nonlinear_fit_from_json

            return nonlinear_fit_from_json(document, f"fit {path}")
        return fit_from_json(document, f"fit {path}")
    if isinstance(document, dict) and document.get("schema") == ESTIMATE and "law" in document:
        from ambid.bearing.magnet.result_file import bearing_from_json

        return bearing_from_json(document, f"estimate {path}")
    return estimate_from_json(document, f"estimate {path}")
