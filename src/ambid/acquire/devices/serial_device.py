"""A controller on a serial port."""

from __future__ import annotations

from ambid.acquire.devices.frames import ROOM
from ambid.acquire.devices.line_device import LineDevice
from ambid.acquire.link.port import Port, open_port
from ambid.rig.rig import Rig


class SerialDevice(LineDevice):
    """The controller behind a serial port, or a pseudo-terminal that acts as one.

    Blocks hold counts. ``Block.time_s`` is sample number over rate, by the controller's clock; its drift against the
    host's is in the counters.

    `port`: such as ``/dev/ttyACM0`` or ``COM3``; `rig`: with ``[daq]`` and calibrations from counts; `baud`: bits per
    second; default daq.baud; `answer_s`: how long to wait for an answer before a command is sent again, s; `room`:
    samples that wait for a reader at most.
    """

    def __init__(
        self,
        port: str,
        rig: Rig,
        *,
        baud: int | None = None,
        boot_s: float | None = None,
        real: bool = True,
        answer_s: float = 0.3,
        room: int = ROOM,
    ) -> None:
        super().__init__(rig, kind="serial", where=port, real=real, answer_s=answer_s, room=room)
        assert rig.daq is not None  # else the settings were refused
        self._port, self._baud, self._boot_s = port, baud or rig.daq.baud, boot_s

    def _open(self) -> Port:
        return open_port(self._port, baud=self._baud, boot_s=self._boot_s)
