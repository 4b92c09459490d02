"""Start values found without the user's help: weak-form regression over frequency bands.

Each equation of motion is integrated against Fourier modulating functions phi_k(t) = w(t) exp(-j w_k t), the weak form
over all frequencies at once (theory.md sec. 2.7, thesis eq. 3.8; Shinbrot 1957; Pearson and Lee 1985). The window w
spans the record and vanishes with three derivatives at both ends, so that integration by parts leaves no boundary terms
and no measured signal is differentiated; all moments come from a few FFTs. Each band gives a candidate; the likelihood
chooses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

__all__ = ["Moments", "candidates", "moments", "regress"]

Spectrum = NDArray[np.complexfloating]

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
    delay_samples: float,
    rate_hz: float,
    known: Mapping[str, float],
    motion: dict[tuple[float, bool], Array] | None = None,
) -> Iterator[dict[str, float]]:
    """Yield start values for the named model, one set for each band.

    `model_name`: ``"one-axis"``, ``"coil"`` or ``"rotor"``; `delay_samples`: delay of the input; `known`: fixed values,
    SI; they are used, and returned unchanged; `motion`: keeps what does not depend on the delay, for the next call.
    Returns all parameters of the model, SI.
    """
    for part, errors_in_variables in _BANDS:
        lines = slice(_LOWEST_LINE, int(part * m.omega.size))
        omega = m.omega[lines]
        if omega.size < 8:
            continue
        jw, corner = 1j * omega, omega[-1] / 3
        s = {role: tuple(v[lines] for v in values) for role, values in m.signals.items()}
        lag = np.exp(-jw * delay_samples / rate_hz)
        level = noise if errors_in_variables else {}
        found: dict[str, float] = dict(known)
        if model_name in ("one-axis", "coil"):
            i0, i1, _ = s["current"]
            terms = [("", 0 * jw, s["voltage"][0] * lag), ("current", 1 + 0 * jw, i0), ("current", jw, i1)]
            if model_name == "one-axis":
                terms.append(("position", jw, s["position"][1]))
            r, ell, *k = regress(terms, 1.0 / np.abs(jw + corner), level)
            found = {"R": r, "L": ell, **({"k_i": k[0]} if k else {}), **known}
        if model_name in ("one-axis", "rotor"):
            x0, x1, x2 = s["position"]
            damping = known.get("c", 0.0)
            rate = damping / found.get("m", np.inf) if damping else 0.0
            kept = None if motion is None or model_name == "rotor" or rate else motion.get((part, errors_in_variables))
            if kept is None:
                force = s["current"][0] * (lag if model_name == "rotor" else 1.0)
                terms = [
                    ("position", jw**2 + rate * jw, x2 + rate * x1),
                    ("position", -1 + 0 * jw, -x0),
                    ("current", 1 + 0 * jw, force),
                ]
                kept = regress(terms, 1.0 / np.abs(jw + corner) ** 2, level)
                if motion is not None:
                    motion[part, errors_in_variables] = kept
            stiffness, current = kept
            if "m" not in known:  # its sign may come out wrong where the motional voltage is lost in the noise
                found["m"] = abs(found["k_i"] / current) if "k_i" in found and current != 0 else 1.0
            found = {**found, "k_x": stiffness * found["m"], "k_i": current * found["m"], "c": damping, **known}
        yield {name: float(value) for name, value in found.items()}


def regress(terms: list[tuple[str, Spectrum, Spectrum]], weight: Array, noise: Mapping[str, float]) -> Array:
    """Regress the first term on the others, over complex lines with real coefficients.

    With noise levels given, generalised total least squares: the combination of terms that is smallest against what the
    noise alone would leave (Van Huffel and Vandewalle 1991); without, ordinary least squares by QR.

    `weight`: (n_lines,); `noise`: role -> noise standard deviation; empty: ordinary least squares. Returns (n_terms -
    1,), naN where the noise description cannot be used.
    """
    a = np.stack([t[2] for t in terms], axis=1) * weight[:, None]
    a = np.vstack([a.real, a.imag])
    norm = np.linalg.norm(a, axis=0)
    norm[norm == 0] = 1.0
    short = np.asarray(np.linalg.qr(a / norm, mode="r"))
    if not noise:
        found = np.linalg.lstsq(short[:, 1:], short[:, 0], rcond=None)[0]
        return np.asarray(found / norm[1:] * norm[0], dtype=np.float64)
    spread = np.full((len(terms), len(terms)), 0.0)
    for role, sd in noise.items():
        f = np.stack([t[1] * (t[0] == role) for t in terms], axis=1) * (weight * sd)[:, None] / norm
        spread += (f.conj().T @ f).real
    spread += 1e-12 * np.trace(spread) * np.eye(len(terms))
    if not spread[0, 0] > 0:
        return np.full(len(terms) - 1, np.nan)
    # smallest generalised singular vector of a against the noise: exact columns get a tiny one
    factor = np.linalg.cholesky(spread)
    _, _, vt = np.linalg.svd(np.linalg.solve(factor, short.T).T)
    v = np.linalg.solve(factor.T, vt[-1]) / norm
    return -v[1:] / v[0] if v[0] != 0 else np.full(len(terms) - 1, np.nan)


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
