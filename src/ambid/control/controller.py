"""The controller of a loop: as the rig's [loop] says, or identified from a record of it.

Each input obeys A(d) u = F(d) r - B(d) y of logged signals, d = 1 - 1/z, almost without noise: least squares over the
excited lines find it to the last digits (Ljung 1999, sec. 10.1). A voltage with noise of its own is weighted by 1/|A|
again and again (Sanathanan and Koerner 1963). The reference may act anywhere inside the controller.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.physics.law import StateLaw
from ambid.physics.linear_model import LinearModel
from ambid.physics.loop import Loop
from ambid.rotor.spectra import smoothed
from ambid.simulation.plant import fed_back, law_on, signals_fed_back

_ORDERS = 8  # highest degree that is tried
_PASSES = 6
_EXACT = 1e-7  # residual over the input from which a law is exact
_ROUNDING = 1e-9
_COUPLED = 1e-3  # residual of an axis' own law from which those of all axes are tried
_LEAST_LINES = 4  # real equations for each unknown


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Law:
    """What one input is made of; polynomials in d/scale, lowest power first."""

    outputs: tuple[int, ...]
    references: tuple[int, ...]
    scale: float
    coefficients: Array  # (1 + n_outputs + n_references, n + 1): A, B of each output, F of each reference
    covariance: Array | None = None  # of the coefficients, row by row
    misfit: float = 0.0  # rms of the residual over that of the input, line by line

    def powers(self, d: Complex) -> Complex:
        """Return the powers of d/scale, (n_lines, n + 1)."""
        return np.asarray((d / self.scale)[:, None] ** np.arange(self.coefficients.shape[1]))

    def ratios(self, d: Complex) -> Complex:
        """Return B/A of each output, then F/A of each reference, (n_lines, n_outputs + n_references)."""
        values = self.powers(d) @ self.coefficients.T
        return np.asarray(values[:, 1:] / values[:, :1])

    def variance(self, d: complex, direction: Complex, weight: complex) -> float:
        """Return the variance of Re(weight Σ B/A direction) at one line; `direction`: by output."""
        if self.covariance is None:
            return 0.0
        x = self.powers(np.array([d]))[0]
        values = self.coefficients @ x
        through = complex(direction @ (values[1 : 1 + direction.size] / values[0]))
        slopes = np.zeros(self.coefficients.shape, dtype=complex)
        slopes[0] = -through * x / values[0]
        slopes[1 : 1 + direction.size] = direction[:, None] * x / values[0]
        g = np.real(weight * slopes).ravel()
        return float(g @ self.covariance @ g)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Controller:
    """A linear controller, u = F r - K y."""

    laws: tuple[Law, ...]  # one for each input of the plant
    rate_hz: float
    n_outputs: int
    n_references: int
    source: str  # "record" where it was identified, "rig" where it is the rig's [loop]
    state: StateLaw | None = None  # of a [loop] that has one, in place of `laws`
    fed_back: tuple[int, ...] = ()  # the outputs that `state` sees

    @property
    def n_inputs(self) -> int:
        """Commands that it gives."""
        return len(self.laws) if self.state is None else self.state.D.shape[0]

    @property
    def misfit(self) -> float:
        """Largest residual of the laws over their inputs."""
        return max((law.misfit for law in self.laws), default=0.0)

    @property
    def orders(self) -> tuple[int, ...]:
        """Degree of each law."""
        return tuple(law.coefficients.shape[1] - 1 for law in self.laws) if self.state is None else (self.state.order,)

    def backward(self, frequency_hz: Array) -> Complex:
        """Return d = 1 - 1/z at some frequencies."""
        return np.asarray(1.0 - np.exp(-2j * np.pi * frequency_hz / self.rate_hz))

    def response(self, frequency_hz: Array) -> tuple[Complex, Complex]:
        """Return K (n, n_inputs, n_outputs) and F (n, n_inputs, n_references) at some frequencies in Hz."""
        d = self.backward(frequency_hz)
        K = np.zeros((d.size, self.n_inputs, self.n_outputs), dtype=complex)
        F = np.zeros((d.size, self.n_inputs, self.n_references), dtype=complex)
        if self.state is not None:
            K[:, :, list(self.fed_back)] = -self.state.response(frequency_hz)
            F[:] = np.eye(self.n_inputs)
        for j, law in enumerate(self.laws):
            ratios = law.ratios(d)
            K[:, j, list(law.outputs)] = ratios[:, : len(law.outputs)]
            F[:, j, list(law.references)] = ratios[:, len(law.outputs) :]
        return K, F

    def variance(self, frequency_hz: Array, outputs: Complex, weights: Complex) -> float:
        """Return the variance of Re(weights K seen) at one frequency."""
        d = complex(self.backward(frequency_hz)[0])
        return sum(
            law.variance(d, outputs[list(law.outputs)], complex(w)) for law, w in zip(self.laws, weights, strict=False)
        )


def controller_of_loop(loop: Loop, plant_model: LinearModel, rate_hz: float) -> Controller:
    """Return the controller of a rig's [loop] (`ambid.physics.loop.Loop`; a PID is the same on every axis), references
    added to its output.
    """
    n_u, n_y = len(plant_model.inputs), len(plant_model.outputs)
    law = law_on(loop, plant_model, rate_hz)
    if law is not None:
        signals = tuple(int(k) for k in signals_fed_back(plant_model))
        return Controller(
            laws=(), rate_hz=rate_hz, n_outputs=n_y, n_references=n_u, source="rig", state=law, fed_back=signals
        )  # fmt: skip
    T, tau = 1.0 / rate_hz, loop.filter_s
    lag = np.polynomial.Polynomial([T, tau])  # of the derivative, over which d stands
    integrates, one = bool(loop.ki), np.polynomial.Polynomial([0.0, 1.0])
    A = lag * one if integrates else lag
    B = loop.kp * A + loop.kd * one * (one if integrates else 1.0)
    B = B + loop.ki * T * (1.0 - one) * lag if integrates else B
    laws = []
    for j, (position, current) in enumerate(fed_back(plant_model)):
        own = [k for k in (position, current) if k >= 0]
        rows = [A, *([B] if position >= 0 else []), *([loop.kc * A] if current >= 0 else []), A]
        table = np.zeros((len(rows), 2 + integrates))
        for row, polynomial in zip(table, rows, strict=True):
            row[: polynomial.coef.size] = polynomial.coef
        laws.append(Law(outputs=tuple(own), references=(j,), scale=1.0, coefficients=table))
    return Controller(laws=tuple(laws), rate_hz=rate_hz, n_outputs=n_y, n_references=n_u, source="rig")


def identify_controller(
    frequency_hz: Array, u: Complex, y: Complex, r: Complex, *, rate_hz: float, own: Sequence[Sequence[int]]
) -> Controller:
    """Identify the controller from spectra `u`, `y`, `r` (n_lines, n) at excited lines, of one stretch or means over
    periods; `own`: the outputs beside each input. Reference j belongs to input j where there are as many.
    EstimationError for too few lines.
    """
    d = np.asarray(1.0 - np.exp(-2j * np.pi * frequency_hz / rate_hz))
    n_u, n_y, n_r = u.shape[1], y.shape[1], r.shape[1]
    laws = []
    for j in range(n_u):
        mine = (j,) if n_r == n_u else tuple(range(n_r))
        law = _law(d, u[:, j], y, r, tuple(own[j]), mine)
        if law is None or law[0].misfit > _COUPLED:
            every = _law(d, u[:, j], y, r, tuple(range(n_y)), tuple(range(n_r)))
            law = every if law is None or (every is not None and every[1] < law[1]) else law
        if law is None:
            raise EstimationError(
                f"the record excites {d.size} lines; they are too few to identify the controller. Excite more lines, "
                "or give [loop] in the rig"
            )
        laws.append(law[0])
    return Controller(laws=tuple(laws), rate_hz=rate_hz, n_outputs=n_y, n_references=n_r, source="record")


def _law(
    d: Complex, u: Complex, y: Complex, r: Complex, outputs: tuple[int, ...], references: tuple[int, ...]
) -> tuple[Law, float] | None:
    """Return the law of one input with its order by the Bayesian criterion, and that criterion."""
    outputs = tuple(k for k in outputs if np.any(y[:, k]))
    references = tuple(k for k in references if np.any(r[:, k]))
    signals = np.column_stack([u, y[:, outputs], -r[:, references]])
    best: tuple[Law, float] | None = None
    since = 0
    for n in range(_ORDERS + 1):
        unknowns = (n + 1) * signals.shape[1] + n
        if 2 * d.size < _LEAST_LINES * unknowns:
            break
        scale, table, covariance, spread, misfit = _fit(d, signals, n)
        criterion = 2.0 * float(np.sum(np.log(spread))) + np.log(2.0 * d.size) * unknowns
        if best is None or criterion < best[1]:
            law = Law(
                outputs=outputs, references=references, scale=scale, coefficients=table, covariance=covariance,
                misfit=misfit,
            )  # fmt: skip
            best, since = (law, criterion), 0
        else:
            since += 1
        if misfit < _EXACT or since > 1:
            break
    return best


def _fit(d: Complex, signals: Complex, n: int) -> tuple[float, Array, Array, Array, float]:
    """Fit A u + B y - F r = T, all of degree `n`, T from the stretch's ends. Returns scale of d, coefficients,
    covariance, residual power over the input's (no less than exact) by line, and its root mean.
    """
    scale = float(np.max(np.abs(d)))
    x = (d / scale)[:, None] ** np.arange(n + 1)
    columns = (signals[:, :, None] * x[:, None, :]).reshape(d.size, -1)
    columns = np.hstack([columns, x[:, :n]])
    level = np.sqrt(smoothed(np.abs(signals[:, :1]) ** 2)[:, 0])
    level = np.maximum(level, 1e-12 * float(np.max(level)))
    size, A = level, np.ones(d.size, dtype=complex)
    for _ in range(_PASSES):
        rows = columns / (size * np.abs(A))[:, None]
        rows = np.concatenate([rows.real, rows.imag])
        norm = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        _, s, Vt = np.linalg.svd(np.linalg.qr(rows / norm, mode="r"))
        c = Vt[-1] / norm
        A = x @ c[: n + 1]
        gauge = float(np.max(np.abs(A)))
        c, A = c / gauge, A / gauge
        left = np.abs(columns @ c / A)
        size = np.sqrt(smoothed(left[:, None] ** 2)[:, 0] + (_ROUNDING * level) ** 2)
    half = Vt[:-1] / s[:-1, None] / norm / gauge
    variance = s[-1] ** 2 / max(rows.shape[0] - c.size, 1)
    n_laws = signals.shape[1] * (n + 1)
    power = (size / level) ** 2
    misfit = float(np.sqrt(np.mean((left / level) ** 2)))
    return (
        scale, c[:n_laws].reshape(-1, n + 1), variance * (half.T @ half)[:n_laws, :n_laws],
        np.maximum(power, _EXACT**2), misfit,
    )  # fmt: skip
