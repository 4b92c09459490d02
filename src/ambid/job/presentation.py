"""How each kind of result is shown: one register of what describes it, what it is drawn beside, and its JSON; nothing
else shows one. What there is to see is a `Document` of `ambid.report`: text, figure, page, table and short forms.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambid.errors import AmbidError, EstimationError, needs
from ambid.estimation.estimate import fields_json, json_text, plain_json
from ambid.estimation.result import Result
from ambid.job.files import PAGE_ENDINGS, Files
from ambid.record import Record, read_record
from ambid.report.document import (
    Document,
    Lines,
    Section,
    page_sections,
    plain_parts,
    terminal,
    told_sections,
    warnings_of,
)
from ambid.report.text import SPREAD, WIDTH, WORDS, Paint, joined, plain, verdict_lines

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ambid.physics.shaft import Shaft
    from ambid.report.signals import Traces

_SHOWN = 6  # numbers in a short line
_OF_LOOPS = ("Estimate", "RotorEstimate")  # whose page shows the margins of their loop


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """How one kind of result is shown."""

    # a result and what it is drawn beside, None where that is not known
    describe: Callable[[Any, Any], Document]
    write: Callable[[Any], str]  # its JSON
    # what is drawn of a record that is given beside the result; default: as its model takes it
    beside: Callable[[Any, Any], Any] | None = None


def text(result: Result, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Return a result for people, the verdict first."""
    lines = verdict_lines(result.verdict, width=width, paint=paint)
    body = terminal(document_of(result), width=width, paint=paint)
    return joined([lines, [body], [paint(SPREAD, "dim")] if "±" in body else []])


def content(result: Result) -> dict[str, Any]:
    """Return a result, the verdict first, without figures, in the types of JSON, for whoever shows it otherwise."""
    about = document_of(result)
    return {
        "verdict": result.verdict.word, "reasons": [f"{r.check}: {r.text}" for r in result.verdict.reasons],
        "title": about.headline or about.title, "subtitle": about.subtitle, "warnings": warnings_of(about),
        "sections": [
            {"title": s.title, "folded": s.folded, "note": s.note, "parts": plain_parts(s.parts)}
            for s in told_sections(about)
        ],
        "spread": SPREAD,
    }  # fmt: skip


def figure(result: Result, record: Any = None, ax: Any = None) -> Figure:
    """Draw a result beside a record, or what it was made from, with the verdict above; into axes without it."""
    from ambid.report.drawing import into, judged

    page = into(ax, lambda: drawing(result, record))
    return page if ax is not None else judged(page, result.verdict)


def drawing(result: Result, record: Any = None) -> Figure:
    """Draw a result beside a record, or what it was made from."""
    from ambid.report.drawing import WIDE

    return document_of(result, record).figure(WIDE)


def page(result: Result, record: Any = None) -> str:
    """Return a page with a result and its figures as HTML."""
    from ambid.report.page import page_html

    return page_html(_with_loop(result, record), result.verdict, made=_now())


def stage_page(files: Files, path: Path, result: Result, record: Any = None) -> None:
    """Write a page with a result and its figures, as HTML or PDF by the ending of `path`."""
    if path.name.lower().endswith(".pdf"):
        from ambid.report.page import page_pdf

        book = page_pdf(_with_loop(result, record), result.verdict, made=_now())
        files.stage(path, lambda beside: beside.write_bytes(book))
    else:
        files.stage_text(path, page(result, record))


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


def _with_loop(result: Any, record: Any) -> Document:
    """Return the document of a page: of an estimate with the margins of its loop, where that is known."""
    document = document_of(result, record)
    if type(result).__name__ not in _OF_LOOPS or not result.sensitivity:
        return document
    from ambid.job.loop_margins import margins_beside

    margins = margins_beside(result, _beside(result, record))
    if margins is None:
        return document
    of_loop = document_of(margins)
    heads = [[Lines(lines=[s.heading])] if s.heading else [] for s in of_loop.sections]
    parts = [part for head, s in zip(heads, of_loop.sections, strict=True) if s.page for part in (*head, *s.parts)]
    section = Section(title="Margins of the loop", parts=parts, figure=of_loop.figure)
    return replace(document, appendix=lambda: [section, *document.appendix()])


def document(result: Result) -> str:
    """Return the JSON of a result."""
    return _kind(result).write(result)


def dataframe(result: Result) -> Any:
    """Return the table of a result as a pandas.DataFrame."""
    with needs("pandas", "a DataFrame", "frames"):
        import pandas
    index, columns = document_of(result).frame()
    return pandas.DataFrame(dict(columns)).set_index(index)


def line(result: Result) -> str:
    """Return a result on one line: what it is, the verdict, main numbers."""
    about = document_of(result)
    shown = ", ".join(f"{name} {value}" for name, value in about.numbers[:_SHOWN])
    more = ", …" if len(about.numbers) > _SHOWN else ""
    words = WORDS[result.verdict.word][0]
    return f"<{type(result).__name__} {about.title}: {words}{'; ' if shown else ''}{shown}{more}>"


def notebook(result: Result) -> str:
    """Return the verdict and the main numbers as a small table in HTML."""
    about = document_of(result)
    head = f"<b>{html.escape(about.title)}</b>: {WORDS[result.verdict.word][0]}"
    reasons = "".join(f"<li>{html.escape(f'{r.check}: {r.text}')}</li>" for r in result.verdict.reasons)
    rows = "".join(f"<tr><th>{html.escape(n)}</th><td>{html.escape(value)}</td></tr>" for n, value in about.numbers)
    return f"<div>{head}{f'<ul>{reasons}</ul>' if reasons else ''}<table>{rows}</table></div>"


def write_page(result: Result, path: str | Path, record: Any = None) -> None:
    """Write the page of a result."""
    with Files() as files:
        files.claim(Path(path), "path", PAGE_ENDINGS)
        stage_page(files, Path(path), result, record)


def write_document(result: Result, path: str | Path) -> None:
    """Write the JSON of a result."""
    with Files() as files:
        files.claim(Path(path), "path")
        files.stage_text(Path(path), document(result))


def document_of(result: Result, record: Any = None) -> Document:
    """Return what there is to see of a result; `record`: drawn beside it, default: what it was made from."""
    return _kind(result).describe(result, _beside(result, record))


def _kind(result: Result) -> Kind:
    name = type(result).__name__
    if name not in _KINDS:
        raise EstimationError(f"a {name} has no text and no figure of its own. Show the result that it is part of")
    return _KINDS[name]


def _beside(result: Any, record: Any) -> Any:
    """Return what is drawn beside a result: a record that is given, read as it wants it, or what it was made from."""
    beside = _kind(result).beside
    if record is None:
        return result.used
    if beside is not None:
        return beside(result, record)
    from ambid.job.results import data_of

    return data_of(result, record, where="the result")


# --- what describes each kind ---------------------------------------------------------------------------------------


def _declared(place: str) -> Callable[[Any, Any], Document]:
    """Return a description that needs nothing but the result and what it was made from; `place`: ``file.function``."""
    module, function = place.split(".")

    def describe(result: Any, used: Any) -> Document:
        document: Document = getattr(import_module(f"ambid.report.{module}"), function)(result, used)
        return document

    return describe


def _estimate(e: Any, used: Any) -> Document:
    from ambid.report.estimate import estimate_document

    @cache
    def evidence() -> Any:
        from ambid.job.data import signals_of
        from ambid.physics.linear_model import model
        from ambid.report.estimate_figures import Evidence
        from ambid.validation.second_record import replay

        run = None if used is None else replay(e, signals_of(used, model(e.model)))
        return Evidence(estimate=e, run=run, start_s=0.0 if used is None else used.start_s)

    return estimate_document(e, evidence)


def _bearing(e: Any, used: Any) -> Document:
    from ambid.report.estimate import estimate_document

    @cache
    def evidence() -> Any:
        from ambid.report.estimate_figures import bearing_evidence

        records = () if used is None else used if isinstance(used, tuple) else (used,)
        return bearing_evidence(e, [(x.record, x.start_s) for x in records])

    return estimate_document(e, evidence)


def _validation(v: Any, used: Any) -> Document:
    from ambid.report.estimate import validation_document

    def traces() -> Sequence[Traces]:
        """The record beside its predictions."""
        from ambid.bearing.magnet_result import NonlinearBearingEstimate
        from ambid.estimation.estimate import Estimate
        from ambid.report.estimate_figures import Evidence, bearing_evidence
        from ambid.report.fit_figures import traces_of

        estimate, data = used
        if isinstance(estimate, NonlinearBearingEstimate):
            return bearing_evidence(estimate, [(data.record, data.start_s)]).records
        if not isinstance(estimate, Estimate):
            return (traces_of(estimate, data, second=True),)
        from ambid.job.data import signals_of
        from ambid.physics.linear_model import model
        from ambid.validation.second_record import replay

        run = replay(estimate, signals_of(data, model(estimate.model)))
        return (Evidence(estimate=estimate, run=run, start_s=data.start_s).traces_ahead(),)

    of_rotor = used is not None and type(used[0]).__name__ == "RotorEstimate"

    def runs() -> Sequence[Any]:
        from ambid.job.rotor import replays_of

        return replays_of(*used) if of_rotor else ()

    return validation_document(v, cache(traces) if used is not None and not of_rotor else tuple, runs)


def _rotor(e: Any, used: Any) -> Document:
    from ambid.job.results import rig_of
    from ambid.job.rotor import replays_of
    from ambid.report.rotor import rotor_document

    try:
        shaft: Shaft | None = rig_of(e, "the estimate").shaft
    except AmbidError:  # its text alone may say no more where it lies now
        shaft = None

    @cache
    def evidence() -> Any:
        from ambid.report.rotor_figures import RotorEvidence

        runs = () if used is None else replays_of(e, used)
        return RotorEvidence(estimate=e, runs=runs, shaft=shaft, records=() if used is None else tuple(used))

    return rotor_document(e, shaft, evidence)


def _track(t: Any, used: Any) -> Document:
    from ambid.report.track import track_document

    def truth(units: Mapping[str, str]) -> Any:
        from ambid.job.following import truth_beside

        return None if used.record is None else truth_beside(used.record, used.rate_hz, units)

    if used is None:
        return track_document(t)
    return track_document(t, events=used.events, history=used.history, truth=truth)


def _followed(_: Any, record: Any) -> Any:
    from ambid.job.following import Followed

    return Followed(record=record)


def _commissioned(c: Any, _: Any) -> Document:
    from ambid.report.commission import commission_document
    from ambid.rig import rig_text

    def identified() -> list[Section]:
        """Sections of the estimate's page; signals are in record.h5, and not here too."""
        sections = page_sections(document_of(c.estimate))
        return [replace(s, signals=()) for s in sections if s.title != "Rig"]

    def tracked() -> list[Section]:
        from ambid.report.track_figures import track_figure

        caption = "Each parameter with its 95 % band while the bench runs, the model error against its limit."
        figure = lambda width: track_figure(c.track, width=width)  # noqa: E731
        return [Section(title="Live track", caption=caption, figure=figure)]

    where = f"{c.device.kind} {c.device.port}, {c.device.rate_hz:g} Hz"
    more: dict[str, Callable[[], Sequence[Section]]] = {}
    more |= {} if c.estimate is None else {"identify": identified}
    more |= {} if c.track is None else {"track": tracked}
    return commission_document(c, where, rig_text(c.rig, c.folder), more)


# --- JSON -----------------------------------------------------------------------------------------------------------


def _dumps(result: Any) -> str:
    return str(result.dumps())


def _written(place: str) -> Callable[[Any], str]:
    """Return the writer of a kind whose document has a form of its own; `place`: ``room.file.function``."""
    module, _, function = place.rpartition(".")
    return lambda result: str(getattr(import_module(f"ambid.{module}"), function)(result))


def _fields(schema: str, result: Any) -> str:
    """Write all fields of a result."""
    return json_text({"schema": schema, **fields_json(result), "passed": result.passed})


def _compared(c: Any) -> str:
    return json_text({"schema": "ambid.comparison/1", "record": c.record.get("file"), **plain_json(c.as_dict())})


def _whole(place: str, schema: str, beside: Callable[[Any, Any], Any] | None = None) -> Kind:
    return Kind(describe=_declared(place), write=partial(_fields, f"ambid.{schema}/1"), beside=beside)


def _path(_: Any, at: Any) -> Any:
    return at


def _record(_: Any, record: Any) -> Record:
    return record if isinstance(record, Record) else read_record(record)


_FIT = _declared("fit.fit_document")
_KINDS: Mapping[str, Kind] = {
    "Estimate": Kind(describe=_estimate, write=_dumps),
    "NonlinearBearingEstimate": Kind(describe=_bearing, write=_dumps),
    "RotorEstimate": Kind(describe=_rotor, write=_dumps),
    "BlackBoxFit": Kind(describe=_FIT, write=_written("blackbox.fit.fit_text")),
    "NonlinearFit": Kind(describe=_FIT, write=_written("nonlinear.fit.nonlinear_fit_text")),
    "Measured": Kind(
        describe=_declared("response.response_document"), write=_written("bearing.measured.measured_text")
    ),
    "Comparison": Kind(describe=_declared("fit.comparison_document"), write=_compared),
    "Agreement": _whole("agreement.agreement_document", "agreement"),
    "Commissioned": Kind(describe=_commissioned, write=_dumps),
    "Track": Kind(describe=_track, write=_written("tracking.lines_file.track_document"), beside=_followed),
    "Validation": Kind(describe=_validation, write=partial(_fields, "ambid.validation/1")),
    "Margins": _whole("margins.margins_document", "margins"),
    "Acceptance": _whole("acceptance.acceptance_document", "acceptance"),
    "Experiment": _whole("experiment.experiment_document", "experiment"),
    "Design": _whole("design.design_document", "design"),
    "Inspection": _whole("record.inspection_document", "inspection", _record),
    "Acquired": _whole("device.acquired_document", "acquisition", _path),
    "Recorded": _whole("device.recorded_document", "recovery", _path),
    "History": _whole("history.history_document", "history"),
    "Watched": _whole("history.watch_document", "alarms"),
    "FleetRun": _whole("fleet.fleet_document", "fleet"),
}
"""By the name of the result's class: what shows it is imported when one is shown."""
