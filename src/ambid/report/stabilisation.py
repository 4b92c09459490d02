"""Figure of a stabilisation diagram: poles by order over frequency, with the singular values beside."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ambid.report.numbers import sized
from ambid.validate.stabilisation import ModePole, Stabilisation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STABLE, _FREQUENCY, _NEW, _MODE = "#0b6fb8", "#e08a1e", "#aaaaaa", "#c0392b"
_WIDE = 100.0  # largest over smallest frequency from which the axis is logarithmic


def stabilisation_figure(found: Stabilisation) -> Figure:
    """Draw a stabilisation diagram.

    `found`: any. Returns poles by order over frequency, above them damping over frequency, beside them the singular
    values.
    """
    from matplotlib.figure import Figure

    page = Figure(figsize=(11, 7), layout="constrained")
    page.suptitle(f"stabilisation diagram, {found.method}", fontsize=13)
    (damping, empty), (diagram, values) = page.subplots(
        2, 2, width_ratios=(4, 1), height_ratios=(1, 2), sharex="col", sharey="row"
    )
    empty.axis("off")
    _frequency_axis(diagram, found)
    _diagram(diagram, found)
    empty.legend(*diagram.get_legend_handles_labels(), loc="center", fontsize=8, title="poles", title_fontsize=9)
    _damping(damping, found)
    size = np.asarray(found.singular_values)
    values.semilogx(size / max(float(size.max(initial=0.0)), 1e-300), found.orders, "o-", color=_NEW, markersize=4)
    values.axhline(found.suggested, color=_MODE, linewidth=1.0, linestyle="--")
    values.set_xlabel("singular value")
    values.set_title(f"least BIC: order {found.suggested}", fontsize=10)
    for axes in (damping, diagram, values):
        axes.grid(True, color="#dddddd", linewidth=0.6)
        axes.tick_params(labelsize=9)
    return page


def _diagram(axes: Axes, found: Stabilisation) -> None:
    from matplotlib.ticker import MaxNLocator

    kinds = (
        ("new", "x", _NEW),
        ("stable in frequency", "^", _FREQUENCY),
        ("stable in frequency, damping and shape", "o", _STABLE),
    )
    for k, (label, marker, color) in enumerate(kinds):
        chosen = [p for p in found.poles if (2 if p.stable else int(p.stable_frequency)) == k]
        axes.plot(*_places(chosen), marker, color=color, markersize=5, label=label, linestyle="none")
    for mode in found.modes:
        axes.axvline(mode.frequency_hz, color=_MODE, linewidth=0.9, alpha=0.6)
    axes.set_xlabel("frequency of the pole [Hz]")
    axes.set_ylabel("order")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))


def _frequency_axis(axes: Axes, found: Stabilisation) -> None:
    """Frequencies over several decades want a logarithmic axis."""
    seen = np.array([p.frequency_hz for p in found.poles if p.frequency_hz > 0])
    if seen.size and seen.max() > _WIDE * seen.min():
        axes.set_xscale("log")


def _damping(axes: Axes, found: Stabilisation) -> None:
    stable = [p for p in found.poles if p.stable]
    axes.set_ymargin(0.2)
    axes.plot([p.frequency_hz for p in stable], [p.damping for p in stable], "o", color=_STABLE, markersize=4)
    for mode in found.modes:
        axes.annotate(
            sized(mode.frequency_hz, "Hz"),
            (mode.frequency_hz, mode.damping),
            textcoords="offset points",
            xytext=(4, 4),
            fontsize=8,
        )
    axes.axhline(0, color=_NEW, linewidth=0.8)
    axes.set_ylabel("damping (under 0: unstable)")


def _places(poles: list[ModePole]) -> tuple[list[float], list[int]]:
    return [p.frequency_hz for p in poles], [p.order for p in poles]
