"""Results as they come from files, how they do on another record, and what a ledger has of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from ambid.bearing.magnet_result import NonlinearBearingEstimate, bearing_from_json
from ambid.blackbox.fit import BlackBoxFit, fit_from_json
from ambid.errors import AmbidError, EstimationError
from ambid.estimation.estimate import FIT_SCHEMA, Check, Estimate, estimate_from_json, read_as, read_whole
from ambid.estimation.estimate import SCHEMA as ESTIMATE
from ambid.job.data import Channels, Reading, RigSource, Source, check_same_bench, known_rig, load_bench, signals_of
from ambid.nonlinear.fit import NONLINEAR_STRUCTURES, NonlinearFit, nonlinear_fit_from_json
from ambid.physics.linear_model import model
from ambid.record import ENDINGS, GapPolicy, read_record
from ambid.record.record import file_bytes, utf8_text
from ambid.rig import Rig, rig_from_text
from ambid.rotor.estimate import RotorEstimate
from ambid.settings.caller import path_of, saved, setting
from ambid.settings.calls import of_job
from ambid.tracking.lines_file import SCHEMA as TRACK
from ambid.tracking.lines_file import read_track
from ambid.validation.fits import second_check
from ambid.validation.fits import validation as fit_validation
from ambid.validation.second_record import Validation, validation

if TYPE_CHECKING:
    from ambid.control.experiment import Experiment
    from ambid.ledger import History

AnyFit = BlackBoxFit | NonlinearFit
AnyEstimate = Estimate | NonlinearBearingEstimate | RotorEstimate
_BEGIN = 200  # letters in which a track says that it is one
_SHOWN = 12  # letters of what is no result
_EXPERIMENT = "ambid.experiment/1"


def load(path: str | Path) -> Any:
    """Read a file that ambid wrote or reads: a result of any verb, a record, a rig.

    Parameters
    ----------
    path : str or Path
        What `Result.save` or the command's option ``json`` wrote: an estimate, fit, track, frequency response,
        comparison, validation, inspection or acquisition. Or a record, as `ambid.read_record` reads it, or a rig.

    Returns
    -------
    Result, Record or Rig
        By the ending of the file. A result is without the record it was made from: give that as ``record=`` to figures
        that show it.

    Raises
    ------
    AmbidError
        If the file cannot be read, or is not complete.
    """
    path = path_of(path, "result")
    if path.name.lower().endswith(ENDINGS):
        return read_record(path)
    return known_rig(path) if path.suffix.lower() == ".toml" else load_result(path)


def load_result(path: str | Path) -> Any:
    """Read a result of any verb from its file."""
    path = path_of(path, "result")
    text = _text(path, "estimate")
    if f'"{TRACK}"' in text[:_BEGIN]:
        return read_track(path)
    return result_of(text, path)


def result_of(text: str, path: Path) -> Any:
    """Read a result that is no track from its JSON; `path`: where it is from, for messages."""
    document = _object(text, path, "estimate", "identify")
    read: Callable[[Mapping[str, Any], str], Any] = _READERS.get(str(document.get("schema")), _estimate)
    return read(document, str(path))


def _text(path: Path, what: str) -> str:
    return utf8_text(file_bytes(path, EstimationError, what), path, EstimationError, what)


def _object(text: str, path: Path, what: str, job: str) -> Mapping[str, Any]:
    """Parse the object that a result's file holds; `what` and `job`: the result and what wrote it, for messages."""
    advice = f"Give {saved(job)}"
    try:
        document = json.loads(text)
    except json.JSONDecodeError as failure:
        raise EstimationError(f"{what} {path}, row {failure.lineno}: not JSON ({failure.msg}). {advice}") from None
    except (RecursionError, ValueError):
        raise EstimationError(
            f"{what} {path} is nested too deeply, or holds a number that is too long. {advice}"
        ) from None
    if not isinstance(document, dict):
        raise EstimationError(f"{what} {path} holds {text.strip()[:_SHOWN]!r}, and no result, {{...}}. {advice}")
    return document


def _estimate(document: Mapping[str, Any], path: str) -> Any:
    from ambid.control.margins import AxisSensitivity

    nonlinear, where = "law" in document, f"estimate {path}"
    if document.get("sensitivity"):  # kept as it stands in the file, and judged only where it is shown
        kind = Mapping[str, AxisSensitivity]
        read_whole(lambda: read_as(kind, document["sensitivity"], "sensitivity"), where, "estimate", "identify")  # type: ignore[type-abstract]
    if "modes" in document:
        from ambid.rotor.estimate import rotor_estimate_from_json

        return rotor_estimate_from_json(document, where)
    return bearing_from_json(document, where) if nonlinear else estimate_from_json(document, where)


def _fit(document: Mapping[str, Any], path: str) -> AnyFit:
    nonlinear = str(document.get("structure")) in NONLINEAR_STRUCTURES
    where = f"fit {path}"
    return nonlinear_fit_from_json(document, where) if nonlinear else fit_from_json(document, where)


def _whole(module: str, name: str, job: str, *, own: str = "") -> Callable[[Mapping[str, Any], str], Any]:
    """Return a reader of a result whose file has all its fields by name; `own`: the reader of one that has not."""

    def read(document: Mapping[str, Any], path: str) -> Any:
        kind = getattr(import_module(f"ambid.{module}"), name)
        if own:
            return getattr(kind, own)(document, path)
        return read_whole(lambda: read_as(kind, document), f"{name.lower()} {path}", name.lower(), job)

    return read


def _measured(document: Mapping[str, Any], path: str) -> Any:
    from ambid.bearing.measured import measured_from_json

    return measured_from_json(document, f"frequency response {path}")


def _comparison(document: Mapping[str, Any], path: str) -> Any:
    from ambid.validation.comparison import comparison_from_json

    return comparison_from_json(document, f"comparison {path}")


_READERS: Mapping[str, Callable[[Mapping[str, Any], str], Any]] = {
    ESTIMATE: _estimate,
    FIT_SCHEMA: _fit,
    "ambid.frf/1": _measured,
    "ambid.comparison/1": _comparison,
    _EXPERIMENT: _whole("control.experiment", "Experiment", "design_experiment"),
    "ambid.design/1": _whole("control.design", "Design", "design_controller"),
    "ambid.history/1": _whole("ledger.history", "History", "history"),
    "ambid.commission/1": _whole("job.commissioning", "Commissioned", "commission", own="of_file"),
    "ambid.alarms/1": _whole("ledger.monitor", "Watched", "alarms"),
    "ambid.agreement/1": _whole("validation.agreement", "Agreement", "compare"),
    "ambid.acceptance/1": _whole("control.acceptance", "Acceptance", "accept"),
    "ambid.margins/1": _whole("control.margins", "Margins", "margins"),
    "ambid.validation/1": _whole("validation.second_record", "Validation", "validate"),
    "ambid.inspection/1": _whole("validation.inspection", "Inspection", "info"),
    "ambid.acquisition/1": _whole("acquisition.session", "Acquired", "acquire"),
    "ambid.fleet/1": _whole("ledger.store", "FleetRun", "fleet_run"),
    "ambid.recovery/1": _whole("acquisition.recorder", "Recorded", "recover"),
}


def experiment_of(excitation: object) -> Experiment | None:
    """Return the experiment that an excitation is, or the file of one; None for the name of another excitation."""
    if not isinstance(excitation, (str, Path)):
        from ambid.control.experiment import Experiment

        return excitation if isinstance(excitation, Experiment) else None
    if str(excitation).isalpha():
        return None
    refusal = f"{str(excitation)!r} is no experiment. Give {saved('design_experiment')}, or the name of an excitation"
    path = Path(excitation)
    if path.suffix.lower() != ".json":
        raise AmbidError(refusal)
    document = _object(_text(path, "experiment"), path, "experiment", "design_experiment")
    if document.get("schema") != _EXPERIMENT:
        raise AmbidError(refusal)
    found: Experiment = _READERS[_EXPERIMENT](document, str(path))
    return found


def data_of(
    known: AnyEstimate | AnyFit, record: Any, rig: Rig | None = None, *, where: str, **reading: Unpack[Reading]
) -> Any:
    """Read a further record as a result wants it: a Record, IOData of a fit, a TakenRecord of a nonlinear bearing, a
    tuple of a rotor. `rig`: default as the result remembers it; `where`: name of the result, for messages.
    """
    if isinstance(known, BlackBoxFit | NonlinearFit):
        if rig is not None:
            raise EstimationError(f"{where} is a black-box fit, which has no rig. Omit {setting('rig')}")
        channels = Channels(
            inputs=known.inputs, outputs=known.outputs, rate_hz=reading.get("rate_hz"), gaps=reading.get("gaps"),
            units=reading.get("units"), layout=reading.get("layout"),
        )  # fmt: skip
        data = channels.read(record, (reading.get("from_s"), reading.get("to_s")))
        check_same_bench(known.units, known.dt, data)
        return data
    bench = rig_of(known, where) if rig is None else rig
    if isinstance(known, RotorEstimate):
        return (load_bench(record, bench, **reading),)
    if isinstance(known, Estimate):
        return load_bench(record, bench, **reading)
    from ambid.job.nonlinear_bearing import bearing_rig, take_record

    return take_record(record, bearing_rig(bench), reading)


@of_job("validate")
def validate(
    estimate: AnyEstimate | AnyFit | str | Path,
    record: Source,
    rig: RigSource | None = None,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
) -> Validation:
    """Judge an estimate or a fit on another record of the same bench: nothing is fitted but offsets and initial state.

    Parameters
    ----------
    estimate : Estimate, NonlinearBearingEstimate, RotorEstimate, BlackBoxFit, NonlinearFit, str or Path
        A result, or its file.
    record : file, Record, DataFrame, Dataset or dict of arrays
        Of a rotor that moves; for a rotor on many axes with periodic excitation.
    rig : Rig, path, dict or TOML text, optional
        Through which the record is read; default: the rig that the estimate was made with.
    from_s, to_s, rate_hz, gaps, units, layout : optional
        As `ambid.identify`.

    Returns
    -------
    Validation

    Raises
    ------
    AmbidError
        If estimate, record or rig break a rule.
    """
    known = load_result(estimate) if isinstance(estimate, str | Path) else estimate
    name = Path(estimate).name if isinstance(estimate, str | Path) else ""
    reading = Reading(from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps, units=units, layout=layout)
    data = data_of(known, record, None if rig is None else known_rig(rig), where=name or "the estimate", **reading)
    if isinstance(known, BlackBoxFit | NonlinearFit):
        fit = fit_validation(known, data)
        found: dict[str, Any] = {
            "fit": fit,
            "checks": {"second_record": second_check(known, fit)},
            "samples": data.n_samples,
        }
        model_name, source = known.structure, data.record
    elif isinstance(known, RotorEstimate):
        from ambid.job.rotor import validated

        found, model_name = validated(known, data), known.model
        source = data[0].provenance
    elif isinstance(known, Estimate):
        found, model_name = dict(validation(known, signals_of(data, model(known.model)))), known.model
        source = data.provenance
    else:
        from ambid.validation.nonlinear_bearing import validation as bearing_validation

        found, model_name = dict(bearing_validation(known, data.record)), known.model
        source = data.remembered
    checks = {k: c if isinstance(c, Check) else read_as(Check, c, k) for k, c in found["checks"].items()}
    return Validation(
        used=(known, data), estimate=name, record=str(source.get("file") or ""), model=model_name,
        samples=found["samples"], fit=found["fit"], checks=checks,
    )  # fmt: skip


def rig_of(estimate: AnyEstimate | RotorEstimate, where: str) -> Rig:
    """Return the rig that an estimate remembers; `where` is its name, for messages."""
    text, folder = estimate.rig.get("text"), estimate.rig.get("folder")
    if not isinstance(text, str) or not isinstance(folder, str):
        raise EstimationError(f"{where} does not hold its rig. Give {setting('rig')}")
    try:
        return rig_from_text(text, Path(folder) / "rig.toml")
    except AmbidError as error:
        raise EstimationError(f"{where}: its rig cannot be used: {error}. Give {setting('rig')}") from None


def history(bearing: str, *, ledger: str | Path, every: bool = False) -> History:
    """Return what is known of a bearing over time.

    Of each record and job one estimate counts: that of the newest version of ambid, of several by it the latest.

    Parameters
    ----------
    bearing : str
        Its name; of a rotor the machine's.
    ledger : str or Path
        File of SQLite, or URL of PostgreSQL.
    every : bool, optional
        Also estimates that do not count.

    Returns
    -------
    History

    Raises
    ------
    AmbidError
        If there is no such ledger, or no such bearing in it.
    """
    from ambid.ledger import open_ledger

    with open_ledger(ledger, write=False) as found:
        return found.history(bearing, every=every)
