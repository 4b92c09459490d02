"""A measured frequency response with what was fitted to it, what those models say, and its file ``ambid.frf/1``;
compared with a held input's response as that was measured: sampled under the hold, delay included.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.bearing.frequency import Channels, FrequencyEstimate, response
from ambid.blackbox.fit import BlackBoxFit, fit_from_json, fit_to_json
from ambid.blackbox.frequency import check_lines
from ambid.blackbox.model import StateSpaceModel
from ambid.errors import EstimationError
from ambid.estimation.estimate import (
    EstimatedParameter,
    covariance_apart,
    covariance_together,
    fields_json,
    plain_json,
    read_as,
    read_whole,
)
from ambid.estimation.modes import Modal, Mode
from ambid.estimation.result import Reason, Result
from ambid.physics.linear_model import StateSpace, discretise
from ambid.physics.linear_model import model as physical_model
from ambid.settings.caller import setting
from ambid.signals.response import FrequencyResponse

Complex = NDArray[np.complex128]

_CLEAR = 0.25  # standard deviation over magnitude up to which a line is clear
_LINES, _SHARE = 10, 0.1  # clear lines, and share of all, that a response wants
_FEWEST = 3  # without which nothing is to be seen
_MOST_WRITTEN = 200_000  # entries of covariances in a file
_STEP = 1e-3  # standard deviations of a coefficient over which a difference is taken


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Measured(Result):
    """A frequency response of one record and the models that were fitted to it, file schema ``ambid.frf/1``.

    Attributes
    ----------
    response : FrequencyResponse
    references : tuple of str
        Channels of the loop's outer excitation that were used.
    open_loop : bool
        Whether the user declares the record open loop.
    fit : BlackBoxFit or None
        Structure ``frf-ml`` or ``frf-subspace``.
    estimate : FrequencyEstimate or None
        Physical parameters.
    modal : Modal or None
        Modes, with their checks; None where none were asked for.
    record : Mapping[str, object]
        ``samples``, ``rate_hz``, ``sha256``, ``file``, ``history``.
    timing_s : Mapping[str, float]
        Wall time by stage.
    """

    response: FrequencyResponse
    references: tuple[str, ...] = ()
    open_loop: bool = False
    fit: BlackBoxFit | None = None
    estimate: FrequencyEstimate | None = None
    modal: Modal | None = None
    record: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    timing_s: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """A response of which noise leaves few lines, and what stands against the models fitted to it."""
        frf, reasons = self.response, list[Reason]()
        with np.errstate(divide="ignore", invalid="ignore"):
            clear = np.count_nonzero(frf.sd < _CLEAR * np.abs(frf.G), axis=0)
        worst = np.unravel_index(np.argmin(clear), clear.shape)
        least, lines = int(clear[worst]), frf.frequency_hz.size
        if least < max(_LINES, _SHARE * lines):
            pair = f"{frf.inputs[worst[1]]} → {frf.outputs[worst[0]]}"
            text = f"{least} of {lines} lines of {pair} stand out of the noise. Excite more, longer or in another band"
            reasons.append(Reason(check="noise", text=text, grave=least < _FEWEST))
        if not (self.references or self.open_loop):
            text = (
                f"without a reference, feedback biases the response. Give {setting('reference')}, or "
                f"{setting('open_loop', True)} if there is none"
            )
            reasons.append(Reason(check="feedback", text=text))
        if "assumed" in frf.details:
            reasons.append(Reason(check="noise", text=str(frf.details["assumed"])))
        for name, model in (("fit", self.fit), ("physical", self.estimate), ("modes", self.modal)):
            reasons += [replace(r, check=f"{name}.{r.check}") for r in (() if model is None else model.reasons)]
        return tuple(reasons)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Modes in order of frequency; none where none were asked for."""
        return () if self.modal is None else self.modal.modes

    def __getitem__(self, name: str) -> EstimatedParameter:
        model = self.estimate or self.fit
        if model is None:
            raise EstimationError("no model was fitted to this response. Give orders=, state_space= or rig=")
        return model[name]

    @property
    def distortion_sd(self) -> Array | None:
        """Standard deviation due to distortion, shape (n_f, n_y, n_u); None where noise is all that was measured."""
        frf = self.response
        if frf.noise_covariance is None or np.array_equal(frf.noise_covariance, frf.covariance):
            return None
        return frf.distortion_sd


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelResponse:
    """What a model says of a response, with what its coefficients leave open."""

    source: str  # what the model is
    frequency_hz: Array  # (n_frequencies,), Hz
    G: Complex  # (n_frequencies, n_outputs, n_inputs), complex
    log_sd: Array  # (n_frequencies, n_outputs, n_inputs), standard deviation of the natural logarithm of the magnitude
    phase_sd: Array  # (n_frequencies, n_outputs, n_inputs), rad


def model_responses(measured: Measured, frequency_hz: Array) -> tuple[ModelResponse, ...]:
    """Return the responses at `frequency_hz` of the black-box fit and of the physical parameters, as far as there are
    such, in the form that was measured.
    """
    responses = []
    if measured.fit is not None:
        responses.append(_of_fit(measured.fit, measured.response, frequency_hz))
    if measured.estimate is not None:
        responses.append(_of_estimate(measured.estimate, measured.response, frequency_hz))
    return tuple(responses)


def _of_fit(fit: BlackBoxFit, frf: FrequencyResponse, frequency_hz: Array) -> ModelResponse:
    omega, model, zoh = 2 * np.pi * frequency_hz, fit.model, frf.hold == "zoh"
    if isinstance(model, StateSpaceModel):
        # the method takes the known delay out of the lines beforehand
        late = np.exp(-1j * omega * float(str(fit.details.get("delay_s", 0.0))))[:, None, None]
        if model.dt is None and zoh:
            G = _sampled(model, omega, fit.dt) * late
            return _along(fit.structure, frequency_hz, G, _differences(model, omega, fit) * late[..., None])
        G, slope = model.frequency_response(omega) * late, model.frequency_response_derivative(omega) * late[..., None]
    else:
        G, slope = model.frequency_response(omega), model.frequency_response_derivative(omega)
        if model.dt is None and zoh:  # the hold's own response, which the fit takes out
            hold = (np.sinc(frequency_hz * fit.dt) * np.exp(-0.5j * omega * fit.dt))[:, None, None]
            G, slope = G * hold, slope * hold[..., None]
    return with_spread(fit.structure, frequency_hz, G, slope, fit.covariance)


def _of_estimate(estimate: FrequencyEstimate, frf: FrequencyResponse, frequency_hz: Array) -> ModelResponse:
    plant, names = physical_model(estimate.model), estimate.covariance_names
    at = replace(check_lines(frf, 1), omega=2 * np.pi * frequency_hz)
    channels = Channels(
        outputs=tuple(plant.outputs.index(x) for x in frf.outputs),
        inputs=tuple(plant.inputs.index(x) for x in frf.inputs),
    )
    delay = estimate.delay.samples + estimate.delay.fraction
    G, slope = response(plant, estimate.values, names, at, channels, delay)
    return with_spread(f"physical parameters of {estimate.model}", frequency_hz, G, slope, estimate.covariance)


def with_spread(
    source: str, frequency_hz: Array, G: Complex, slope: Complex, covariance: Array | None
) -> ModelResponse:
    """Return a response (n_f, n_y, n_u) with its spread by slopes (n_f, n_y, n_u, n) and covariance (n, n): real and
    imaginary part of d(ln G) are the changes of log magnitude and of phase.
    """
    return _along(source, frequency_hz, G, slope @ _root(covariance, slope.shape[-1]))


def _along(source: str, frequency_hz: Array, G: Complex, spread: Complex) -> ModelResponse:
    """Standard deviations from independent directions, last axis of `spread`, each of one standard deviation."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.nan_to_num(spread / G[..., None])
    return ModelResponse(
        source=source,
        frequency_hz=frequency_hz,
        G=G,
        log_sd=np.linalg.norm(relative.real, axis=-1),
        phase_sd=np.linalg.norm(relative.imag, axis=-1),
    )


def _root(covariance: Array | None, n: int) -> Array:
    """A square root of a covariance, column by column a direction; scaled first, as coefficients differ by decades."""
    if covariance is None:
        return np.zeros((n, 0))
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(sd > 0, sd, 1.0)
    size, directions = np.linalg.eigh(covariance / np.outer(unit, unit))
    return np.asarray(unit[:, None] * directions * np.sqrt(np.maximum(size, 0.0)))


def _sampled(model: StateSpaceModel, omega: Array, dt: float) -> Complex:
    """Response of a continuous plant with a held input at the sampling instants."""
    n = model.order
    space = StateSpace(A=model.A, B=model.B, C=model.C, E=np.zeros((n, 0)))
    d, _ = discretise(space, dt)
    wide = np.broadcast_to(d.B.astype(np.complex128), (omega.size, *d.B.shape))
    states = np.linalg.solve(np.exp(1j * omega * dt)[:, None, None] * np.eye(n) - d.A, wide)
    return np.asarray(d.C @ states + model.D)


def _differences(model: StateSpaceModel, omega: Array, fit: BlackBoxFit) -> Complex:
    """Changes of the sampled response along the directions of the covariance, by central differences."""
    root = _root(fit.covariance, model.theta.size)
    root = root[:, np.linalg.norm(root, axis=0) > 0]
    moved = [
        sum(sign * _sampled(model.with_theta(model.theta + sign * _STEP * way), omega, fit.dt) for sign in (1, -1))
        / (2 * _STEP)
        for way in root.T
    ]
    return np.stack(moved, axis=-1) if moved else np.zeros((omega.size, *model.D.shape, 0), dtype=np.complex128)


SCHEMA = "ambid.frf/1"


def measured_text(measured: Measured) -> str:
    """Return the JSON text of a measured response, one field a line."""
    fields = measured_to_json(measured).items()
    body = ",\n ".join(f"{json.dumps(name)}: {json.dumps(value, allow_nan=False)}" for name, value in fields)
    return f"{{{body}}}\n"


def measured_to_json(measured: Measured) -> dict[str, Any]:
    """Return a measured response in the form of schema ``ambid.frf/1``; numbers that are not finite are null."""
    frf, estimate = measured.response, measured.estimate
    more = {
        "G": _by_pair(frf, frf.G),
        "sd": _by_pair(frf, frf.sd),
        "noise_sd": _by_pair(frf, frf.noise_sd),
        "distortion_sd": _by_pair(frf, measured.distortion_sd),
        "coherence": None if frf.coherence is None else {o: frf.coherence[:, k] for k, o in enumerate(frf.outputs)},
        "covariance": _covariance_json(frf),
        "fit": None if measured.fit is None else fit_to_json(measured.fit),
        "estimate": None if estimate is None else covariance_together(fields_json(estimate, without=("record",))),
        "modes": measured.modes,
        "modal": None if measured.modal is None else fields_json(measured.modal, without=("modes", "record")),
    }
    return {
        "schema": SCHEMA,
        **fields_json(measured, without=("response", "fit", "estimate", "modal")),
        **fields_json(frf, without=("G", "covariance", "noise_covariance", "coherence")),
        **plain_json(more),
    }


def measured_from_json(document: Mapping[str, Any], where: str) -> Measured:
    """Read a measured response back, from the file `where` for messages; of several inputs or outputs the noise comes
    back without correlations between the pairs.
    """
    return read_whole(lambda: _from_json(document, where), where, "frequency response", "frf")


def _from_json(d: Mapping[str, Any], where: str) -> Measured:
    inputs, outputs = d["inputs"], d["outputs"]

    def whole(by_pair: Any, kind: Any) -> Any:
        columns = [read_as(kind, by_pair[o][i], f"{o}.{i}") for o in outputs for i in inputs]
        return None if by_pair is None else np.stack(columns, axis=1)

    sd, noise = whole(d["sd"], Array), None if d["noise_sd"] is None else whole(d["noise_sd"], Array)
    (n, pairs), coherence = sd.shape, d["coherence"]
    matrix = None if d["covariance"] is None else read_as(Complex, d["covariance"]["matrix"]).reshape(n, pairs, pairs)
    diagonal = np.eye(pairs)[None].astype(np.complex128)
    response = {
        **d,
        "G": whole(d["G"], Complex).reshape(n, len(outputs), len(inputs)),
        "covariance": diagonal * sd[:, None, :] ** 2 if matrix is None else matrix,
        "noise_covariance": None if noise is None else diagonal * noise[:, None, :] ** 2,
        "coherence": coherence and np.stack([read_as(Array, coherence[o]) for o in outputs], axis=1),
    }
    fit, estimate, modal = d["fit"], d["estimate"], d.get("modal")
    return Measured(
        response=read_as(FrequencyResponse, response),
        references=tuple(d["references"]),
        open_loop=d["open_loop"],
        fit=None if fit is None else fit_from_json(fit, where),
        estimate=None if estimate is None else read_as(FrequencyEstimate, covariance_apart(estimate)),
        modal=None if modal is None else read_as(Modal, {**modal, "modes": d["modes"], "record": d["record"]}),
        record=d["record"],
        timing_s=d["timing_s"],
    )


def _by_pair(frf: FrequencyResponse, values: Any) -> dict[str, dict[str, Any]] | None:
    """``{output: {input: [...]}}``."""
    if values is None:
        return None
    return {o: {i: values[:, j, k] for k, i in enumerate(frf.inputs)} for j, o in enumerate(frf.outputs)}


def _covariance_json(frf: FrequencyResponse) -> dict[str, Any] | None:
    """With one entry `sd` says it all; matrices of many outputs on many lines would fill tens of megabytes."""
    if frf.n_inputs * frf.n_outputs == 1 or frf.covariance.size > _MOST_WRITTEN:
        return None
    return {"entries": [[o, i] for o in frf.outputs for i in frf.inputs], "matrix": frf.covariance}
