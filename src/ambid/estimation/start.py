"""Start values found without the user's help: weak-form regression over frequency bands.

Each equation of motion is integrated against Fourier modulating functions phi_k(t) = w(t) exp(-j w_k t), the weak form
over all frequencies at once (theory.md sec. 2.7, thesis eq. 3.8; Shinbrot 1957; Pearson and Lee 1985). The window w
spans the record and vanishes with three derivatives at both ends, so that integration by parts leaves no boundary terms
and no measured signal is differentiated; all moments come from a few FFTs. Each band gives a candidate; the likelihood
chooses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.estimation.linear import column_sizes

Spectrum = NDArray[np.complexfloating]
Term = tuple[str, Spectrum, Spectrum]  # role whose noise it holds, what that noise passes through, moments

# upper band edges as fractions of the Nyquist frequency: wide bands want the errors-in-variables regression (sensor
# noise dominates up there), narrow ones plain least squares (disturbances dominate, and few lines are left)
_BANDS = (
    (0.6, True),
    (0.3, True),
    (0.15, True),
    (0.06, True),
    (0.15, False),
    (0.06, False),
    (0.025, False),
    (0.01, False),
)
_LOWEST_LINE = 3  # the window's main lobe: lines below see the constant


def candidates(
    model_name: str,
    m: Moments,
    noise: Mapping[str, float],
    delays: Sequence[float],
    rate_hz: float,
    known: Mapping[str, float],
) -> Iterator[tuple[float, dict[str, float]]]:
    """Yield start values for the named model, one set for each band and delay.

    `model_name`: ``"one-axis"``, ``"coil"`` or ``"rotor"``; `delays`: of the input, in samples; `known`: fixed values,
    SI; they are used, and returned unchanged. Yields the delay with all parameters of the model, SI.
    """
    damping = known.get("c", 0.0)
    rate = damping / known.get("m", np.inf) if damping else 0.0
    for part, errors_in_variables in _BANDS:
        lines = slice(_LOWEST_LINE, int(part * m.omega.size))
        omega = m.omega[lines]
        if omega.size < 8:
            continue
        jw, corner, level = 1j * omega, omega[-1] / 3, noise if errors_in_variables else {}
        s = {role: tuple(v[lines] for v in values) for role, values in m.signals.items()}
        lags = [np.exp(-jw * d / rate_hz) for d in delays]
        electric: list[Array] = [np.zeros(0)] * len(lags)
        if model_name in ("one-axis", "coil"):
            i0, i1, _ = s["current"]
            terms: list[Term] = [("current", 1 + 0 * jw, i0), ("current", jw, i1)]
            if model_name == "one-axis":
                terms.append(("position", jw, s["position"][1]))
            coil = Regressors(terms, 1.0 / np.abs(jw + corner), level)
            electric = [coil.regress(("", 0 * jw, s["voltage"][0] * lag)) for lag in lags]
        motion: list[Array] = []
        if model_name in ("one-axis", "rotor"):
            x0, x1, x2 = s["position"]
            for lag in lags if model_name == "rotor" else [1.0]:
                terms = [("position", -1 + 0 * jw, -x0), ("current", 1 + 0 * jw, s["current"][0] * lag)]
                rotor = Regressors(terms, 1.0 / np.abs(jw + corner) ** 2, level)
                motion.append(rotor.regress(("position", jw**2 + rate * jw, x2 + rate * x1)))
            motion *= len(lags) // len(motion)
        for j, d in enumerate(delays):
            found = {**dict(zip(("R", "L", "k_i"), electric[j], strict=False)), **known}
            if motion:
                stiffness, current = motion[j]
                if "m" not in known:  # its sign may come out wrong where the motional voltage is lost in the noise
                    found["m"] = abs(found["k_i"] / current) if "k_i" in found and current != 0 else 1.0
                found = {**found, "k_x": stiffness * found["m"], "k_i": current * found["m"], "c": damping, **known}
            yield d, {name: float(value) for name, value in found.items()}


class Regressors:
    """Terms that others are regressed on, over complex lines with real coefficients, reduced once by QR."""

    def __init__(self, terms: Sequence[Term], weight: Array, noise: Mapping[str, float]) -> None:
        """Reduce terms.

        `weight`: (n_lines,); `noise`: role -> noise standard deviation; empty: ordinary least squares.
        """
        a = np.stack([_real(t[2] * weight) for t in terms], axis=1)
        self.size = column_sizes(a)  # (n_terms,), what the columns are divided by
        self.Q, self.R = np.linalg.qr(a / self.size)
        self.weight, self.noise = weight, noise
        # role -> what its noise leaves in each term, (n_lines, n_terms)
        self.filters = {
            role: np.stack([t[1] * (t[0] == role) for t in terms], axis=1) * (weight * sd)[:, None] / self.size
            for role, sd in noise.items()
        }
        self.spread = sum(((f.conj().T @ f).real for f in self.filters.values()), np.zeros((len(terms),) * 2))

    def regress(self, first: Term) -> Array:
        """Regress one more term on these.

        With noise levels, generalised total least squares: the combination of terms that is smallest against what the
        noise alone would leave (Van Huffel and Vandewalle 1991); without, ordinary least squares. Returns (n_terms,),
        NaN where the noise description cannot be used.
        """
        b, n = _real(first[2] * self.weight), self.size.size
        length = float(np.linalg.norm(b)) or 1.0
        along = self.Q.T @ b / length
        if not self.noise:
            return np.asarray(np.linalg.lstsq(self.R, along, rcond=None)[0] / self.size * length)
        short, spread = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
        short[:n, :n], short[:n, n] = self.R, along
        short[n, n] = np.linalg.norm(b / length - self.Q @ along)
        spread[:n, :n] = self.spread
        if first[0] in self.noise:
            own = first[1] * self.weight * self.noise[first[0]] / length
            spread[n, :n] = spread[:n, n] = (self.filters[first[0]].conj().T @ own).real
            spread[n, n] = np.vdot(own, own).real
        spread += 1e-12 * np.trace(spread) * np.eye(n + 1)
        if not spread[n, n] > 0:
            return np.full(n, np.nan)
        # smallest generalised singular vector against the noise: exact columns get a tiny one
        factor = np.linalg.cholesky(spread)
        _, _, vt = np.linalg.svd(np.linalg.solve(factor, short.T).T)
        v = np.linalg.solve(factor.T, vt[-1]) / np.append(self.size, length)
        return -v[:n] / v[n] if v[n] != 0 else np.full(n, np.nan)


def _real(x: Spectrum) -> Array:
    return np.concatenate([x.real, x.imag])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moments:
    """Spectra of the signals and of their first and second derivatives, by modulating functions."""

    omega: Array  # (n_lines,), rad/s
    # role -> (value, first derivative, second derivative), each (n_lines,), complex
    signals: Mapping[str, tuple[Spectrum, Spectrum, Spectrum]]


def moments(signals: Mapping[str, Array], held: tuple[str, ...], rate_hz: float) -> Moments:
    """Take the modulating-function moments of all signals.

    `signals`: role -> samples, shape (n_samples,), SI, deviations from the operating point.
    """
    n = len(next(iter(signals.values())))
    period, length = 1.0 / rate_hz, n / rate_hz
    t = np.arange(n) / n
    w = (3 - 4 * np.cos(2 * np.pi * t) + np.cos(4 * np.pi * t)) / 8
    w1 = (8 * np.pi * np.sin(2 * np.pi * t) - 4 * np.pi * np.sin(4 * np.pi * t)) / (8 * length)
    w2 = (16 * np.pi**2 * np.cos(2 * np.pi * t) - 16 * np.pi**2 * np.cos(4 * np.pi * t)) / (8 * length**2)
    omega = 2 * np.pi * np.fft.rfftfreq(n, period)
    jw = 1j * omega
    result = {}
    for role, x in signals.items():
        m0, m1, m2 = np.fft.rfft(w * x), np.fft.rfft(w1 * x), np.fft.rfft(w2 * x)
        value = m0 * np.sinc(omega * period / (2 * np.pi)) * np.exp(-0.5j * omega * period) if role in held else m0
        # integration by parts: int phi x' = -int phi' x with phi' = (w' - jw w) e, and again for x''
        result[role] = (value, jw * m0 - m1, m2 - 2 * jw * m1 - omega**2 * m0)
    return Moments(omega=np.asarray(omega, dtype=np.float64), signals=result)
