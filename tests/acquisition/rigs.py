"""Rigs for the tests of settings: the prototype's bench with calibrations from counts, and ways to change it."""

from ambid.rig import Rig, rig_from_text

PROTOTYPE = """schema = "ambid.rig/1"
name = "prototype"
model = "one-axis"
[channels.voltage]
column = "duty"
gain = 0.03
offset = -12.0
[channels.current]
column = "coil"
gain = 2.44140625e-3
offset = -1.25
[channels.position]
column = "gap"
gain = 2.44140625e-6
offset = -1.25e-3
[parameters]
m = { value = 0.3, unit = "kg" }
k_x = { value = -6702.0, unit = "N/m" }
k_i = { value = 20.1, unit = "N/A" }
R = { value = 6.0, unit = "ohm" }
L = { value = 80.3, unit = "mH" }
[loop]
kp = 1.94e4
ki = 7.85e4
kd = 92.6
kc = 33.8
derivative_cutoff_hz = 300.0
delay = 0.3
limits = { voltage = 11.4, current = 1.0, position = 1e-3 }
[daq]
rate_hz = 2000.0
"""


def bench(*changes: tuple[str, str], text: str = PROTOTYPE, path="rig.toml") -> Rig:
    """Return the prototype's rig with pieces of its text replaced; each has to be there."""
    for sound, changed in changes:
        assert sound in text, sound
        text = text.replace(sound, changed, 1)
    return rig_from_text(text, path)
