"""Frequency response of a physical model and its exact derivatives, and start values for its parameters.

Under a hold, the response of the exactly sampled plant, with a delay of whole samples and a fraction; else that of the
continuous plant, with exp(-j omega tau).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.blackbox.frequency.lines import Lines
from ambid.estimation import start as weak_form
from ambid.physics.discretise import discretise
from ambid.physics.linear_model import LinearModel

Complex = NDArray[np.complex128]

_COPIES = 2000  # rows for the bands of the weak form, which count in parts of a long spectrum


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Channels:
    """Which inputs and outputs of the model were measured."""

    outputs: tuple[int, ...]  # rows of the model's C, in the order of the response's outputs
    inputs: tuple[int, ...]  # columns of its B


def response(
    model: LinearModel,
    theta: Mapping[str, float],
    names: Sequence[str],
    ln: Lines,
    channels: Channels,
    delay: float,
    *,
    slope: bool = True,
    moving: bool = True,
) -> tuple[Complex, Complex]:
    """Return the model's response and its derivative by parameters and delay.

    `theta`: SI; `names`: parameters to differentiate by; `slope`: whether derivatives are wanted; `moving`: whether the
    derivative by the delay is one of them. Returns `G`: (n_frequencies, n_outputs, n_inputs), complex; `derivative`:
    the last by the delay in samples; empty where not wanted.
    """
    space = model.matrices(theta)
    along = [model.derivative(theta, name) for name in names] if slope else []
    n, columns, rows = space.A.shape[0], list(channels.inputs), list(channels.outputs)
    if ln.held:
        whole = int(np.floor(delay))
        points = np.exp(1j * ln.omega * ln.dt)
        late = np.exp(-1j * ln.omega * ln.dt)[:, None, None]
        shift = late**whole
        fraction = delay - whole
        at, directions = discretise(space, ln.dt, fraction=fraction if fraction or moving else None, derivatives=along)
        A, C = at.A, at.C[rows]
        B = at.B[:, columns] + at.B_late[:, columns] * late
        changes = [(d.A, d.B[:, columns] + d.B_late[:, columns] * late, d.C[rows]) for d in directions if slope]
    else:
        points = 1j * ln.omega
        shift = np.exp(-1j * ln.omega * ln.dt * delay)[:, None, None]
        A, C = space.A, space.C[rows]
        B = np.broadcast_to(space.B[:, columns], (points.size, n, len(columns)))
        changes = [(d.A, d.B[:, columns][None], d.C[rows]) for d in along]
    pencil = points[:, None, None] * np.eye(n) - A
    right = np.linalg.solve(pencil, B.astype(np.complex128)) * shift
    G = C @ right
    if not slope:
        return G, np.empty((*G.shape, 0), dtype=np.complex128)
    wide = np.broadcast_to(C.T.astype(np.complex128), (points.size, n, len(rows)))
    left = np.swapaxes(np.linalg.solve(np.swapaxes(pencil, 1, 2), wide), 1, 2)
    out = np.empty((*G.shape, len(names) + int(moving)), dtype=np.complex128)
    for j, (dA, dB, dC) in enumerate(changes[: out.shape[-1]]):
        out[..., j] = left @ (dA @ right + dB * shift) + dC @ right
    if moving and not ln.held:
        out[..., -1] = -1j * (ln.omega * ln.dt)[:, None, None] * G
    return G, out


def start_values(
    model: LinearModel, ln: Lines, channels: Channels, delay: float, known: Mapping[str, float]
) -> Iterator[dict[str, float]]:
    """Yield start values: the equations of motion, linear in the parameters, by regression over bands of lines.

    As `ambid.estimation.start`, with the response in place of the spectra: the input is 1 (times its hold), each output
    its G. Nothing where the model's equations want an output that was not measured.

    `known`: fixed values, SI. Returns all parameters, SI, as they come out (not always a plant).
    """
    copies = max(1, _COPIES // ln.n_lines)
    omega = np.repeat(ln.omega, copies)
    angle = omega * ln.dt
    hold = np.sinc(angle / (2 * np.pi)) * np.exp(-0.5j * angle) if ln.held else np.ones(omega.size, dtype=np.complex128)
    signals = {model.inputs[channels.inputs[0]]: (hold, 1j * omega * hold, -(omega**2) * hold)}
    noise = {}
    for j, k in enumerate(channels.outputs):
        g = np.repeat(ln.G[:, j, 0], copies)
        signals[model.outputs[k]] = (g, 1j * omega * g, -(omega**2) * g)
        noise[model.outputs[k]] = float(np.sqrt(np.mean(ln.sd[:, j, 0] ** 2)))
    if set(model.outputs) - set(signals):
        return
    moments = weak_form.Moments(omega=omega, signals=signals)
    yield from weak_form.candidates(model.name, moments, noise, delay, 1.0 / ln.dt, known)
