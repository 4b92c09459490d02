"""Why a controller went to its safe state, in words, and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

from ambid.acquire.device import DeviceEvent
from ambid.acquire.protocol.table import table

_REMEDY: Mapping[str, str] = MappingProxyType(
    {
        "overrun": "Lower daq.rate_hz",
        "host_silent": "Free the machine, or raise daq.host_ms",
        "over_current": "Excite less, look at the coil, or widen daq.trip.current if the coil bears it",
        "out_of_gap": "Change the gains of [loop], excite less, or look at sensor and daq.trip.position",
        "interlock": "Close the loop: cable, emergency stop",
        "line_break": "Look at the cable",
        "self_test": "See what the self-test names",
        "watchdog": "Look at the supply, and at the firmware's build",
    }
)
"""What to do about each cause of `messages.toml`."""


_AT_ONCE_MS = 10  # after the time to lift


def fault_words(fault: DeviceEvent, *, rate_hz: float = math.nan, lift_ms: int = 0) -> str:
    """Write a fault for people: cause, what it means, where, and what to do.

    `fault`: of kind ``fault``. Returns one sentence with its remedy, without a full stop.
    """
    about = {entry.name: entry.about for entry in table().enums["cause"]}.get(fault.what)
    at = "" if fault.sample is None else f" at sample {fault.sample}"
    meaning = "" if about is None else f", {about}"
    remedy = _REMEDY.get(fault.what, "See to the cause")
    lifted = (lift_ms + _AT_ONCE_MS) * rate_hz / 1e3  # a rate that is not known compares false
    if fault.what == "out_of_gap" and fault.sample is not None and fault.sample <= lifted:
        remedy = f"The rotor was not up when daq.lift_ms = {lift_ms} was over: raise it, or change the gains of [loop]"
    return f"{fault.what}{meaning}{at}. {remedy}"
