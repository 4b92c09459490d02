"""The way from a controller to a record: wire protocol, devices, recorder."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.acquire.device import Device as Device
    from ambid.acquire.program import expected as expected
    from ambid.acquire.recorder import read_acquisition as read_acquisition
    from ambid.acquire.recording import acquire as acquire

__getattr__, __dir__, __all__ = exports(__name__)
