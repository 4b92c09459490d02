"""Frequency responses from records: the choice of the method, `frf_periodic`, `frf_random` or `frf_local`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.signals.local_response import frf_local
from ambid.signals.periodic_response import find_period, frf_periodic
from ambid.signals.random_response import frf_random
from ambid.signals.response import FrequencyResponse

Method = Literal["auto", "periodic", "random", "local"]


def frequency_response(
    u: Array | Sequence[Array],
    y: Array | Sequence[Array],
    rate_hz: float,
    *,
    r: Array | Sequence[Array] | None = None,
    method: Method = "auto",
    **options: object,
) -> FrequencyResponse:
    """Measure a frequency response by a named method, or by the one that the data allow.

    Parameters
    ----------
    u, y : ndarray, shape (n_samples, n_u) and (n_samples, n_y), or a sequence of them
        Inputs and outputs; a sequence holds the experiments of a periodic excitation.
    rate_hz : float
        Sampling rate in Hz.
    r : ndarray, shape (n_samples, n_r), or a sequence of them, optional
        References of a closed loop.
    method : {"auto", "periodic", "random", "local"}
        "auto" takes `frf_periodic` for several experiments, a given period, or an excitation (r, or u without it) of
        one input that repeats at least twice; else `frf_local`. What was taken is in the result's `method`.
    **options
        Passed on to the method; all know `open_loop`, `hold`, `inputs`, `outputs` and `units`.

    Returns
    -------
    FrequencyResponse
        The estimate.

    Raises
    ------
    EstimationError
        If the method is unknown, several experiments are given to a method of one, or the method refuses the data.
    """
    several = not isinstance(u, np.ndarray)
    if method == "auto":
        periodic = several or "period" in options or "lines" in options or repeats(u if r is None else r)
        method = "periodic" if periodic else "local"
    if method == "periodic":
        return frf_periodic(u, y, rate_hz, r=r, **options)  # type: ignore[arg-type]
    if method not in ("random", "local"):
        raise EstimationError(
            f"frequency response by method {method!r}; it must be 'auto', 'periodic', 'random' or 'local'. Give one"
        )
    if several:
        raise EstimationError(f"method {method!r} takes one record, not several. Give one, or use method 'periodic'")
    taken = frf_random if method == "random" else frf_local
    return taken(u, y, rate_hz, r=r, **options)  # type: ignore[arg-type]


def repeats(x: object) -> bool:
    """Tell whether one excitation repeats at least twice.

    `x`: more than one column never does, nor does a constant.
    """
    excitation = np.asarray(x, dtype=np.float64)
    if (excitation.ndim == 2 and excitation.shape[1] > 1) or np.ptp(excitation) == 0.0:
        return False
    try:
        return bool(2 * find_period(excitation) <= excitation.shape[0])
    except EstimationError:
        return False
