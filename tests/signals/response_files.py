"""Frequency responses of a levitated axis, and files of them as analysers write them."""

import numpy as np

from ambid.bearing.physical_target import physical_response
from ambid.physics.linear_model import model
from ambid.physics.presets import preset

TRUTH = preset("unstable-bearing").parameters
F = np.arange(2.0, 400.0, 2.0)


def plant(name="one-axis", f=F):
    """The exact response, (n_f, n_y)."""
    m = model(name)
    theta = {p.name: TRUTH[p.name] for p in m.parameters}
    return physical_response(m, theta, 2 * np.pi * f, dt=None, delay_s=0.0, along=())[0][:, :, 0]


def noisy(G, share, seed=1):
    """The response with complex errors of so much of |G|."""
    rng = np.random.default_rng(seed)
    return G + share * np.abs(G) * (rng.standard_normal(G.shape) + 1j * rng.standard_normal(G.shape)) / np.sqrt(2)


def uff(functions, *, double=True, even=True):
    """Bytes of a universal file; `functions`: of (kind, output node, input node, f, values, units)."""
    return b"".join(_dataset(*one, double, even) for one in functions)


def _dataset(kind, response, reference, f, values, units, double, even):
    complex_ = np.iscomplexobj(values)
    form = (6 if double else 5) if complex_ else (4 if double else 2)
    columns = [values.real, values.imag] if complex_ else [values]
    flat = np.column_stack([*([] if even else [f]), *columns]).ravel()
    body = "".join(f"{x:20.11e}" + "\n" * (k % 4 == 3) for k, x in enumerate(flat)).encode() + b"\n"
    axes = [(18, "Hz"), (8, units[0]), (13, units[1]), (0, "NONE")]
    lines = [
        "    58", *["made by a test"] * 5,
        f"{kind:5d}{0:10d}{0:5d}{0:10d} {'NONE':10s}{response:10d}{3:4d} {'NONE':10s}{reference:10d}{3:4d}",
        f"{form:10d}{f.size:10d}{int(even):10d}{f[0] if even else 0:13.5e}{f[1] - f[0] if even else 0:13.5e}{0:13.5e}",
        *[f"{code:10d}    0    0    0 {'NONE':20s} {text:20s}" for code, text in axes],
    ]  # fmt: skip
    return b"    -1\n" + "\n".join(f"{x:80s}" for x in lines).encode() + b"\n" + body + b"    -1\n"


def units_164(system):
    """Dataset 164: the system of units."""
    return f"    -1\n   164\n{system:10d}{'SI':20s}{1:10d}\n    -1\n".encode()
