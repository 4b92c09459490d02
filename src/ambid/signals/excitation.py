"""The excitations by name, as ``ambid simulate --excitation NAME`` and ``ambid acquire`` ask for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from functools import partial
from inspect import signature
from math import ceil, log2
from types import MappingProxyType

import numpy as np

from ambid.arrays import Array
from ambid.errors import AmbidError
from ambid.signals.multisine import multisine
from ambid.signals.waveforms import checked, checked_band, chirp, gaussian, prbs, steps


def _prbs_in_band(
    n_samples: int, rate_hz: float, *, band: tuple[float, float] | None = None, **options: object
) -> Array:
    """PRBS with its half-power frequency 0.44/tick at the top of the band and a line at its bottom or under."""
    if band is not None:
        low, high = checked_band(band, rate_hz)
        if {"hold", "bits"} & options.keys():
            raise AmbidError("prbs got a band and hold or bits; the band sets both. Give the band or them")
        hold = max(1, int(0.44 * rate_hz / high))
        options["hold"] = hold
        if low > 0.0:
            options["bits"] = max(2, ceil(log2(rate_hz / (hold * low) + 1.0)))
    return prbs(n_samples, rate_hz, **options)  # type: ignore[arg-type]


EXCITATIONS: Mapping[str, Callable[..., Array]] = MappingProxyType(
    {
        "steps": steps,
        "chirp": chirp,
        "prbs": _prbs_in_band,
        "gaussian": gaussian,
        "multisine": multisine,
        "schroeder": partial(multisine, phases="schroeder"),
    }
)
"""Excitations by name; each takes (n_samples, rate_hz, *, amplitude, ...)."""

_NEED_BAND = ("chirp", "multisine", "schroeder")


def excitation(
    name: str,
    n_samples: int,
    rate_hz: float,
    *,
    amplitude: float,
    band: tuple[float, float] | None = None,
    seed: int | np.random.Generator = 0,
    **options: object,
) -> Array:
    """Make an excitation by name.

    Parameters
    ----------
    name : str
        ``steps``, ``chirp``, ``prbs``, ``gaussian``, ``multisine`` or ``schroeder``.
    n_samples : int
        Samples.
    rate_hz : float
        Sampling rate in Hz.
    amplitude : float
        Peak (rms for ``gaussian``) in the unit of the result, unless the option ``amplitude_is`` says otherwise.
    band : (float, float), optional
        Band in Hz. Default: one period over the record to a fifth of the rate for chirp and multisines, all for prbs
        and gaussian. Steps have none: their option is ``hold_s``, an eighth of the duration by default.
    seed : int or numpy.random.Generator
        Source of randomness; the same seed gives the same samples. Steps and chirp have none.
    **options : object
        Further settings of that excitation.

    Returns
    -------
    ndarray, shape (n_samples,), unit of `amplitude`
        The excitation.

    Raises
    ------
    AmbidError
        If the name or an option is unknown (the message names the nearest), or a setting is out of range.
    """
    if name not in EXCITATIONS:
        near = get_close_matches(name, EXCITATIONS, n=1, cutoff=0.4)
        hint = f"Did you mean {near[0]!r}?" if near else "Give one of these"
        raise AmbidError(f"excitation {name!r} is unknown; there are {', '.join(EXCITATIONS)}. {hint}")
    checked(n_samples, rate_hz)
    known = _options(name)
    for option in options:
        if option not in known:
            near = get_close_matches(option, known, n=1, cutoff=0.4)
            hint = f"Did you mean {near[0]!r}?" if near else "Leave it out"
            raise AmbidError(f"excitation {name!r} has no option {option!r}; it has {', '.join(known)}. {hint}")
    settings: dict[str, object] = {"amplitude": amplitude, **options}
    if name == "steps":
        if band is not None:
            raise AmbidError("excitation 'steps' has no band. Leave the band out, or choose 'prbs' for steps in a band")
        settings.setdefault("hold_s", n_samples / rate_hz / 8.0)
    elif band is not None:
        settings["band"] = band
    elif name in _NEED_BAND:
        settings["band"] = (rate_hz / n_samples, rate_hz / 5.0)
    if name not in ("steps", "chirp"):
        settings["seed"] = seed
    return EXCITATIONS[name](n_samples, rate_hz, **settings)


def _options(name: str) -> list[str]:
    """Names of the options of an excitation beside those that `excitation` itself takes."""
    function = prbs if name == "prbs" else EXCITATIONS[name]
    taken = {"n_samples", "rate_hz", "amplitude", "band", "seed"} | ({"phases"} if name == "schroeder" else set())
    return [p for p in signature(function).parameters if p not in taken]
