"""A complete rig file and record for the tests of this folder."""

import pytest

RIG = """schema = "ambid.rig/1"
name = "ball"
model = "one-axis"
[channels.voltage]
column = "duty"
table = "table.csv"
delay = 2
[channels.current]
column = "coil"
gain = 0.5
offset = 0.1
[channels.position]
column = "gap"
unit = "um"
[parameters]
m = { value = 60.54, unit = "g", role = "fixed" }
k_x = { unit = "N/m" }
k_i = { value = -55.7, unit = "N/A" }
R = { value = 4.2, unit = "ohm", role = "prior", sd = 0.5 }
[operating_point]
position = { value = 10.0, unit = "mm" }
current = "auto"
[loop]
kind = "pid"
kp = 1.5e4
ki = 3
kd = 20.5
kc = 1
derivative_cutoff_hz = 2000.0
delay = 1.5
limits = { voltage = [0, 12], position = 4e-4 }
[noise]
position = 1e-6
force = 0.01
resolutions = { current = 0.005 }
[record]
rate_hz = 1000.0
gaps = "cut"
from = 2.0
to = 14.5
"""

TABLE = "duty [1],voltage [V]\n0,0\n0.5,5\n1,12\n"


@pytest.fixture
def rig_text():
    """Text of a rig file that uses every kind of entry."""
    return RIG


@pytest.fixture
def rig_file(tmp_path):
    """Return a function that writes a rig file beside its table and gives its path."""

    def write(text=RIG):
        (tmp_path / "table.csv").write_text(TABLE)
        path = tmp_path / "rig.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write
