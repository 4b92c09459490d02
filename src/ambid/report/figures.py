"""Figures of physical parameters: of a record beside its model, and of a nonlinear bearing with its curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.magnet_problem import BearingRecord
from ambid.bearing.magnet_result import Curve, Curves, NonlinearBearingEstimate
from ambid.bearing.measured import ModelResponse, with_spread
from ambid.blackbox.model import StateSpaceModel, pole_covariance
from ambid.estimation.estimate import Estimate
from ambid.physics.linear_model import model
from ambid.report.drawing import (
    MEASURED,
    PREDICTED,
    Pole,
    Traces,
    bode_panel,
    frequency_grid,
    grid,
    poles_panel,
    records_panel,
    residuals_panel,
    roots,
    signals_panel,
    single,
    stacked,
)
from ambid.report.estimate_text import names_words
from ambid.report.numbers import prefixed
from ambid.report.text import pole_table
from ambid.validation import nonlinear_bearing
from ambid.validation.second_record import Replay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from ambid.report.drawing import Draw
    from ambid.validation.second_result import Validation

_LOWEST_HZ = 0.1
_WIDEST = 1e9  # rad/s, standard deviation from which a pole counts as multiple: its derivative does not exist
_LEVELS = 3  # currents or positions for which a curve is drawn
_POINTS = 121
_BEYOND = 0.1  # part of the usual range by which curves go beyond it
_CLOUD = 1500  # points of a record in the map
_ROW = 1.6  # height of a record, inches


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """What the figures of an estimate show beside it."""

    estimate: Estimate
    run: Replay | None  # a record run through the estimate's predictor; None: only what needs none is drawn
    start_s: float = 0.0  # time of the record's first sample in s

    @property
    def title(self) -> str:
        """What stands above the figures."""
        return f"{self.estimate.record.get('file') or 'record'}: model {self.estimate.model}"

    @property
    def traces(self) -> Traces:
        """What the panels of signals and residuals draw."""
        run, plant = self.run, model(self.estimate.model)
        assert run is not None
        rate_hz = run.fit.problem.rate_hz
        return Traces(
            time_s=self.start_s + (run.first + np.arange(run.measured.shape[0])) / rate_hz,
            names=plant.outputs,
            units=tuple(plant.units[role] for role in plant.outputs),
            measured=run.measured,
            predicted=run.predicted,
            simulated=run.simulated,
            sd=np.sqrt(np.diag(self.estimate.noise.innovation_covariance)),
        )

    def drawings(self) -> dict[str, tuple[float, Draw]]:
        """Return the drawings by name, each with its height in inches."""
        estimate = self.estimate
        found: dict[str, tuple[float, Draw]] = {}
        if self.run is not None:
            traces = self.traces
            n_y = len(traces.names)
            found |= {
                "signals": (2.3 * n_y, lambda place: signals_panel(place, traces)),
                "residuals": (2.2 * n_y, lambda place: residuals_panel(place, traces)),
            }
        return {
            **found,
            "bode": (4.6, lambda place: _bode(place, estimate)),
            "poles": (3.4, lambda place: _poles(place, estimate)),
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingEvidence:
    """What the figures of a nonlinear bearing show beside it."""

    estimate: NonlinearBearingEstimate
    traces: tuple[Traces, ...]  # one for each of its records, position and current; without any no record is drawn

    @property
    def title(self) -> str:
        """What stands above the figures."""
        return f"{names_words(list(self.estimate.noise))}: {self.estimate.law}"

    def drawings(self) -> dict[str, tuple[float, Draw]]:
        """Return the drawings by name, each with its height in inches."""
        height, traces = 0.7 + _ROW * len(self.traces), self.traces
        return {
            "curves": (3.6, lambda place: _curves(place, self.estimate)),
            "map": (3.6, lambda place: _map(place, self)),
            **({"records": (height, lambda place: records_panel(place, traces))} if traces else {}),
        }


def bearing_evidence(
    estimate: NonlinearBearingEstimate, records: Sequence[tuple[BearingRecord, float]]
) -> BearingEvidence:
    """Run the records of an estimate, or others, each with the time of its first sample, through it again."""
    traces = []
    own = len(records) == len(estimate.noise)
    for name, (record, start_s) in zip(estimate.noise if own else [r.name for r, _ in records], records, strict=True):
        run = nonlinear_bearing.replay(estimate, record, noise_of=name if own else None)
        traces.append(
            Traces(
                title=name,
                names=("position", "current"),
                units=("m", "A"),
                time_s=start_s + (run.first + np.arange(run.measured.shape[0])) / record.rate_hz,
                measured=run.measured,
                predicted=run.predicted,
                sd=run.sd,
            )
        )
    return BearingEvidence(estimate=estimate, traces=tuple(traces))


def overview(evidence: Evidence | BearingEvidence) -> Figure:
    """Draw all figures on one page, one below the other."""
    return stacked(evidence.title, list(evidence.drawings().values()))


def figures(evidence: Evidence | BearingEvidence) -> dict[str, Figure]:
    """Draw the figures one by one, as a report shows them."""
    return {name: single(height, draw) for name, (height, draw) in evidence.drawings().items()}


def validation_figure(found: Validation) -> Figure:
    """Draw the one-step fit of each output on a further record."""
    sizes = {
        k: v["one_step"]["fit"] if isinstance(v["one_step"], dict) else v["one_step"] for k, v in found.fit.items()
    }

    def draw(place: Figure | SubFigure) -> None:
        axes = place.subplots()
        axes.barh(list(sizes), [np.nan if x is None else x for x in sizes.values()], color=PREDICTED, height=0.5)
        axes.set_xlabel("one-step fit, 1 is perfect")
        axes.set_xlim(right=1.0)
        grid(axes)

    return stacked(
        f"{found.record or 'record'} judged with {found.estimate or 'a result'}", [(1.0 + 0.5 * len(sizes), draw)]
    )


# --- a linear plant -------------------------------------------------------------------------------------------------


def _as_black_box(estimate: Estimate) -> tuple[StateSpaceModel, Array]:
    """The plant as a black-box model, and the slopes of its coefficients by the estimated parameters."""
    plant = model(estimate.model)
    space = plant.matrices(estimate.values)
    n_y, n_u, n = space.C.shape[0], space.B.shape[1], space.A.shape[0]
    rest = {"D": np.zeros((n_y, n_u)), "K": np.zeros((n, n_y))}
    moved = [plant.derivative(estimate.values, name) for name in estimate.covariance_names]
    slopes = [np.concatenate([x.ravel() for x in (d.A, d.B, d.C, *rest.values())]) for d in moved]
    return StateSpaceModel(A=space.A, B=space.B, C=space.C, dt=None, **rest), np.array(slopes).T


def responses(estimate: Estimate, *, n_frequencies: int = 600) -> ModelResponse:
    """Compute the frequency response of every pair with its spread, from 0.1 Hz to half the sampling rate.

    The delay of the input is not in it.
    """
    plant, slopes = _as_black_box(estimate)
    nyquist = 0.5 * float(str(estimate.record["rate_hz"]))
    frequency = frequency_grid(estimate.continuous.poles, min(_LOWEST_HZ, 0.01 * nyquist), nyquist, n_frequencies)
    omega = 2 * np.pi * frequency
    by_parameter = plant.frequency_response_derivative(omega) @ slopes
    return with_spread(estimate.model, frequency, plant.frequency_response(omega), by_parameter, estimate.covariance)


def poles(estimate: Estimate) -> list[Pole]:
    """Compute the poles of the plant with their spread, sorted by real part."""
    plant, slopes = _as_black_box(estimate)
    spread = pole_covariance(plant, slopes @ estimate.covariance @ slopes.T)
    return sorted(roots(plant.poles(), spread, _WIDEST), key=lambda pole: pole.value.real)


def _bode(figure: Figure | SubFigure, estimate: Estimate) -> None:
    late = {role: d.samples + d.fraction for role, d in estimate.delay.items()}
    asides = {role: f", without its delay of {x:.3g} samples" for role, x in late.items() if x}
    plant = model(estimate.model)
    bode_panel(figure, responses(estimate), plant.inputs, plant.outputs, plant.units, asides)


def _poles(figure: Figure | SubFigure, estimate: Estimate) -> None:
    found = poles(estimate)
    text = pole_table([(p.value, p.covariance) for p in found if p.value.imag >= 0], times=True)
    poles_panel(figure, found, "\n".join(text), "poles of the identified plant, 95 % regions")


# --- a nonlinear bearing --------------------------------------------------------------------------------------------


def _wide(limits: tuple[float, float]) -> Array:
    low, high = limits
    beyond = _BEYOND * (high - low)
    return np.linspace(low - beyond, high + beyond, _POINTS)


def _curves(figure: Figure | SubFigure, e: NonlinearBearingEstimate) -> None:
    """k_i, k_x and L over the position at some currents."""
    x, levels = _wide(e.usual["position"]), np.linspace(*e.usual["current"], _LEVELS)
    scale, unit = prefixed(float(np.max(np.abs(x))), "m")
    axes = figure.subplots(1, 3)
    found = [e.curves(x, level) for level in levels.tolist()]
    for a, name, meaning in zip(
        axes, ("k_i", "k_x", "L"), ("force–current factor", "stiffness", "inductance"), strict=True
    ):
        size, shown = _unit_of(found, name)
        for k, (level, at) in enumerate(zip(levels, found, strict=True)):
            inside = at.coil_inside if name == "L" else at.inside
            _banded(a, x / scale, getattr(at, name), inside, size, f"C{k}", f"at {level:.3g} A")
        a.set_xlabel(f"position [{unit}]")
        a.set_ylabel(f"{name} [{shown}]")
        a.set_title(f"{meaning} {name}", fontsize=10)
        grid(a)
    axes[0].legend(loc="best", fontsize=8, framealpha=0.85)
    figure.suptitle(
        "curves with 95 % bands; dotted outside the range of the free rotor (L: of all records)", fontsize=10
    )


def _unit_of(found: Sequence[Curves], name: str) -> tuple[float, str]:
    largest = max(float(np.max(np.abs(getattr(at, name).value))) for at in found)
    return prefixed(largest, getattr(found[0], name).unit)


def _banded(axes: Axes, x: Array, c: Curve, inside: NDArray[np.bool_], scale: float, color: str, label: str) -> None:
    axes.fill_between(x, c.low / scale, c.high / scale, color=color, alpha=0.25, linewidth=0)
    axes.plot(x, c.value / scale, ":", color=color, linewidth=1.2)
    axes.plot(x, np.where(inside, c.value / scale, np.nan), "-", color=color, linewidth=1.6, label=label)


def _map(figure: Figure | SubFigure, evidence: BearingEvidence) -> None:
    """Where the records were, and L over the current."""
    e = evidence.estimate
    where, over = figure.subplots(1, 2, width_ratios=(3, 2))
    scale, unit = prefixed(float(np.max(np.abs(e.coil_hull[:, 0]))), "m")
    for k, t in enumerate(evidence.traces):
        every = max(1, t.measured.shape[0] // _CLOUD)
        used = t.measured[np.isfinite(t.predicted[:, 1])][::every]
        x, i = used[:, 0] / scale, used[:, 1]
        held = not np.any(np.isfinite(t.predicted[:, 0]))
        where.plot(x, i, "|" if held else ".", color=f"C{k % 10}", markersize=2.5, alpha=0.5)
        where.plot([], [], "|" if held else "o", color=f"C{k % 10}", markersize=5, label=t.title)
    for hull, width in ((e.hull, 1.2), (e.coil_hull, 0.6)):
        corners = np.vstack([hull, hull[:1]])
        where.plot(corners[:, 0] / scale, corners[:, 1], "-", color=MEASURED, linewidth=width)
    _balance(where, e, scale)
    where.set_xlabel(f"position [{unit}]")
    where.set_ylabel("current [A]")
    where.set_title("positions and currents of the records; hulls of the free rotor and of all records", fontsize=10)
    where.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7, framealpha=0.85)
    low, high = e.coil_hull[:, 1].min(), e.coil_hull[:, 1].max()
    currents, levels = np.linspace(low, high, _POINTS), np.linspace(*e.usual["position"], _LEVELS)
    found = [e.curves(np.full(_POINTS, x), currents) for x in levels.tolist()]
    size, shown = _unit_of(found, "L")
    for k, (x, at) in enumerate(zip(levels, found, strict=True)):
        _banded(over, currents, at.L, at.coil_inside, size, f"C{k}", f"at {x / scale:.3g} {unit}")
    over.set_xlabel("current [A]")
    over.set_ylabel(f"L [{shown}]")
    over.set_title("inductance over the current", fontsize=10)
    over.legend(loc="best", fontsize=8, framealpha=0.85)
    grid(where, over)


def _balance(axes: Axes, e: NonlinearBearingEstimate, scale: float) -> None:
    """The line on which one magnet carries the weight: where a rotor at rest has to be, whatever the dynamics say."""
    weight = e.values["m"] * e.values["g"]
    if e.law.pair or weight == 0.0:
        return
    x, i = np.meshgrid(_wide(e.usual["position"])[::4], np.linspace(*e.range["current"], 60))
    force = e.curves(x.ravel(), i.ravel()).force.value.reshape(x.shape)
    axes.contour(x / scale, i, force + weight, levels=[0.0], colors="black", linewidths=1.4, linestyles="--")
    axes.plot([], [], "--", color="black", linewidth=1.4, label="carries the weight")
