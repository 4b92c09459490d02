"""Which experiment would show what a record does not?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ambid.bearing.uncertainty import Uncertainty
from ambid.estimation.uncertainty import WEAK

_ADVICE = {
    "k_x": "k_x shows where the displacement force counts: excite more at low frequency (from {low:.2g} Hz), or larger",
    "k_i": "k_i shows in the motional voltage and in the force: excite larger motion near {mid:.3g} Hz",
    "m": "m shows in the acceleration: excite up to {mid:.3g} Hz and beyond, larger",
    "R": "R shows in slow currents: add steps of the voltage that are held for {settle:.2g} s or longer",
    "L": "L shows in fast changes of the current: excite around {corner:.3g} Hz and above",
    "c": "c shows near the mechanical resonance: excite around {low:.3g} Hz",
}


def experiment_hint(
    u: Uncertainty, values: Mapping[str, float], band_hz: tuple[float, float, float], *, robust: bool
) -> str | None:
    """Say which experiment would show the weakest direction.

    `values`: all parameters, SI; `robust`: which standard deviations count. Returns none where everything is
    identifiable.
    """
    unseen = [name for name, seen in zip(u.names, u.identifiable_at(robust=robust), strict=True) if not seen]
    if not unseen:
        return None
    in_direction = {name for name, share in u.weakest.items() if abs(share) > 0.5}
    if {"m", "k_x", "k_i"} <= in_direction or (
        "R" not in values and {"k_x", "k_i", "m"} & in_direction and len(in_direction) > 1
    ):
        return (
            "m, k_x and k_i can only be told up to a common factor: the motional voltage k_i x' is lost in the noise. "
            "Weigh the rotor and fix m (or give a prior), or excite faster and larger motion"
        )
    frequencies = _frequencies(values, band_hz)
    advice = [_ADVICE[name].format(**frequencies) for name in unseen if name in _ADVICE]
    worst = float(max(u.relative_sd(robust=robust)))
    factor = worst / WEAK
    more = (
        f"with the same band, {factor:.2g} times the amplitude or {factor**2:.2g} times the length would do"
        if factor < 1e3
        else ""
    )
    return "; ".join([*advice, *([more] if more else [])])


def _frequencies(values: Mapping[str, float], band_hz: tuple[float, float, float]) -> dict[str, float]:
    """Frequencies at which the parameters show, Hz, within what a record can hold, and the coil's settling time, s."""
    first, lowest, last = band_hz
    v = {k: max(abs(x), 1e-300) for k, x in values.items()}
    stiff = np.sqrt(v["k_x"] / v["m"]) / (2 * np.pi) if {"k_x", "m"} <= v.keys() else lowest
    coupled = np.sqrt(v["k_i"] ** 2 / (v["m"] * v["L"])) / (2 * np.pi) if {"k_i", "m", "L"} <= v.keys() else stiff
    corner = v["R"] / v["L"] / (2 * np.pi) if {"R", "L"} <= v.keys() else stiff
    held = {"low": min(stiff, lowest) / 3, "mid": max(coupled, stiff), "corner": corner}
    within = {name: float(np.clip(f, first, last)) for name, f in held.items()}
    return {**within, "settle": 5 / (2 * np.pi * within["corner"])}
