"""An excitation in the controller's numbers: volts at the coil become counts of pulse width."""

from __future__ import annotations

from ambid.acquire.device import Program
from ambid.acquire.protocol.table import table
from ambid.acquire.scales import scale_of
from ambid.acquire.settings import ControllerSettings
from ambid.errors import DeviceError
from ambid.rig.rig import Rig


def counts_of(program: Program, rig: Rig, settings: ControllerSettings) -> dict[str, int]:
    """Return the fields of the message ``excitation``.

    Parameters
    ----------
    program : Program
        Amplitude in V.
    rig : Rig
        With the calibration of its voltage.
    settings : ControllerSettings
        Of the device.

    Returns
    -------
    dict of str to int
        Without ``id``.

    Raises
    ------
    DeviceError
        If the amplitude is less than a count, or the pulse width has no room for it.
    """
    slope = abs(scale_of(rig, "voltage").slope(settings.duty_bias))
    amplitude = round(program.amplitude / slope)
    room = settings.duty_high - settings.duty_low
    if program.kind != "none" and not 1 <= amplitude <= room:
        raise DeviceError(
            f"an excitation of {program.amplitude:g} V is {amplitude} counts of pulse width; the controller takes 1 to"
            f" {room}, i.e. {slope:.3g} to {slope * room:.3g} V. Give another amplitude"
        )
    return {
        "kind": table().value("kind", program.kind),
        "amplitude": amplitude,
        "hold": program.hold,
        "length": program.length,
        "cycles": program.cycles,
        "seed": program.seed,
    }
