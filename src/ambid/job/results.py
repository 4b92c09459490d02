"""Results as they come from files, and how they do on another record."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambid.errors import AmbidError, EstimationError

if TYPE_CHECKING:
    from ambid.bearing.magnet.result import NonlinearBearingEstimate
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.estimation.estimate import Estimate
    from ambid.job.data import Part
    from ambid.nonlinear.fit import NonlinearFit
    from ambid.rig import Rig

    AnyFit = BlackBoxFit | NonlinearFit
    AnyEstimate = Estimate | NonlinearBearingEstimate


def read_estimate(path: str | Path) -> AnyEstimate | AnyFit:
    """Read an estimate, linear or nonlinear, or a black-box or nonlinear fit from its file.

    Parameters
    ----------
    path : str or Path
        JSON, schema ``ambid.estimate/1`` or ``ambid.fit/1``.

    Returns
    -------
    Estimate, NonlinearBearingEstimate, BlackBoxFit or NonlinearFit

    Raises
    ------
    EstimationError
        If the file cannot be read, or is no whole result.
    """
    from ambid.blackbox.fit_file import SCHEMA, fit_from_json
    from ambid.estimation.estimate import SCHEMA as ESTIMATE
    from ambid.estimation.estimate import estimate_from_json
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
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema == SCHEMA:
        from ambid.nonlinear.structures import NONLINEAR_STRUCTURES

        if str(document.get("structure")) in NONLINEAR_STRUCTURES:
            from ambid.nonlinear.fit_file import nonlinear_fit_from_json

            return nonlinear_fit_from_json(document, f"fit {path}")
        return fit_from_json(document, f"fit {path}")
    if schema == ESTIMATE and "law" in document:
        from ambid.bearing.magnet.result import bearing_from_json

        return bearing_from_json(document, f"estimate {path}")
    return estimate_from_json(document, f"estimate {path}")


def read_linear_estimate(path: str | Path, otherwise: str) -> Estimate:
    """Read an estimate from which linear tracking can begin; `otherwise` is the refusal of any other result."""
    from ambid.estimation.estimate import Estimate

    found = read_estimate(path)
    if not isinstance(found, Estimate):
        raise EstimationError(otherwise)
    return found


def judge_estimate(
    known: AnyEstimate, record: Path, rig: Rig, part: Part, rate_hz: float | None, gaps: str | None
) -> Mapping[str, object]:
    """Judge an estimate on a further record, of a rotor that moves, read through a rig."""
    from ambid.estimation.estimate import Estimate
    from ambid.physics.models import model

    if isinstance(known, Estimate):
        from ambid.job.data import load, signals_of
        from ambid.validate.second_record import validation

        used = load(record, rig, from_s=part[0], to_s=part[1], rate_hz=rate_hz, gaps=gaps)
        return validation(known, signals_of(used, model(known.model)))
    from ambid.job.bearing_records import bearing_rig, take_record
    from ambid.job.data import Reading
    from ambid.validate.nonlinear_bearing import validation as bearing_validation

    how = Reading(from_s=part[0], to_s=part[1], rate_hz=rate_hz, gaps=gaps)
    return bearing_validation(known, take_record(record, bearing_rig(rig), how).record)


def judge_fit(known: AnyFit, record: Path, part: Part, rate_hz: float | None, gaps: str | None) -> dict[str, Any]:
    """Judge a fit on a further record: ``samples``, ``fit`` by output, ``passed`` and ``objections``."""
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.job.data import check_same_bench, read_data
    from ambid.validate.blackbox import validation
    from ambid.validate.second_record import objections

    data = read_data(record, known.inputs, known.outputs, part=part, rate_hz=rate_hz, gaps=gaps)
    check_same_bench(known.units, known.dt, data)
    found: Mapping[str, Any]
    if isinstance(known, BlackBoxFit):
        found = validation(known, data)
    else:
        from ambid.validate.nonlinear import validation as nonlinear_validation

        found = nonlinear_validation(known, data)
    against = objections(known, found)
    return {"samples": data.n_samples, "fit": found, "passed": not against, "objections": list(against)}


def rig_of(estimate: AnyEstimate, path: Path) -> Rig:
    """Return the rig that an estimate remembers; `path` is its file, for messages."""
    from ambid.rig import rig_from_text

    text, folder = estimate.rig.get("text"), estimate.rig.get("folder")
    if not isinstance(text, str) or not isinstance(folder, str):
        raise EstimationError(f"estimate {path} does not hold its rig. Give --rig")
    try:
        return rig_from_text(text, Path(folder) / "rig.toml")
    except AmbidError as error:
        raise EstimationError(
            f"estimate {path}: the rig that it remembers cannot be used: {error}. Or give --rig"
        ) from None
