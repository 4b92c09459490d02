"""Which experiment would show what a record does not?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ambid.identify.uncertainty import WEAK, Uncertainty

_ADVICE = {
    "k_x": "k_x shows where the displacement force counts: excite more at low frequency (from {low:.2g} Hz), or larger",
    "k_i": "k_i shows in the motional voltage and in the force: excite larger motion near {mid:.3g} Hz",
    "m": "m shows in the acceleration: excite up to {mid:.3g} Hz and beyond, larger",
    "R": "R shows in slow currents: add steps of the voltage that are held for {settle:.2g} s or longer",
    "L": "L shows in fast changes of the current: excite around {corner:.3g} Hz and above",
    "c": "c shows near the mechanical resonance: excite around {low:.3g} Hz",
}


def experiment_hint(u: Uncertainty, values: Mapping[str, float], lowest_hz: float, *, robust: bool) -> str | None:
    """Say which experiment would show the weakest direction.

    Parameters
    ----------
    u : Uncertainty
    values : Mapping[str, float]
        All parameters, SI.
    lowest_hz : float
        Lowest frequency at which the input now has power.
    robust : bool
        Which standard deviations count.

    Returns
    -------
    str or None
        None where everything is identifiable.
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
    frequencies = _frequencies(values, lowest_hz)
    advice = [_ADVICE[name].format(**frequencies) for name in unseen if name in _ADVICE]
    worst = float(max(u.relative_sd(robust=robust)))
    factor = worst / WEAK
    more = (
        f"with the same band, {factor:.2g} times the amplitude or {factor**2:.2g} times the length would do"
        if factor < 1e3
        else ""
    )
    return "; ".join([*advice, *([more] if more else [])])


def _frequencies(values: Mapping[str, float], lowest_hz: float) -> dict[str, float]:
    """Frequencies at which the parameters show, Hz, and the coil's settling time, s."""
    v = {k: abs(x) for k, x in values.items()}
    low = np.sqrt(v.get("k_x", 0.0) / v["m"]) / (2 * np.pi) if v.get("m") else lowest_hz
    coupled = (
        np.sqrt(v["k_i"] ** 2 / (v["m"] * v["L"])) / (2 * np.pi) if v.get("m") and v.get("L") and "k_i" in v else low
    )
    corner = v["R"] / v["L"] / (2 * np.pi) if v.get("L") and "R" in v else low
    return {
        "low": float(min(low, lowest_hz) / 3 if lowest_hz > 0 else low / 3),
        "mid": float(max(coupled, low)),
        "corner": float(max(corner, 1e-9)),
        "settle": float(5 / (2 * np.pi * max(corner, 1e-9))),
    }
