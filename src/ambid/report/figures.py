"""Figures of an estimate: measured against predicted, residuals with bounds, Bode with uncertainty, poles.

Everything is drawn on `matplotlib.figure.Figure` objects, without pyplot: no window system, no global state.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from ambid.arrays import Array
from ambid.estimation.estimate import Estimate
from ambid.physics.models import model
from ambid.report._drawing import (
    BOUND,
    MEASURED,
    PREDICTED,
    grid,
    magnitude_axis,
    phase_axis,
    pole_region,
    pole_words,
)
from ambid.report._panels import Traces, residuals_panel, signals_panel
from ambid.report.response import poles, responses
from ambid.validate.second_record import Replay

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """What the figures of an estimate show beside it."""

    estimate: Estimate
    run: Replay  # a record run through the estimate's predictor
    start_s: float = 0.0  # time of the record's first sample in s

    @property
    def rate_hz(self) -> float:
        """Sampling rate in Hz."""
        return self.run.fit.problem.rate_hz

    @property
    def time_s(self) -> Array:
        """Time of the rows of `run`, shape (n_used,), in s."""
        return self.start_s + (self.run.first + np.arange(self.run.measured.shape[0])) / self.rate_hz

    @property
    def outputs(self) -> tuple[str, ...]:
        """Roles of the columns of `run`."""
        return model(self.estimate.model).outputs

    @property
    def traces(self) -> Traces:
        """What the panels of signals and residuals draw."""
        run, units = self.run, model(self.estimate.model).units
        return Traces(
            time_s=self.time_s,
            names=self.outputs,
            units=tuple(units[role] for role in self.outputs),
            measured=run.measured,
            predicted=run.predicted,
            simulated=run.simulated,
            innovation_sd=np.sqrt(np.diag(self.estimate.noise.innovation_covariance)),
        )


def overview(evidence: Evidence) -> Figure:
    """Draw all figures on one page.

    `evidence`: estimate and replayed record. Returns signals, residuals, Bode and poles, one below the other.
    """
    from matplotlib.figure import Figure

    n_y = len(evidence.outputs)
    heights = [2.3 * n_y, 2.2 * n_y, 4.6, 3.4]
    page = Figure(figsize=(11, sum(heights) + 0.5), layout="constrained")
    name = evidence.estimate.record.get("file") or "record"
    page.suptitle(f"{name}: model {evidence.estimate.model}", fontsize=13)
    parts: Any = page.subfigures(4, 1, height_ratios=heights)
    for part, draw in zip(parts, (_signals, _residuals, _bode, _poles), strict=True):
        draw(part, evidence)
    return page


def figures(evidence: Evidence) -> dict[str, Figure]:
    """Draw the figures one by one, as a report shows them.

    `evidence`: estimate and replayed record. Returns ``signals``, ``residuals``, ``bode`` and ``poles``.
    """
    from matplotlib.figure import Figure

    n_y = len(evidence.outputs)
    drawings = {
        "signals": (2.4 * n_y, _signals),
        "residuals": (2.2 * n_y, _residuals),
        "bode": (4.8, _bode),
        "poles": (3.4, _poles),
    }
    found = {}
    for name, (height, draw) in drawings.items():
        found[name] = Figure(figsize=(11, height), layout="constrained")
        draw(found[name], evidence)
    return found


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
    """
    # no date inside: equal estimates give equal files
    dates = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    ending = kind or Path(str(target)).suffix.lower().removeprefix(".")
    figure.savefig(target, dpi=130, format=ending, metadata=dates.get(ending))


def _signals(figure: Figure | SubFigure, evidence: Evidence) -> None:
    signals_panel(figure, evidence.traces)


def _residuals(figure: Figure | SubFigure, evidence: Evidence) -> None:
    residuals_panel(figure, evidence.traces)


def _bode(figure: Figure | SubFigure, evidence: Evidence) -> None:
    """Magnitude and phase of each output per input, with 95 % bands."""
    found = responses(evidence.estimate)
    axes = figure.subplots(2, len(found), squeeze=False, sharex=True, height_ratios=(3, 2))
    units = model(evidence.estimate.model).units
    for j, r in enumerate(found):
        magnitude, phase = axes[:, j]
        magnitude_axis(magnitude, r)
        phase_axis(phase, r)
        magnitude.set_ylabel(f"magnitude [{units[r.output]}/{units[r.source]}]")
        phase.set_ylabel("phase [°]")
        phase.set_xlabel("frequency [Hz]")
        late = evidence.estimate.delay[r.source]
        aside = (
            f", without its delay of {late.samples + late.fraction:.3g} samples" if late.samples + late.fraction else ""
        )
        magnitude.set_title(f"{r.source} → {r.output}{aside}", fontsize=10)
        magnitude.legend(loc="lower left", fontsize=8, framealpha=0.85)
        grid(magnitude, phase)


def _poles(figure: Figure | SubFigure, evidence: Evidence) -> None:
    """Poles with 95 % regions, and beside them in numbers."""
    axes, beside = figure.subplots(1, 2, width_ratios=(3, 2))
    found = poles(evidence.estimate)
    for pole in found:
        unstable = pole.value.real > 0
        color = BOUND if unstable else PREDICTED
        axes.plot(pole.value.real, pole.value.imag, "x", color=color, markersize=8, markeredgewidth=1.8)
        pole_region(axes, pole, color)
    axes.margins(0.15)
    axes.axvline(0, color=MEASURED, linewidth=0.8)
    axes.axhline(0, color=MEASURED, linewidth=0.8)
    low, high = axes.get_xlim()
    axes.axvspan(0, max(high, 0.15 * -low), color="#fbe9e7", zorder=0)
    axes.set_xlim(low, max(high, 0.15 * -low))
    axes.set_xlabel("real part [rad/s] – right of zero the plant is unstable")
    axes.set_ylabel("imaginary part [rad/s]")
    axes.set_title("poles of the identified plant, 95 % regions", fontsize=10)
    grid(axes)
    beside.axis("off")
    lines = ["pole [rad/s]", "", *(line for pole in found if pole.value.imag >= 0 for line in pole_words(pole))]
    beside.text(0.0, 0.97, "\n".join(lines), fontsize=10, va="top", family="monospace", transform=beside.transAxes)
