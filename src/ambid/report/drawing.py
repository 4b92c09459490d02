"""What all figures are made of: a panel is one pair of axes, a block a few panels, a figure blocks below each other.

Everything is drawn on `matplotlib.figure.Figure` objects, without pyplot: no window system, no global state. Colours
are those of Okabe and Ito, which stay apart for colour-blind readers. Every band is a 95 % interval.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError
from ambid.estimation.result import Verdict
from ambid.report.text import SPREAD, WORDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure, SubFigure

MEASURED, PREDICTED, BAND, BOUND = "#4d4d4d", "#0072b2", "#a9d1ec", "#d55e00"
GREEN, ORANGE, PURPLE, SKY = "#009e73", "#e69f00", "#cc79a7", "#56b4e9"
CYCLE = (PREDICTED, ORANGE, GREEN, PURPLE, SKY, BOUND, MEASURED)
STYLES = {"good": "#1b7837", "doubt": "#b35900", "bad": "#b2182b"}
WIDE = 11.0  # inches of a page
_given: list[Any] = []  # axes that are drawn into
_DPI = 130  # of a PNG
PIXELS = 500  # stretches of which a long curve shows the extremes, about one for each column of pixels
_LETTERS = 13.7  # of a legend on an inch
_LOGARITHMIC = 5.0  # ratio of limits from which an axis is
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.edgecolor": "#777777",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.prop_cycle": "cycler('color', " + str(list(CYCLE)) + ")",
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "text.color": "#1a1a1a",
    "axes.labelcolor": "#1a1a1a",
    "lines.linewidth": 1.2,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """What is drawn on one pair of axes."""

    draw: Callable[[Axes], object]
    height: float = 1.9  # inches


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """Panels that belong together: columns side by side."""

    columns: Sequence[Sequence[Panel]]  # of each, its panels from top to bottom
    widths: tuple[float, ...] = ()  # of the columns, beside each other
    title: str = ""
    shared: bool = True  # whether the panels of a column have one horizontal axis
    legend: Sequence[Any] = ()  # entries beside those that the panels' artists make

    @property
    def panels(self) -> list[Panel]:
        """All of them, column by column."""
        return [p for column in self.columns for p in column]

    @property
    def height(self) -> float:
        """What the block needs, inches."""
        return 0.55 + max(sum(p.height for p in column) for column in self.columns)

    def draw(self, place: Figure | SubFigure, width: float) -> None:
        """Draw the block, with one legend below it, where it covers nothing."""
        columns = self.columns
        rows = max(len(column) for column in columns)
        tallest = [max((c[k].height for c in columns if k < len(c)), default=1.0) for k in range(rows)]
        axes = place.subplots(
            rows, len(columns), squeeze=False, height_ratios=tallest,
            width_ratios=self.widths or None if len(columns) > 1 else None,
            sharex="col" if self.shared else False,
        )  # fmt: skip
        for column, below in zip(columns, axes.T, strict=True):
            for k, a in enumerate(below):
                if k >= len(column):
                    a.axis("off")
                    below[len(column) - 1].tick_params(labelbottom=True)  # hidden as of all but the last row
                    continue
                column[k].draw(a)
                if self.shared and k + 1 < len(column):
                    a.set_xlabel("")
        handles = {label: h for a in place.axes for h, label in zip(*a.get_legend_handles_labels(), strict=True)}
        handles |= {h.get_label(): h for h in self.legend}
        if handles:
            fitting = int(_LETTERS * width / (6 + max(map(len, handles))))
            ncols = min(max(1, fitting), 5)
            place.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=ncols)
        if self.title:
            place.suptitle(textwrap.fill(self.title, int(11 * width)), fontsize=10)


def stacked(title: str, blocks: Sequence[Block], width: float = WIDE) -> Figure:
    """Return a page of blocks, one below the other; `width` in inches."""
    import matplotlib

    if _given:  # axes to draw into
        for axes, one in zip(_given, [p for block in blocks for p in block.panels], strict=False):
            one.draw(axes)
        return _given[0].get_figure(root=True)  # type: ignore[no-any-return]
    heights = [block.height for block in blocks]
    with matplotlib.rc_context(_STYLE):
        page: Figure = _page_class()(figsize=(width, sum(heights) + 0.5 * bool(title)), layout="constrained")
        if title:
            page.suptitle(textwrap.fill(title, int(8 * width)), fontsize=12)
        places: Any = page.subfigures(len(blocks), 1, height_ratios=heights) if len(blocks) > 1 else page
        for place, block in zip(np.atleast_1d(places), blocks, strict=True):
            block.draw(place, width)
    return page


def into(ax: Any, draw: Callable[[], Figure]) -> Figure:
    """Draw into axes that are given, or where there are none (None) on a page of its own."""
    global _given
    before, _given = _given, [] if ax is None else list(np.ravel(ax))
    try:
        return draw()
    finally:
        _given = before


@cache
def _page_class() -> type[Figure]:
    """Return a figure that a notebook shows also where no backend of pyplot was chosen."""
    from io import BytesIO

    from matplotlib.figure import Figure

    class Page(Figure):
        def _repr_png_(self) -> bytes:
            self.savefig(picture := BytesIO(), format="png", dpi=_DPI)
            return picture.getvalue()

    Page.__name__ = "Figure"
    return Page


def judged(figure: Figure, verdict: Verdict) -> Figure:
    """Put the verdict above a figure: its word in colour, and the names of the checks that speak against it."""
    from matplotlib.offsetbox import AnchoredOffsetbox, HPacker, TextArea

    words, style = WORDS[verdict.word]
    letters = int(11 * figure.get_figwidth()) - 75  # what there is room for
    names = textwrap.shorten(", ".join(r.check for r in verdict.reasons), max(letters, 12), placeholder=" …")
    parts = [
        ("verdict: ", {}),
        (words, {"color": STYLES[style], "weight": "bold"}),
        (f" – {names}" if names else "", {}),
    ]
    line = HPacker(children=[TextArea(x, textprops={"size": 10, **how}) for x, how in parts], pad=0, sep=0)
    box = AnchoredOffsetbox(
        "upper left", child=line, frameon=False, bbox_to_anchor=(0.0, 1.0), bbox_transform=figure.transFigure
    )
    box.set_in_layout(False)
    figure.add_artist(box)
    figure.suptitle(f"\n{figure.get_suptitle()}", fontsize=12)  # the empty line is their place
    at = (0.995, 1.0 - 0.05 / figure.get_figheight())
    note = figure.text(*at, SPREAD, ha="right", va="top", size=8, color="#555555")
    note.set_in_layout(False)
    return figure


def single(block: Block, width: float = WIDE) -> Figure:
    """Return one block as a figure."""
    return stacked("", [block], width)


def head(axes: Axes, text: str, *, good: bool = True) -> None:
    """Write what a panel shows above it: in the colour of a warning where it speaks against the result."""
    axes.set_title(text if good else f"✗ {text}", color="#1a1a1a" if good else BOUND)


def save(figure: Figure, target: str | Path | BinaryIO, *, kind: str | None = None) -> None:
    """Write a figure.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        What to write.
    target : str, Path or binary file
        ``.png``, ``.svg`` or ``.pdf``.
    kind : str, optional
        Format, where the name does not tell it.

    Raises
    ------
    AmbidError
        If the format is another one.
    """
    # no date inside: equal estimates give equal files
    dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    ending = kind or Path(str(target)).suffix.lower().removeprefix(".")
    if ending not in ("png", "svg", "pdf"):
        raise AmbidError(f"a figure as .{ending} ({target}); it is written as .png, .svg or .pdf. Name it so")
    backend = import_module(f"matplotlib.backends.backend_{'agg' if ending == 'png' else ending}")
    figure.set_dpi(_DPI)
    # `savefig` would draw everything twice
    getattr(backend.FigureCanvas(figure), f"print_{ending}")(target, metadata=dates.get(ending))


def curve(
    axes: Axes,
    t: Array,
    y: Array,
    color: str,
    label: str | None,
    *,
    linewidth: float = 0.9,
    alpha: float = 0.45,
    zorder: float | None = None,
) -> None:
    """Draw a curve, or, where there are more samples than the paper shows, the band between its extremes."""
    options: dict[str, Any] = {"color": color, "label": label} | ({} if zorder is None else {"zorder": zorder})
    if y.size <= 2 * PIXELS:
        axes.plot(t, y, linewidth=linewidth, **options)
    else:
        axes.fill_between(*extremes(t, y, y), linewidth=0.5, alpha=alpha, **options)


def extremes(t: Array, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Return a band as the extremes of as many stretches as the paper shows, where it has more samples."""
    if t.size <= 2 * PIXELS:
        return t, low, high
    edges = np.linspace(0, t.size, PIXELS + 1).astype(int)[:-1]
    return t[edges], np.fmin.reduceat(low, edges), np.fmax.reduceat(high, edges)


def log_axis(axis: Axis, low: float, high: float) -> None:
    """Set the limits of an axis, logarithmic where they are far apart; under two decades with plain numbers."""
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

    axes, upright = axis.axes, axis.axis_name == "y"  # type: ignore[attr-defined]
    wide = high > 100 * low
    if high > _LOGARITHMIC * low:
        (axes.set_yscale if upright else axes.set_xscale)("log")
    (axes.set_ylim if upright else axes.set_xlim)(low / 1.1, high * 1.1)
    if high <= _LOGARITHMIC * low:
        return
    axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(LogFormatterSciNotation() if wide else "{x:g}")
    axis.set_minor_formatter(NullFormatter())


def said_panel(text: str) -> Block:
    """Return a text in the place of a figure: why there is none."""
    return Block(columns=[[Panel(draw=lambda axes: (axes.axis("off"), axes.set_title(textwrap.fill(text, 60))))]])


def panel(draw: Callable[..., object], *which: Any, height: float = 1.9) -> Panel:
    """Return a panel that a function of the axes and of `which` draws."""
    return Panel(draw=lambda axes: draw(axes, *which), height=height)
