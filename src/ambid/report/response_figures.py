"""Figures of a measured frequency response and of a stabilisation diagram."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.measured import Measured, ModelResponse, model_responses
from ambid.estimation.modes import Modal, Mode
from ambid.estimation.result import NORMAL_95
from ambid.estimation.stable_poles import PoleCluster, TrialPole
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
from ambid.report.numbers import sized
from ambid.report.response_panels import Complex, Pair, angle_ticks, magnitude_axis, pairs_panel, phase_axis, unwrapped
from ambid.validation.stabilisation import Stabilisation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
_WIDE = 100.0  # largest over smallest frequency from which the axis is logarithmic


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
        seen = np.where(x > 0, x, np.nan)
        axes.plot(f, seen, ".", color=color, markersize=0.8 * dot, label=label, zorder=1.7)
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


def _angle(G: Complex, f: Array, known: NDArray[np.bool_], models: Sequence[ModelResponse], pair: Pair) -> Array:
    """Phase of the lines in rad: the turn nearest to a model's, which noise does not make jump."""
    if not models:
        return unwrapped(G, known=known)
    near = np.interp(f, models[0].frequency_hz, unwrapped(models[0].G[:, *pair]))
    return np.asarray(near + np.angle(G * np.exp(-1j * near)))


def _marker(n: int) -> float:
    return 4.0 if n <= 300 else 2.0 if n <= 3000 else 1.0


# --- a stabilisation diagram ----------------------------------------------------------------------------------------


def stabilisation_figure(found: Stabilisation, width: float = WIDE) -> Figure:
    """Draw poles by order over frequency, above them damping over frequency, beside them the singular values."""
    seen = np.array([p.frequency_hz for p in found.poles if p.frequency_hz > 0])
    logarithmic = bool(seen.size and seen.max() > _WIDE * seen.min())

    damping, diagram = pole_panels(found.poles, found.modes, logarithmic=logarithmic)

    def values(axes: Axes) -> None:
        size = np.asarray(found.singular_values)
        axes.semilogx(size / max(float(size.max(initial=0.0)), 1e-300), found.orders, "o-", color=_NEW, markersize=4)
        axes.axhline(found.suggested, color=_MODE, linewidth=1.0, linestyle="--")
        axes.set_xlabel("singular value")
        _orders(axes)
        head(axes, f"least BIC: order {found.suggested}")

    empty = Panel(draw=lambda axes: axes.axis("off"), height=0.2)
    block = Block(
        columns=[[damping, diagram], [empty, Panel(draw=values)]],
        widths=(4, 1),
    )
    return stacked(f"stabilisation diagram, {found.method}", [block], width)


def pole_panels(
    poles: Sequence[TrialPole],
    modes: Sequence[PoleCluster],
    *,
    logarithmic: bool = False,
    most: float | None = None,
) -> tuple[Panel, Panel]:
    """Return damping over frequency of stable poles, with the modes' names, and below it all poles by order.

    `most`: damping up to which it is drawn.
    """

    def over_frequency(axes: Axes) -> None:
        for mode in modes:
            axes.axvline(mode.frequency_hz, color=_MODE, linewidth=0.9, alpha=0.6, label="mode")
        axes.set_xlabel("frequency of the pole [Hz]")
        if logarithmic:
            axes.set_xscale("log")

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
        if most is not None:
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
    found = [
        PoleCluster(pole=2 * np.pi * m.frequency_hz.value * complex(-m.damping.value, 1.0), orders=())
        for m in modal.modes
    ]
    damping, diagram = pole_panels(modal.poles, found, most=2 * max((c.damping for c in found), default=0.5))
    columns = [[damping, diagram]]
    if modal.modes and len(modal.outputs) > 1:
        empty = Panel(draw=lambda axes: axes.axis("off"), height=2.0)
        columns.append([empty, panel(_shapes, modal, height=3.6)])
    return Block(columns=columns, widths=(3, 2)[: len(columns)] if len(columns) > 1 else (), title=title)


def _shapes(axes: Axes, modal: Modal) -> None:
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


def modal_figure(modal: Modal, width: float = WIDE) -> Figure:
    """Draw modes that were found without a response."""
    return stacked(f"{modal.record.get('file') or 'record'}: operational modes", [modal_panel(modal)], width)
