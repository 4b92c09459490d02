"""How each kind of result is shown: one register of text, figure, page, document and table; one function for each.

The methods of `ambid.estimation.result.Result` and the verbs come here; nothing else shows a result.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ambid.errors import AmbidError, EstimationError, counted
from ambid.estimation.estimate import EstimatedParameter, fields_json, json_text, plain_json
from ambid.estimation.result import Result
from ambid.job.files import PAGE_ENDINGS, Files
from ambid.record import Record, read_record
from ambid.recursive.lines import Track
from ambid.report.text import SPREAD, WIDTH, WORDS, Paint, joined, plain, verdict_lines

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ambid.physics.shaft import Shaft
    from ambid.report.page import Page
    from ambid.report.signal_panels import Traces

Table = tuple[str, Mapping[str, Sequence[object]]]
"""Name of the column that is the index, and the columns."""

_SHOWN = 6  # numbers in a short line


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """How one kind of result is shown."""

    text: Callable[..., str]  # what stands below the verdict; takes width and paint
    # of the result, what it was made from, None where that is not known, and the width of the page in inches
    figure: Callable[[Any, Any, float], Figure]
    document: Callable[[Any], str]  # its JSON
    table: Callable[[Any], Table]
    title: Callable[[Any], str]  # what it is, in a few words
    page: Callable[[Any, Any], Page] | None = None  # as `figure`, of any width; default: text and figure
    # what is drawn of a record that is given beside the result; default: as its model takes it
    beside: Callable[[Any, Any], Any] | None = None
    # records beside their predictions, where a page without a form of its own shows them down to the samples
    traces: Callable[[Any, Any], Sequence[Traces]] | None = None


def text(result: Result, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Return a result for people, the verdict first."""
    lines = verdict_lines(result.verdict, width=width, paint=paint)
    body = view(result).text(result, width=width, paint=paint)
    return joined([lines, [body], [paint(SPREAD, "dim")] if "±" in body else []])


def figure(result: Result, record: Any = None) -> Figure:
    """Draw a result beside a record, or what it was made from, with the verdict above."""
    from ambid.report.drawing import WIDE, judged

    return judged(view(result).figure(result, _beside(result, record), WIDE), result.verdict)


def page(result: Result, record: Any = None) -> str:
    """Return a page with a result and its figures as HTML."""
    from ambid.report.page import page_html

    return page_html(_page(result, record), result.verdict, made=_now())


def stage_page(files: Files, path: Path, result: Result, record: Any = None) -> None:
    """Write a page with a result and its figures, as HTML or PDF by the ending of `path`."""
    if path.name.lower().endswith(".pdf"):
        from ambid.report.book import page_pdf

        book = page_pdf(_page(result, record), result.verdict, made=_now())
        files.stage(path, lambda beside: beside.write_bytes(book))
    else:
        files.stage_text(path, page(result, record))


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


def _page(result: Result, record: Any) -> Page:
    from ambid.report.page import Page, Section
    from ambid.report.strips import CLOSE, strips_of

    known, used = view(result), _beside(result, record)
    if known.page is None:
        title = known.title(result)
        said = Section(title="Result", text=known.text(result, width=WIDTH, paint=plain))
        drawn = Section(title="Figures", figure=lambda width: known.figure(result, used, width))
        traces = () if known.traces is None else known.traces(result, used)
        close = [Section(title="Signals", caption=CLOSE, signals=[strips_of(t) for t in traces])] if traces else []
        return Page(title=title, sections=[said, *close, drawn])
    return _with_loop(result, used, known.page(result, used))


def _with_loop(result: Any, used: Any, made: Page) -> Page:
    """Return a page of an estimate with the margins of its loop, where that is known."""
    if not getattr(result, "sensitivity", None):
        return made
    from ambid.job.loop_margins import margins_beside
    from ambid.report.page import Section

    found = margins_beside(result, used)
    if found is None:
        return made
    known = _margins()
    section = Section(
        title="Margins of the loop", text=known.text(found, width=WIDTH, paint=plain),
        figure=lambda width: known.figure(found, None, width),
    )  # fmt: skip
    return replace(made, sections=[*made.sections[:-1], section, *made.sections[-1:]])


def document(result: Result) -> str:
    """Return the JSON of a result."""
    return view(result).document(result)


def dataframe(result: Result) -> Any:
    """Return the table of a result as a pandas.DataFrame."""
    try:
        import pandas
    except ImportError:
        raise AmbidError("pandas is not installed, and a DataFrame needs it. Install pandas") from None
    index, columns = view(result).table(result)
    return pandas.DataFrame(dict(columns)).set_index(index)


def line(result: Result) -> str:
    """Return a result on one line: what it is, the verdict, main numbers."""
    numbers = _numbers(result)
    shown = ", ".join(f"{name} {said}" for name, said in numbers[:_SHOWN])
    more = ", …" if len(numbers) > _SHOWN else ""
    words = WORDS[result.verdict.word][0]
    return f"<{type(result).__name__} {view(result).title(result)}: {words}{'; ' if shown else ''}{shown}{more}>"


def notebook(result: Result) -> str:
    """Return the verdict and the main numbers as a small table in HTML."""
    words = WORDS[result.verdict.word][0]
    head = f"<b>{html.escape(view(result).title(result))}</b>: {words}"
    reasons = "".join(f"<li>{html.escape(f'{r.check}: {r.text}')}</li>" for r in result.verdict.reasons)
    rows = "".join(f"<tr><th>{html.escape(n)}</th><td>{html.escape(said)}</td></tr>" for n, said in _numbers(result))
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


def view(result: Result) -> View:
    """Return how a result is shown."""
    name = type(result).__name__
    if name not in _VIEWS:
        raise EstimationError(f"a {name} has no text and no figure of its own. Show the result that it is part of")
    return _VIEWS[name]()


def _beside(result: Any, record: Any) -> Any:
    """Return what is drawn beside a result: a record that is given, read as it wants it, or what it was made from."""
    known = view(result)
    if record is None:
        return result.used
    if known.beside is not None:
        return known.beside(result, record)
    from ambid.job.results import data_of

    return data_of(result, record, where="the result")


def _numbers(result: Any) -> list[tuple[str, str]]:
    """Return name and value ± of a result's parameters, but fixed ones."""
    from ambid.report.numbers import quantity

    if isinstance(result, Track):
        names = result.lines[-1].parameters if result.lines else ()
        return [(n, quantity(result[n].value, result[n].sd, result[n].unit).text) for n in names]
    found: Sequence[EstimatedParameter] = getattr(result, "parameters", ())
    return [(p.name, quantity(p.value, p.sd, p.unit).text.removesuffix(" 1")) for p in found if p.role != "fixed"]


def parameter_columns(parameters: Sequence[EstimatedParameter]) -> Table:
    """Return parameters as columns, one row each."""
    columns: dict[str, list[object]] = {
        name: [getattr(p, name) for p in parameters] for name in ("name", "value", "sd", "unit", "role", "identifiable")
    }
    low, high = [p.ci95[0] for p in parameters], [p.ci95[1] for p in parameters]
    return "name", {**columns, "ci95_low": low, "ci95_high": high}


# --- the kinds ------------------------------------------------------------------------------------------------------


def _estimate() -> View:
    from ambid.physics.linear_model import model
    from ambid.report.figures import Evidence
    from ambid.validation.second_record import replay

    def evidence(e: Any, used: Any) -> Evidence:
        from ambid.job.data import signals_of

        run = None if used is None else replay(e, signals_of(used, model(e.model)))
        return Evidence(estimate=e, run=run, start_s=0.0 if used is None else used.start_s)

    return _of_evidence(evidence, lambda e: f"{e.record.get('file') or 'record'}, model {e.model}")


def _bearing() -> View:
    from ambid.report.estimate_text import names_words
    from ambid.report.figures import BearingEvidence, bearing_evidence

    def evidence(e: Any, used: Any) -> BearingEvidence:
        taken = () if used is None else used if isinstance(used, tuple) else (used,)
        return bearing_evidence(e, [(t.record, t.start_s) for t in taken])

    return _of_evidence(evidence, lambda e: f"{names_words(list(e.noise))}, {e.law}")


def _of_evidence(evidence: Callable[[Any, Any], Any], title: Callable[[Any], str]) -> View:
    """Return how an estimate is shown beside `evidence` of it and what it was made from."""
    from ambid.report.estimate_page import estimate_page
    from ambid.report.estimate_text import estimate_text
    from ambid.report.figures import overview

    return View(
        text=estimate_text,
        figure=lambda e, used, width: overview(evidence(e, used), width),
        page=lambda e, used: estimate_page(evidence(e, used)),
        document=lambda e: str(e.dumps()),
        table=lambda e: parameter_columns(e.parameters),
        title=title,
    )


def _fit() -> View:
    from ambid.blackbox.fit import BlackBoxFit
    from ambid.blackbox.fit_file import fit_text as linear_document
    from ambid.nonlinear.fit import nonlinear_fit_text
    from ambid.report.fit_figures import fit_overview, traces_of
    from ambid.report.fit_text import fit_text

    def records(used: Any) -> tuple[Any, Any]:
        return used if isinstance(used, tuple) else (() if used is None else (used,), None)

    def traces(f: Any, used: Any) -> Sequence[Traces]:
        first, second = records(used)
        own = [traces_of(f, x, title=f"record {k}" if len(first) > 1 else "") for k, x in enumerate(first, 1)]
        return own + ([] if second is None else [traces_of(f, second, second=True, title="second record")])

    return View(
        text=fit_text,
        figure=lambda f, used, width: fit_overview(f, *records(used), width),
        traces=traces,
        document=lambda f: linear_document(f) if isinstance(f, BlackBoxFit) else nonlinear_fit_text(f),
        table=lambda f: parameter_columns(f.parameters),
        title=lambda f: f"{', '.join(f.inputs)}{' → ' if f.inputs else ''}{', '.join(f.outputs)}, {f.structure}",
    )


def _validation() -> View:
    from ambid.bearing.magnet_result import NonlinearBearingEstimate
    from ambid.estimation.estimate import Estimate
    from ambid.job.rotor import replays_of
    from ambid.physics.linear_model import model
    from ambid.report.estimate_text import validation_text
    from ambid.report.figures import Evidence, bearing_evidence, validation_figure
    from ambid.report.fit_figures import traces_of
    from ambid.report.rotor_figures import residuals_block
    from ambid.rotor.estimate import RotorEstimate
    from ambid.validation.second_record import replay

    def beside(known: Any, data: Any) -> Sequence[Traces]:
        if isinstance(known, Estimate):
            from ambid.job.data import signals_of

            run = replay(known, signals_of(data, model(known.model)))
            return (Evidence(estimate=known, run=run, start_s=data.start_s).traces_ahead(),)
        if isinstance(known, NonlinearBearingEstimate):
            return bearing_evidence(known, [(data.record, data.start_s)]).traces
        return (traces_of(known, data, second=True),)

    def traces(_: Any, used: Any) -> Sequence[Traces]:
        return () if used is None or isinstance(used[0], RotorEstimate) else beside(*used)

    def drawn(v: Any, used: Any, width: float) -> Figure:
        turned = replays_of(*used) if used is not None and isinstance(used[0], RotorEstimate) else ()
        return validation_figure(v, traces(v, used), width, more=[residuals_block(run) for run in turned])

    return View(
        text=validation_text,
        figure=drawn,
        traces=traces,
        document=_fields_of("ambid.validation/1"),
        table=lambda v: ("output", {"output": list(v.fit), **_numbers_of(list(v.fit.values()))}),
        title=lambda v: f"{v.record or 'record'} tested with {v.estimate or 'an estimate'}, {v.model}",
    )


def _acquired() -> View:
    from ambid.report.device_text import acquired_text
    from ambid.report.record_figures import record_figure

    def where(a: Any) -> str:
        return "no record" if a.recorded is None else str(a.recorded.path)

    def drawn(a: Any, used: Any, width: float) -> Figure:
        at = used or (a.recorded is not None and a.recorded.path)
        record = read_record(at, gaps="interpolate") if at and Path(at).exists() else None
        return record_figure(record, f"{where(a)}, from {a.info.kind} {a.info.port}", a.quality.columns, width)

    return View(
        text=acquired_text, figure=drawn, document=_fields_of("ambid.acquisition/1"),
        table=lambda a: ("name", _numbers_of([fields_json(c) for c in a.quality.columns])),
        title=lambda a: f"{where(a)}, {a.stored} samples from {a.info.kind} {a.info.port}", beside=lambda _, at: at,
    )  # fmt: skip


def _recorded() -> View:
    from ambid.report.device_text import recorded_text
    from ambid.report.record_figures import record_figure

    def drawn(r: Any, used: Any, width: float) -> Figure:
        return record_figure(read_record(used or r.path, gaps="interpolate"), title(r), (), width)

    def title(r: Any) -> str:
        return f"{r.path}, {r.survey.samples} samples from a journal"

    return View(
        text=recorded_text, figure=drawn, document=_fields_of("ambid.recovery/1"), title=title,
        table=lambda r: ("path", {"path": [str(r.path)], **_numbers_of([fields_json(r.survey)])}),
        beside=lambda _, at: at,
    )  # fmt: skip


def _inspection() -> View:
    from ambid.report.record_figures import record_figure
    from ambid.report.tables import inspection_text
    from ambid.validation.inspection import SCHEMA

    return View(
        text=inspection_text,
        figure=lambda i, used, w: record_figure(used, f"{i.record['file'] or 'record'}: channels", i.channels, w),
        document=_fields_of(SCHEMA),
        table=lambda i: ("name", _numbers_of([fields_json(c) for c in i.channels])),
        title=lambda i: f"{i.record['file'] or 'record'}, {i.record['samples']} samples at {i.record['rate_hz']:g} Hz",
        beside=lambda _, record: record if isinstance(record, Record) else read_record(record),
    )


def _track() -> View:
    from ambid.job.following import Followed
    from ambid.job.track_truth import truth_beside
    from ambid.report.track_figures import TrackHistory, track_figure
    from ambid.report.track_text import track_text
    from ambid.tracking.lines_file import track_document

    def drawn(t: Any, used: Followed | None, width: float) -> Figure:
        history = (None if used is None else used.history) or TrackHistory.of(t)
        if used is None or used.record is None:
            return track_figure(history, width=width)
        units = {name: history.header.units.get(name, "") for name in history.names}
        return track_figure(history, truth=truth_beside(used.record, used.rate_hz, units), width=width)

    def table(t: Any) -> Table:
        history = TrackHistory.of(t)
        columns: dict[str, Any] = {"t": history.t, "state": [x.state for x in t.lines], "error": history.error}
        for name in history.names:
            columns |= dict(zip((name, f"{name} sd"), history.values(name)[:2], strict=True))
        return "t", columns

    return View(
        text=lambda t, **how: track_text(t, events=() if t.used is None else t.used.events, **how),
        figure=drawn, document=track_document, table=table, beside=lambda _, record: Followed(record=record),
        title=lambda t: f"{t.header.record.get('file') or 'record'}, track of {t.totals.seconds_of_record:.4g} s",
    )  # fmt: skip


def _measured() -> View:
    from ambid.bearing.measured import measured_text
    from ambid.report.fit_text import frf_text
    from ambid.report.response_figures import frf_figure

    def table(m: Any) -> Table:
        frf = m.response
        columns: dict[str, Any] = {"frequency_hz": frf.frequency_hz}
        for j, o in enumerate(frf.outputs):
            for k, i in enumerate(frf.inputs):
                columns |= {f"{o}/{i}": frf.G[:, j, k], f"{o}/{i} sd": frf.sd[:, j, k]}
        return "frequency_hz", columns

    return View(
        text=frf_text, figure=lambda m, _, width: frf_figure(m, width), document=measured_text, table=table,
        title=lambda m: f"{m.record.get('file') or 'record'}, frequency response, {m.response.frequency_hz.size} lines",
    )  # fmt: skip


def _comparison() -> View:
    from ambid.report.fit_figures import comparison_figure
    from ambid.report.tables import comparison_text

    def document(c: Any) -> str:
        return json_text({"schema": "ambid.comparison/1", "record": c.record.get("file"), **plain_json(c.as_dict())})

    def table(c: Any) -> Table:
        names = ("structure", "orders", "one_step", "simulation", "seconds", "n_estimated", "bic", "failed")
        rows = [(x.structure, x.orders, x.one_step, x.simulation, x.seconds, x.fit and x.fit.n_estimated,
                 x.fit and x.fit.criteria.get("bic"), ", ".join(x.failed)) for x in c.entries]  # fmt: skip
        return "structure", dict(zip(names, zip(*rows, strict=True), strict=True))

    return View(
        text=comparison_text, figure=comparison_figure, document=document, table=table,
        title=lambda c: f"{c.record.get('file') or 'record'}, {len(c.entries)} structures compared",
    )  # fmt: skip


def _commissioned() -> View:
    from ambid.report.commission_page import commission_page
    from ambid.report.drawing import stacked
    from ambid.report.page import Section
    from ambid.report.track_figures import track_figure
    from ambid.rig import rig_text

    def title(c: Any) -> str:
        return f"Commissioning: {c.rig.name}"

    def drawn(c: Any, _: Any, width: float) -> Figure:
        return stacked(title(c), [p.block for step in c.steps for p in step.pictures], width)

    def made(c: Any, _: Any) -> Page:
        more: dict[str, list[Section]] = {}
        if c.estimate is not None:
            known = view(c.estimate)
            assert known.page is not None
            sections = known.page(c.estimate, c.estimate.used).sections  # signals: in record.h5, and not here too
            more["identify"] = [replace(s, signals=()) for s in sections if s.title != "Rig"]
        if c.track is not None:
            caption = "Each parameter with its 95 % band while the bench runs, the model error against its limit."
            more["track"] = [
                Section(title="Live track", caption=caption, figure=lambda width: track_figure(c.track, width=width))
            ]
        where = f"{c.device.kind} {c.device.port}, {c.device.rate_hz:g} Hz"
        return commission_page(
            title(c), c.steps, c.names, subtitle=where, more=more, rig=rig_text(c.rig, c.folder),
            provenance=[("rig", str(c.rig.source or c.rig.name)), ("device", where), ("folder", str(c.folder))],
        )  # fmt: skip

    def said(c: Any, *, width: int = WIDTH, paint: Paint = plain) -> str:
        from ambid.report.device_text import step_text

        of = len(c.names)
        return "\n".join(step_text(s, f"{k}/{of}", width=width, paint=paint) for k, s in enumerate(c.steps, 1))

    def table(c: Any) -> Table:
        names = [s.name for s in c.steps]
        return "step", {"step": names, "passed": [s.passed for s in c.steps]}

    return View(text=said, figure=drawn, page=made, document=lambda c: str(c.dumps()), table=table, title=title)


def _fields_of(schema: str) -> Callable[[Any], str]:
    """Return a writer of all fields of a result."""

    def write(result: Any) -> str:
        return json_text({"schema": schema, **fields_json(result), "passed": result.passed})

    return write


def _numbers_of(rows: Sequence[Any]) -> dict[str, list[object]]:
    """Return the numbers that all rows have, by name; those of a number in another behind a dot."""
    flat = [_flat(row) for row in rows]
    return {name: [row.get(name) for row in flat] for name in (flat[0] if flat else ())}


def _flat(row: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, x in row.items():
        found |= _flat(x, f"{before}{name}.") if isinstance(x, Mapping) else {f"{before}{name}": x}
    return found


def _modal() -> View:
    from ambid.report.modes_text import modal_text, mode_table
    from ambid.report.response_figures import modal_figure

    return View(
        text=modal_text, figure=lambda m, _, width: modal_figure(m, width), document=_fields_of("ambid.modes/1"),
        table=lambda m: ("mode", mode_table(m.modes)),
        title=lambda m: f"{m.record.get('file') or 'record'}, {len(m.modes)} modes",
    )  # fmt: skip


def _rotor() -> View:
    from ambid.job.results import rig_of
    from ambid.job.rotor import replays_of
    from ambid.report.rotor_figures import RotorEvidence, rotor_overview
    from ambid.report.rotor_page import rotor_page
    from ambid.report.rotor_text import rotor_text

    def shaft(e: Any) -> Shaft | None:
        try:
            return rig_of(e, "the estimate").shaft
        except AmbidError:  # its text alone may say no more where it lies now
            return None

    def evidence(e: Any, used: Any) -> RotorEvidence:
        taken = () if used is None else tuple(used)
        runs = () if used is None else replays_of(e, used)
        return RotorEvidence(estimate=e, runs=runs, shaft=shaft(e), records=taken)

    return View(
        text=lambda e, **how: rotor_text(e, shaft=shaft(e), **how),
        figure=lambda e, used, width: rotor_overview(evidence(e, used), width),
        page=lambda e, used: rotor_page(evidence(e, used)),
        document=lambda e: str(e.dumps()),
        table=lambda e: parameter_columns((*e.parameters, *e.mode_parameters)),
        title=lambda e: f"{e.record.get('file') or 'record'}, rotor on {len(e.plant.axes)} axes",
    )


def _margins() -> View:
    from ambid.control.margins import SCHEMA
    from ambid.report.margins_figures import margins_figure
    from ambid.report.margins_text import margins_text

    def title(m: Any) -> str:
        return f"{m.record.get('file') or 'record'}, margins of the loop of model {m.model}"

    def table(m: Any) -> Table:
        rows = [{**fields_json(s), **fields_json(m.margins[axis])} for axis, s in m.sensitivity.items()]
        return "axis", {"axis": list(m.sensitivity), **_numbers_of(rows)}

    return View(
        text=margins_text, figure=lambda m, _, width: margins_figure(m, title(m), width),
        document=_fields_of(SCHEMA), table=table, title=title,
    )  # fmt: skip


def _experiment() -> View:
    from ambid.control.experiment import SCHEMA
    from ambid.report.experiment_figures import experiment_figure
    from ambid.report.experiment_text import experiment_text, title_of

    def table(x: Any) -> Table:
        rows = [fields_json(e) for e in x.expected.values()]
        return "name", {"name": list(x.expected), **_numbers_of(rows)}

    return View(
        text=experiment_text, figure=lambda x, _, width: experiment_figure(x, title_of(x), width),
        document=_fields_of(SCHEMA), table=table, title=title_of,
    )  # fmt: skip


def _design() -> View:
    from ambid.control.design import FIGURES, SCHEMA
    from ambid.report.design_figures import design_figure
    from ambid.report.design_text import design_text

    def title(d: Any) -> str:
        return f"{d.record.get('file') or 'record'}, controller for model {d.model}"

    def table(d: Any) -> Table:
        found = {"before": d.before, "after": d.after}
        worst = {f"worst.{name}": [getattr(s.worst, name) for s in found.values()] for name in (*FIGURES, "pole")}
        return "loop", {"loop": list(found), **_numbers_of([fields_json(s.figures) for s in found.values()]), **worst}

    return View(
        text=design_text, figure=lambda d, _, width: design_figure(d, title(d), width),
        document=_fields_of(SCHEMA), table=table, title=title,
    )  # fmt: skip


def _history() -> View:
    from ambid.ledger.history import SCHEMA
    from ambid.report.history_figures import dates, history_figure
    from ambid.report.history_text import history_text

    def table(h: Any) -> Table:
        import numpy as np

        n = len(h.estimates)
        columns: dict[str, Any] = {"taken_at": dates(np.array([e.taken_at for e in h.estimates]))}
        columns |= {name: [getattr(e, name) for e in h.estimates] for name in ("record", "verdict", "failed")}
        for name, s in h.measured.items():
            for what, values in ((name, s.value), (f"{name} sd", s.sd)):
                columns[what] = np.full(n, np.nan)
                columns[what][s.estimate] = values
        return "taken_at", columns

    def title(h: Any) -> str:
        return f"{h.bearing}, history of {counted(len(h.estimates), 'estimate')}"

    return View(
        text=history_text, figure=lambda h, _, width: history_figure(h, title(h), width),
        document=_fields_of(SCHEMA), table=table, title=title,
    )  # fmt: skip


def _value_columns(rows: Sequence[Any], names: Iterable[str]) -> dict[str, list[object]]:
    """Return value and standard deviation of each name, as rows hold them in `values`."""
    return {
        what: [row.values.get(name, (None, None))[k] for row in rows]
        for name in names for k, what in enumerate((name, f"{name} sd"))
    }  # fmt: skip


def _coverage() -> View:
    from ambid.report.coverage_text import coverage_figure, coverage_text, coverage_title
    from ambid.validation.coverage import SCHEMA

    def table(c: Any) -> Table:
        columns: dict[str, list[object]] = {n: [getattr(t, n) for t in c.trials] for n in ("seed", "verdict", "reason")}
        return "seed", columns | _value_columns(c.trials, c.truth)

    return View(
        text=coverage_text, figure=lambda c, _, width: coverage_figure(c, coverage_title(c), width),
        document=_fields_of(SCHEMA), table=table, title=coverage_title,
    )  # fmt: skip


def _watched() -> View:
    from dataclasses import fields

    from ambid.ledger.monitor import SCHEMA, Alarm
    from ambid.report.watch_text import watch_figure, watch_text, watch_title

    def table(w: Any) -> Table:
        return "bearing", {f.name: [getattr(a, f.name) for a in w.alarms] for f in fields(Alarm)}

    return View(
        text=watch_text, figure=lambda w, _, width: watch_figure(w, watch_title(w), width),
        document=_fields_of(SCHEMA), table=table, title=watch_title,
    )  # fmt: skip


def _fleet_run() -> View:
    from ambid.ledger.fleet_run import SCHEMA
    from ambid.report.fleet_text import fleet_figure, fleet_text, fleet_title

    def table(f: Any) -> Table:
        names = ("record", "bearing", "rig", "taken_at", "state", "status", "verdict", "checks", "reason", "seconds")
        columns: dict[str, list[object]] = {name: [getattr(row, name) for row in f.rows] for name in names}
        columns["checks"] = [", ".join(row.checks) for row in f.rows]
        return "record", columns | _value_columns(f.rows, dict.fromkeys(name for row in f.rows for name in row.values))

    return View(
        text=fleet_text, figure=lambda f, _, width: fleet_figure(f, fleet_title(f), width),
        document=_fields_of(SCHEMA), table=table, title=fleet_title,
    )  # fmt: skip


_VIEWS: Mapping[str, Callable[[], View]] = {
    "History": _history,
    "RotorEstimate": _rotor,
    "Estimate": _estimate,
    "NonlinearBearingEstimate": _bearing,
    "BlackBoxFit": _fit,
    "NonlinearFit": _fit,
    "Validation": _validation,
    "Measured": _measured,
    "Modal": _modal,
    "Margins": _margins,
    "Experiment": _experiment,
    "Design": _design,
    "Track": _track,
    "Inspection": _inspection,
    "Acquired": _acquired,
    "Recorded": _recorded,
    "Comparison": _comparison,
    "Commissioned": _commissioned,
    "FleetRun": _fleet_run,
    "Watched": _watched,
    "Coverage": _coverage,
}
"""By the name of the result's class: what shows it is imported when one is shown."""
