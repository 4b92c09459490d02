"""A rig as `ambid simulate` takes one: the plant's numbers and a loop, and not a word of counts."""

from ambid.rig import rig_from_text
from tests.acquisition.rigs import PROTOTYPE


def bare_rig():
    """The prototype without calibrations and without [daq]."""
    head, rest = PROTOTYPE.split("[channels.voltage]")
    plant = rest[rest.index("[parameters]") : rest.index("[daq]")]
    return rig_from_text(head + plant + "[record]\nrate_hz = 2000.0\n", "bare.toml")
