"""Benches for the jobs with a device: the prototype in this process, and ways in which it goes wrong."""

from dataclasses import replace
from pathlib import Path

from ambid.acquisition.device import DeviceEvent, SelfTest
from ambid.acquisition.devices.simulated import SimulatedDevice
from ambid.errors import DeviceError
from ambid.physics.presets import preset
from ambid.rig import load_rig, rig_from_text

PROTOTYPE_FILE = Path(__file__).parents[2] / "src" / "ambid" / "data" / "prototype.toml"
POSITION, CURRENT, DUTY, EXCITATION = range(4)  # columns of its blocks, counts

PLAIN = """schema = "ambid.rig/1"
name = "plain"
model = "one-axis"
[channels.voltage]
column = "voltage"
[channels.current]
column = "current"
[channels.position]
column = "position"
[parameters]
m = { value = 0.3, unit = "kg" }
k_x = { value = -6702.0, unit = "N/m" }
k_i = { value = 20.1, unit = "N/A" }
R = { value = 6.0, unit = "ohm" }
L = { value = 80.3, unit = "mH" }
c = { value = 0.0, unit = "N s/m", role = "fixed" }
[loop]
kp = 1.94e4
ki = 7.85e4
kd = 92.6
kc = 33.8
derivative_cutoff_hz = 300.0
delay = 0.3
limits = { voltage = 11.4, current = 1.0, position = 1e-3 }
[noise]
position = 2e-6
current = 2e-3
force = 0.01
"""
"""Without calibrations and without ``[daq]``: for a bench without hardware."""

COIL = """schema = "ambid.rig/1"
name = "coil"
model = "coil"
[channels.voltage]
column = "voltage"
[channels.current]
column = "current"
[parameters]
R = { value = 6.0, unit = "ohm" }
L = { value = 80.3, unit = "mH" }
[loop]
limits = { voltage = 11.4, current = 2.5 }
[noise]
current = 2e-3
[daq]
rate_hz = 2000.0
"""

THESIS = """schema = "ambid.rig/1"
name = "thesis"
model = "one-axis"
open_loop = true
[channels.voltage]
column = "voltage"
[channels.current]
column = "current"
[channels.position]
column = "position"
[parameters]
m = { value = 0.0976, unit = "kg" }
k_x = { value = 608.1, unit = "N/m" }
k_i = { value = -320.0, unit = "N/A" }
R = { value = 1.138, unit = "ohm" }
L = { value = 60.2, unit = "mH" }
[loop]
limits = { voltage = 1.0, current = 1.0, position = 1e-3 }
[noise]
position = 1e-6
current = 1e-4
[daq]
rate_hz = 2500.0
"""
"""Stable: nothing has to be levitated."""


def prototype(*changes):
    """The prototype's rig, with pieces of its text replaced; each has to be there."""
    if not changes:
        return load_rig(PROTOTYPE_FILE)
    text = PROTOTYPE_FILE.read_text(encoding="utf-8")
    for sound, changed in changes:
        assert sound in text, sound
        text = text.replace(sound, changed, 1)
    return rig_from_text(text, PROTOTYPE_FILE)


class Spoiled(SimulatedDevice):
    """The simulated bench with something wrong: what it samples, tells, or is.

    ``spoil(values, device)`` changes the counts of a block in place; ``lose(device)`` says whether a block is lost;
    ``before(device, mode)`` is called before each start. `starts` counts them, `lifts` those that levitate: hovering is
    the first, with an amplitude that is given one trial the second, then record, second record and tracking.
    """

    def __init__(self, rig, *, spoil=None, lose=None, before=None, **options):
        super().__init__(rig, **options)
        self.spoil, self.lose, self.before = spoil, lose, before
        self.starts, self.lifts, self.blocks, self.excited, self.failed = 0, 0, 0, False, ()
        self.missing = 0

    def self_test(self):
        found = super().self_test()
        return SelfTest(failed=self.failed or found.failed, numbers=found.numbers)

    def start(self, mode):
        self.starts, self.blocks, self.excited = self.starts + 1, 0, False
        self.lifts += mode == "levitate"
        if self.before is not None:
            self.before(self, mode)
        super().start(mode)

    def excite(self, program):
        self.excited = program is not None
        super().excite(program)

    def read(self, timeout_s):
        frame = super().read(timeout_s)
        if frame is None:
            return None
        self.blocks += 1
        if self.lose is not None and self.lose(self):
            n = len(frame.block.values)
            self.missing += n
            self._events.append(DeviceEvent(kind="lost", sample=frame.block.first, what="never came", count=n))
            return self.read(timeout_s)
        if self.spoil is None:
            return frame
        values = frame.block.values.copy()
        self.spoil(values, self)
        return replace(frame, block=replace(frame.block, values=values))

    def become(self, *changes):
        """From now on another bench: parameters of the linear or nonlinear plant, by factor."""
        from ambid.acquisition.devices.simulated import _plant_of

        plant = self._bench.plant
        plant = replace(plant, **{name: factor * getattr(plant, name) for name, factor in changes})
        self._bench = replace(self._bench, plant=plant)
        self._plant, _ = _plant_of(self._bench, self._settings)


class Silent(SimulatedDevice):
    """The line is lost after so many blocks that were passed on in a run with an excitation."""

    def __init__(self, rig, *, after, **options):
        super().__init__(rig, **options)
        self.left = after
        self.playing = False

    def excite(self, program):
        self.playing = program is not None and self.state == "levitating"
        super().excite(program)

    def read(self, timeout_s):
        if self.playing and timeout_s > 0:
            self.left -= 1
            if self.left < 0:
                raise DeviceError("the line is lost. Check the cable")
        return super().read(timeout_s)


def bench():
    """The truth behind the prototype."""
    return preset("prototype")
