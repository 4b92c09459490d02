"""The accepted numbers as an operator reads them: SI values with standard deviations, stale ones marked."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ambid.recursive.lines import TrackedValue
from ambid.track.physical.numbers import Kind, TrackedNumbers
from ambid.track.physical.synchronous import amplitude_and_phase
from ambid.track.supervise.comparison import Accepted


def published(
    numbers: TrackedNumbers, accepted: Accepted, kind: Kind, fresh: Mapping[str, bool]
) -> dict[str, TrackedValue]:
    """Return the accepted numbers of one kind.

    Returns SI.
    """
    sd = np.sqrt(np.diag(accepted.covariance)) * numbers.magnitude
    values = accepted.values * numbers.magnitude
    return {
        numbers.names[j]: TrackedValue(
            value=float(values[j]), sd=float(sd[j]), stale=not fresh.get(numbers.names[j], True)
        )
        for j in numbers.places(kind)
    }


def beside(
    numbers: TrackedNumbers, accepted: Accepted, active: NDArray[np.bool_], *, stale: bool = False
) -> dict[str, TrackedValue]:
    """Return what is tracked beside the parameters: gains of sensors that were found to have changed, unbalance.

    `active`: (p,), which numbers the recursion may move; `stale`: whether they are no longer informed, or known to be
    no longer right. Returns SI; the unbalance in kg m, its phase in rad.
    """
    gains = tuple(numbers.names[j] for j in numbers.places("gain") if active[j])
    if not gains and not numbers.synchronous:
        return {}
    found = published(numbers, accepted, "gain", dict.fromkeys(gains, not stale))
    found = {name: found[name] for name in gains}
    if not numbers.synchronous:
        return found
    at = numbers.places("unbalance")
    size = numbers.magnitude[at]
    a, b = (accepted.values[at] * size).tolist()
    amplitude, sd, phase, phase_sd = amplitude_and_phase(
        a, b, accepted.covariance[np.ix_(at, at)] * np.outer(size, size)
    )
    return {
        **found,
        "unbalance": TrackedValue(value=amplitude, sd=sd, stale=stale),
        "unbalance_phase": TrackedValue(value=phase, sd=phase_sd, stale=stale),
    }
