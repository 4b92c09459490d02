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

    Parameters
    ----------
    port : str
        Such as ``/dev/ttyACM0`` or ``COM3``.
    rig : Rig
        With ``[daq]`` and calibrations from counts.
    baud : int, optional
        Bits per second; default daq.baud.
    boot_s : float, optional
        How long a board takes that resets when its port is opened, s; default 2, none for a pseudo-terminal.
    real : bool
        Whether the controller's time runs with the host's: not on an emulator that goes as fast as it can.
    answer_s : float
        How long to wait for an answer before a command is sent again, s.
    room : int
        Samples that wait for a reader at most.

    Raises
    ------
    RigError
        If the rig does not say what the controller needs.
    DeviceError
        If the controller has no such rate.
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
