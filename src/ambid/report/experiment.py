"""A designed experiment as tables for the terminal: what it moves, and what a record of it will show."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.control.experiment import Experiment
from ambid.report.document import Document, Lines, Section, Table, ending, grid, numbers_of
from ambid.report.drawing import BOUND, CYCLE, MEASURED, ORANGE, Block, curve, head, log_axis, panel, stacked
from ambid.report.numbers import prefixed, quantity, sized
from ambid.simulation.rotor_bench import kind_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_NONE = "–"


def experiment_document(experiment: Experiment, _: Any) -> Document:
    """Describe a designed experiment."""
    x, title = experiment, title_of(experiment)
    return Document(
        title=title, sections=experiment_sections(x), figure=partial(experiment_figure, x, title),
        frame=lambda: ("name", {"name": list(x.expected), **numbers_of(list(x.expected.values()))}),
    )  # fmt: skip


def experiment_sections(experiment: Experiment) -> list[Section]:
    """Say what was designed."""
    x = experiment
    first, last = (sized(float(f), "Hz") for f in (x.frequency_hz[0], x.frequency_hz[-1]))
    lines = [
        f"{x.frequency_hz.size} lines, {first} to {last}, period {x.period} samples at {x.rate_hz:g} Hz",
        f"record of {sized(x.seconds, 's')}, {x.periods} periods; limits kept for {x.drawn} drawn plants",
    ]
    if x.table is not None:
        lines.append(
            f"table for the controller: {len(x.table.elements)} elements of {x.table.hold} ticks, "
            f"amplitude {sized(x.table.amplitude, 'V')}"
        )
    flat = "flat: standard deviation with a flat multisine of the same band and use of the limits"
    rows: list[tuple[str, ...]] = [("", "peak", "limits", "in use", "drawn plants")]
    for name, s in x.signals.items():
        if s.low is None and s.high is None:
            continue
        ends = " … ".join("any" if e is None else sized(e, s.unit) for e in (s.low, s.high))
        most = f"{100.0 * max(s.steady, s.from_rest):.0f} %"
        rows.append((name, sized(s.peak, s.unit), ends, most, f"{100.0 * s.drawn:.0f} %"))
    return [
        Section(heading=[(title_of(x), "strong")], parts=[Lines(lines=lines)]),
        Section(heading=[("what the record will show", "strong")], parts=[expected_table(x), Lines(lines=[flat])]),
        Section(
            heading=[("deviations from rest, four standard deviations of noise kept free", "strong")],
            parts=[grid(rows)],
        ),
        *ending(x),
    ]


def title_of(experiment: Experiment) -> str:
    """Return what was designed, in a few words."""
    loop = "closed" if experiment.closed else "open"
    aim = "all parameters" if experiment.criterion == "all" else experiment.criterion
    return f"experiment for {aim} of model {experiment.model}, {loop} loop"


def expected_table(x: Experiment) -> Table:
    """Return what a record of an experiment will show, by parameter."""
    rows: list[tuple[str, ...]] = [
        ("", "designed for", "relative", "flat", "curvature", f"{100.0 * x.target:.3g} % after")
    ]
    for name, e in x.expected.items():
        needed = _NONE if e.seconds is None or not e.identifiable else sized(e.seconds, "s")
        value = quantity(e.value, e.sd, e.unit).text.removesuffix(" 1")
        moved = _NONE if e.shift is None else f"{e.shift:+.1f} sd"
        rows.append((name, value, f"{100.0 * e.relative_sd:.2g} %", f"{e.flat_sd / e.sd:.2g} times", moved, needed))
    return grid(rows)


def experiment_figure(experiment: Experiment, title: str, width: float) -> Figure:
    """Draw a design."""
    limited = [name for name, x in experiment.signals.items() if x.low is not None or x.high is not None]
    most = {kind_of(name): name for name in sorted(limited, key=lambda name: experiment.signals[name].drawn)}
    shown_of_kind = [name for name in limited if name in most.values()]  # of many axes that which uses most
    waves = [panel(_excitation, experiment)] + [panel(_wave, experiment, name) for name in shown_of_kind]
    panels_shown = [
        panel(_lines, experiment, height=2.4),
        panel(_by_length, experiment, height=2.6),
        panel(_by_level, experiment, height=2.6),
    ]
    return stacked(title, [Block(columns=[waves, panels_shown], widths=(3.0, 2.0), shared=False)], width)


def _excitation(axes: Axes, experiment: Experiment) -> None:
    t = np.arange(experiment.period) / experiment.rate_hz
    for (name, wave), color in zip(experiment.excitation.items(), CYCLE, strict=False):
        curve(axes, t, wave, color, name if len(experiment.excitation) > 1 else None)
    head(axes, f"one period of the excitation of {_inputs(experiment)}")
    axes.set_ylabel("[V]")


def _wave(axes: Axes, experiment: Experiment, name: str) -> None:
    signal, wave = experiment.signals[name], experiment.shown.waves[name]
    ends = [e for e in (signal.low, signal.high) if e is not None]
    scale, unit = prefixed(max(signal.peak, *(abs(e) for e in ends)), signal.unit)
    curve(axes, np.arange(wave.size) / experiment.rate_hz, wave / scale, MEASURED, None)
    for end in ends:
        axes.axhline(end / scale, color=BOUND, linestyle=":", label="limit")
        inside = end - np.copysign(signal.reserve, end)
        axes.axhline(inside / scale, color=ORANGE, linestyle=":", linewidth=0.9, label="limit less noise")
    axes.set_ylabel(f"{name} [{unit}]")
    axes.set_xlabel("time [s]")
    share = 100 * max(signal.steady, signal.from_rest)
    head(
        axes,
        f"{name}: {share:.0f} % of the limits, drawn plants {100 * signal.drawn:.0f} %",
        good=signal.drawn <= 1.001,
    )


def _inputs(experiment: Experiment) -> str:
    names = list(experiment.excitation)
    return names[0] if len(names) == 1 else f"{len(names)} inputs"


def _lines(axes: Axes, experiment: Experiment) -> None:
    for size, color in zip(experiment.amplitude.values(), CYCLE, strict=False):
        f, own = experiment.frequency_hz[size > 0.0], size[size > 0.0]
        axes.vlines(f, 1e-3 * own.max(), own, color=color, linewidth=0.8)
        axes.plot(f, own, ".", color=color, markersize=3)
    head(axes, f"{experiment.frequency_hz.size} lines of {_inputs(experiment)}")
    largest = max(float(size.max()) for size in experiment.amplitude.values())
    least = min(float(size[size > 0.0].min()) for size in experiment.amplitude.values())
    log_axis(axes.xaxis, float(experiment.frequency_hz[0]), float(experiment.frequency_hz[-1]))
    log_axis(axes.yaxis, max(0.5 * least, 1e-3 * largest), largest)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("amplitude [V]")


def _by_length(axes: Axes, experiment: Experiment) -> None:
    for (name, sd), color in zip(experiment.shown.by_length.items(), CYCLE * 2, strict=False):
        axes.plot(experiment.shown.seconds, 100.0 * sd, color=color, label=name)
    axes.axhline(100.0 * experiment.target, color=BOUND, linestyle=":")
    axes.axvline(experiment.seconds, color=MEASURED, linewidth=0.8)
    log_axis(axes.xaxis, float(experiment.shown.seconds[0]), float(experiment.shown.seconds[-1]))
    axes.set_yscale("log")
    axes.set_xlabel("length of the record [s]")
    axes.set_ylabel("relative sd [%]")
    head(axes, f"expected over length, aim {100 * experiment.target:.3g} %")


def _by_level(axes: Axes, experiment: Experiment) -> None:
    for (name, sd), color in zip(experiment.shown.by_level.items(), CYCLE * 2, strict=False):
        axes.plot(100.0 * experiment.shown.levels, 100.0 * sd, color=color, label=name)
    axes.axhline(100.0 * experiment.target, color=BOUND, linestyle=":")
    axes.set_yscale("log")
    axes.set_xlabel("amplitude [% of the design's]")
    axes.set_ylabel("relative sd [%]")
    head(axes, f"expected over level, record of {experiment.seconds:.3g} s")
