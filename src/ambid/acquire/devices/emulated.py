"""The very firmware, run by an emulator before a simulated bearing, behind an ordinary serial port."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from ambid.acquire.default_daq import with_default_daq
from ambid.acquire.devices.emulator import Emulator
from ambid.acquire.devices.frames import ROOM
from ambid.acquire.devices.line_device import LineDevice
from ambid.acquire.devices.plant_file import TemporaryFolder, write_plant_file
from ambid.acquire.devices.played import Pace
from ambid.acquire.link.port import Port, PortEnded, open_port
from ambid.errors import DeviceError
from ambid.physics.presets import Preset
from ambid.rig.rig import Rig

_ANSWER_S = 2.0  # a busy machine may hold the emulator up
_UNREAD_S = 0.25  # of the controller's time
_LOOK_S = 0.001
_GONE_S = 1.0  # between the end of a line and that of its program


class _EmulatedPort:
    """A port from which nothing is taken while nobody wants it, and that says how the bench behind it ended."""

    def __init__(self, port: Port, emulator: Emulator, paused: Callable[[], bool]) -> None:
        self._port, self._emulator, self._paused = port, emulator, paused

    @property
    def name(self) -> str:
        return self._port.name

    def read(self) -> bytes:
        if self._paused():
            time.sleep(_LOOK_S)
            return b""
        try:
            return self._port.read()
        except OSError as failure:
            raise self._why(failure) from None

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except OSError as failure:
            raise self._why(failure) from None

    def _why(self, failure: OSError) -> OSError:
        how = self._emulator.ended(_GONE_S)
        return failure if how is None else PortEnded(f"the emulated bench ended {how}. Start again")

    def close(self) -> None:
        self._port.close()


class EmulatedDevice(LineDevice):
    """The firmware in an emulated controller. Everything but the copper is real: binary, converter, line, protocol.

    As fast as possible, its time is not the host's: it waits for a host that says nothing, and for a reader who left a
    quarter of a second unread, and no drift is told.

    `bench`: the truth; default what daq.bench names, else the rig's own numbers; `seed`: of the noise; `script`: what
    happens to bench and line meanwhile, see `Emulator`; `folder`: where the emulator's files go and stay; default a
    temporary one; `trajectory`: write the bench's true motion into the folder; `room`: samples that wait for a reader
    at most.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        bench: Preset | Rig | None = None,
        pace: Pace = "fastest",
        seed: int = 0,
        script: str | Path | None = None,
        folder: Path | None = None,
        trajectory: bool = False,
        room: int = ROOM,
    ) -> None:
        if pace not in ("real", "fastest"):
            raise DeviceError(f"pace is {pace!r}; a device goes in 'real' time or 'fastest'. Give one of them")
        full = with_default_daq(rig)
        si = any(rig.channel(c.role).calibration is None and c.calibration is not None for c in full.channels)
        super().__init__(
            full, kind="emulated", where="emulated", si=si, real=pace == "real", answer_s=_ANSWER_S, room=room
        )
        self._bench, self._pace, self._seed, self._script = bench, pace, seed, script
        self._kept, self._trajectory = folder, trajectory
        self._temporary: TemporaryFolder | None = None
        self._emulator: Emulator | None = None

    @property
    def emulator(self) -> Emulator | None:
        """The process, while the device is open: its log says what happened at the bench."""
        return self._emulator

    def _open(self) -> Port:
        folder = self._kept
        if folder is None:
            self._temporary = TemporaryFolder()
            folder = self._temporary.path
        folder.mkdir(parents=True, exist_ok=True)
        plant = folder / "plant.txt"
        write_plant_file(plant, self._rig, bench=self._bench)
        self._emulator = Emulator(
            plant,
            script=self._script,
            pace=self._pace,
            seed=self._seed,
            folder=folder,
            trajectory=self._trajectory,
        )
        self._emulator.start()
        port = open_port(self._emulator.port, baud=self._baud, boot_s=0.0)
        return _EmulatedPort(port, self._emulator, self._paused)

    def _paused(self) -> bool:
        # Bytes that are not taken hold the emulator up. An answer that is waited for may stand behind them.
        controller = self._controller
        full = self._stream.frames.held > _UNREAD_S * self._info.rate_hz
        return not self._real and full and controller is not None and not controller.asking

    @property
    def _baud(self) -> int:
        return 1_000_000 if self._rig.daq is None else self._rig.daq.baud

    def _let_go(self) -> None:
        emulator, self._emulator = self._emulator, None
        if emulator is not None:
            emulator.close()
        temporary, self._temporary = self._temporary, None
        if temporary is not None:
            temporary.remove()
