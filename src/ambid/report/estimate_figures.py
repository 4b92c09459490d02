"""Figures of physical parameters: of a record beside its model, and of a nonlinear bearing with its curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.magnet_problem import BearingRecord
from ambid.bearing.magnet_result import Curve, Curves, NonlinearBearingEstimate
from ambid.bearing.measured import ModelResponse, with_spread
from ambid.blackbox.model import StateSpaceModel, pole_covariance
from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate
from ambid.estimation.likelihood import prediction_error
from ambid.estimation.linear import one_thread
from ambid.estimation.result import NORMAL_95
from ambid.physics.linear_model import discretise, model
from ambid.report.drawing import BOUND, CYCLE, MEASURED, WIDE, Block, Panel, head, log_axis, panel, single, stacked
from ambid.report.numbers import prefixed, sized
from ambid.report.response_panels import Pole, bode_panel, frequency_grid, poles_panel, roots
from ambid.report.signals import Traces, records_panel, residuals_panel, signals_panel, whiteness_panel
from ambid.report.text import names_words
from ambid.signals.frf import frf_local
from ambid.signals.response import FrequencyResponse
from ambid.signals.spectra import power_spectrum
from ambid.validation import nonlinear_bearing
from ambid.validation.second_record import Replay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ambid.validation.second_record import Validation

AHEAD = (10, 100)  # samples ahead for which predictions are drawn
_LOWEST_HZ = 0.1
_WIDEST = 1e9  # rad/s, standard deviation from which a pole counts as multiple: its derivative does not exist
_LEVELS = 3  # currents or positions for which a curve is drawn
_POINTS = 121
_BEYOND = 0.1  # part of the usual range by which curves go beyond it
_CLOUD = 1500  # points of a record in the map
_INSTRUMENT_LAGS = 40  # residuals that a controller may still answer
_OWN = 0.9  # part of the power of an input that no residual explains, from which the response is measured
_LOBE = 2  # lines of a spectrum over which its window smears
_MEASURED = 60_000  # samples of a record from which its response is measured


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
        problem = run.fit.problem
        return Traces(
            time_s=self.start_s + (run.first + np.arange(run.measured.shape[0])) / problem.rate_hz,
            names=plant.outputs,
            units=tuple(plant.units[role] for role in plant.outputs),
            measured=run.measured,
            predicted=run.predicted,
            simulated=run.simulated,
            sd=np.sqrt(np.diag(self.estimate.whole_noise.innovation_covariance)),
            inputs=problem.u[problem.skip :],
            input_names=plant.inputs,
            input_units=tuple(plant.units[role] for role in plant.inputs),
        )

    @property
    def records(self) -> Sequence[Traces]:
        """What a page shows down to the samples."""
        return () if self.run is None else (self.traces,)

    def traces_ahead(self) -> Traces:
        """Return what `traces` does, with predictions several samples ahead."""
        run, traces = self.run, self.traces
        assert run is not None
        found = {}
        for k in (k for k in AHEAD if k < traces.time_s.size // 2):
            late = np.full((k - 1, len(traces.names)), np.nan)
            found[k] = np.vstack([late, run.measured[k - 1 :] - prediction_error(run.fit, k)])
        return replace(traces, ahead=found, second=True)

    def drawings(self) -> dict[str, Block]:
        """Return the blocks of the figure by name."""
        e, blocks = self.estimate, dict[str, Block]()
        if self.run is not None:
            traces, failed = self.traces, [name for name, c in e.checks.items() if not c.passed]
            blocks = {
                "signals": signals_panel(traces),
                "residuals": residuals_panel(traces),
                "whiteness": whiteness_panel(traces, failed),
            }
        blocks |= {"bode": _bode(e, measured_beside(self)), "poles": _poles(e)}
        return blocks


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingEvidence:
    """What the figures of a nonlinear bearing show beside it."""

    estimate: NonlinearBearingEstimate
    records: tuple[Traces, ...]  # one for each of its records, position and current; without any no record is drawn

    @property
    def title(self) -> str:
        """What stands above the figures."""
        return f"{names_words(list(self.estimate.noise))}: {self.estimate.law}"

    def drawings(self) -> dict[str, Block]:
        """Return the blocks of the figure by name."""
        e = self.estimate
        return {
            "force": _force(self),
            "curves": _curves(e),
            "map": _map(self),
            **({"records": records_panel(self.records)} if self.records else {}),
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
    return BearingEvidence(estimate=estimate, records=tuple(traces))


def overview(evidence: Evidence | BearingEvidence, width: float = WIDE) -> Figure:
    """Draw all figures on one page, one below the other."""
    return stacked(evidence.title, list(evidence.drawings().values()), width)


def figures(evidence: Evidence | BearingEvidence, width: float = WIDE) -> dict[str, Figure]:
    """Draw the figures one by one, as a report shows them."""
    return {name: single(block, width) for name, block in evidence.drawings().items()}


def validation_figure(
    validation: Validation, beside: Sequence[Traces] = (), width: float = WIDE, *, more: Sequence[Block] = ()
) -> Figure:
    """Draw how a result does on a further record: its predictions one and more steps ahead, and their residuals.

    `beside`: the record with its predictions; without it the sizes of the errors alone are drawn, and `more`.
    """
    failed = [name for name, c in validation.checks.items() if not c.passed]
    blocks = [_sizes_ahead(validation), *more]
    if beside and beside[0].sd.ndim > 1:
        blocks.append(records_panel(beside))
    elif beside:
        (traces,) = beside
        blocks += [signals_panel(traces), residuals_panel(traces), whiteness_panel(traces, failed)]
    return stacked(f"{validation.record or 'record'} tested with {validation.estimate or 'a result'}", blocks, width)


def _sizes_ahead(validation: Validation) -> Block:
    """Parts of the outputs that predictions leave, and how they compare with what the model expects of itself."""
    rows = [(o, what, left) for o, x in validation.fit.items() for what, left in _left(x)]
    ratios = {o: x["k_step_ratio"] for o, x in validation.fit.items() if x.get("k_step_ratio")}

    def left(axes: Axes) -> None:
        names = list(validation.fit)
        at = range(len(rows), 0, -1)
        colors = [CYCLE[names.index(o) % len(CYCLE)] for o, *_ in rows]
        sizes = np.array([100 * max(x, 1e-6) for *_, x in rows])
        axes.scatter(sizes, at, color=colors, s=28, zorder=3)
        log_axis(axes.xaxis, sizes.min() / 2, max(100.0, sizes.max()))
        axes.set_yticks(at, [f"{o}, {what}" for o, what, _ in rows])
        axes.axvline(100, color=BOUND, linestyle="--", linewidth=1.0, label="as good as the mean")
        axes.set_ylim(0.4, len(rows) + 0.6)
        axes.set_xlabel("not explained [% of the output]")
        head(axes, "errors of the predictions: smaller is better")

    def growth(axes: Axes) -> None:
        for (name, by_step), color in zip(ratios.items(), CYCLE, strict=False):
            axes.plot([int(k) for k in by_step], list(by_step.values()), "o-", color=color, label=name)
        axes.axhline(1.0, color=MEASURED, linewidth=0.8, linestyle="--", label="as the model expects")
        axes.set_xscale("log")
        axes.set_ylim(0.0, max(2.0, 1.1 * max(max(x.values()) for x in ratios.values())))
        axes.set_xlabel("samples ahead")
        axes.set_ylabel("error / expected error")
        head(axes, "growth of the errors with the horizon")

    height = 0.8 + 0.24 * len(rows)
    columns = [[panel(left, height=height)], *([[panel(growth, height=height)]] if ratios else [])]
    return Block(columns=columns, widths=(3, 2) if ratios else (), shared=False)


def _left(sizes: Mapping[str, Any]) -> list[tuple[str, float]]:
    """Return what was predicted, and which part 1 - fit of an output that leaves."""
    fits = {"one step ahead": sizes["one_step"]}
    fits |= {f"{k} steps ahead": x for k, x in (sizes.get("k_step") or {}).items() if k != "1"}
    fits["simulated"] = sizes.get("simulation")
    plain = {name: x["fit"] if isinstance(x, Mapping) else x for name, x in fits.items()}
    return [(name, 1 - x) for name, x in plain.items() if x is not None and np.isfinite(x)]


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


def measured_beside(evidence: Evidence) -> FrequencyResponse | None:
    """Measure the response of the record without a model, as the plant's own: without hold and delay of the input.

    A held input's response repeats itself around the rate: sampling adds 13 % to a coil's at a fifth of the rate. So
    what is measured is not divided by the hold, but by what the model says that hold, delay and sampling do to it.

    Feedback would bias a plain ratio of spectra. The reference is the part of the input that residuals, which a
    controller answers, do not explain (joint input-output method); where that is not nearly all of the input, the
    response is not known. None where the record shows none.
    """
    run, plant = evidence.run, model(evidence.estimate.model)
    if run is None:
        return None
    problem = run.fit.problem
    n, rate_hz = min(run.innovations.shape[0], _MEASURED), problem.rate_hz
    u, e, y = problem.u[problem.skip :][:n], run.innovations[:n], run.measured[:n]
    before = np.vstack([np.zeros((_INSTRUMENT_LAGS - 1, e.shape[1])), e])
    rows = sliding_window_view(before, _INSTRUMENT_LAGS, axis=0).reshape(n, -1)
    reference = u - rows @ np.linalg.lstsq(rows.T @ rows, rows.T @ u, rcond=None)[0]
    try:
        with one_thread():
            response = frf_local(
                u, y - y.mean(axis=0), rate_hz, r=reference, inputs=plant.inputs, outputs=plant.outputs,
                units=plant.units,
            )  # fmt: skip
    except EstimationError:
        return None
    own, all_of = (sum(power_spectrum(x, rate_hz).density for x in density.T) for density in (reference, u))
    at = power_spectrum(u[:, 0], rate_hz).frequency_hz
    share = (own / np.maximum(all_of, 1e-300))[_LOBE:]  # the first lines have lost the mean
    shares = sliding_window_view(np.pad(share, (2 * _LOBE, _LOBE), "edge"), 2 * _LOBE + 1)
    known = np.interp(response.frequency_hz, at, shares.min(axis=-1)) > _OWN
    plain = unsampled(evidence.estimate, response.frequency_hz, rate_hz)
    pairs = plain.reshape(plain.shape[0], -1)
    covariance = response.covariance * pairs[:, :, None] * pairs[:, None, :].conj()
    covariance = np.where(known[:, None, None], covariance, np.inf)
    return replace(response, G=response.G * plain, covariance=covariance, noise_covariance=None)


def unsampled(estimate: Estimate, frequency_hz: Array, rate_hz: float) -> NDArray[np.complex128]:
    """Response of the plant itself over the one that a record shows, with hold, delay and sampling, (n, n_y, n_u)."""
    space, late = model(estimate.model).matrices(estimate.values), estimate.delay[model(estimate.model).inputs[0]]
    d = discretise(space, 1.0 / rate_hz, fraction=late.fraction)[0]
    z = np.exp(2j * np.pi * frequency_hz / rate_hz)[:, None, None]
    response = d.C @ np.linalg.solve(z * np.eye(len(d.A)) - d.A, (d.B + d.B_late / z) / z**late.samples)
    return np.asarray(_as_black_box(estimate)[0].frequency_response(2 * np.pi * frequency_hz) / response)


def _bode(estimate: Estimate, measured: FrequencyResponse | None) -> Block:
    late = {role: d.samples + d.fraction for role, d in estimate.delay.items()}
    asides = {role: f", without its delay of {x:.3g} sample{'s' * (x != 1)}" for role, x in late.items() if x}
    plant = model(estimate.model)
    return bode_panel(responses(estimate), plant.inputs, plant.outputs, plant.units, asides, measured)


def _poles(estimate: Estimate) -> Block:
    return poles_panel(poles(estimate), "poles of the identified plant")


# --- a nonlinear bearing --------------------------------------------------------------------------------------------


def _wide(limits: tuple[float, float]) -> Array:
    low, high = limits
    beyond = _BEYOND * (high - low)
    return np.linspace(low - beyond, high + beyond, _POINTS)


def _curves(e: NonlinearBearingEstimate) -> Block:
    """k_i, k_x and L over the position at some currents."""
    x, levels = _wide(e.usual["position"]), np.linspace(*e.usual["current"], _LEVELS)
    scale, unit = prefixed(float(np.max(np.abs(x))), "m")
    curves = [e.curves(x, level) for level in levels.tolist()]

    def over_position(axes: Axes, name: str, meaning: str) -> None:
        size, shown = _unit_of(curves, name)
        for color, level, at in zip(CYCLE, levels, curves, strict=False):
            inside = at.coil_inside if name == "L" else at.inside
            _banded(axes, x / scale, getattr(at, name), inside, size, color, f"at {sized(level, 'A')}")
        axes.set_xlabel(f"position [{unit}]")
        axes.set_ylabel(f"{name} [{shown}]")
        head(axes, f"{meaning} {name}")

    wanted = (("k_i", "force–current factor"), ("k_x", "position stiffness"), ("L", "inductance"))
    panels = [panel(over_position, *w, height=2.5) for w in wanted]
    title = "curves with 95 % intervals; dotted outside the range of the free rotor (L: of all records)"
    return Block(columns=[[p] for p in panels], title=title)


def _unit_of(curves: Sequence[Curves], name: str) -> tuple[float, str]:
    largest = max(float(np.max(np.abs(getattr(at, name).value))) for at in curves)
    return prefixed(largest, getattr(curves[0], name).unit)


def _banded(axes: Axes, x: Array, c: Curve, inside: NDArray[np.bool_], scale: float, color: str, label: str) -> None:
    axes.fill_between(x, c.low / scale, c.high / scale, color=color, alpha=0.2, linewidth=0)
    axes.plot(x, c.value / scale, ":", color=color, linewidth=1.2)
    axes.plot(x, np.where(inside, c.value / scale, np.nan), "-", color=color, linewidth=1.6, label=label)


def _force(evidence: BearingEvidence) -> Block:
    """The force over position and current, where the free rotor was, and a cut through it."""
    e = evidence.estimate
    x, i = np.meshgrid(_wide(e.range["position"])[::2], _wide(e.range["current"])[::2])
    at = e.curves(x.ravel(), i.ravel())
    force, inside = at.force.value.reshape(x.shape), at.inside.reshape(x.shape)
    spread = NORMAL_95 * at.force.sd.reshape(x.shape)
    scale, unit = prefixed(float(np.max(np.abs(x))), "m")
    size, newton = prefixed(float(np.max(np.abs(force[inside]), initial=1e-12)), "N")
    weight = e.values["m"] * e.values["g"]

    def surface(axes: Axes, values: Array, what: str) -> None:
        drawn = axes.contour(x / scale, i, values, levels=10, cmap="viridis", linewidths=1.2)
        axes.clabel(drawn, fontsize=7, fmt="%g")
        axes.contourf(x / scale, i, ~inside, levels=[0.5, 1.5], colors=["#ededed"], zorder=0)
        for color, t in zip(CYCLE, evidence.records, strict=False):
            free = t.measured[np.isfinite(t.predicted[:, 0])]
            points = free[:: max(1, free.shape[0] // _CLOUD)]
            axes.plot(points[:, 0] / scale, points[:, 1], ".", color=color, markersize=1.5, alpha=0.35, zorder=0.5)
        if weight and not e.law.pair:
            axes.contour(x / scale, i, force + weight, levels=[0.0], colors=BOUND, linewidths=1.6, linestyles="--")
            axes.plot([], [], "--", color=BOUND, label="carries the weight")
        axes.set_xlim(x.min() / scale, x.max() / scale)
        axes.set_ylim(i.min(), i.max())
        axes.set_xlabel(f"position [{unit}]")
        axes.set_ylabel("current [A]")
        head(axes, what)

    panels = [
        panel(surface, force / size, f"force [{newton}]", height=3.0),
        panel(surface, spread / size, f"half of its 95 % interval [{newton}]", height=3.0),
    ]
    return Block(
        columns=[[p] for p in panels],
        title="force over position and current; grey: outside the range of the free rotor",
    )


def _map(evidence: BearingEvidence) -> Block:
    """Where the records were, and L over the current."""
    e = evidence.estimate
    scale, unit = prefixed(float(np.max(np.abs(e.coil_hull[:, 0]))), "m")

    def where(axes: Axes) -> None:
        for color, t in zip(cycle(CYCLE), evidence.records, strict=False):
            every = max(1, t.measured.shape[0] // _CLOUD)
            points = t.measured[np.isfinite(t.predicted[:, 1])][::every]
            mark = "." if np.any(np.isfinite(t.predicted[:, 0])) else "|"
            axes.plot(points[:, 0] / scale, points[:, 1], mark, color=color, markersize=2.5, alpha=0.6, label=t.title)
        for hull, width in ((e.hull, 1.2), (e.coil_hull, 0.6)):
            corners = np.vstack([hull, hull[:1]])
            axes.plot(corners[:, 0] / scale, corners[:, 1], "-", color=MEASURED, linewidth=width)
        axes.set_xlabel(f"position [{unit}]")
        axes.set_ylabel("current [A]")
        head(axes, "range of the records: hulls of the free rotor and of all")

    def inductance(axes: Axes) -> None:
        low, high = e.coil_hull[:, 1].min(), e.coil_hull[:, 1].max()
        currents, levels = np.linspace(low, high, _POINTS), np.linspace(*e.usual["position"], _LEVELS)
        curves = [e.curves(np.full(_POINTS, x), currents) for x in levels.tolist()]
        size, unit = _unit_of(curves, "L")
        for color, x, at in zip(CYCLE, levels, curves, strict=False):
            _banded(axes, currents, at.L, at.coil_inside, size, color, f"at {sized(x, 'm')}")
        axes.set_xlabel("current [A]")
        axes.set_ylabel(f"L [{unit}]")
        head(axes, "inductance L over the current")

    return Block(columns=[[Panel(draw=where, height=2.8)], [Panel(draw=inductance, height=2.8)]])
