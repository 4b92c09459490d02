"""Physical parameters as people see them: of a record, a nonlinear bearing, a black box; and a second record."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.magnet_result import Curve, NonlinearBearingEstimate
from ambid.control.zones import Zone
from ambid.errors import counted
from ambid.estimation.estimate import Check, Estimate, Judged
from ambid.estimation.result import RecordEntry
from ambid.physics.law_magnet import BEARING_NUMBERS
from ambid.physics.linear_model import model
from ambid.report.document import (
    Checks,
    Document,
    Fitting,
    Lines,
    Part,
    Preformatted,
    Section,
    Table,
    Warnings,
    grid,
    numbers_of,
    timing_section,
)
from ambid.report.numbers import prefixed, sized
from ambid.report.parameters import calibration_lines, fit_table, parameter_table, pole_table, short_numbers
from ambid.report.text import (
    Cell,
    Line,
    delay_line,
    fraction,
    names_words,
    other_warnings,
    pure,
    status_words,
    title_line,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ambid.bearing.frequency import FrequencyEstimate
    from ambid.bearing.physical import PhysicalFit
    from ambid.report.estimate_figures import BearingEvidence, Evidence
    from ambid.report.response_panels import Pole
    from ambid.report.signals import Traces
    from ambid.rotor.replay import RotorReplay
    from ambid.validation.second_record import Validation

AnyEstimate = Estimate | NonlinearBearingEstimate

_POSITIONS, _CURRENTS = 5, 3  # of the table of curves
_UNITS = {"position": "m", "current": "A"}
_SIGNS = "Sign convention: force = k_i · current − k_x · position; an attracting magnet has k_x < 0."
_SOURCES = {"information": "information matrix", "robust": "scatter over the record (robust)"}
_TOGETHER = "Parameters with a correlation near ±1 are known only together: the data show their combination."
_OUTSIDE = "* outside the recorded range: the law extrapolates; its sd does not cover that"
_CAPTIONS = {
    "signals": (
        "Measured and predicted",
        "Each sample predicted from all samples before it. Shaded: the stretch with the largest errors. Long records "
        "are drawn by the extremes of short stretches.",
    ),
    "residuals": (
        "Residuals",
        "What the predictions leave of the measurement. For a right model 5 % of them lie outside the dashed bounds, "
        "and their spectrum is flat.",
    ),
    "whiteness": (
        "Residual tests",
        "Residuals of a right model are correlated neither with their own past nor with past inputs. The verdicts are "
        "those of the checks, which allow for the estimated parameters; the bands do not.",
    ),
    "bode": (
        "Frequency response of the identified plant",
        "From the physical parameters, with the 95 % interval that their covariance gives. Points: measured without a "
        "model, hold and delay of the input taken out.",
    ),
    "poles": ("Poles", "Of the identified plant in open loop, with their 95 % regions."),
    "force": (
        "Force",
        "Force of the magnet over position and current, and how well it is known. Points: samples of the free rotor.",
    ),
    "curves": (
        "Curves",
        "From one co-energy, so that force and back-EMF agree. Dotted outside the recorded range: there the law "
        "extrapolates, which the interval does not cover.",
    ),
    "map": (
        "Range of the records",
        "Each point is a sample. For one magnet, a rotor at rest lies where the force equals its weight.",
    ),
    "records": (
        "Records",
        "Each sample predicted from all samples before it; residuals over the standard deviation that the predictor "
        "expects of them. For a right model 5 % lie outside the dashed bounds.",
    ),
}


def estimate_document(estimate: AnyEstimate, evidence: Callable[[], Evidence | BearingEvidence]) -> Document:
    """Describe an estimate, linear or of a nonlinear bearing; `evidence`: what its figures show beside it."""
    e, linear = estimate, isinstance(estimate, Estimate)
    meanings = {spec.name: spec.meaning for spec in (*model(e.model).parameters, *BEARING_NUMBERS)}
    table = parameter_table(e.parameters, e.verdict, meanings)
    note = f"{_SIGNS} Standard deviations are from the {_SOURCES[e.covariance_method]}."
    warnings = Section(parts=[Warnings(warnings=other_warnings(e.checks, e.warnings))])
    sections = [
        Section(parts=header(e), page=False),
        *([] if linear else [warnings]),
        Section(title="Parameters", parts=[table, Lines(lines=calibration_lines(e), indent=2)], note=note),
        correlations_section("Correlations of the estimated parameters", e.covariance_names, e.covariance),
        *([] if isinstance(e, Estimate) else [_curves(e)]),
        Section(title="Delay and fit", parts=[Lines(lines=delay_lines(e))]),
        Section(parts=[output_table(e)]),
        Section(parts=[Lines(lines=sensitivity_lines(getattr(e, "sensitivity", {})))]),
        Section(title="Checks", parts=[Checks(checks=e.checks, above=True)]),
        *([] if e.validation is None else [second_section(e.validation)]),
        *([warnings] if linear else []),
        timing_section(e.timing_s, wrap=False),
    ]

    def drawings() -> list[Section]:
        from ambid.report.drawing import single
        from ambid.report.signals import strips_of

        shown_evidence = evidence()
        return [
            Section(
                title=_CAPTIONS[name][0], caption=_CAPTIONS[name][1], figure=partial(single, block),
                signals=[strips_of(t) for t in shown_evidence.records] if name in ("signals", "records") else (),
            )
            for name, block in shown_evidence.drawings().items()
        ]  # fmt: skip

    def drawn(width: float) -> Figure:
        from ambid.report.estimate_figures import overview

        return overview(evidence(), width)

    def appendix() -> list[Section]:
        from ambid.report.estimate_figures import poles

        return [*([poles_section(poles(e))] if isinstance(e, Estimate) else []), *rig_sections(e.rig)]

    about = _about_record(e) if isinstance(e, Estimate) else _about_records(e)
    point = ", ".join(f"{role} {x:.6g}" for role, x in e.operating_point.items()) + " (SI)"
    return Document(
        **about["texts"], sections=sections, figure=drawn, frame=table.frame,
        drawings=drawings, appendix=appendix,
        provenance=[
            *about["provenance"], ("rig", str(e.rig.get("name") or "–")), ("operating point", point),
            *computing_time(e.timing_s),
        ],
        numbers=short_numbers(e.parameters),
    )  # fmt: skip


def rig_sections(rig: Mapping[str, object]) -> list[Section]:
    """Return the text of the rig that a result remembers, folded."""
    text = str(rig.get("text") or "")
    return [Section(title="Rig", parts=[Preformatted(text=text)], folded=True)] if text else []


def computing_time(timing_s: Mapping[str, float]) -> list[tuple[str, str]]:
    """Return how long a result took, for the provenance of its page."""
    return [("computing time", f"{sum(timing_s.values()):.3g} s")] if timing_s else []


def _about_record(e: Estimate) -> dict[str, Any]:
    """Title, subtitle and origin of an estimate from one record."""
    record = RecordEntry.of(e.record)
    return {
        "texts": {
            "title": f"{record.name}, model {e.model}",
            "headline": f"{record.name}: physical parameters",
            "subtitle": f"{e.rig.get('name') or 'no rig'} – model {e.model}, {record.samples} samples at "
            f"{record.rate_hz:g} Hz ({record.seconds:.4g} s), search {e.status}",
            "history": record.history,
        },
        "provenance": [("record", record.file or "–"), ("SHA-256 of the record", record.sha256 or "–")],
    }


def _about_records(e: NonlinearBearingEstimate) -> dict[str, Any]:
    """Title, subtitle and origin of a nonlinear bearing."""
    entries = list(zip(e.noise, map(RecordEntry.of, e.records), strict=True))
    name = names_words(list(e.noise))
    return {
        "texts": {
            "title": f"{name}, {e.law}",
            "headline": f"{name}: nonlinear bearing",
            "subtitle": f"{e.rig.get('name') or 'no rig'} – {e.law}, {_seconds(e):.4g} s in all, search {e.status}",
            "history": [f"{name}: {step}" for name, record in entries for step in record.history],
        },
        "provenance": [(name, f"SHA-256 {record.sha256 or '–'}") for name, record in entries],
    }


def header(estimate: AnyEstimate) -> list[Part]:
    """Say what was identified from what, and whether the search converged; of several records their names."""
    e = estimate
    if isinstance(e, Estimate):
        return [Lines(lines=[title_line(RecordEntry.of(e.record), f"model {e.model}", e.status)], wrap=False)]
    names = list(e.noise)
    law = ", ".join([str(e.law), *(["eddy pole"] * e.eddy), *(["drift"] * (e.drift and not e.extended))])
    first = [(names_words(names), "strong"), f": {law}, {_seconds(e):.4g} s", *status_words(e.status)]
    groups = list[Line]()
    for words, at_rest in (("moving", False), ("held", True)):
        group = [n for n, r in zip(names, e.records, strict=True) if bool(r["held"]) == at_rest]
        if group and len(names) > 1:
            groups.append(["", f"{words}: {', '.join(group)}"])
    return [Lines(lines=[first], wrap=False), Lines(lines=groups, indent=2, hang=True)]


def _seconds(e: NonlinearBearingEstimate) -> float:
    """Return the length of all records in s."""
    return sum(RecordEntry.of(r).seconds for r in e.records)


# --- curves of a nonlinear bearing ----------------------------------------------------------------------------------


def _curves(e: NonlinearBearingEstimate) -> Section:
    """Tables of k_i, k_x and L; where the terminal is narrow the middle current stands alone."""
    middle = np.array([np.mean(e.usual["current"])])
    return Section(
        title="Curves over position and current", note="Value ± standard deviation.",
        parts=[Fitting(wide=_stacked(curve_rows(e)), narrow=lambda _: _stacked(curve_rows(e, current=middle)))],
    )  # fmt: skip


def _stacked(tables: Sequence[Sequence[Sequence[Cell]]]) -> list[Part]:
    parts: list[Part] = [grid(tables[0])]
    for rows in tables[1:]:
        parts += [Lines(lines=[""]), grid(rows)]
    outside = any("*" in cell for rows in tables for row in rows for cell in row)
    return [*parts, *([Lines(lines=[_OUTSIDE])] if outside else [])]


def curve_rows(
    estimate: NonlinearBearingEstimate, position: Array | None = None, current: Array | None = None
) -> list[list[tuple[str, ...]]]:
    """Return a table each of k_i, k_x and L over positions in m and currents in A, where the free rotor usually was.

    * marks points that no record came to.
    """
    position = np.linspace(*estimate.usual["position"], _POSITIONS) if position is None else position
    current = np.linspace(*estimate.usual["current"], _CURRENTS) if current is None else current
    grid = np.meshgrid(position, current, indexing="ij")
    curves = estimate.curves(grid[0].ravel(), grid[1].ravel())
    scale, unit = prefixed(float(np.max(np.abs(position))), "m")
    heads = [f"at {c:.3g} A" for c in current]
    tables = []
    for name, inside in {"k_i": curves.inside, "k_x": curves.inside, "L": curves.coil_inside}.items():
        cells, shown = _cells(getattr(curves, name), inside)
        table = [(f"{name} [{shown}]", *heads)]
        for k, x in enumerate(position.tolist()):
            table.append((f"  {x / scale:.4g} {unit}", *cells[k * len(heads) : (k + 1) * len(heads)]))
        tables.append(table)
    return tables


def _cells(curve: Curve, inside: NDArray[np.bool_]) -> tuple[list[str], str]:
    """Values with standard deviations, all in the unit that suits the largest."""
    scale, unit = prefixed(float(np.max(np.abs(curve.value))), curve.unit)
    cells = []
    for value, sd, inside_range in zip(curve.value / scale, curve.sd / scale, inside, strict=True):
        digits = 1 - int(np.floor(np.log10(sd))) if sd > 0 else 4
        digits = min(max(digits, 0), 6)
        cells.append(f"{value:.{digits}f} ± {sd:.{digits}f}{'' if inside_range else ' *'}")
    return cells, unit


# --- delay, fit, loop -----------------------------------------------------------------------------------------------


def delay_lines(estimate: AnyEstimate) -> list[str]:
    """Say by how much each input is delayed; of a bearing the voltage, at each sampling rate."""
    more = [f"model extended by: {', '.join(estimate.extended)}"] if estimate.extended else []
    if isinstance(estimate, Estimate):
        rate = RecordEntry.of(estimate.record).rate_hz
        return [delay_line(role, d, rate) for role, d in estimate.delay.items()] + more
    delays = [(f"voltage at {rate}", d, float(rate.removesuffix(" Hz"))) for rate, d in estimate.delay.items()]
    return [delay_line(*d) for d in delays] + more


def output_table(estimate: AnyEstimate) -> Table:
    """Return a table of the fit of each output; of a bearing on each record, where of a held rotor the current."""
    if isinstance(estimate, Estimate):
        return fit_table(estimate.fit, model(estimate.model).units, "unstable in open loop")
    rows: list[tuple[str, ...]] = [("one-step fit", "position", "innovations", "current", "innovations")]
    for name, fits in estimate.fit.items():
        cells: list[str] = []
        for role, unit in _UNITS.items():
            f = fits.get(role)
            cells += ["held", ""] if f is None else [f"{f.one_step:.4f}", f"{sized(f.innovation_sd, unit)} rms"]
        rows.append((name, *cells))
    return grid(rows)


def sensitivity_lines(sensitivity: Mapping[str, Any]) -> list[str]:
    """Say the peak of the sensitivity of one axis, predicted and measured; nothing where it is not known."""
    lines = []
    for s in sensitivity.values():
        peak, measured = s["peak_db"], s["measured_peak_db"]
        at = f"{pure(peak['value'], peak['sd'] or 0.0)} dB at {sized(s['frequency_hz'], 'Hz')}"
        line = f"sensitivity of the loop: {at}"
        if measured is not None:
            at = f"{pure(measured, s.get('measured_sd_db') or 0.0)} dB at {sized(s['measured_frequency_hz'], 'Hz')}"
            line += f"; measured {at}"
        lines.append(f"{line}; zone {Zone.read(s).words} of ISO 14839-3")
    return lines


def correlations_section(title: str, names: tuple[str, ...], covariance: Array) -> Section:
    """Return the correlations of a covariance (n, n) as a section of a page, folded."""
    sd = np.sqrt(np.diag(covariance))
    rows = covariance / np.outer(sd, sd)
    cells = [["", *names], *([name, *(f"{x:.3f}" for x in row)] for name, row in zip(names, rows, strict=True))]
    return Section(title=title, caption=_TOGETHER, parts=[grid(cells)], folded=True, terminal=False)


def poles_section(poles: Sequence[Pole]) -> Section:
    """Return the poles of a plant in numbers, those above the real axis."""
    above = [(p.value, p.covariance) for p in poles if p.value.imag >= 0]
    return Section(title="Poles in numbers", parts=pole_table(above, times=True), folded=True)


# --- a second record ------------------------------------------------------------------------------------------------


def second_section(validation: Mapping[str, Any]) -> Section:
    """Return how an estimate does on a second record: the fit of each output, then the checks."""
    samples = counted(int(validation["samples"]), "sample")
    checks = {
        name: Check(passed=bool(c["passed"]), detail=str(c["detail"]), p=c.get("p"))
        for name, c in validation["checks"].items()
    }
    return Section(
        title="On the second record", heading=[(f"on the second record ({samples})", "strong")],
        parts=[*second_parts(validation["fit"]), Checks(checks=checks)],
    )  # fmt: skip


def second_parts(fits: Mapping[str, Any]) -> list[Part]:
    """Return the fit of each output on a second record: some steps ahead, beside its noise or identification."""
    first = next(iter(fits.values()))
    if isinstance(first["one_step"], Mapping):
        rows = [("fit", "one step", "rmse", "simulation", "rmse")]
        rows += [(output, *_pair(f["one_step"]), *_pair(f.get("simulation"))) for output, f in fits.items()]
        outside = first.get("extrapolated")
        more = [] if outside is None else [f"outside the training data: {100 * float(outside):.2g} % of it"]
        return [grid(rows), Lines(lines=more)]
    if "k_step" in first:
        horizons = list(first["k_step"])
        wide: list[tuple[str, ...]] = [("fit", *(f"{k} ahead" for k in horizons), "simulation")]
        for role, f in fits.items():
            free = "unstable in open loop" if f["simulation"] is None else fraction(f["simulation"])
            wide.append((role, *(fraction(f["k_step"][k]) for k in horizons), free))
        return [grid(wide)]
    if "over_noise" in first:
        left = [("fit", "explained", "left over", "over its noise")]
        for role, f in fits.items():
            rms = sized(f["innovation_rms"], "A" if role.endswith("_current") else "m")
            left.append((role, fraction(f["one_step"]), f"{rms} rms", f"{f['over_noise']:.3g}"))
        return [grid(left)]
    beside = [("fit", "one step", "innovations", "relative to identification")]
    for role, f in fits.items():
        rms = f"{sized(f['innovation_rms'], _UNITS[role])} rms"
        beside.append((role, f"{f['one_step']:.4f}", rms, f"{100 * f['ratio']:.3g} %"))
    return [grid(beside)]


def _pair(error: Mapping[str, Any] | None) -> tuple[str, str]:
    return ("–", "–") if error is None or error["fit"] is None else (fraction(error["fit"]), f"{error['rmse']:.4g}")


def validation_document(
    validation: Validation, traces: Callable[[], Sequence[Traces]], runs: Callable[[], Sequence[RotorReplay]]
) -> Document:
    """Describe how a result does on a further record.

    `traces`: the record beside its predictions; `runs`: of a rotor, its response beside the model's.
    """
    v = validation

    def drawn(width: float) -> Figure:
        from ambid.report.estimate_figures import validation_figure
        from ambid.report.rotor_figures import residuals_block

        return validation_figure(v, traces(), width, more=[residuals_block(run) for run in runs()])

    return Document(
        title=f"{v.record or 'record'} tested with {v.estimate or 'an estimate'}, {v.model}",
        sections=validation_sections(v), figure=drawn, drawings=lambda: signals_and_figures(traces(), drawn),
        frame=lambda: ("output", {"output": list(v.fit), **numbers_of(list(v.fit.values()))}),
    )  # fmt: skip


def signals_and_figures(traces: Sequence[Traces], figure: Callable[[float], Figure]) -> list[Section]:
    """Return the sections of a page with records down to the samples, and all figures in one."""
    from ambid.report.signals import CLOSE, strips_of

    close = [Section(title="Signals", caption=CLOSE, signals=[strips_of(t) for t in traces])] if traces else []
    return [*close, Section(title="Figures", figure=figure)]


def validation_sections(validation: Validation) -> list[Section]:
    """Say how a result does on a further record."""
    v = validation
    head = f" tested with {v.estimate or 'a result'}, {v.model}; {v.samples} samples"
    return [
        Section(parts=[Lines(lines=[[(v.record or "record", "strong"), head]], wrap=False)]),
        Section(parts=second_parts(v.fit)),
        Section(title="Checks", parts=[Checks(checks=v.checks, above=True)]),
    ]


# --- parameters from a black box or a response ----------------------------------------------------------------------


def physics_section(estimate: PhysicalFit | FrequencyEstimate) -> Section:
    """Return the physical parameters that follow from a black-box fit or a measured response, and their checks."""
    d = estimate.delay
    spread = "" if d.sd is None else f" ± {d.sd:.2g}"
    delay = f"delay {counted(f'{d.samples + d.fraction:.4g}{spread}', 'sample')}, {d.how}"
    heading: list[Cell] = [(f"physical parameters of model {estimate.model}", "strong")]
    if isinstance(estimate, Judged):  # its warnings stand with those of the response
        checks, warnings = dict(estimate.checks), list[str]()
        heading += status_words(estimate.status)
    else:
        low, high = estimate.band_hz
        checks = {"agreement": estimate.misfit}
        delay += f"; from {sized(low, 'Hz')} to {sized(high, 'Hz')}"
        warnings = other_warnings(checks, estimate.warnings)
        heading.append(f", from {estimate.structure}")
    table = parameter_table(estimate.parameters, estimate.verdict)
    parts: list[Part] = [table, Lines(lines=[delay], wrap=False), Checks(checks=checks), Warnings(warnings=warnings)]
    return Section(title=f"Physical parameters of model {estimate.model}", heading=heading, parts=parts)
