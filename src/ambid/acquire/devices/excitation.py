"""An excitation in the controller's numbers: volts at the coil become counts of pulse width."""

from __future__ import annotations

from ambid.acquire.device import Program
from ambid.acquire.program import amplitude_counts
from ambid.acquire.protocol.table import table
from ambid.acquire.settings import ControllerSettings
from ambid.rig.rig import Rig


def counts_of(program: Program, rig: Rig, settings: ControllerSettings) -> dict[str, int]:
    """Return the fields of the message ``excitation``.

    `program`: amplitude in V; `rig`: with the calibration of its voltage; `settings`: of the device. Returns without
    ``id``.
    """
    amplitude = 0
    if program.kind != "none":
        amplitude = amplitude_counts(program, rig, settings.duty_bias, (settings.duty_low, settings.duty_high))
    return {
        "kind": table().value("kind", program.kind),
        "amplitude": amplitude,
        "hold": program.hold,
        "length": program.length,
        "cycles": program.cycles,
        "seed": program.seed,
    }
