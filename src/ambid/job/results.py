"""Results as they come from files, and how they do on another record."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Unpack

from ambid.bearing.magnet_result import NonlinearBearingEstimate, bearing_from_json
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.fit_file import fit_from_json
from ambid.errors import AmbidError, EstimationError
from ambid.estimation.estimate import FIT_SCHEMA, Estimate, estimate_from_json
from ambid.estimation.estimate import SCHEMA as ESTIMATE
from ambid.job.data import Channels, Reading, Source, check_same_bench, load_bench, signals_of
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.fit_file import nonlinear_fit_from_json
from ambid.nonlinear.structures import NONLINEAR_STRUCTURES
from ambid.physics.linear_model import model
from ambid.record.record import file_bytes, utf8_text
from ambid.rig import Rig, rig_from_text
from ambid.validation.fits import objections
from ambid.validation.fits import validation as fit_validation
from ambid.validation.second_record import validation

AnyFit = BlackBoxFit | NonlinearFit
AnyEstimate = Estimate | NonlinearBearingEstimate


def load(path: str | Path) -> AnyEstimate | AnyFit:
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
    if schema == FIT_SCHEMA:
        if str(document.get("structure")) in NONLINEAR_STRUCTURES:
            return nonlinear_fit_from_json(document, f"fit {path}")
        return fit_from_json(document, f"fit {path}")
    if schema == ESTIMATE and "law" in document:
        return bearing_from_json(document, f"estimate {path}")
    return estimate_from_json(document, f"estimate {path}")


def read_linear_estimate(path: str | Path, otherwise: str) -> Estimate:
    """Read an estimate from which linear tracking can begin; `otherwise` is the refusal of any other result."""
    found = load(path)
    if not isinstance(found, Estimate):
        raise EstimationError(otherwise)
    return found


def validate(
    known: AnyEstimate | AnyFit, path: Path, record: Source, rig: Rig | None = None, **reading: Unpack[Reading]
) -> dict[str, Any]:
    """Judge a result on a further record, of a rotor that moves.

    `path`: its file, for messages; `rig`: through which the record is read; default: as the result remembers it.
    Returns with ``passed``; of a fit ``samples``, ``fit`` by output and ``objections``.
    """
    part = reading.get("from_s"), reading.get("to_s")
    if isinstance(known, BlackBoxFit | NonlinearFit):
        if rig is not None:
            raise EstimationError(f"{path.name} is a black-box fit, which knows no rig. Leave --rig out")
        channels = Channels(
            inputs=known.inputs, outputs=known.outputs, rate_hz=reading.get("rate_hz"), gaps=reading.get("gaps")
        )
        data = channels.read(record, part)
        check_same_bench(known.units, known.dt, data)
        found = fit_validation(known, data)
        against = objections(known, found)
        return {"samples": data.n_samples, "fit": found, "passed": not against, "objections": list(against)}
    bench = rig_of(known, path) if rig is None else rig
    if isinstance(known, Estimate):
        return dict(validation(known, signals_of(load_bench(record, bench, **reading), model(known.model))))
    from ambid.job.bearing_records import bearing_rig, take_record
    from ambid.validation.nonlinear_bearing import validation as bearing_validation

    return dict(bearing_validation(known, take_record(record, bearing_rig(bench), reading).record))


def rig_of(estimate: AnyEstimate, path: Path) -> Rig:
    """Return the rig that an estimate remembers; `path` is its file, for messages."""
    text, folder = estimate.rig.get("text"), estimate.rig.get("folder")
    if not isinstance(text, str) or not isinstance(folder, str):
        raise EstimationError(f"estimate {path} does not hold its rig. Give --rig")
    try:
        return rig_from_text(text, Path(folder) / "rig.toml")
    except AmbidError as error:
        raise EstimationError(
            f"estimate {path}: the rig that it remembers cannot be used: {error}. Or give --rig"
        ) from None
