"""A device by the word that a person gives for its port."""

from __future__ import annotations

from pathlib import Path

from ambid.acquire.device import Device
from ambid.acquire.devices.played import Pace
from ambid.errors import DeviceError
from ambid.physics.presets import Preset
from ambid.rig.rig import Rig

REPLAY = "replay:"
"""What a port begins with that is a record."""


def open_device(
    port: str,
    rig: Rig,
    *,
    bench: Preset | Rig | None = None,
    pace: Pace = "fastest",
    seed: int = 0,
    script: Path | None = None,
) -> Device:
    """Return the device that a port's name stands for, not yet opened: it is a context.

    Parameters
    ----------
    port : str
        ``emulated``, ``simulated``, ``replay:FILE``, else the name of a serial port.
    rig : Rig
        Of the bench.
    bench : Preset or Rig, optional
        The truth behind what is emulated or simulated; default what daq.bench names, else the rig's own numbers.
    pace : {"fastest", "real"}
        Of what is no hardware, which has its own.
    seed : int
        Of the noise of what is emulated or simulated.
    script : Path, optional
        What happens to an emulated bench meanwhile.

    Returns
    -------
    Device
        Not yet opened.

    Raises
    ------
    DeviceError
        If an option does not fit the device, or as the device's own constructor.
    RigError
        If the rig does not say what the device needs.
    """
    if script is not None and port != "emulated":
        raise DeviceError(f"a script is for port emulated; {port!r} has none. Leave it out")
    if bench is not None and port not in ("emulated", "simulated"):
        raise DeviceError(
            f"a bench is chosen for ports emulated and simulated; behind {port!r} stands its own. Leave it out"
        )
    if not port.strip():
        raise DeviceError("the port has no name. Give a serial port, or emulated, simulated, or replay:FILE")
    if port == "emulated":
        from ambid.acquire.devices.emulated import EmulatedDevice

        return EmulatedDevice(rig, bench=bench, pace=pace, seed=seed, script=script)
    if port == "simulated":
        from ambid.acquire.devices.simulated import SimulatedDevice

        return SimulatedDevice(rig, bench=bench, pace=pace, seed=seed)
    if port.startswith(REPLAY):
        from ambid.acquire.devices.replay import ReplayDevice

        name = port.removeprefix(REPLAY)
        if not name.strip():
            raise DeviceError(f"port {port!r} names no record. Give {REPLAY}FILE")
        return ReplayDevice(name, rig, pace=pace)
    from ambid.acquire.devices.serial_device import SerialDevice

    return SerialDevice(port, rig)
