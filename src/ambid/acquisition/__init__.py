"""The way from a controller to a record: wire protocol, devices, recorder."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.acquisition.device import Device as Device
    from ambid.acquisition.program import expected as expected
    from ambid.acquisition.recorder import read_acquisition as read_acquisition
    from ambid.acquisition.session import acquire as acquire

__getattr__, __dir__, __all__ = exports(__name__)
