"""Devices: what stands at the other end of a port, and the one that a port's name stands for."""

from __future__ import annotations

from ambid.acquisition.device import Device
from ambid.acquisition.devices.played import Pace, ReplayDevice
from ambid.errors import DeviceError
from ambid.physics.presets import Preset
from ambid.rig.rig import Rig
from ambid.settings.caller import command

REPLAY = "replay:"
"""What a port begins with that is a record."""


def open_device(
    port: str,
    rig: Rig,
    *,
    bench: Preset | Rig | None = None,
    pace: Pace = "fastest",
    seed: int = 0,
) -> Device:
    """Return the device, a context not yet opened, of a port's name: ``emulated``, ``simulated``, ``replay:FILE``, else
    of a serial port; `pace` is of what is no hardware, which has its own, `seed` of the noise of what is emulated or
    simulated.
    """
    if rig.rotor is not None and port != "simulated" and not port.startswith(REPLAY):
        making = command("simulate", "RIG", excitation="zippered", excitation_only=True, out="FILE.csv")
        raise DeviceError(
            f"rig {rig.name!r} has {len(rig.rotor.axes)} axes; this controller drives one. Choose port simulated, or "
            f"write the excitation by '{making}', play it on the rotor's own controllers, and give their record to "
            "'ambid identify' or 'ambid track', or replay it"
        )
    if bench is not None and port not in ("emulated", "simulated"):
        raise DeviceError(f"a bench is chosen for ports emulated and simulated only; {port!r} has its own. Omit it")
    if not port.strip():
        raise DeviceError("the port has no name. Give a serial port, or emulated, simulated, or replay:FILE")
    if port == "emulated":
        from ambid.acquisition.devices.emulated import EmulatedDevice

        return EmulatedDevice(rig, bench=bench, pace=pace, seed=seed)
    if port == "simulated" and rig.rotor is not None:
        from ambid.acquisition.devices.rotor import RotorDevice

        return RotorDevice(rig, bench=bench, pace=pace, seed=seed)
    if port == "simulated":
        from ambid.acquisition.devices.simulated import SimulatedDevice

        return SimulatedDevice(rig, bench=bench, pace=pace, seed=seed)
    if port.startswith(REPLAY):
        name = port.removeprefix(REPLAY)
        if not name.strip():
            raise DeviceError(f"port {port!r} names no record. Give {REPLAY}FILE")
        return ReplayDevice(name, rig, pace=pace)
    from ambid.acquisition.devices.line_device import SerialDevice

    return SerialDevice(port, rig)
