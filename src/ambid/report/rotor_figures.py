"""Figures of a rotor's estimate: its response measured and modelled, residuals, mode shapes, poles, uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ambid.arrays import Array, Complex
from ambid.bearing.measured import ModelResponse, with_spread
from ambid.blackbox.model import complex_covariance
from ambid.physics.rotor_model import RotorModel, position_role
from ambid.physics.shaft import Shaft
from ambid.physics.whirl import campbell, free_rotor_of, whirl_sd
from ambid.record import Record
from ambid.report.drawing import MEASURED, PREDICTED, WIDE, Block, Panel, head, log_axis, panel, stacked
from ambid.report.numbers import prefixed, response_unit
from ambid.report.response_panels import Pole, frequency_grid, magnitude_axis, marks, phase_axis, poles_panel, roots
from ambid.report.rotor_drawing import balance_block, campbell_panel, orbit_blocks, shapes_block
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.replay import RotorReplay, at_speed, point_of, slopes
from ambid.rotor.response import Sampled
from ambid.signals.response import FrequencyResponse

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_AROUND, _GRID = 1.6, 500  # how far the model is drawn beyond the excited band, at how many frequencies
_WIDEST = 1e9  # rad/s, from which the spread of a pole is not drawn
_RAYLEIGH_95 = float(np.sqrt(-np.log(0.05)))  # 95 % of |e| over its standard deviation √E|e|²
_SHARE = 0.5  # of the largest input at a line, from which a line without a reference counts as one of this axis
_BEYOND, _SPEEDS = 1.3, 41  # how far over the fastest record and the lowest mode whirl is drawn, and at how many speeds
_MARKS = 40  # lines of each decade that are drawn with their intervals: modes are narrow
_PLANE_NAMES = ("x", "y", "z")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RotorEvidence:
    """What the figures of a rotor show beside its estimate."""

    estimate: RotorEstimate
    runs: tuple[RotorReplay, ...] = ()  # its records with periodic excitation; without any the model alone is drawn
    shaft: Shaft | None = None  # its drawing
    records: tuple[Record, ...] = ()  # whose signals a page shows

    @property
    def title(self) -> str:
        """What stands above the figures."""
        e = self.estimate
        name = e.record.get("file") or "record"
        return f"{name if len(e.records) == 1 else f'{len(e.records)} records'}: rotor on {len(e.plant.axes)} axes"

    def drawings(self) -> dict[str, Block]:
        """Return the blocks of the figure by name."""
        e, plant = self.estimate, self.estimate.plant
        blocks: dict[str, Block] = {}
        first = self.runs[0] if self.runs else None
        r = response_of(e, first)
        for p in plant.planes:
            at = [j for j, (_, plane) in enumerate(plant.placed) if plane == p]
            blocks[f"response_{_PLANE_NAMES[p]}"] = _matrix(e, r, first, _positions(plant, p), at)
        if (plant if first is None else first.model).turning:
            at = [j for j, (_, plane) in enumerate(plant.placed) if plane == 0]
            blocks["response_across"] = _matrix(e, r, first, _positions(plant, 1), at)
        if plant.coils:
            blocks["coils"] = _coils(e, r, first)
        for k, run in enumerate(self.runs):
            blocks["residuals" if k == 0 else f"residuals_{k + 1}"] = residuals_block(run)
        if e.modes or self.shaft is not None:
            planes = {place: e.numbers[place] for place in plant.places}
            blocks["shapes"] = shapes_block(planes, e.modes, shaft=self.shaft)
        whirl = _whirl(e, self.shaft)
        if whirl is not None:
            blocks["campbell"] = Block(columns=[[whirl]])
        for k, block in enumerate(orbit_blocks(e)):
            blocks["orbits" if k == 0 else f"orbits_{k + 1}"] = block
        unbalance = balance_block(e.synchronous) if e.synchronous else None
        if unbalance is not None:
            blocks["unbalance"] = unbalance
        blocks["poles"] = poles_panel(rotor_poles(e), "poles of the identified rotor in its magnets, open loop")
        return blocks


def rotor_overview(evidence: RotorEvidence, width: float = WIDE) -> Figure:
    """Draw all figures on one page, one below the other."""
    return stacked(evidence.title, list(evidence.drawings().values()), width)


# --- response -------------------------------------------------------------------------------------------------------


def response_of(estimate: RotorEstimate, run: RotorReplay | None = None) -> ModelResponse:
    """Return the response of every pair with its spread, sampled, with hold and delay, as records show it.

    `run`: at the speed and around the band of this record; default: at that of the estimate, up to half the rate.
    """
    rate = float(str(estimate.record["rate_hz"]))
    lines = np.array([0.002 * rate, 0.5 * rate / _AROUND]) if run is None else run.experiment.spectra.frequency_hz
    model = at_speed(estimate, estimate.speed if run is None else run.experiment.speed)
    space, at = model.matrices(estimate.numbers), point_of(estimate)
    poles = np.linalg.eigvals(space.A).astype(np.complex128)
    f = frequency_grid(poles, lines[0] / _AROUND, min(_AROUND * lines[-1], 0.499 * rate), _GRID)
    sampled = Sampled(space=space, omega=2 * np.pi * f, rate_hz=rate, delays=at.delays, held=model.held)
    n_u = len(model.inputs)
    unit = np.eye(n_u, dtype=complex)
    moved = [slopes(estimate, sampled, model, np.tile(unit[j], (f.size, 1))) for j in range(n_u)]
    return with_spread("rotor", f, sampled.transfer(), np.stack(moved, axis=2), estimate.covariance)


def measured_pairs(run: RotorReplay, outputs: Sequence[int], inputs: Sequence[int]) -> FrequencyResponse:
    """Return the response of some pairs at the lines where the input's axis is excited: H + e/U.

    e is what the model leaves of an output, so that the part of the other axes is taken out as the model says; the
    noise of e makes the interval. Elsewhere the variance is infinite.
    """
    spectra, plant = run.experiment.spectra, run.model
    size = np.abs(spectra.mean_u if spectra.R is None else spectra.R)
    own = size >= _SHARE * np.max(size, axis=1, keepdims=True)
    own = (own & (size > 0))[:, inputs]
    U = np.where(own, spectra.mean_u[:, inputs], 1.0)
    G = run.H[:, outputs][:, :, inputs] + run.left[:, outputs, None] / U[:, None, :]
    variance = np.real(np.diagonal(run.covariance, axis1=1, axis2=2))[:, outputs, None] / np.abs(U[:, None, :]) ** 2
    flat = np.where(own[:, None, :], variance, np.inf).reshape(len(U), -1)
    covariance = np.zeros((*flat.shape, flat.shape[1]), dtype=complex)
    covariance[:, np.arange(flat.shape[1]), np.arange(flat.shape[1])] = flat
    return FrequencyResponse(
        frequency_hz=spectra.frequency_hz, G=G, covariance=covariance, method="periods",
        inputs=tuple(plant.inputs[j] for j in inputs), outputs=tuple(plant.outputs[k] for k in outputs),
        units=plant.units, rate_hz=spectra.rate_hz, degrees_of_freedom=np.inf,
    )  # fmt: skip


def _positions(plant: RotorModel, plane: int) -> list[int]:
    """Return the positions of a plane among the outputs."""
    return [k for k in range(len(plant.sensors)) if _plane_of(plant, k) == plane]


def _plane_of(plant: RotorModel, position: int) -> int:
    return plant.placed[plant.sensors[position][0]][1]


def _matrix(
    e: RotorEstimate, r: ModelResponse, run: RotorReplay | None, outputs: Sequence[int], inputs: Sequence[int]
) -> Block:
    """The responses of a plane: a column for each input, magnitude and phase of each output below each other."""
    columns = []
    for j in inputs:
        pairs = [panel(_pair, e.plant, r, run, (k, j), part, height=h) for k in outputs for part, h in _PARTS]
        columns.append(pairs)
    source, plane = (_PLANE_NAMES[p] for p in (e.plant.placed[inputs[0]][1], _plane_of(e.plant, outputs[0])))
    across = f"response in plane {plane} to magnets in plane {source}: gyroscopic coupling"
    return Block(columns=columns, title=across if source != plane else f"response of the rotor in plane {plane}")


_PARTS = ("magnitude", 2.0), ("phase", 1.4)


def _coils(e: RotorEstimate, r: ModelResponse, run: RotorReplay | None) -> Block:
    """The current of each coil from its own voltage."""
    first = len(e.plant.sensors)
    pairs = [(first + k, j) for k, j in enumerate(e.plant.coils)]
    columns = [[panel(_pair, e.plant, r, run, pair, part, height=h) for part, h in _PARTS] for pair in pairs]
    return Block(columns=columns, title="current of each coil")


def _pair(
    axes: Axes, plant: RotorModel, r: ModelResponse, run: RotorReplay | None, pair: tuple[int, int], part: str
) -> None:
    """Magnitude or phase of one pair, with what was measured."""
    output, source = plant.outputs[pair[0]], plant.inputs[pair[1]]
    at = slice(None), slice(pair[0], pair[0] + 1), slice(pair[1], pair[1] + 1)
    one = ModelResponse(
        source=r.source, frequency_hz=r.frequency_hz, G=r.G[at], log_sd=r.log_sd[at], phase_sd=r.phase_sd[at]
    )
    measured = None if run is None else measured_pairs(run, [pair[0]], [pair[1]])
    if part == "magnitude":
        magnitude_axis(axes, one, (0, 0), label="identified rotor")
        if measured is not None:
            marks(axes, measured, (0, 0), per_decade=_MARKS)
        axes.set_ylabel(f"[{response_unit(plant.units, output, source)}]")
        head(axes, f"{source} → {output}")
        return
    phase_axis(axes, one, (0, 0))
    if measured is not None:
        marks(axes, measured, (0, 0), guide=one, per_decade=_MARKS)
    axes.set_ylabel("phase [°]")
    axes.set_xlabel("frequency [Hz]")


# --- along the shaft and over speed ----------------------------------------------------------------------------------


def _whirl(e: RotorEstimate, shaft: Shaft | None) -> Panel | None:
    """The whirl of the free rotor over speed, where its polar inertia or its drawing is known."""
    fastest = max(abs(float(str(r["speed"]))) for r in e.records)
    n = len(e.modes)
    lowest = 2.0 * np.pi * e.modes[0].frequency_hz.value if n else 0.0
    most = _BEYOND * max(fastest, lowest)
    if most == 0.0 or (shaft is None and not (n and e.plant.turning)):
        return None
    speeds = np.linspace(0.0, most, _SPEEDS)
    drawn = None if shaft is None else campbell(shaft, speeds, lines=2 * max(n, 1) + 1)
    diagram = sd = None
    if n and e.plant.turning:
        free = e.plant.with_modes(n)  # those above the band are a guess
        diagram = campbell(free_rotor_of(free, e.numbers), speeds)
        sd = whirl_sd(free, e.numbers, e.covariance_names, e.covariance, diagram)
    at = sorted({abs(float(str(r["speed"]))) for r in e.records} - {0.0})
    return campbell_panel(diagram, drawn=drawn, sd=sd, speeds=at)


# --- residuals ------------------------------------------------------------------------------------------------------


def residuals_block(run: RotorReplay) -> Block:
    """What the model leaves of each output, a column for each axis, beside what noise would."""
    plant, rows = run.model, []
    for j, axis in enumerate(plant.axes):
        roles = [position_role(axis, k) for k in range(len(plant.placed[j][0].z_sensors))] + [f"{axis}_current"]
        rows.append([plant.outputs.index(role) for role in roles if role in plant.outputs])
    most = max(map(len, rows))
    columns = [[panel(_residual, run, k, height=1.7) for k in row] for row in rows]
    empty = Panel(draw=lambda axes: axes.axis("off"), height=1.7)
    columns = [[*column, *([empty] * (most - len(column)))] for column in columns]
    return Block(columns=columns, title="residuals at the excited lines beside the noise")


def _residual(axes: Axes, run: RotorReplay, k: int) -> None:
    """Amplitudes of the residuals of one output over frequency."""
    role = run.model.outputs[k]
    f, left = run.experiment.spectra.frequency_hz, 2.0 * np.abs(run.left[:, k])
    bound = 2.0 * _RAYLEIGH_95 * np.sqrt(np.real(run.covariance[:, k, k]))
    order = np.argsort(f)
    scale, unit = prefixed(float(np.max(bound)), run.model.units[role])
    out = float(np.mean(left > bound))
    axes.loglog(f, left / scale, ".", color=MEASURED, markersize=2.0, alpha=0.6, label="residual")
    axes.loglog(f[order], bound[order] / scale, color=PREDICTED, linewidth=1.3, label="95 % of noise lie below")
    low = float(np.quantile(left[left > 0], 0.02)) if np.any(left > 0) else float(bound.min()) / 10
    log_axis(axes.xaxis, float(f.min()), float(f.max()))
    log_axis(axes.yaxis, low / scale, float(max(left.max(), bound.max())) / scale)
    axes.set_ylabel(f"[{unit}]")
    axes.set_xlabel("frequency [Hz]")
    head(axes, f"{role}: {100 * out:.2g} % above")


# --- poles and uncertainty ------------------------------------------------------------------------------------------


def rotor_poles(estimate: RotorEstimate) -> list[Pole]:
    """Return the poles of the plant with their spread, sorted by real part."""
    model, theta = estimate.plant, estimate.numbers
    values, V = np.linalg.eig(model.matrices(theta).A)
    inverse = np.linalg.inv(V)
    physical = {p.name for p in model.parameters}
    moved: list[Complex] = [
        np.einsum("ij,jk,ki->i", inverse, model.derivative(theta, name).A, V, optimize=True)
        if name in physical
        else np.zeros(values.size, dtype=complex)
        for name in estimate.covariance_names
    ]
    spread: Array = complex_covariance(np.array(moved).T, estimate.covariance)
    return sorted(roots(values.astype(complex), spread, _WIDEST), key=lambda pole: pole.value.real)
