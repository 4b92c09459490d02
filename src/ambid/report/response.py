"""Measured frequency responses and modes of vibration as people see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.measured import Measured, ModelResponse, model_responses
from ambid.blackbox.fit import BlackBoxFit, any_structure
from ambid.blackbox.model import TransferModel
from ambid.estimation.modes import EstimatedNumber, Modal, Mode, PoleCluster, TrialPole
from ambid.estimation.result import NORMAL_95, RecordEntry
from ambid.report.document import (
    Checks,
    Column,
    Document,
    Fitting,
    Lines,
    Part,
    Section,
    Table,
    Warnings,
    grid,
    timing_section,
)
from ambid.report.drawing import (
    BAND,
    BOUND,
    GREEN,
    MEASURED,
    ORANGE,
    PREDICTED,
    WIDE,
    Block,
    Panel,
    head,
    panel,
    stacked,
)
from ambid.report.estimate import physics_section
from ambid.report.fit import coefficient_parts, settings_text
from ambid.report.fit_figures import pole_parts
from ambid.report.numbers import prefixed, quantity, response_unit, sized
from ambid.report.parameters import short_numbers
from ambid.report.response_panels import Complex, Pair, angle_ticks, magnitude_axis, pairs_panel, phase_axis, unwrapped
from ambid.report.text import Cell, Line, plain, status_words, title_line, wrapped
from ambid.settings.caller import setting
from ambid.units import UNKNOWN

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_SINGULAR_VALUES = 8

_ANY = 10**6  # columns of a terminal that has room

_OUTPUTS = 8  # whose shape a terminal shows

_FIELDS = ("frequency_hz", "damping")

_ALIKE = 0.8  # assurance from which two shapes are called alike


def response_document(measured: Measured, _: Any) -> Document:
    """Describe a measured response, and what was fitted to it."""
    m, frf = measured, measured.response
    columns: dict[str, Any] = {"frequency_hz": frf.frequency_hz}
    for j, o in enumerate(frf.outputs):
        for k, i in enumerate(frf.inputs):
            columns |= {f"{o}/{i}": frf.G[:, j, k], f"{o}/{i} sd": frf.sd[:, j, k]}
    name = RecordEntry.of(m.record).name
    return Document(
        title=f"{name}, frequency response, {frf.frequency_hz.size} lines", sections=response_sections(m),
        figure=partial(frf_figure, m), frame=lambda: ("frequency_hz", columns),
        numbers=short_numbers(getattr(m, "parameters", ())),
    )  # fmt: skip


def response_sections(measured: Measured) -> list[Section]:
    """Say what was measured, and what was fitted to it."""
    fit, estimate, modal = measured.fit, measured.estimate, measured.modal
    return [
        Section(parts=_header(measured)),
        Section(title="Pairs", parts=pair_parts(measured)),
        Section(title="Distortions", parts=_distortions(measured)),
        *([] if fit is None else [_fit(fit)]),
        *([] if estimate is None else [physics_section(estimate)]),
        *([] if modal is None else mode_sections(modal)),
        Section(parts=[Warnings(warnings=warnings_of(measured))]),
        timing_section(measured.timing_s, wrap=False),
    ]


def _header(measured: Measured) -> list[Part]:
    frf, record = measured.response, RecordEntry.of(measured.record)
    first: Line = [(record.name, "strong"), ": frequency response"]
    if record.samples:
        first = title_line(replace(record, rate_hz=frf.rate_hz), "frequency response")
    reference = f", reference {', '.join(measured.references)}" if measured.references else ""
    loop = ", declared open loop" if measured.open_loop else ""
    signals = f"from {', '.join(frf.inputs)} to {', '.join(frf.outputs)}{reference}{loop}"
    details: Any = frf.details
    f, periods = frf.frequency_hz, ""
    if "period" in details:
        dropped = sum(details.get("dropped_periods", ()))
        periods = f", {'+'.join(map(str, details['periods']))} periods of {details['period']} samples"
        periods += f" ({dropped} more left out)" if dropped else ""
    method = f"{frf.method}{periods}; {f.size} lines, {sized(f[0], 'Hz')} to {sized(f[-1], 'Hz')}"
    return [Lines(lines=[first], wrap=False), Lines(lines=[signals, method])]


def pair_parts(measured: Measured) -> list[Part]:
    """Return size and quality of the response of every pair: medians over the lines, in percent of the magnitude.

    A narrow terminal leaves the magnitudes out; names that are too long to stand beside anything have their own lines.
    """
    frf, noise, distortion = measured.response, measured.response.noise_sd, measured.distortion_sd
    rows: list[tuple[str, ...]] = [("", "|G|", "sd", "noise", "distortion", "coherence")]
    for j, o in enumerate(frf.outputs):
        for k, i in enumerate(frf.inputs):
            g = frf.magnitude[:, j, k]
            shares = [_share(sd, g, j, k) for sd in (frf.sd, noise, distortion)]
            coherence = "–" if frf.coherence is None else f"{float(np.median(frf.coherence[:, j])):.4f}"
            rows.append((f"{i} → {o}", _range(g, response_unit(frf.units, o, i)), *shares, coherence))
    table = grid(rows, right=(2, 3, 4, 5))
    columns = [replace(c, spare=c.label == "|G|") for c in table.columns]

    def apart(width: int) -> list[Part]:
        head, *values = grid([("  ", *row[2:]) for row in rows], right=(1, 2, 3, 4)).lines(_ANY, plain)
        labelled = [[*wrapped([row[0]], width), line] for row, line in zip(rows[1:], values, strict=True)]
        return [Lines(lines=[head, *(line for pair in labelled for line in pair)], wrap=False)]

    separated = "; noise and distortion were not separated" if distortion is None else ""
    return [
        Fitting(wide=[replace(table, columns=columns)], narrow=apart),
        Lines(lines=[f"(medians over the lines, of |G|{separated})"]),
    ]


def _range(g: Array, unit: str) -> str:
    low, high = float(np.min(g)), float(np.max(g))
    scale, shown_unit = (1.0, unit) if unit.startswith((UNKNOWN, "1/")) else prefixed(high, unit)
    return f"{low / scale:.3g} … {high / scale:.3g} {shown_unit}".removesuffix(" 1")


def _share(sd: Array | None, g: Array, j: int, k: int) -> str:
    if sd is None:
        return "–"
    with np.errstate(divide="ignore"):
        return f"{100 * float(np.median(sd[:, j, k] / g)):.2g} %"


def _distortions(measured: Measured) -> list[Part]:
    """Levels at the lines that the excitation left out, beside the signal."""
    levels: Any = measured.response.details.get("distortions")
    if levels is None:
        return []

    def rms(values: Array, k: int) -> float:
        return float(np.sqrt(np.mean(values[:, k] ** 2)))

    def relative(values: Array | None, k: int) -> str:
        if values is None or not values.size:
            return "–"
        x, signal = rms(values, k), rms(levels.signal, k)
        return f"{20 * np.log10(x / signal):.1f} dB" if x > 0 and signal > 0 else "none"

    rows: list[tuple[str, ...]] = [("at lines without excitation", "even", "its noise", "odd", "its noise")]
    kinds = (levels.even, levels.even_noise, levels.odd, levels.odd_noise)
    rows += [(output, *(relative(x, k) for x in kinds)) for k, output in enumerate(measured.response.outputs)]
    meaning = "(rms of a line relative to that of an excited one)"
    return [grid(rows, right=(1, 2, 3, 4)), Lines(lines=[meaning])]


def _fit(fit: BlackBoxFit) -> Section:
    """What was fitted to a response."""
    about = f": {any_structure(fit.structure).summary}; {settings_text(fit.orders)}"
    first, repeated = _first_entry(fit)
    # states are in coordinates of the method's own: their numbers say nothing
    coefficients = coefficient_parts(fit, without=repeated) if fit.structure == "frf-ml" else []
    lines, d = list[str](), fit.details
    delay, sd = d.get("delay_s"), d.get("delay_sd_s")
    if delay or sd is not None:
        value = float(str(delay))
        late = quantity(value, 0.0 if sd is None else float(str(sd)), "s").text
        lines.append(f"delay {late} ({value / fit.dt:.4g} samples)")
    parts = [Lines(lines=lines, wrap=False), Lines(lines=_laguerre(d))]
    return Section(
        title="Fit",
        parts=[
            Lines(lines=[[(fit.structure, "strong"), about, *status_words(fit.status)]]),
            *coefficients, *pole_parts(first), *parts, Checks(checks=fit.checks),
        ],
    )  # fmt: skip


def _laguerre(d: Any) -> list[str]:
    if "condition_without" not in d:
        return []
    values = " ".join(f"{s:.3g}" for s in d["singular_values"][:_SINGULAR_VALUES])
    more = " …" if len(d["singular_values"]) > _SINGULAR_VALUES else ""
    return [
        f"Laguerre operator p = {d['p']:.4g} rad/s: condition {d['condition']:.3g} of {d['block_rows']} block rows, "
        f"{d['condition_without']:.3g} without it; singular values {values}{more} (noise alone: about 1)"
    ]


def _first_entry(fit: BlackBoxFit) -> tuple[BlackBoxFit, list[int]]:
    """The fit of the first entry where all share a denominator, which has all the poles, and places of its copies."""
    model = fit.model
    dens = [d for row in model.den for d in row] if isinstance(model, TransferModel) else []
    if not isinstance(model, TransferModel) or len(dens) < 2 or not all(np.array_equal(d, dens[0]) for d in dens):
        return fit, []
    places = [(o or i, which, range(p.start, p.stop)) for o, which, i, p in model.blocks()]
    own = [k for other, _, place in places if not other for k in place]
    copies = [k for other, which, place in places if other and which == "den" for k in place]
    first = TransferModel(num=((model.num[0][0],),), den=((model.den[0][0],),), dt=model.dt, delay=model.delay[:1])
    covariance = None if fit.covariance is None else fit.covariance[np.ix_(own, own)]
    return replace(fit, model=first, covariance=covariance), copies


def warnings_of(measured: Measured) -> list[str]:
    """Return all warnings, each once, without what only repeats a failed check; those of the response first."""
    warnings = [*measured.response.warnings]
    for x in (measured.fit, measured.estimate):
        if x is None:
            continue
        details = [c.detail for c in x.checks.values() if not c.passed]
        for whole in x.warnings:
            warning = whole
            for detail in details:  # it stands with the checks
                warning = warning.replace(f"{detail}; ", "")
            if not warning.endswith(tuple(details)):
                warnings.append(warning)
    return list(dict.fromkeys(warnings))


# --- modes ----------------------------------------------------------------------------------------------------------


def mode_sections(modal: Modal) -> list[Section]:
    """Return modes, their shapes and their checks."""
    low, high = modal.band_hz
    first = f"modes between {sized(low, 'Hz')} and {sized(high, 'Hz')}: {len(modal.modes)}"
    return [
        Section(title="Modes", parts=[Lines(lines=[[(first, "strong")]], wrap=False), mode_table(modal.modes)]),
        Section(parts=[Fitting(wide=_shapes(modal, 0), narrow=lambda width: _shapes(modal, width))]),
        Section(parts=[] if modal.mac is None else _assurance(modal.mac, modal.modes, modal.against)),
        Section(title="Checks of the modes", parts=[Checks(checks=modal.checks, above=True)]),
    ]


def mode_table(modes: Sequence[Mode]) -> Table:
    """Return frequency, damping and shape of each mode, one a row."""
    outputs = tuple(modes[0].shape) if modes else ()

    def number(label: str, name: str, unit: str, scale: float) -> Column:
        def of(row: tuple[int, Mode]) -> EstimatedNumber:
            x: EstimatedNumber = getattr(row[1], name)
            return x

        return Column(
            label=label,
            cell=lambda row: quantity(scale * of(row).value, scale * of(row).sd, unit).text,
            frame={
                name: lambda row: of(row).value,
                f"{name} sd": lambda row: of(row).sd,
                f"{name} low": lambda row: of(row).ci95[0],
                f"{name} high": lambda row: of(row).ci95[1],
            },
        )

    def unseen(row: tuple[int, Mode]) -> str:
        names = [name.removesuffix("_hz") for name in _FIELDS if not getattr(row[1], name).identifiable]
        return f"{' and '.join(names)} not identifiable" if names else ""

    def shape(output: str) -> Column:
        return Column(frame={f"shape {output}": lambda row: row[1].complex_shape[output]})

    return Table(
        rows=list(enumerate(modes, 1)),
        columns=[
            Column(cell=lambda row: str(row[0]), right=True, frame={"mode": lambda row: row[0]}),
            number("frequency", "frequency_hz", "Hz", 1.0),
            number("damping", "damping", "%", 100.0),
            Column(cell=unseen, frame={"identifiable": lambda row: row[1].identifiable}),
            *map(shape, outputs),
        ],
    )


def _shapes(modal: Modal, width: int) -> list[Part]:
    """Return the shape of each mode over the outputs, largest 1; a part that is a quarter of a period late with j.

    `width`: of a terminal that is too narrow for all modes side by side.
    """
    modes = modal.modes
    names = [o for o in modal.outputs if modes and o in modes[0].shape][:_OUTPUTS]
    if len(names) < 2:
        return []
    rows: list[tuple[str, ...]] = [("shape", *(str(k) for k in range(1, len(modes) + 1)))]
    for name in names:
        shape = [m.complex_shape[name] for m in modes]
        rows.append((name, *(f"{x.real:.2f}" + (f"{x.imag:+.2f}j" if abs(x.imag) > 0.1 else "") for x in shape)))
    most = len(modes)
    if width:
        cell = 2 + max(len(c) for row in rows for c in row[1:])
        most = max((width - max(map(len, names)) - 2) // cell, 1)
    parts: list[Part] = []
    for begin in range(0, len(modes), most):
        some = [(row[0], *row[1 + begin : 1 + begin + most]) for row in rows]
        parts.append(grid(some, right=range(1, len(some[0]))))
    rest = len(modal.outputs) - len(names)
    return [
        *parts,
        Lines(lines=[f"… and {rest} outputs more; {setting('json')} has them all"] if rest > 0 else [], wrap=False),
    ]


def _assurance(assurance: Array, rows: Sequence[Mode], across: Sequence[Mode]) -> list[Part]:
    """Return the modal assurance criterion of modes with others, by frequency; * from 0.8 on: alike."""
    if not (rows and across):
        return [Lines(lines=["the estimate has no mode in this band"])] if rows else []
    cells: list[Sequence[Cell]] = [("MAC", *(f"{m.frequency_hz.value:.4g} Hz" for m in across))]
    for m, values in zip(rows, assurance, strict=True):
        shares = (f"{x:.2f}{'*' if x >= _ALIKE else ' '}" for x in values)
        cells.append((f"{m.frequency_hz.value:.4g} Hz", *shares))
    return [grid(cells, right=range(1, len(cells[0])))]


_NOISE, _DISTORTION, _RANGE = GREEN, ORANGE, "#d4d4d4"

_MODELS: tuple[tuple[str, str, str], ...] = (
    (PREDICTED, BAND, "-"),
    (BOUND, "#f5cdb0", "--"),
)  # line and band of the black-box fit and of the physical parameters

_PHASE_KNOWN = 0.5  # radius of the 95 % region over the magnitude up to which the phase is

_GRID = 800  # frequencies at which a model is drawn

_STABLE, _FREQUENCY, _NEW, _MODE = PREDICTED, ORANGE, "#aaaaaa", BOUND

_KINDS = (
    ("new", "x", _NEW),
    ("stable in frequency", "^", _FREQUENCY),
    ("stable in frequency, damping and shape", "o", _STABLE),
)  # of poles, those that are stable in everything last

_NEAR_MODE = 0.02  # of its frequency, within which a mode's peak lies


# --- a measured frequency response ----------------------------------------------------------------------------------


def frf_figure(measured: Measured, width: float = WIDE) -> Figure:
    """Draw magnitude and phase of every pair: lines with 95 % bands, noise and distortion, the models over them."""
    frf = measured.response
    f = frf.frequency_hz
    models = model_responses(measured, np.geomspace(f[0], f[-1], _GRID)) if f.size > 1 else ()
    block = pairs_panel(
        lambda axes, pair: _magnitude(axes, measured, models, pair),
        lambda axes, pair: _phase(axes, measured, models, pair),
        frf.inputs, frf.outputs, frf.units,
    )  # fmt: skip
    name = measured.record.get("file") or "record"
    modal = [] if measured.modal is None else [modal_panel(measured.modal, "modes")]
    return stacked(f"{name}: frequency response, {frf.method}", [block, *modal], width)


def _magnitude(axes: Axes, measured: Measured, models: Sequence[ModelResponse], pair: Pair) -> None:
    """Measured lines with their band, the levels under them, the models over them."""
    frf = measured.response
    f, size, radius = frf.frequency_hz, frf.magnitude[:, *pair], frf.confidence_radius()[:, *pair]
    noise = None if frf.noise_sd is None else frf.noise_sd[:, *pair]
    distortion = None if measured.distortion_sd is None else measured.distortion_sd[:, *pair]
    levels = [(frf.sd[:, *pair], _NOISE, "sd of measured")] if distortion is None else []
    levels += [(noise, _NOISE, "noise sd")] if distortion is not None and noise is not None else []
    levels += [(distortion, _DISTORTION, "distortion sd")] if distortion is not None else []
    drawn = [x[x > 0] for x, _, _ in levels if np.any(x > 0)]
    bottom = 0.5 * min([float(size[size > 0].min()), *(float(np.percentile(x, 2)) for x in drawn)])
    lower = np.maximum(size - radius, 0.1 * bottom)
    axes.fill_between(f, lower, size + radius, color=_RANGE, linewidth=0, label="measured, 95 %")
    for m, (line, band, style) in zip(models, _MODELS, strict=False):
        magnitude_axis(axes, m, pair, label=m.source, band_label=f"{m.source}, 95 %", colors=(line, band), style=style)
    dot = _marker(f.size)
    axes.plot(f, size, ".", color=MEASURED, markersize=dot, label="measured", zorder=1.8)
    for x, color, label in levels:
        positive = np.where(x > 0, x, np.nan)
        axes.plot(f, positive, ".", color=color, markersize=0.8 * dot, label=label, zorder=1.7)
    axes.set_xscale("linear" if measured.modal else "log")  # modes want room above, where they lie
    axes.set_yscale("log")
    if f.size > 1:
        axes.set_xlim(f[0], f[-1])
    # a sweep leaves noise beyond its ends, far above the modes
    near = np.concatenate(
        [size[:0], *(size[np.abs(f / m.frequency_hz.value - 1) < _NEAR_MODE] for m in measured.modes)]
    )
    axes.set_ylim(bottom, 2.0 * float(np.max(near if near.size else size)))
    _mark_modes(axes, measured.modes)


def _mark_modes(axes: Axes, modes: Sequence[Mode]) -> None:
    """Lines at the frequencies of modes; dashed where the data do not show one."""
    for m in modes:
        style, label = ("-", "mode") if m.identifiable else (":", "mode, not identifiable")
        axes.axvline(m.frequency_hz.value, color=_MODE, linewidth=0.9, alpha=0.6, linestyle=style, label=label)


def _phase(axes: Axes, measured: Measured, models: Sequence[ModelResponse], pair: Pair) -> None:
    """Phase, unwrapped beginning near zero; where |G| is lost in its sd the band is all angles."""
    frf = measured.response
    f, size, radius = frf.frequency_hz, frf.magnitude[:, *pair], frf.confidence_radius()[:, *pair]
    ratio = np.minimum(radius / np.maximum(size, 1e-300), 1.0)
    angle = np.rad2deg(_angle(frf.G[:, *pair], f, ratio < _PHASE_KNOWN, models, pair))
    spread = np.where(ratio < 1, np.rad2deg(np.arcsin(ratio)), 180.0)
    near = float(unwrapped(models[0].G[:, *pair])[0]) if models else 0.0  # a phase near ±180° begins on one side
    for m, (line, band, style) in zip(models, _MODELS, strict=False):
        phase_axis(axes, m, pair, near=near, colors=(line, band), style=style)
    axes.fill_between(f, angle - spread, angle + spread, color=_RANGE, linewidth=0, zorder=0.5)
    axes.plot(f, angle, ".", color=MEASURED, markersize=_marker(f.size), zorder=1.8)
    axes.set_xscale("linear" if measured.modal else "log")
    lines = [np.rad2deg(unwrapped(m.G[:, *pair], near)) for m in models]
    angle_ticks(axes, np.concatenate([angle, *lines]))


def _angle(G: Complex, f: Array, valid: NDArray[np.bool_], models: Sequence[ModelResponse], pair: Pair) -> Array:
    """Phase of the lines in rad: the turn nearest to a model's, which noise does not make jump."""
    if not models:
        return unwrapped(G, valid=valid)
    near = np.interp(f, models[0].frequency_hz, unwrapped(models[0].G[:, *pair]))
    return np.asarray(near + np.angle(G * np.exp(-1j * near)))


def _marker(n: int) -> float:
    return 4.0 if n <= 300 else 2.0 if n <= 3000 else 1.0


def pole_panels(poles: Sequence[TrialPole], modes: Sequence[PoleCluster], most: float) -> tuple[Panel, Panel]:
    """Return damping over frequency of stable poles up to a largest one, with the modes' names, and below it all poles
    by order.
    """

    def over_frequency(axes: Axes) -> None:
        for mode in modes:
            axes.axvline(mode.frequency_hz, color=_MODE, linewidth=0.9, alpha=0.6, label="mode")
        axes.set_xlabel("frequency of the pole [Hz]")

    def damping(axes: Axes) -> None:
        over_frequency(axes)
        axes.set_ymargin(0.25)
        stable = [p for p in poles if p.stable]
        axes.plot([p.frequency_hz for p in stable], [p.damping for p in stable], "o", color=_STABLE, markersize=4)
        for mode in modes:
            at, words = (mode.frequency_hz, mode.damping), sized(mode.frequency_hz, "Hz")
            axes.annotate(words, at, textcoords="offset points", xytext=(4, 4), fontsize=8)
        axes.axhline(0, color=_NEW, linewidth=0.8)
        axes.set_ylabel("damping")
        axes.set_ylim(-0.1 * most, most)
        head(axes, "damping (under 0: unstable)")

    def diagram(axes: Axes) -> None:
        over_frequency(axes)
        for k, (label, marker, color) in enumerate(_KINDS):
            chosen = [p for p in poles if (2 if p.stable else int(p.stable_frequency)) == k]
            frequency, orders = [p.frequency_hz for p in chosen], [p.order for p in chosen]
            axes.plot(frequency, orders, marker, color=color, markersize=5, label=label, linestyle="none")
        _orders(axes)
        head(axes, "poles by order")

    return Panel(draw=damping, height=2.0), Panel(draw=diagram, height=3.6)


def _orders(axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.set_ylabel("order")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))


# --- modes ----------------------------------------------------------------------------------------------------------


def modal_panel(modal: Modal, title: str = "") -> Block:
    """Return the poles that the search for modes began from, with the modes it ended in, and the modes' shapes."""
    curves = [
        PoleCluster(pole=2 * np.pi * m.frequency_hz.value * complex(-m.damping.value, 1.0), orders=())
        for m in modal.modes
    ]
    damping, diagram = pole_panels(modal.poles, curves, 2 * max((c.damping for c in curves), default=0.5))
    columns = [[damping, diagram]]
    if modal.modes and len(modal.outputs) > 1:
        empty = Panel(draw=lambda axes: axes.axis("off"), height=2.0)
        columns.append([empty, panel(_draw_shapes, modal, height=3.6)])
    return Block(columns=columns, widths=(3, 2)[: len(columns)] if len(columns) > 1 else (), title=title)


def _draw_shapes(axes: Axes, modal: Modal) -> None:
    """Shapes over outputs, one row of bars for each mode, with 95 % intervals."""
    at = np.arange(len(modal.outputs))
    for k, m in enumerate(modal.modes):
        numbers = [m.shape[o] for o in modal.outputs]
        size, error = np.array([x.value for x in numbers]), np.array([NORMAL_95 * x.sd for x in numbers])
        axes.bar(at, 0.4 * size, 0.7, bottom=k, color=BAND, edgecolor=PREDICTED, linewidth=0.6)
        axes.errorbar(at, k + 0.4 * size, 0.4 * error, fmt="none", color=MEASURED, elinewidth=0.8)
        axes.axhline(k, color=_NEW, linewidth=0.6)
    axes.set_xticks(at, modal.outputs, rotation=45)
    axes.set_yticks(range(len(modal.modes)), [sized(m.frequency_hz.value, "Hz") for m in modal.modes])
    head(axes, "shapes")
